"""The typed client: every method against a running service, and every way an answer can fail."""

from collections.abc import Callable, Iterator

import httpx
import pytest

from app import problems
from app.client import Client, ClientError, ProblemAnswer, ServiceUnreachable, grid_of
from app.errors import NotReady
from app.flight_intents import State
from app.times import now_ms
from planner.errors import Block
from tests.cli.serving import serving
from tests.cli.town import AIRCRAFT, GRID, LINK_MS, OCCUPIED, along_row, flight, place, town_airspace

HOUR_MS = 3_600_000

Answer = Callable[[httpx.Request], httpx.Response]


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    folder = tmp_path_factory.mktemp("client")
    airspace = town_airspace(folder)
    with serving(folder, "--airspace", str(airspace)) as server, Client(server.url) as client:
        yield client


@pytest.fixture
def later() -> int:
    """An hour from now, in ms."""
    return now_ms() + HOUR_MS


def answering(answer: Answer) -> Client:
    """Return a client whose service answers like this."""
    return Client("http://127.0.0.1", transport=httpx.MockTransport(answer))


def test_a_submitted_flight_comes_back_planned(town: Client, later: int) -> None:
    intent = town.submit(along_row(0, 0, later, reference="ORD-1"))
    assert (intent.state, intent.operator, intent.reference) == ("accepted", "acme-air", "ORD-1")
    assert (intent.aircraft_type, intent.priority, intent.refusal) == (AIRCRAFT, 0, None)
    assert (intent.earliest_departure, intent.latest_departure) == (later, later + 300_000)
    assert (intent.departure, intent.arrival) == (later, later + 9 * LINK_MS)
    assert (intent.flight_time_s, intent.ground_hold_s, intent.hover_s, intent.delay_s) == (16.668, 0.0, 0.0, 0.0)
    assert [stop.block for stop in intent.trajectory] == [(i, 0, 0) for i in range(10)]
    assert [stop.arrive for stop in intent.trajectory] == [later + i * LINK_MS for i in range(10)]
    assert [hold.block for hold in intent.reservations] == [(i, 0, 0) for i in range(10)]
    assert (intent.reservations[1].enter, intent.reservations[1].exit) == (later, later + 2 * LINK_MS + 1)
    assert intent.origin.block == (0, 0, 0)
    assert (intent.origin.lon, intent.origin.lat, intent.origin.alt_m) == pytest.approx(place((0, 0, 0)), abs=1e-9)


def test_a_submitted_flight_can_be_read_again(town: Client, later: int) -> None:
    intent = town.submit(along_row(1, 0, later))
    assert town.flight_intent(intent.id) == intent


def test_one_idempotency_key_makes_one_flight(town: Client, later: int) -> None:
    body = along_row(2, 0, later)
    first = town.submit(body, idempotency_key="once")
    assert town.submit(body, idempotency_key="once") == first
    assert town.submit(body).sequence == first.sequence + 1


def test_an_idempotency_key_with_another_body_is_a_problem(town: Client, later: int) -> None:
    town.submit(along_row(3, 0, later), idempotency_key="twice")
    with pytest.raises(ProblemAnswer) as problem:
        town.submit(along_row(3, 0, later + 1), idempotency_key="twice")
    assert (problem.value.status, problem.value.reason) == (422, "idempotency-key-reused")


def test_a_preview_is_planned_and_not_recorded(town: Client, later: int) -> None:
    revision = town.readiness().revision
    preview = town.preview(along_row(5, 0, later))
    assert preview.state == "preview"
    assert (preview.departure, preview.arrival) == (later, later + 9 * LINK_MS)
    assert len(preview.reservations) == 10
    assert town.readiness().revision == revision


def test_a_cancelled_flight_holds_nothing(town: Client, later: int) -> None:
    intent = town.submit(along_row(6, 0, later))
    cancelled = town.cancel(intent.id)
    assert (cancelled.id, cancelled.state, cancelled.reservations) == (intent.id, "cancelled", [])
    assert int(cancelled.version) > int(intent.version)
    assert town.flight_intent(intent.id) == cancelled


def test_flights_are_listed_by_sequence_over_all_pages(town: Client, later: int) -> None:
    # One more than two pages of fifty.
    made = [town.submit(along_row(j % 4, 1, later + j * 60_000, operator="pages")).id for j in range(101)]
    listed = list(town.flight_intents(operator="pages"))
    assert [intent.id for intent in listed] == made
    assert [intent.sequence for intent in listed] == sorted(intent.sequence for intent in listed)


def test_flights_are_listed_by_state_and_operator(town: Client, later: int) -> None:
    kept = town.submit(along_row(7, 1, later, operator="states"))
    gone = town.cancel(town.submit(along_row(8, 1, later, operator="states")).id)
    assert [intent.id for intent in town.flight_intents("states", State.ACCEPTED)] == [kept.id]
    assert list(town.flight_intents("states", State.CANCELLED)) == [gone]
    assert list(town.flight_intents("states", State.REJECTED)) == []
    assert list(town.flight_intents("nobody")) == []


def test_the_airspace_describes_its_grid(town: Client) -> None:
    airspace = town.airspace()
    assert (airspace.id, airspace.name, airspace.crs) == ("town", "town", "EPSG:32642")
    assert airspace.statically_occupied == [2, 1, 0]
    assert (airspace.occupancy_rule, airspace.search) == ("containment", "safe-interval")
    assert grid_of(airspace) == GRID


def test_the_statically_occupied_blocks_are_listed(town: Client) -> None:
    assert sorted(town.static_blocks().blocks) == sorted(OCCUPIED)


def test_the_aircraft_types_are_listed(town: Client) -> None:
    types = {item.id: item for item in town.aircraft_types()}
    assert len(types) == 5
    assert types[AIRCRAFT].link_speeds_mps.horizontal == 18.0
    assert types[AIRCRAFT].planned_link_speeds_mps.horizontal == pytest.approx(10.8)


def test_the_status_lists_the_blocks_in_use_at_a_time(town: Client, later: int) -> None:
    alone = later + 24 * HOUR_MS
    intent = town.submit(along_row(9, 2, alone))
    status = town.status(at_ms=alone)
    assert status.at == alone
    # On its first link the flight holds both ends.
    assert [(block.block, block.status.value, block.flight_intents) for block in status.blocks] == [
        ((0, 9, 2), "green", [intent.id]),
        ((1, 9, 2), "green", [intent.id]),
    ]


def test_the_status_is_of_now_by_default(town: Client) -> None:
    before = now_ms()
    assert before <= town.status().at <= now_ms()


def test_the_journal_continues_after_a_revision(town: Client, later: int) -> None:
    revision = town.readiness().revision or 0
    intent = town.submit(along_row(8, 2, later))
    town.cancel(intent.id)
    page = town.events(after=revision)
    assert [(event.revision, event.kind, event.flight_intent_id) for event in page.items] == [
        (revision + 1, "accepted", intent.id),
        (revision + 2, "cancelled", intent.id),
    ]
    assert page.next_cursor is None


def test_a_ready_service_says_so(town: Client) -> None:
    readiness = town.readiness()
    assert (readiness.status, readiness.mode, readiness.waiting) == ("ready", "read-write", 0)


def test_a_recorded_refusal_is_a_problem_with_its_members(town: Client, later: int) -> None:
    first = town.submit(flight((0, 7, 2), (9, 7, 2), later))
    with pytest.raises(ProblemAnswer, match=r"^409 Traffic or closed airspace leaves no plan: ") as problem:
        town.submit(flight((0, 7, 2), (9, 7, 2), later + 1, later + 1))
    assert (problem.value.status, problem.value.reason) == (409, "no_departure_slot")
    members = problem.value.members
    assert members["type"] == "/problems/no-conflict-free-plan"
    assert members["conflicting_intents"] == [first.id]
    assert members["sequence"] == first.sequence + 1
    refused = town.flight_intent(members["flight_intent_id"])
    assert (refused.state, refused.trajectory, refused.reservations) == ("rejected", [], [])
    assert refused.refusal is not None
    assert refused.refusal.reason == "no_departure_slot"


@pytest.mark.parametrize(
    ("origin", "destination", "reason", "nearest"),
    [
        ((4, 4, 0), (0, 0, 0), "origin_blocked", [3, 4, 0]),
        ((0, 0, 0), (0, 9, 0), "destination_blocked", [0, 8, 0]),
        ((5, 5, 0), (5, 5, 0), "same_block", None),
        ((-1, 5, 0), (5, 5, 0), "outside_airspace", None),
    ],
)
def test_a_flight_that_cannot_be_planned_is_a_problem_with_its_reason(
    town: Client, later: int, origin: Block, destination: Block, reason: str, nearest: list[int] | None
) -> None:
    with pytest.raises(ProblemAnswer) as problem:
        town.submit(flight(origin, destination, later))
    assert (problem.value.status, problem.value.reason) == (422, reason)
    assert problem.value.members["type"] == "/problems/not-plannable"
    assert problem.value.members.get("nearest_free_block") == nearest


def test_an_unknown_flight_is_a_problem_without_a_reason_of_its_own(town: Client) -> None:
    for ask in (town.flight_intent, town.cancel):
        with pytest.raises(ProblemAnswer) as problem:
            ask("nobody")
        assert str(problem.value) == "404 Unknown flight intent: there is no flight intent nobody"
        assert (problem.value.status, problem.value.reason) == (404, "unknown-flight-intent")


def test_an_unknown_aircraft_is_a_problem(town: Client, later: int) -> None:
    with pytest.raises(ProblemAnswer) as problem:
        town.submit(along_row(0, 0, later, aircraft_type="zeppelin"))
    assert (problem.value.status, problem.value.reason) == (422, "unknown-aircraft-type")


def test_a_service_that_is_not_there_is_unreachable() -> None:
    with (
        Client("http://127.0.0.1:9") as client,
        pytest.raises(ServiceUnreachable, match=r"^no answer from http://127\.0\.0\.1:9: "),
    ):
        client.readiness()


def test_a_service_that_is_too_slow_is_unreachable() -> None:
    def never(request: httpx.Request) -> httpx.Response:
        raise httpx.ReadTimeout("", request=request)

    with pytest.raises(ServiceUnreachable, match=r"^no answer from http://127\.0\.0\.1: ReadTimeout$"):
        answering(never).airspace()


@pytest.mark.parametrize("url", ["nonsense", "ftp://127.0.0.1", "http://127.0.0.1:x"])
def test_an_address_that_is_none_is_a_client_error(url: str) -> None:
    with pytest.raises(ClientError):
        Client(url).readiness()


@pytest.mark.parametrize("text", ["<html>Bad gateway</html>", '["bad gateway"]', ""])
def test_an_error_that_is_no_problem_document_is_still_a_problem_answer(text: str) -> None:
    client = answering(lambda _: httpx.Response(502, text=text))
    with pytest.raises(ProblemAnswer) as problem:
        client.airspace()
    assert problem.value.status == 502
    assert problem.value.reason == "unknown"
    assert problem.value.members == {"title": "Bad Gateway", "detail": text}


@pytest.mark.parametrize("answer", [httpx.Response(200, text="<html>"), httpx.Response(200, json={"items": 7})])
def test_an_answer_of_another_shape_is_a_client_error(answer: httpx.Response) -> None:
    with pytest.raises(ClientError):
        answering(lambda _: answer).airspace()


def test_a_redirect_is_a_client_error() -> None:
    with pytest.raises(ClientError):
        answering(lambda _: httpx.Response(307, headers={"Location": "/elsewhere"})).airspace()


def test_a_service_that_is_not_ready_says_why() -> None:
    unready = problems.response_to(NotReady("the ledger writer has stopped", waiting=3))
    with pytest.raises(ProblemAnswer) as problem:
        answering(lambda _: httpx.Response(503, content=bytes(unready.body))).readiness()
    assert (problem.value.status, problem.value.reason) == (503, "the ledger writer has stopped")
    assert "the ledger writer has stopped" in str(problem.value)
