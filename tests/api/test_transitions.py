"""The states of a flight intent over HTTP: what operators may do when, and what ending a flight frees."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from app.main import create_app
from app.routes.answers import FlightIntentAnswer
from app.settings import Settings
from app.times import format_time, parse_time
from planner.errors import Block
from tests.api.bodies import SUBMIT, TELEMETRY, intent, position, problem, report
from tests.api.serving import Client, served, settings_for
from tests.api.test_running import settings_with
from tests.ledger.district import DEPARTURE_MS, STREET
from tests.ledger.locations import on_sqlite
from tests.ledger.process import FakeClock, assert_no_overlaps

NOBODY = "01a2025d-cf8d-7793-bfd6-fd7be76cdfea"
LINK_MS = 1668
ARRIVAL_MS = DEPARTURE_MS + 7 * LINK_MS
# Between the third and the fourth block: these two are held.
MIDWAY_MS = DEPARTURE_MS + 2 * LINK_MS + 500


@pytest.fixture
def on_street(ledger: str, tmp_path: Path) -> Settings:
    return settings_for(STREET, ledger, tmp_path)


@pytest.fixture
def street(on_street: Settings, clock: FakeClock) -> Iterator[Client]:
    """Return a client of a service over one street."""
    with served(create_app(on_street, clock, elapsed_ms=clock)) as client:
        yield client


@contextmanager
def second_process(on_street: Settings, clock: FakeClock) -> Iterator[Client]:
    """Serve the same ledger from a process that has an index of its own, with what is reserved now in it."""
    with served(create_app(on_street, clock, elapsed_ms=clock)) as client:
        yield client


def submit(client: Client, origin: str = "W", destination: str = "E", **members: Any) -> dict[str, Any]:
    answer: dict[str, Any] = client.post(SUBMIT, json=intent(origin, destination, district=STREET, **members)).json()
    return answer


def see(client: Client, flight: str, time_ms: int, place: Any = (0, 0, 0), *, airborne: bool | None = True) -> None:
    """Report where a flight's aircraft was."""
    where = position(place, time_ms, district=STREET, flight_intent_id=flight, airborne=airborne)
    assert client.post(TELEMETRY, json=report(where)).json()["accepted"] == 1


def state_of(client: Client, flight: str) -> str:
    return str(client.get(f"{SUBMIT}/{flight}").json()["state"])


def kinds(client: Client) -> list[str]:
    return [item["kind"] for item in client.get("/v1/events").json()["items"]]


def against(client: Client, clock: FakeClock) -> dict[str, Any]:
    """Submit a flight the other way, now or never; return its answer."""
    return submit(client, "E", "W", earliest_ms=clock.now_ms + 1, window_ms=0)


# What may be done in which state


def accepted(client: Client, _: FakeClock) -> str:
    return str(submit(client)["id"])


def rejected(client: Client, _: FakeClock) -> str:
    submit(client)
    return str(submit(client, window_ms=0)["flight_intent_id"])


def cancelled(client: Client, clock: FakeClock) -> str:
    flight = accepted(client, clock)
    client.delete(f"{SUBMIT}/{flight}")
    return flight


def activated(client: Client, clock: FakeClock) -> str:
    flight = accepted(client, clock)
    client.post(f"{SUBMIT}/{flight}/activate")
    return flight


def nonconforming(client: Client, clock: FakeClock) -> str:
    """Fly without having been activated."""
    flight = accepted(client, clock)
    clock.now_ms = DEPARTURE_MS
    see(client, flight, clock.now_ms)
    client.service.monitor.look()
    return flight


def contingent(client: Client, clock: FakeClock) -> str:
    """Fly, and be lost for longer than half a minute."""
    flight = nonconforming(client, clock)
    for seconds in (6, 30):
        clock.advance(seconds=seconds)
        client.service.monitor.look()
    return flight


def ended(client: Client, clock: FakeClock) -> str:
    flight = accepted(client, clock)
    client.post(f"{SUBMIT}/{flight}/end")
    return flight


STATES: dict[str, Callable[[Client, FakeClock], str]] = {
    "accepted": accepted, "rejected": rejected, "cancelled": cancelled, "activated": activated,
    "nonconforming": nonconforming, "contingent": contingent, "ended": ended,
}  # fmt: skip
LEGAL = {
    ("accepted", "activate"): "activated",
    ("activated", "activate"): "activated",
    ("nonconforming", "activate"): "nonconforming",
    ("accepted", "end"): "ended",
    ("activated", "end"): "ended",
    ("nonconforming", "end"): "ended",
    ("contingent", "end"): "ended",
    ("ended", "end"): "ended",
    ("accepted", "cancel"): "cancelled",
    ("cancelled", "cancel"): "cancelled",
}


def attempt(client: Client, flight: str, action: str) -> Any:
    if action == "cancel":
        return client.delete(f"{SUBMIT}/{flight}")
    return client.post(f"{SUBMIT}/{flight}/{action}")


@on_sqlite
@pytest.mark.parametrize("action", ["activate", "end", "cancel"])
@pytest.mark.parametrize("state", STATES)
def test_each_state_allows_exactly_these_actions(street: Client, clock: FakeClock, state: str, action: str) -> None:
    flight = STATES[state](street, clock)
    assert state_of(street, flight) == state
    before = street.get(f"{SUBMIT}/{flight}").json()
    response = attempt(street, flight, action)
    if (state, action) in LEGAL:
        assert (response.status_code, response.json()["state"]) == (200, LEGAL[state, action])
        assert street.get(f"{SUBMIT}/{flight}").json() == response.json()
    else:
        detail = problem(response, 409, "illegal-transition")["detail"]
        assert detail.startswith(f"flight intent {flight} is {state} and cannot be")
        assert street.get(f"{SUBMIT}/{flight}").json() == before


def test_activation_is_a_new_version_and_an_event(street: Client) -> None:
    flight = accepted(street, FakeClock())
    response = street.post(f"{SUBMIT}/{flight}/activate")
    answer = response.json()
    FlightIntentAnswer.model_validate(answer)
    assert (answer["version"], response.headers["etag"]) == ("2", '"2"')
    assert len(answer["reservations"]) == 8
    assert kinds(street) == ["accepted", "activated"]


@on_sqlite
@pytest.mark.parametrize("action", ["activate", "end", "cancel"])
def test_what_is_done_twice_is_done_once(street: Client, action: str) -> None:
    flight = accepted(street, FakeClock())
    first = attempt(street, flight, action)
    again = attempt(street, flight, action)
    assert (again.status_code, again.json()) == (200, first.json())
    assert len(kinds(street)) == 2


@on_sqlite
@pytest.mark.parametrize("action", ["activate", "end"])
@pytest.mark.parametrize("flight", [NOBODY, "ORD-7781", "0"])
def test_an_unknown_flight_has_no_states(street: Client, flight: str, action: str) -> None:
    problem(attempt(street, flight, action), 404, "unknown-flight-intent")


@on_sqlite
@pytest.mark.parametrize("action", ["activate", "end"])
def test_a_server_that_only_reads_changes_no_state(on_street: Settings, clock: FakeClock, action: str) -> None:
    with served(create_app(on_street, clock)) as client:
        flight = submit(client)["id"]
    with served(create_app(settings_with(on_street, read_only=True), clock)) as reader:
        problem(attempt(reader, flight, action), 421, "read-only")
        assert state_of(reader, flight) == "accepted"


@on_sqlite
@pytest.mark.parametrize("action", ["activate", "end"])
def test_a_service_whose_writer_has_stopped_changes_no_state(street: Client, action: str) -> None:
    flight = accepted(street, FakeClock())
    street.service.writer.stop()
    problem(attempt(street, flight, action), 503, "ledger-unavailable")


@on_sqlite
@pytest.mark.parametrize(("late_ms", "status"), [(0, 200), (1, 409)])
def test_a_flight_can_be_activated_until_it_should_have_arrived(
    street: Client, clock: FakeClock, late_ms: int, status: int
) -> None:
    flight = accepted(street, clock)
    clock.now_ms = ARRIVAL_MS + late_ms
    assert attempt(street, flight, "activate").status_code == status


def test_a_flight_activated_in_the_air_is_activated_as_soon_as_it_is_seen_to_conform(
    street: Client, clock: FakeClock
) -> None:
    flight = nonconforming(street, clock)
    assert street.post(f"{SUBMIT}/{flight}/activate").json()["state"] == "nonconforming"
    street.service.monitor.look()
    assert state_of(street, flight) == "activated"


def test_a_flight_is_activated_no_earlier_before_its_departure_than_is_allowed(
    on_street: Settings, clock: FakeClock
) -> None:
    with served(create_app(settings_with(on_street, activation_lead_s=30), clock, elapsed_ms=clock)) as client:
        flight = submit(client)["id"]
        clock.now_ms = DEPARTURE_MS - 30_001
        refusal = problem(client.post(f"{SUBMIT}/{flight}/activate"), 409, "illegal-transition")
        assert f"may be activated from {format_time(DEPARTURE_MS - 30_000)} on" in refusal["detail"]
        assert kinds(client) == ["accepted"]
        clock.now_ms += 1
        assert client.post(f"{SUBMIT}/{flight}/activate").json()["state"] == "activated"


@pytest.mark.parametrize(("later_ms", "state"), [(20_000, "activated"), (20_001, "accepted"), (600_000, "accepted")])
def test_an_activated_flight_that_is_put_off_for_longer_than_allowed_is_accepted_again(
    on_street: Settings, clock: FakeClock, later_ms: int, state: str
) -> None:
    with served(create_app(settings_with(on_street, activation_lead_s=30), clock, elapsed_ms=clock)) as client:
        flight = submit(client)["id"]
        clock.now_ms = DEPARTURE_MS - 10_000
        assert client.post(f"{SUBMIT}/{flight}/activate").status_code == 200
        later = intent("W", "E", district=STREET, earliest_ms=DEPARTURE_MS + later_ms)
        changed = client.request("PUT", f"{SUBMIT}/{flight}", json=later, headers={"If-Match": "*"}).json()
        assert (changed["state"], state_of(client, flight), kinds(client)[-1]) == (state, state, state)
        # It makes way again, and is activated when it is due.
        above = submit(client, "E", "W", earliest_ms=DEPARTURE_MS + later_ms, window_ms=0, priority=1)
        made_way = [each["flight_intent_id"] for each in above.get("displaced", [])]
        assert made_way == ([flight] if later_ms == 600_000 else [])
        clock.now_ms = parse_time(client.get(f"{SUBMIT}/{flight}").json()["trajectory"][0]["depart"])
        assert client.post(f"{SUBMIT}/{flight}/activate").json()["state"] == "activated"


# What ending a flight frees


@pytest.mark.parametrize("action", ["end", "cancel"])
def test_before_its_departure_a_flight_gives_up_all_it_holds(
    street: Client, on_street: Settings, clock: FakeClock, action: str
) -> None:
    with second_process(on_street, clock) as other:
        flight = accepted(street, clock)
        clock.now_ms = DEPARTURE_MS - 1
        assert attempt(street, flight, action).json()["reservations"] == []
        assert against(other, clock)["delay_s"] == 0.0
        assert "departure" not in against(street, clock)
    assert_no_overlaps(on_street.ledger)


@pytest.mark.parametrize("action", ["end", "cancel"])
def test_in_the_air_a_flight_keeps_what_it_holds_until_its_arrival(
    street: Client, on_street: Settings, clock: FakeClock, action: str
) -> None:
    with second_process(on_street, clock) as other:
        flight = submit(street)
        clock.now_ms = DEPARTURE_MS
        see(street, flight["id"], clock.now_ms)
        assert attempt(street, flight["id"], action).json()["reservations"] == flight["reservations"]
        for client in (street, other):
            assert "departure" not in against(client, clock)
        later = submit(other, "E", "W", earliest_ms=clock.now_ms)
    assert parse_time(later["departure"]) == ARRIVAL_MS + 1
    assert_no_overlaps(on_street.ledger)


@pytest.mark.parametrize("action", ["end", "cancel"])
def test_once_it_has_landed_a_flight_gives_up_what_lies_ahead(
    street: Client, on_street: Settings, clock: FakeClock, action: str
) -> None:
    with second_process(on_street, clock) as other:
        flight = submit(street)
        clock.now_ms = MIDWAY_MS
        see(street, flight["id"], clock.now_ms, (2, 0, 0), airborne=False)
        held = attempt(street, flight["id"], action).json()["reservations"]
        passed = [hold for hold in flight["reservations"] if parse_time(hold["enter"]) <= MIDWAY_MS]
        end = format_time(MIDWAY_MS + 1)
        assert held == [{**hold, "exit": min(hold["exit"], end)} for hold in passed]
        assert [hold["block"][0] for hold in held if hold["exit"] == end] == [2, 3]
        # Who starts in the same millisecond would still meet it.
        assert "departure" not in submit(other, "W", "E", earliest_ms=clock.now_ms - 3 * LINK_MS, window_ms=0)
        assert against(other, clock)["delay_s"] == 0.0
        assert "departure" not in against(street, clock)
    assert_no_overlaps(on_street.ledger)


@on_sqlite
def test_what_was_freed_can_be_had_in_the_process_that_freed_it(street: Client, clock: FakeClock) -> None:
    flight = submit(street)
    clock.now_ms = MIDWAY_MS
    see(street, flight["id"], clock.now_ms, (2, 0, 0), airborne=False)
    attempt(street, flight["id"], "end")
    assert against(street, clock)["delay_s"] == 0.0
    assert_no_overlaps(street.service.settings.ledger)


def test_a_process_that_starts_later_knows_what_was_freed(
    street: Client, on_street: Settings, clock: FakeClock
) -> None:
    flight = submit(street)
    clock.now_ms = MIDWAY_MS
    see(street, flight["id"], clock.now_ms, (2, 0, 0), airborne=False)
    attempt(street, flight["id"], "end")
    with second_process(on_street, clock) as other:
        assert against(other, clock)["delay_s"] == 0.0
    assert_no_overlaps(on_street.ledger)


@pytest.mark.parametrize("action", ["end", "cancel"])
def test_what_a_flight_kept_that_is_over_goes_when_it_is_down_and_the_request_is_repeated(
    street: Client, on_street: Settings, clock: FakeClock, action: str
) -> None:
    with second_process(on_street, clock) as other:
        flight = submit(street)
        clock.now_ms = DEPARTURE_MS
        see(street, flight["id"], clock.now_ms)
        kept = attempt(street, flight["id"], action).json()
        clock.now_ms = MIDWAY_MS
        assert attempt(other, flight["id"], action).json() == kept
        see(other, flight["id"], clock.now_ms, (2, 0, 0), airborne=False)
        freed = attempt(street, flight["id"], action).json()
        passed = [hold for hold in flight["reservations"] if parse_time(hold["enter"]) <= MIDWAY_MS]
        end = format_time(MIDWAY_MS + 1)
        assert freed["reservations"] == [{**hold, "exit": min(hold["exit"], end)} for hold in passed]
        assert (freed["state"], int(freed["version"])) == (kept["state"], int(kept["version"]) + 1)
        assert attempt(other, flight["id"], action).json() == freed
        assert kinds(street) == ["accepted", kept["state"], kept["state"]]
        assert against(other, clock)["delay_s"] == 0.0
        assert "departure" not in against(street, clock)
    assert_no_overlaps(on_street.ledger)


@on_sqlite
@pytest.mark.parametrize("action", ["end", "cancel"])
def test_after_its_arrival_nothing_is_left_to_free(street: Client, clock: FakeClock, action: str) -> None:
    flight = submit(street)
    clock.now_ms = ARRIVAL_MS
    kept = attempt(street, flight["id"], action).json()
    clock.now_ms = ARRIVAL_MS + 1000
    see(street, flight["id"], clock.now_ms, (7, 0, 0), airborne=False)
    assert attempt(street, flight["id"], action).json() == kept
    assert len(kinds(street)) == 2


@on_sqlite
@pytest.mark.parametrize("last", ["on the ground before its departure", "in the air again", "somewhere"])
def test_who_has_not_landed_since_its_departure_keeps_what_it_holds(
    street: Client, clock: FakeClock, last: str
) -> None:
    flight = submit(street)
    clock.now_ms = DEPARTURE_MS - 1000
    see(street, flight["id"], clock.now_ms, airborne=False)
    clock.now_ms = MIDWAY_MS
    if last == "in the air again":
        see(street, flight["id"], MIDWAY_MS - 1000, (2, 0, 0), airborne=False)
        see(street, flight["id"], MIDWAY_MS, (2, 0, 0), airborne=True)
    elif last == "somewhere":
        see(street, flight["id"], MIDWAY_MS, (2, 0, 0), airborne=None)
    assert attempt(street, flight["id"], "end").json()["reservations"] == flight["reservations"]


@on_sqlite
@pytest.mark.parametrize(("place", "is_free"), [((0, 0, 0), True), ((2, 0, 0), False)])
def test_before_its_departure_a_flight_is_down_where_it_stands_on_its_pad_if_nobody_says_whether_it_flies(
    street: Client, clock: FakeClock, place: Block, is_free: bool
) -> None:
    flight = submit(street)
    clock.now_ms = DEPARTURE_MS - 1
    see(street, flight["id"], clock.now_ms, place, airborne=None)
    assert (attempt(street, flight["id"], "end").json()["reservations"] == []) == is_free


@on_sqlite
def test_a_flight_that_still_stands_on_its_pad_when_it_should_fly_gives_up_what_lies_ahead(
    street: Client, clock: FakeClock
) -> None:
    flight = submit(street)
    clock.now_ms = MIDWAY_MS
    see(street, flight["id"], clock.now_ms, airborne=False)
    attempt(street, flight["id"], "end")
    assert against(street, clock)["delay_s"] == 0.0


@on_sqlite
def test_a_flight_that_stood_on_its_pad_a_while_ago_may_be_in_the_air_and_keeps_what_it_holds(
    street: Client, clock: FakeClock
) -> None:
    flight = submit(street)
    clock.now_ms = DEPARTURE_MS + 300
    see(street, flight["id"], clock.now_ms, airborne=False)
    clock.advance(ms=5_001)
    assert attempt(street, flight["id"], "end").json()["reservations"] == flight["reservations"]


@on_sqlite
@pytest.mark.parametrize("action", ["end", "cancel"])
def test_a_flight_that_took_off_before_its_departure_keeps_what_it_holds(
    street: Client, clock: FakeClock, action: str
) -> None:
    flight = submit(street)
    clock.now_ms = DEPARTURE_MS - 2_000
    see(street, flight["id"], clock.now_ms, (1, 0, 0))
    assert attempt(street, flight["id"], action).json()["reservations"] == flight["reservations"]


@on_sqlite
def test_after_its_arrival_ending_a_flight_takes_nothing_away(street: Client, clock: FakeClock) -> None:
    flight = submit(street)
    clock.now_ms = ARRIVAL_MS + 1
    see(street, flight["id"], clock.now_ms, (7, 0, 0), airborne=False)
    answer = attempt(street, flight["id"], "end").json()
    assert (answer["state"], answer["reservations"]) == ("ended", flight["reservations"])


def test_a_flight_that_lands_early_frees_its_blocks_by_itself(
    street: Client, on_street: Settings, clock: FakeClock
) -> None:
    with second_process(on_street, clock) as other:
        flight = submit(street)
        attempt(street, flight["id"], "activate")
        clock.now_ms = ARRIVAL_MS - 1000
        see(street, flight["id"], clock.now_ms, (7, 0, 0), airborne=False)
        assert "departure" not in against(other, clock)
        street.service.monitor.look()
        assert state_of(street, flight["id"]) == "ended"
        assert against(other, clock)["delay_s"] == 0.0
    assert_no_overlaps(on_street.ledger)
