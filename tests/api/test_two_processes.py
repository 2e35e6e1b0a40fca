"""Two processes on one ledger, and one whose ledger is locked."""

import asyncio
import threading
from collections.abc import Callable
from functools import partial

import pytest

from app.main import create_app
from app.settings import Settings
from app.writer import Writer
from tests.api.bodies import SUBMIT
from tests.api.serving import Client, served
from tests.api.watching import (
    ALERTS,
    ARRIVAL_MS,
    FLIGHTS,
    STATUS,
    TOLERANCE_MS,
    activated,
    colours,
    flights,
    fly,
    look,
    see,
    state_of,
    submit,
    told,
)
from tests.ledger.district import DEPARTURE_MS
from tests.ledger.locations import on_sqlite, write_lock
from tests.ledger.process import FakeClock, until


def _wait(writers: list[Writer], count: int) -> bool:
    """Tell whether so many pieces of work wait, with as many writers as there are."""
    return all(writer.waiting for writer in writers[:count]) and sum(writer.waiting for writer in writers) >= count


def all_at_once(ledger: str, writers: list[Writer], *work: Callable[[], object]) -> None:
    """Do work in threads of their own, whose writers find the ledger locked until all of it waits to be recorded."""
    for writer in writers:
        # After the first of two answers it keeps house, which needs the lock too.
        for _ in range(2):
            writer.enqueue(lambda *_: None, lambda: None).future.result()
    with write_lock(ledger):
        for writer in writers:
            # The writer takes this and waits for the lock; what comes then waits behind it.
            writer.enqueue(lambda *_: None, lambda: None)
        asyncio.run(until(lambda: not any(writer.waiting for writer in writers)))
        threads = [threading.Thread(target=task) for task in work]
        for count, thread in enumerate(threads, start=1):
            thread.start()
            asyncio.run(until(partial(_wait, writers, count)))
    for thread in threads:
        thread.join()


def test_two_processes_answer_the_same(lanes: Client, on_lanes: Settings, clock: FakeClock) -> None:
    with served(create_app(on_lanes, clock)) as other:
        flight = activated(lanes)
        clock.now_ms = DEPARTURE_MS
        see(other, flight, 0.5, 1.5)
        see(lanes, "radar-1", 5.5, 2.5)
        look(other)
        for path in (STATUS, FLIGHTS, ALERTS, "/v1/events", f"{SUBMIT}/{flight}"):
            assert lanes.get(path).json() == other.get(path).json()
        assert colours(lanes)[0, 1, 0] == ("yellow", ["unplanned_use"])
        clock.advance(seconds=1)
        fly(lanes, flight)
        assert flights(other)[flight]["conformance"] == "conforming"


def test_two_monitors_that_look_at_once_record_each_change_once(
    lanes: Client, on_lanes: Settings, clock: FakeClock
) -> None:
    with served(create_app(on_lanes, clock)) as other:
        flight, unseen = submit(lanes), submit(lanes, "V", "F")
        clock.now_ms = DEPARTURE_MS
        see(lanes, flight, 0.5, 1.5)
        see(other, "radar-1", 3.5, 1.5)
        looks = [partial(look, client) for client in (lanes, other)]
        all_at_once(on_lanes.ledger, [lanes.service.writer, other.service.writer], *looks)
        recorded = told(lanes)[2:]
        assert sorted(recorded, key=str) == sorted(
            [
                ("nonconforming", flight, []),
                ("deviating", flight, ["off_track"]),
                ("deviating", "radar-1", ["no_flight_intent"]),
            ],
            key=str,
        )
        clock.now_ms = ARRIVAL_MS + TOLERANCE_MS + 1
        looks = [partial(look, client) for client in (lanes, other)]
        all_at_once(on_lanes.ledger, [lanes.service.writer, other.service.writer], *looks)
        assert [kind for kind, whose, _ in told(lanes) if whose == unseen] == ["accepted", "ended"]


@on_sqlite
def test_what_is_seen_is_shown_although_it_cannot_be_recorded_yet(
    lanes: Client, on_lanes: Settings, clock: FakeClock
) -> None:
    monitor = lanes.service.monitor
    see(lanes, "radar-1", 3.5, 1.5)
    with write_lock(on_lanes.ledger):
        first = monitor.look(patience_s=0.0)
        clock.advance(seconds=1)
        second = monitor.look(patience_s=0.0)
        assert (monitor.latest, second.at_ms - first.at_ms) == (second, 1000)
    look(lanes)
    assert told(lanes) == [("deviating", "radar-1", ["no_flight_intent"])]


@pytest.mark.parametrize(("action", "state"), [("activate", "activated"), ("end", "ended")])
def test_a_change_that_an_operator_made_meanwhile_is_not_undone(
    lanes: Client, on_lanes: Settings, clock: FakeClock, action: str, state: str
) -> None:
    flight = submit(lanes)
    clock.now_ms = DEPARTURE_MS
    fly(lanes, flight)
    answers: list[int] = []
    all_at_once(
        on_lanes.ledger,
        [lanes.service.writer],
        lambda: answers.append(lanes.post(f"{SUBMIT}/{flight}/{action}").status_code),
        partial(look, lanes),
    )
    assert answers == [200]
    assert state_of(lanes, flight) == state
