"""Retention: what ended long enough ago goes, whole and in small steps; what is still to come never does."""

import asyncio
from dataclasses import replace

import pytest

from app.flight_intents import FlightIntent, State
from tests.ledger.district import SQUARE, STREET
from tests.ledger.locations import database
from tests.ledger.process import DAY_MS, POLICY, FakeClock, Process, arrival, key, reserved, until

HOUR_MS = 3_600_000
AN_HOUR = replace(POLICY, retention_ms=HOUR_MS, idempotency_ms=HOUR_MS)


def kept(ledger: str) -> tuple[list[int], set[int], list[int]]:
    """Return the sequence numbers of intents, those of reservations, and the revisions of the journal."""
    with database(ledger) as connection:
        intents = [row[0] for row in connection.rows("SELECT sequence FROM flight_intents ORDER BY sequence")]
        revisions = [row[0] for row in connection.rows("SELECT revision FROM journal ORDER BY revision")]
    return intents, set(reserved(ledger).values()), revisions


def across(process: Process, clock: FakeClock, window_ms: int = 300_000) -> FlightIntent:
    """Submit a flight that wants to depart now."""
    return process.submit(SQUARE.submission("N", "S", earliest_ms=clock.now_ms, window_ms=window_ms))


@pytest.mark.parametrize(("too_late_ms", "intents"), [(0, [1, 2]), (1, [2])])
def test_a_flight_is_removed_whole_once_it_ended_longer_ago_than_retention_keeps_it(
    too_late_ms: int, intents: list[int], ledger: str, clock: FakeClock
) -> None:
    with Process(ledger, SQUARE.airspace, clock, policy=AN_HOUR) as process:
        clock.now_ms = arrival(across(process, clock)) + HOUR_MS + too_late_ms
        across(process, clock)
        removed = process.ledger.removed()
    # The journal's first entry is older than the flight's end.
    assert kept(ledger) == (intents, set(intents), [2])
    with database(ledger) as connection:
        assert connection.rows("SELECT sequence, revision FROM counters") == [(2, 2)]
    assert (removed.before_ms is None, removed.journal_through) in [(intents == [1, 2], 1), (True, 0)]


def test_without_retention_nothing_is_ever_removed(ledger: str, clock: FakeClock) -> None:
    with Process(ledger, SQUARE.airspace, clock) as process:
        across(process, clock)
        clock.advance(ms=1000 * DAY_MS)
        across(process, clock)
    assert kept(ledger) == ([1, 2], {1, 2}, [1, 2])


def test_refused_and_cancelled_intents_go_when_they_would_have_ended(ledger: str, clock: FakeClock) -> None:
    with Process(ledger, STREET.airspace, clock, policy=AN_HOUR) as process:
        flown = process.submit(STREET.submission("W", "E", window_ms=0))
        refused = process.submit(STREET.submission("W", "E", window_ms=0))
        cancelled = process.cancel(process.submit(STREET.submission("E", "W")))
        assert [flown.state, refused.state, cancelled.state] == [State.ACCEPTED, State.REJECTED, State.CANCELLED]
        clock.advance(ms=2 * HOUR_MS)
        process.submit(STREET.submission("W", "E", earliest_ms=clock.now_ms))
    assert kept(ledger) == ([4], {4}, [5])


def test_a_flight_that_is_still_to_come_stays_however_long_ago_it_was_planned(ledger: str, clock: FakeClock) -> None:
    with Process(ledger, SQUARE.airspace, clock, policy=AN_HOUR) as process:
        ahead = process.submit(SQUARE.submission("N", "S", earliest_ms=clock.now_ms + DAY_MS))
        clock.advance(ms=DAY_MS // 2)
        across(process, clock)
        assert process.ledger.find(ahead.id) is not None
    # Of its planning the journal knows no more.
    assert kept(ledger) == ([1, 2], {1, 2}, [2])


def test_an_intent_stays_while_its_idempotency_key_is_kept(ledger: str, clock: FakeClock) -> None:
    policy = replace(AN_HOUR, idempotency_ms=3 * HOUR_MS)
    with Process(ledger, SQUARE.airspace, clock, policy=policy) as process:
        request = SQUARE.submission("N", "S")
        first = process.submit(request, key("key"))
        clock.advance(ms=2 * HOUR_MS)
        across(process, clock)
        assert process.submit(request, key("key")).id == first.id
        clock.advance(ms=2 * HOUR_MS)
        across(process, clock)
    assert kept(ledger)[0] == [3]


def test_a_clock_that_is_far_ahead_removes_nothing_that_is_still_to_come(ledger: str, clock: FakeClock) -> None:
    elapsed = FakeClock(0)
    with Process(ledger, SQUARE.airspace, clock, elapsed_ms=elapsed, policy=AN_HOUR) as process:
        tomorrow = process.submit(SQUARE.submission("N", "S", earliest_ms=clock.now_ms + DAY_MS))
        request = SQUARE.submission("N", "S", window_ms=10 * DAY_MS)
        first = process.submit(request, key("key"))
        clock.advance(ms=3 * DAY_MS)
        for _ in range(3):
            across(process, clock)
            clock.advance(seconds=61)
        assert process.submit(request, key("key")).id == first.id
        clock.advance(ms=-3 * DAY_MS)
        across(process, clock)
        assert process.ledger.find(tomorrow.id) is not None
        # When the time has really passed, they go.
        clock.advance(ms=5 * DAY_MS)
        elapsed.advance(ms=5 * DAY_MS)
        across(process, clock)
        asyncio.run(until(lambda: process.ledger.find(tomorrow.id) is None))


def test_a_machine_that_starts_with_a_clock_far_ahead_removes_nothing_that_is_still_to_come(
    ledger: str, clock: FakeClock
) -> None:
    with Process(ledger, SQUARE.airspace, clock, policy=AN_HOUR) as process:
        tomorrow = process.submit(SQUARE.submission("N", "S", earliest_ms=clock.now_ms + DAY_MS))
    clock.advance(ms=3 * DAY_MS)
    with Process(ledger, SQUARE.airspace, clock, elapsed_ms=FakeClock(0), policy=AN_HOUR) as process:
        for _ in range(3):
            clock.advance(seconds=61)
            across(process, clock)
        assert process.ledger.find(tomorrow.id) is not None
    assert len(kept(ledger)[0]) == 4


def test_a_process_that_lags_behind_what_is_left_of_the_journal_loads_the_ledger_afresh(
    ledger: str, clock: FakeClock
) -> None:
    with (
        Process(ledger, SQUARE.airspace, clock, policy=AN_HOUR) as one,
        Process(ledger, SQUARE.airspace, clock) as other,
    ):
        ahead = one.submit(SQUARE.submission("N", "S", earliest_ms=clock.now_ms + DAY_MS))
        clock.advance(ms=2 * HOUR_MS)
        across(one, clock)
        asyncio.run(until(lambda: one.ledger.removed().journal_through == 1))
        across(other, clock)
        assert other.indexed(clock.now_ms) == reserved(ledger, clock.now_ms)
        assert ahead.sequence in other.indexed(clock.now_ms).values()


def test_numbers_go_on_after_everything_was_removed(ledger: str, clock: FakeClock) -> None:
    with Process(ledger, SQUARE.airspace, clock, policy=AN_HOUR) as process:
        for _ in range(3):
            across(process, clock)
        clock.advance(ms=DAY_MS)
        across(process, clock)
    assert kept(ledger)[0] == [4]
    with Process(ledger, SQUARE.airspace, clock, policy=AN_HOUR) as process:
        clock.advance(ms=DAY_MS)
        intent = across(process, clock)
    assert (intent.sequence, intent.version) == (5, 5)
    assert kept(ledger) == ([5], {5}, [5])


def test_a_great_deal_is_removed_step_by_step_while_nobody_asks_for_anything(ledger: str, clock: FakeClock) -> None:
    with Process(ledger, SQUARE.airspace, clock) as process:
        many = [SQUARE.submission("N", "S", window_ms=HOUR_MS) for _ in range(100)]
        process.together(*(process.deconfliction.submit(submission) for submission in many))
    with Process(ledger, SQUARE.airspace, clock, policy=AN_HOUR) as process:
        clock.advance(ms=DAY_MS)
        across(process, clock)
        asyncio.run(until(lambda: kept(ledger)[0] == [101]))
    assert kept(ledger) == ([101], {101}, [101])
