"""POST /v1/flight-intents/batch: planned together, all of it recorded or nothing, and nobody else moved."""

import asyncio
import json
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from threading import Event
from typing import Any

import httpx
import pytest
from sqlalchemy import Connection

from app.batches import Batches, BatchOutcome
from app.errors import BatchNotPlanned, ItemRefused, QueueFull, TooManyRequests
from app.flight_intents import State
from app.main import create_app
from app.service import Service
from tests.api.bodies import SUBMIT, intent, problem, recorded
from tests.api.serving import Client, served, settings_for
from tests.ledger.commits import commit_and_fail, on_commit
from tests.ledger.district import DEPARTURE_MS, LANES
from tests.ledger.locations import SqliteLedgers
from tests.ledger.process import FakeClock, closing, until

BATCH = "/v1/flight-intents/batch"
EAST, WEST = ("W", "E"), ("E", "W")


@pytest.fixture
def ledger(tmp_path: Path) -> str:
    """Return the location of a new ledger: what a batch asks of it, single intents ask of both databases."""
    return SqliteLedgers(tmp_path).migrated()


def lane(*places: str, **members: Any) -> dict[str, Any]:
    return intent(*places, district=LANES, **members)


def post(
    client: Client, *items: dict[str, Any], headers: dict[str, str] | None = None, **members: Any
) -> httpx.Response:
    body = {"flight_intents": list(items), "improve_for_s": 0.05, **members}
    return client.post(BATCH, json=body, headers=headers or {})


def listed(client: Client) -> list[dict[str, Any]]:
    items: list[dict[str, Any]] = client.get(SUBMIT, params={"limit": "500"}).json()["items"]
    return items


def test_every_flight_is_recorded_in_the_order_of_the_batch_and_the_figures_are_of_what_is_recorded(
    lanes: Client,
) -> None:
    response = post(lanes, lane(*EAST), lane("V", "F"), lane(*WEST), lane(*EAST))
    answer = response.json()
    assert response.status_code == 201
    assert [item["sequence"] for item in answer["items"]] == [1, 2, 3, 4]
    assert [recorded(item) for item in answer["items"]] == listed(lanes)
    delays = [item["delay_s"] for item in answer["items"]]
    assert sum(delays) == pytest.approx(answer["improved"]["total_delay_s"])
    assert max(delays) == answer["improved"]["worst_delay_s"]
    assert 0 < answer["improved"]["total_delay_s"] <= answer["first_come"]["total_delay_s"]
    assert answer["improvement"]["stopped_by"] == "time"
    assert answer["improvement"]["elapsed_s"] >= 0.05


def test_first_come_is_what_the_flights_would_get_one_by_one(lanes: Client) -> None:
    items = [lane(*EAST), lane(*WEST), lane(*EAST, earliest_ms=DEPARTURE_MS + 5000)]
    first_come = post(lanes, *items).json()["first_come"]
    for item in listed(lanes):
        lanes.delete(f"{SUBMIT}/{item['id']}")
    one_by_one = [lanes.post(SUBMIT, json=item).json()["delay_s"] for item in items]
    assert first_come["total_delay_s"] == pytest.approx(sum(one_by_one))


def test_who_has_to_be_refused_is_recorded_with_the_flight_of_the_batch_that_is_in_the_way(lanes: Client) -> None:
    flown, refused = post(lanes, lane(*EAST, window_ms=0), lane(*EAST, window_ms=0)).json()["items"]
    assert (refused["status"], refused["reason"], refused["sequence"]) == (409, "no_departure_slot", 2)
    assert refused["conflicting_intents"] == [flown["id"]]
    assert lanes.get(f"{SUBMIT}/{refused['flight_intent_id']}").json()["state"] == State.REJECTED


def test_one_bad_item_is_named_and_nothing_is_recorded(lanes: Client) -> None:
    answer = problem(post(lanes, lane(*EAST), lane("W", "W")), 422, "item-refused")
    assert (answer["index"], answer["cause"]["reason"]) == (1, "same_block")
    unknown = problem(post(lanes, lane(*EAST, aircraft_type="kite")), 422, "item-refused")
    assert (unknown["index"], unknown["cause"]["type"]) == (0, "/problems/unknown-aircraft-type")
    past = problem(post(lanes, lane(*EAST), lane(*EAST, earliest_ms=0, window_ms=0)), 422, "item-refused")
    assert (past["index"], past["cause"]["type"]) == (1, "/problems/departure-in-the-past")
    invalid = problem(post(lanes, lane(*EAST), {**lane(*EAST), "origin": None}), 422, "validation-error")
    assert invalid["errors"][0]["loc"][:4] == ["body", "flight_intents", 1, "origin"]
    assert listed(lanes) == []


@pytest.mark.parametrize("flights", [0, 501])
def test_a_batch_has_1_to_500_flights(lanes: Client, flights: int) -> None:
    problem(post(lanes, *[lane(*EAST)] * flights), 422, "validation-error")


def test_of_what_is_no_batch_no_more_is_looked_at_than_needed(lanes: Client) -> None:
    def places(response: httpx.Response) -> list[list[object]]:
        return [error["loc"] for error in problem(response, 422, "validation-error")["errors"]]

    unknown: dict[str, Any] = {f"member {number}": 0 for number in range(50)}
    assert places(post(lanes, lane(*EAST), **unknown)) == [["body", "member 0"]]
    item = lane(*EAST, **unknown) | {"origin": unknown | lane(*EAST)["origin"]}
    inside = ["body", "flight_intents", 0]
    assert places(post(lanes, item)) == [[*inside, "origin", "member 0"], [*inside, "member 0"]]
    too_many = lanes.post(BATCH, json={"flight_intents": [0] * 501})
    assert (
        problem(too_many, 422, "validation-error")["detail"] == "body: 501 flight_intents; a batch may have up to 500"
    )


def test_a_batch_has_one_priority(lanes: Client) -> None:
    answer = problem(post(lanes, lane(*EAST), lane(*EAST, priority=5)), 422, "validation-error")
    assert "flight_intents[1] has priority 5" in answer["detail"]


def test_a_batch_displaces_nobody_whatever_its_priority(lanes: Client) -> None:
    first = lanes.post(SUBMIT, json=lane(*EAST)).json()
    (urgent,) = post(lanes, lane(*EAST, priority=100)).json()["items"]
    assert urgent["delay_s"] > 0
    assert urgent["displaced"] == []
    assert lanes.get(f"{SUBMIT}/{first['id']}").json() == recorded(first)


def test_the_same_key_brings_the_same_flights_again_as_they_are_now(lanes: Client) -> None:
    key = {"Idempotency-Key": "b1"}
    items = [lane(*EAST), lane(*WEST)]
    first, again = post(lanes, *items, headers=key), post(lanes, *items, headers=key)
    assert "idempotent-replayed" not in first.headers
    assert again.headers["idempotent-replayed"] == "true"
    assert again.json() == first.json()
    lanes.delete(f"{SUBMIT}/{first.json()['items'][0]['id']}")
    states = [item["state"] for item in post(lanes, *items, headers=key).json()["items"]]
    assert states == [State.CANCELLED, State.ACCEPTED]
    problem(post(lanes, *items[:1], headers=key), 422, "idempotency-key-reused")
    problem(lanes.post(SUBMIT, json=items[0], headers=key), 422, "idempotency-key-reused")
    assert len(listed(lanes)) == 2


def submitted(client: Client, meanwhile: Any, *places: tuple[str, str], window_ms: int = 300_000) -> BatchOutcome:
    """Submit a batch and do something after what is reserved was looked at and before the batch is recorded."""

    asked = 0

    def stop() -> bool:
        nonlocal asked
        asked += 1
        if asked <= len(places):
            # Each flight has to be planned once.
            return False
        meanwhile()
        return True

    submissions = [LANES.submission(*ends, window_ms=window_ms) for ends in places]
    return client.portal.call(client.service.batches.submit, submissions, 5.0, None, stop)


def test_a_plan_whose_blocks_were_reserved_meanwhile_is_made_anew_and_the_others_stand(lanes: Client) -> None:
    outcome = submitted(lanes, lambda: lanes.post(SUBMIT, json=lane(*EAST)), EAST, ("V", "F"))
    rival, first, second = listed(lanes)
    assert (rival["delay_s"], second["delay_s"]) == (0, 0)
    assert first["delay_s"] > 0
    assert [one.sequence for one in outcome.intents] == [first["sequence"], second["sequence"]] == [2, 3]
    assert outcome.comparison.first_come.total_ms == 0
    assert outcome.comparison.improved.total_ms == pytest.approx(first["delay_s"] * 1000)
    assert outcome.comparison.improvement.stopped_by == "shutdown"


def test_a_plan_through_what_was_closed_meanwhile_is_made_anew(lanes: Client) -> None:
    shut = closing([LANES.block("E")], DEPARTURE_MS, None)
    outcome = submitted(lanes, lambda: lanes.portal.call(lanes.service.airspace_closing.close, shut), EAST, ("V", "F"))
    refused, flown = outcome.intents
    assert refused.refusal is not None
    assert refused.refusal.conflicting_constraints == (shut.id,)
    assert flown.state is State.ACCEPTED


def test_a_batch_whose_commit_is_lost_is_looked_up(lanes: Client) -> None:
    flights = [LANES.submission(*EAST), LANES.submission(*WEST)]
    # The first one is that of a look at what is reserved.
    commits: list[Callable[[Connection], object]] = [commit_and_fail, bool]
    with on_commit(lambda connection: commits.pop()(connection) if commits else None):
        outcome = lanes.portal.call(lanes.service.batches.submit, flights, 0.0, None, lambda: False)
    assert [one.id for one in outcome.intents] == [one["id"] for one in listed(lanes)]
    assert (len(outcome.intents), commits) == (2, [])


def test_a_plan_whose_departure_has_passed_meanwhile_is_made_anew(lanes: Client, clock: FakeClock) -> None:
    outcome = submitted(lanes, lambda: clock.advance(seconds=90), EAST)
    (path,) = [one.trajectory for one in outcome.intents]
    assert path is not None
    assert path.departure_ms >= clock()


def test_where_a_whole_window_has_passed_meanwhile_nothing_is_recorded(lanes: Client, clock: FakeClock) -> None:
    with pytest.raises(ItemRefused, match=r"flight_intents\[0\]: the latest departure"):
        submitted(lanes, lambda: clock.advance(seconds=90), EAST, window_ms=10_000)
    assert listed(lanes) == []


def test_others_are_served_while_a_batch_is_planned_and_too_many_batches_are_turned_away(lanes: Client) -> None:
    turned_away = Event()

    def stop() -> bool:
        assert turned_away.wait(10)
        return False

    async def many() -> list[BatchOutcome | BaseException]:
        batches = lanes.service.batches
        jobs = [
            asyncio.ensure_future(batches.submit([LANES.submission(*EAST, operator=operator)], 0.0, None, stop))
            for operator in ("a-air", "a-air", "b-air", "c-air", "d-air", "e-air")
        ]
        await until(jobs[-1].done)
        turned_away.set()
        return await asyncio.gather(*jobs, return_exceptions=True)

    outcomes = lanes.portal.call(many)
    assert [type(outcome) for outcome in outcomes] == [BatchOutcome, TooManyRequests, *[BatchOutcome] * 3, QueueFull]
    assert len(listed(lanes)) == 4
    assert post(lanes, lane(*EAST, operator="a-air")).status_code == 201


def slow_by(service: Service, seconds: int) -> Batches:
    """Return batches for which so much time passes from one look at the clock to the next."""
    deconfliction = service.deconfliction
    clock = count(0, seconds).__next__
    return Batches(service.writer, service.ledger, deconfliction._scheduler, deconfliction, clock)


def test_a_batch_that_cannot_be_planned_in_time_is_refused_with_nothing_recorded(lanes: Client) -> None:
    def batch() -> Any:
        flights = [LANES.submission(*EAST)] * 2
        return slow_by(lanes.service, 15).submit(flights, 0.0, None, lambda: False)

    with pytest.raises(BatchNotPlanned, match="2 flight intents were not planned within 20 s"):
        lanes.portal.call(batch)
    with pytest.raises(BatchNotPlanned):
        lanes.portal.call(lanes.service.batches.submit, [LANES.submission(*EAST)], 0.0, None, lambda: True)
    assert listed(lanes) == []


def test_others_do_not_wait_until_a_batch_is_planned_again(lanes: Client) -> None:
    rivals: list[dict[str, Any]] = []

    def reserve() -> bool:
        if not rivals:
            rivals.append(lanes.post(SUBMIT, json=lane(*EAST)).json())
        return False

    def batch() -> Any:
        flights = [LANES.submission("V", "F"), LANES.submission(*EAST)]
        return slow_by(lanes.service, 2).submit(flights, 0.0, None, reserve)

    with pytest.raises(BatchNotPlanned, match="others have reserved"):
        lanes.portal.call(batch)
    assert listed(lanes) == [recorded(rivals[0])]
    # What the flight that could have stayed held is free again.
    assert lanes.post(SUBMIT, json=lane("V", "F")).json()["delay_s"] == 0


def test_who_is_cancelled_leaves_the_planner_to_the_next(lanes: Client) -> None:
    asked = 0

    def watched() -> bool:
        nonlocal asked
        asked += 1
        return False

    async def cancelled() -> tuple[int, int]:
        batches = lanes.service.batches
        flights = [LANES.submission(*EAST), LANES.submission(*WEST)]
        job = asyncio.ensure_future(batches.submit(flights, 5.0, None, watched))
        await until(lambda: asked > len(flights))
        job.cancel()
        with pytest.raises(asyncio.CancelledError):
            await job
        before = asked
        await batches.submit(flights[:1], 0.0, None, lambda: False)
        return before, asked

    before, after = lanes.portal.call(cancelled)
    assert after == before
    assert len(listed(lanes)) == 1


def test_a_client_that_hangs_up_gives_its_turn_back(lanes: Client) -> None:
    body = json.dumps({"flight_intents": [lane(*EAST), lane(*WEST)], "improve_for_s": 5}).encode()
    messages = iter([{"type": "http.request", "body": body}, {"type": "http.disconnect"}])
    sent: list[Any] = []

    async def receive() -> Any:
        return next(messages)

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {
        "type": "http", "http_version": "1.1", "method": "POST", "scheme": "http", "path": BATCH, "root_path": "",
        "query_string": b"", "headers": [(b"host", b"127.0.0.1"), (b"content-type", b"application/json")],
        "state": {"service": lanes.service},
    }  # fmt: skip
    lanes.portal.call(create_app(lanes.service.settings, running=lanes.service), scope, receive, send)
    assert json.loads(sent[1]["body"])["detail"] == "the connection ended before the batch was planned"
    assert listed(lanes) == []
    assert post(lanes, lane(*EAST)).status_code == 201


@pytest.fixture
def strict(ledger: str, tmp_path: Path, clock: FakeClock) -> Iterator[Client]:
    """Return a client of a service that bounds bodies, and operators to two open flights."""
    limits = {"max_body_bytes": 1024, "max_batch_bytes": 2048, "open_intents_limit": 2}
    with served(create_app(settings_for(LANES, ledger, tmp_path, **limits), clock, elapsed_ms=clock)) as client:
        yield client


def test_a_batch_has_its_own_limit_of_bytes_and_counts_whole_against_an_operators_flights(strict: Client) -> None:
    problem(post(strict, *[lane(*EAST)] * 3), 429, "too-many-open-intents")
    padded = lane(*EAST, reference="x" * 200)
    assert post(strict, padded, padded).status_code == 201
    problem(post(strict, *[padded] * 8), 413, "body-too-large")
    problem(post(strict, lane(*EAST)), 429, "too-many-open-intents")
    assert len(listed(strict)) == 2
