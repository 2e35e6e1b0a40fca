"""Idempotency keys: the first answer again, in the transaction that gave it."""

import asyncio

import pytest

from app.deconfliction import Outcome
from app.errors import DepartureInThePast, IdempotencyKeyReused
from tests.ledger.commits import commit_and_fail, on_next_commit
from tests.ledger.district import SQUARE
from tests.ledger.process import DAY_MS, POLICY, FakeClock, Process, key

THREE_DAYS_MS = 3 * DAY_MS


def submit(process: Process, digest: str = "one body", name: str = "key", **request: object) -> Outcome:
    """Submit a flight across the square with an idempotency key."""
    submission = SQUARE.submission("N", "S", **request)  # type: ignore[arg-type]
    return asyncio.run(process.deconfliction.submit(submission, key(name, digest)))


def test_a_key_brings_the_first_answer_again_and_records_nothing(square: Process) -> None:
    first, again = submit(square), submit(square)
    assert (first.replayed, again.replayed, again.intent.id) == (None, b"1", first.intent.id)
    assert len(square.ledger.everything()[0]) == 1


def test_a_key_with_another_body_is_refused(square: Process) -> None:
    submit(square)
    with pytest.raises(IdempotencyKeyReused):
        submit(square, digest="another body")
    assert len(square.ledger.everything()[0]) == 1


def test_two_operators_may_use_the_same_key(square: Process) -> None:
    first, second = submit(square), submit(square, operator="other-air")
    assert (first.intent.sequence, second.intent.sequence, second.replayed) == (1, 2, None)


def test_a_key_is_kept_for_exactly_its_time(square: Process, clock: FakeClock) -> None:
    submit(square, window_ms=THREE_DAYS_MS)
    clock.advance(ms=POLICY.idempotency_ms)
    square.submit(SQUARE.submission("N", "S", window_ms=THREE_DAYS_MS))
    assert submit(square, window_ms=THREE_DAYS_MS).replayed == b"1"
    clock.advance(ms=1)
    square.submit(SQUARE.submission("N", "S", window_ms=THREE_DAYS_MS))
    assert submit(square, window_ms=THREE_DAYS_MS).intent.sequence == 4


def test_a_key_outlives_a_clock_that_is_wrong_for_a_while(ledger: str, clock: FakeClock) -> None:
    with Process(ledger, SQUARE.airspace, clock, elapsed_ms=FakeClock(0)) as process:
        submit(process, window_ms=THREE_DAYS_MS)
        clock.advance(ms=2 * DAY_MS)
        process.submit(SQUARE.submission("N", "S", earliest_ms=clock.now_ms))
        assert submit(process, window_ms=THREE_DAYS_MS).replayed == b"1"


def test_a_key_of_a_request_that_was_not_recorded_can_be_used_again(square: Process, clock: FakeClock) -> None:
    clock.advance(seconds=361)
    with pytest.raises(DepartureInThePast):
        submit(square)
    assert submit(square, earliest_ms=clock.now_ms, digest="another body").replayed is None


def test_a_repetition_after_the_departure_has_passed_still_brings_the_first_answer(
    square: Process, clock: FakeClock
) -> None:
    submit(square)
    clock.advance(seconds=3600)
    assert submit(square).replayed == b"1"


def test_duplicates_in_one_batch_make_one_intent(square: Process) -> None:
    request = SQUARE.submission("N", "S")
    answers = square.together(*(square.deconfliction.submit(request, key("key")) for _ in range(4)))
    assert [answer.replayed for answer in answers] == [None, b"1", b"1", b"1"]
    assert len(square.ledger.everything()[0]) == 1


def test_a_key_outlives_the_process(ledger: str, clock: FakeClock) -> None:
    with Process(ledger, SQUARE.airspace, clock) as process:
        submit(process)
    with Process(ledger, SQUARE.airspace, clock) as process:
        assert submit(process).replayed == b"1"


def test_a_repetition_whose_commit_was_lost_is_answered_with_the_first_answer(square: Process) -> None:
    first = submit(square)
    with on_next_commit(commit_and_fail):
        again = submit(square)
    assert (again.intent.id, again.replayed) == (first.intent.id, b"1")
