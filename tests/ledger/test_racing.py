"""Two processes on one ledger, each with an index of its own: the write lock and the journal keep them in step."""

import asyncio
import random
import threading
from collections.abc import Callable
from contextlib import suppress

import pytest
from sqlalchemy import Engine, event

from app.errors import IllegalTransition
from app.flight_intents import FlightIntent, State
from tests.ledger.district import SQUARE, START_MS, STREET
from tests.ledger.process import (
    FakeClock,
    Process,
    assert_gapless,
    assert_journal_tells_states,
    assert_no_overlaps,
    reserved,
    until,
)
from tests.ledger.test_restart import described, random_submission


def at_once(*work: Callable[[], None]) -> None:
    """Do work in threads that start together; fail if one fails."""
    errors: list[BaseException] = []
    barrier = threading.Barrier(len(work))

    def run(task: Callable[[], None]) -> None:
        try:
            barrier.wait()
            task()
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=[task]) for task in work]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []


def test_a_process_sees_what_another_reserved(pair: tuple[Process, Process]) -> None:
    one, other = pair
    first = one.submit(STREET.submission("W", "E"))
    refused = other.submit(STREET.submission("E", "W", window_ms=0))
    assert refused.refusal is not None
    assert (first.sequence, refused.sequence, refused.refusal.reason) == (1, 2, "no_conflict_free_path")


def test_a_process_sees_what_another_cancelled(pair: tuple[Process, Process]) -> None:
    one, other = pair
    first = one.submit(STREET.submission("W", "E"))
    other.cancel(first)
    again = one.submit(STREET.submission("W", "E", window_ms=0))
    assert described(again)[2:] == described(first)[2:]  # type: ignore[index]


def test_a_process_sees_space_that_another_freed_and_gave_away_again(pair: tuple[Process, Process]) -> None:
    one, other = pair
    first = one.submit(STREET.submission("W", "E"))
    other.cancel(first)
    second = other.submit(STREET.submission("W", "E"))
    third = one.submit(STREET.submission("W", "E"))
    assert third.trajectory is not None
    assert second.trajectory is not None
    assert third.trajectory.departure_ms > second.trajectory.departure_ms
    assert_no_overlaps(one.location)


def test_a_process_keeps_what_a_flight_holds_that_another_cancelled_in_the_air(
    pair: tuple[Process, Process], clock: FakeClock
) -> None:
    one, other = pair
    first = one.submit(STREET.submission("W", "E"))
    clock.advance(seconds=61)
    other.cancel(first)
    other.submit(STREET.submission("E", "W"))
    one.submit(STREET.submission("E", "W"))
    assert one.indexed(clock.now_ms) == reserved(one.location, clock.now_ms)


def test_what_is_read_in_several_steps_is_of_one_moment(pair: tuple[Process, Process]) -> None:
    one, other = pair
    intent = one.submit(STREET.submission("W", "E"))

    cancelled: list[FlightIntent] = []

    def cancel_meanwhile(_connection: object, _cursor: object, statement: str, *_: object) -> None:
        if statement.startswith("SELECT flight_intents") and not cancelled:
            cancelled.append(intent)
            other.cancel(intent)

    event.listen(Engine, "after_cursor_execute", cancel_meanwhile)
    try:
        (listed,) = one.ledger.page(after_sequence=0, limit=10)
    finally:
        event.remove(Engine, "after_cursor_execute", cancel_meanwhile)
    assert described(listed) == described(intent)
    (listed,) = one.ledger.page(after_sequence=0, limit=10)
    assert (listed.state, len(listed.reservations)) == (State.CANCELLED, 0)


@pytest.mark.compiled
def test_a_process_that_lags_far_behind_catches_up(ledger: str, clock: FakeClock) -> None:
    with (
        Process(ledger, SQUARE.airspace, clock) as one,
        Process(ledger, SQUARE.airspace, clock) as other,
    ):

        async def submit_many() -> None:
            spread = [SQUARE.submission("N", "S", earliest_ms=START_MS + 600_000 * n) for n in range(1001)]
            await asyncio.gather(*(one.deconfliction.submit(submission) for submission in spread))

        asyncio.run(submit_many())
        assert other.submit(SQUARE.submission("N", "S")).version == 1002
        assert other.indexed(clock.now_ms) == reserved(ledger)
    assert_no_overlaps(ledger)


@pytest.mark.compiled
@pytest.mark.parametrize("seed", range(3))
def test_racing_processes_never_overlap_and_leave_no_gaps(seed: int, ledger: str, clock: FakeClock) -> None:
    with (
        Process(ledger, SQUARE.airspace, clock) as one,
        Process(ledger, SQUARE.airspace, clock) as other,
    ):

        def operator(process: Process, number: int) -> Callable[[], None]:
            def fly() -> None:
                chance = random.Random(10 * seed + number)
                mine: list[FlightIntent] = []
                for _ in range(25):
                    mine.append(process.submit(random_submission(SQUARE, chance, START_MS)))
                    if chance.random() < 0.4:
                        with suppress(IllegalTransition):
                            (other if process is one else one).cancel(mine.pop(chance.randrange(len(mine))))

            return fly

        at_once(*(operator(process, number) for number, process in enumerate((one, other, one, other))))
        assert len(one.ledger.everything()[0]) == 100
        assert {intent.state for intent in one.ledger.everything()[0]} >= {State.ACCEPTED, State.CANCELLED}
        assert_no_overlaps(ledger)
        assert_gapless(ledger)
        assert_journal_tells_states(ledger)
        for process in (one, other):
            process.submit(SQUARE.submission("N", "S", earliest_ms=START_MS + 86_400_000))
        one.submit(SQUARE.submission("N", "S", earliest_ms=START_MS + 86_400_000))
        assert one.indexed(0) == reserved(ledger)


def test_processes_with_different_clocks_never_overlap(ledger: str) -> None:
    early, late = FakeClock(), FakeClock(START_MS + 120_000)
    with (
        Process(ledger, STREET.airspace, early) as one,
        Process(ledger, STREET.airspace, late) as other,
    ):
        for n in range(12):
            process = (one, other)[n % 2]
            process.submit(STREET.submission("WE"[n % 2], "EW"[n % 2], window_ms=900_000))
            early.advance(seconds=11)
            late.advance(seconds=11)
    assert_no_overlaps(ledger)
    assert_gapless(ledger)


def test_an_idle_process_whose_clock_was_set_back_has_its_whole_index_again(ledger: str) -> None:
    wrong, right = FakeClock(), FakeClock()
    with Process(ledger, STREET.airspace, wrong) as one, Process(ledger, STREET.airspace, right) as other:
        one.submit(STREET.submission("W", "E"))
        wrong.advance(seconds=86_400)
        one.submit(STREET.submission("W", "E", earliest_ms=wrong.now_ms))
        wrong.advance(seconds=-86_400)
        other.submit(STREET.submission("W", "E", earliest_ms=START_MS + 600_000))
        asyncio.run(until(lambda: one.indexed(START_MS) == reserved(ledger, START_MS)))
