"""Positions in the ledger: how long they are kept, whose go with a flight, and what landing frees in every index."""

import asyncio
from collections.abc import Iterator
from dataclasses import replace

import pytest

from app.errors import LedgerUnavailable
from app.flight_intents import FlightIntent, State
from app.surveillance import Aircraft, Remark, Sighting
from tests.ledger.commits import commit_and_fail, fail, on_next_commit
from tests.ledger.district import DEPARTURE_MS, SQUARE, START_MS, STREET
from tests.ledger.locations import database
from tests.ledger.process import (
    DAY_MS,
    POLICY,
    FakeClock,
    Process,
    arrival,
    assert_gapless,
    assert_no_overlaps,
    assert_sound,
    departure,
    held,
    reserved,
    until,
)
from tests.ledger.test_retention import across

HOUR_MS = 3_600_000
RADAR = Aircraft(0, "radar-1")


@pytest.fixture
def square(ledger: str, clock: FakeClock) -> Iterator[Process]:
    with Process(ledger, SQUARE.airspace, clock) as process:
        yield process


def see(process: Process, aircraft: Aircraft, *times_ms: int, airborne: bool | None = None) -> None:
    """Record where an aircraft was: always in the same place."""
    where = SQUARE.centre("N")
    seen = [(aircraft, Sighting(time_ms, where.lon, where.lat, where.alt_m, airborne)) for time_ms in times_ms]
    process.writer.enqueue(lambda transaction, _: transaction.store_positions(seen), lambda: None).future.result()


def end(process: Process, intent: FlightIntent) -> FlightIntent:
    return asyncio.run(process.deconfliction.end(intent.id))


def history(ledger: str) -> list[tuple[int, str, int]]:
    """Return whose positions of when are kept."""
    with database(ledger) as connection:
        rows = connection.rows("SELECT intent, track_id, time FROM position_history ORDER BY time, intent")
    return [(intent, track, time) for intent, track, time in rows]


def newest(ledger: str) -> set[tuple[int, str]]:
    """Return whose newest position is known."""
    with database(ledger) as connection:
        return {(intent, track) for intent, track in connection.rows("SELECT intent, track_id FROM newest_positions")}


def keep_house(process: Process) -> None:
    """Let the writer look for what has passed: it does so behind every answer."""
    for _ in range(2):
        process.writer.enqueue(lambda *_: None, lambda: None).future.result()


# Retention


@pytest.mark.parametrize(("too_late_ms", "kept"), [(0, [START_MS, START_MS + 1]), (1, [START_MS + 1])])
def test_a_position_is_kept_for_an_hour(
    square: Process, ledger: str, clock: FakeClock, too_late_ms: int, kept: list[int]
) -> None:
    see(square, RADAR, START_MS, START_MS + 1)
    clock.advance(ms=HOUR_MS + too_late_ms)
    keep_house(square)
    assert [time for _, _, time in history(ledger)] == kept
    assert square.ledger.removed().positions_before_ms == (None if too_late_ms == 0 else START_MS + too_late_ms)


def test_how_long_positions_are_kept_is_a_matter_of_policy(ledger: str, clock: FakeClock) -> None:
    with Process(ledger, SQUARE.airspace, clock, policy=replace(POLICY, positions_ms=DAY_MS)) as process:
        see(process, RADAR, START_MS)
        clock.advance(ms=DAY_MS)
        keep_house(process)
        assert len(history(ledger)) == 1
        clock.advance(seconds=61)
        keep_house(process)
        assert history(ledger) == []


def test_of_a_track_nothing_is_left_and_of_a_flight_where_it_was_last(
    square: Process, ledger: str, clock: FakeClock
) -> None:
    flight = Aircraft(across(square, clock).sequence)
    see(square, flight, START_MS)
    see(square, RADAR, START_MS)
    clock.advance(ms=2 * HOUR_MS)
    keep_house(square)
    asyncio.run(until(lambda: newest(ledger) == {(flight.sequence, "")}))
    assert history(ledger) == []


def test_a_great_many_positions_go_step_by_step(square: Process, ledger: str, clock: FakeClock) -> None:
    see(square, RADAR, *range(START_MS, START_MS + 5000))
    clock.advance(ms=2 * HOUR_MS)
    see(square, RADAR, clock.now_ms)
    asyncio.run(until(lambda: len(history(ledger)) == 1))
    assert history(ledger) == [(0, "radar-1", clock.now_ms)]
    assert newest(ledger) == {(0, "radar-1")}


def test_a_clock_that_is_far_ahead_removes_no_position(ledger: str, clock: FakeClock) -> None:
    with Process(ledger, SQUARE.airspace, clock, elapsed_ms=FakeClock(0)) as process:
        see(process, RADAR, START_MS)
        clock.advance(ms=DAY_MS)
        keep_house(process)
        assert len(history(ledger)) == 1
        assert process.ledger.removed().positions_before_ms is None


def test_a_removed_flight_takes_its_positions_and_remarks_along(ledger: str, clock: FakeClock) -> None:
    policy = replace(POLICY, retention_ms=HOUR_MS, idempotency_ms=HOUR_MS, positions_ms=DAY_MS)
    with Process(ledger, SQUARE.airspace, clock, policy=policy) as process:
        flight = Aircraft(across(process, clock).sequence)
        for aircraft in (flight, RADAR):
            see(process, aircraft, START_MS)
        remarks = dict.fromkeys((flight, RADAR), Remark("lost", ("lost",), START_MS, START_MS))
        process.writer.enqueue(lambda transaction, now: transaction.remark(remarks, now), lambda: None).future.result()
        clock.advance(ms=2 * HOUR_MS)
        across(process, clock)
        keep_house(process)
    assert history(ledger) == [(0, "radar-1", START_MS)]
    assert newest(ledger) == {(0, "radar-1")}
    with database(ledger) as connection:
        assert connection.rows("SELECT intent, track_id FROM remarks") == [(0, "radar-1")]


# Landing


def test_every_process_gives_away_what_a_landed_flight_gave_up(pair: tuple[Process, Process], clock: FakeClock) -> None:
    one, other = pair
    flight = one.submit(STREET.submission("W", "E"))
    clock.advance(seconds=63)
    other.submit(STREET.submission("E", "W", earliest_ms=START_MS + 600_000))
    see(one, Aircraft(flight.sequence), clock.now_ms, airborne=False)
    held = end(other, flight).reservations
    assert max(held.exit_ms.tolist()) == clock.now_ms + 1
    for process in (one, other, one):
        process.submit(STREET.submission("E", "W", earliest_ms=clock.now_ms + 1))
        assert process.indexed(clock.now_ms) == reserved(one.location, clock.now_ms)
    assert_no_overlaps(one.location)
    assert_gapless(one.location)


def test_a_process_keeps_what_a_flight_holds_that_another_ended_in_the_air(
    pair: tuple[Process, Process], clock: FakeClock
) -> None:
    one, other = pair
    flight = one.submit(STREET.submission("W", "E"))
    clock.advance(seconds=63)
    before = reserved(one.location)
    assert end(other, flight).state is State.ENDED
    assert reserved(one.location) == before
    one.submit(STREET.submission("E", "W"))
    assert one.indexed(clock.now_ms) == reserved(one.location, clock.now_ms)


def test_a_flight_that_ends_in_the_millisecond_in_which_it_departs_keeps_what_it_holds(
    pair: tuple[Process, Process], clock: FakeClock
) -> None:
    one, _ = pair
    flight = one.submit(STREET.submission("W", "E"))
    assert flight.trajectory is not None
    clock.now_ms = flight.trajectory.departure_ms
    assert len(end(one, flight).reservations) == len(flight.reservations)
    assert one.indexed(clock.now_ms) == reserved(one.location, clock.now_ms)


def test_a_flight_that_may_have_left_early_counts_among_the_open_ones_until_it_should_have_arrived(
    square: Process, clock: FakeClock
) -> None:
    def counted() -> int:
        with square.ledger.transaction() as transaction:
            return transaction.count_open("acme-air", 10, clock.now_ms)

    early, on_its_pad = (
        square.submit(SQUARE.submission("N", "S", earliest_ms=DEPARTURE_MS + hours * 3_600_000)) for hours in (1, 2)
    )
    see(square, Aircraft(early.sequence), clock.now_ms, airborne=True)
    assert held(square.cancel(early)) == held(early)
    assert held(square.cancel(on_its_pad)) == set()
    assert counted() == 1
    clock.now_ms = arrival(early) - 1
    assert counted() == 1
    clock.advance(ms=1)
    assert counted() == 0


def kept_and_down(process: Process, clock: FakeClock) -> FlightIntent:
    """Return a flight that was ended in the air, and whose aircraft was seen on the ground since."""
    intent = process.submit(SQUARE.submission("N", "S"))
    clock.now_ms = departure(intent)
    kept = end(process, intent)
    assert held(kept) == held(intent)
    clock.advance(seconds=1)
    see(process, Aircraft(intent.sequence), clock.now_ms, airborne=False)
    return kept


def test_what_was_freed_later_by_a_commit_that_was_lost_is_answered_from_the_ledger(
    square: Process, clock: FakeClock
) -> None:
    kept = kept_and_down(square, clock)
    with on_next_commit(commit_and_fail):
        freed = end(square, kept)
    assert (freed.state, freed.version) == (State.ENDED, kept.version + 1)
    assert max(freed.reservations.exit_ms) == clock.now_ms + 1
    assert_sound(square)


def test_what_a_commit_that_failed_should_have_freed_is_still_held(square: Process, clock: FakeClock) -> None:
    kept = kept_and_down(square, clock)
    with on_next_commit(fail), pytest.raises(LedgerUnavailable, match="nothing was recorded"):
        end(square, kept)
    found = square.ledger.find(kept.id)
    assert found is not None
    assert (found.version, held(found)) == (kept.version, held(kept))
    assert end(square, kept).version == kept.version + 1
    assert_sound(square)
