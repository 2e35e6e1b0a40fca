"""The one writer: order, previews, neighbours in a batch, work that plans nothing."""

import asyncio
import threading
from typing import Never
from urllib.parse import urlsplit

import pytest
from sqlalchemy import Connection

from app.deconfliction import IdempotencyKey, Outcome, PreviewPlan
from app.errors import BeyondHorizon, DepartureInThePast, IllegalTransition, LedgerUnavailable, OutcomeUnknown
from app.flight_intents import FlightIntent, Refusal, State
from app.ledger import Transaction
from app.writer import BatchReport
from tests.ledger.commits import commit_and_fail, fail, on_commit, on_next_commit
from tests.ledger.district import DEPARTURE_MS, SQUARE, START_MS, STREET
from tests.ledger.locations import Ledgers, database, on_postgresql
from tests.ledger.process import (
    HORIZON_MS,
    FakeClock,
    Hold,
    Process,
    assert_gapless,
    assert_sound,
    departure,
    held,
    outcomes,
)

# Order and numbers


def test_sequence_and_version_count_from_one(square: Process) -> None:
    intents = [square.submit(SQUARE.submission("N", "S")) for _ in range(3)]
    assert [(intent.sequence, intent.version) for intent in intents] == [(1, 1), (2, 2), (3, 3)]


def test_a_refusal_takes_a_sequence_number(street: Process) -> None:
    street.submit(STREET.submission("W", "E"))
    refused = street.submit(STREET.submission("W", "E", window_ms=0))
    accepted = street.submit(STREET.submission("W", "E"))
    assert [(refused.sequence, refused.state), (accepted.sequence, accepted.state)] == [
        (2, State.REJECTED),
        (3, State.ACCEPTED),
    ]


def test_a_cancellation_takes_a_revision_but_no_sequence_number(square: Process) -> None:
    cancelled = square.cancel(square.submit(SQUARE.submission("N", "S")))
    second = square.submit(SQUARE.submission("N", "S"))
    assert (cancelled.sequence, cancelled.version) == (1, 2)
    assert (second.sequence, second.version) == (2, 3)


@pytest.mark.parametrize(
    ("earliest_ms", "window_ms", "error"),
    [
        (START_MS - 2, 1, DepartureInThePast),
        (START_MS, HORIZON_MS + 1, BeyondHorizon),
        (START_MS + HORIZON_MS + 1, 0, BeyondHorizon),
    ],
)
def test_a_request_outside_the_horizon_takes_no_number(
    square: Process, earliest_ms: int, window_ms: int, error: type[Exception]
) -> None:
    with pytest.raises(error):
        square.submit(SQUARE.submission("N", "S", earliest_ms=earliest_ms, window_ms=window_ms))
    assert len(square.ledger.everything()[0]) == 0
    assert square.ledger.revision() == 0


@pytest.mark.parametrize(("earliest_ms", "window_ms"), [(START_MS - 2, 2), (START_MS, HORIZON_MS)])
def test_the_first_and_the_last_moment_of_the_horizon_are_accepted(
    square: Process, earliest_ms: int, window_ms: int
) -> None:
    intent = square.submit(SQUARE.submission("N", "S", earliest_ms=earliest_ms, window_ms=window_ms))
    assert (intent.state, departure(intent)) == (State.ACCEPTED, START_MS)


def test_requests_that_wait_together_are_planned_in_the_order_of_their_arrival(street: Process) -> None:
    answers = outcomes(street, *[STREET.submission("W", "E", operator=f"operator-{n}") for n in range(5)])
    intents = [answer.intent for answer in answers if isinstance(answer, Outcome)]
    assert [intent.sequence for intent in intents] == [1, 2, 3, 4, 5]
    assert [departure(intent) for intent in intents] == sorted(departure(intent) for intent in intents)
    assert_sound(street)


def test_requests_that_wait_together_are_committed_once(street: Process) -> None:
    commits: list[Connection] = []
    with on_commit(commits.append):
        outcomes(street, *[STREET.submission("W", "E") for _ in range(5)])
    # The first request is in its transaction already when the others come.
    assert len(commits) == 1


def test_everything_in_a_batch_has_one_now(ledger: str) -> None:
    ticking = FakeClock()

    def clock() -> int:
        ticking.advance(ms=7)
        return ticking.now_ms

    with Process(ledger, SQUARE.airspace, clock) as process:
        answers = outcomes(process, *[SQUARE.submission("N", "S") for _ in range(3)])
    assert len({answer.intent.received_ms for answer in answers if isinstance(answer, Outcome)}) == 1


def test_a_clock_that_is_corrected_a_little_does_not_bring_back_moments_that_have_been(
    square: Process, clock: FakeClock
) -> None:
    clock.advance(seconds=100)
    square.submit(SQUARE.submission("N", "S"))
    clock.advance(seconds=-10)
    intent = square.submit(SQUARE.submission("S", "N"))
    assert departure(intent) >= START_MS + 100_000


def test_after_a_clock_was_wrong_by_a_day_the_service_goes_on_at_the_right_time(
    street: Process, clock: FakeClock
) -> None:
    before = street.submit(STREET.submission("W", "E"))
    clock.advance(seconds=86_400)
    with pytest.raises(DepartureInThePast):
        street.submit(STREET.submission("W", "E"))
    clock.advance(seconds=-86_400)
    intent = street.submit(STREET.submission("W", "E"))
    assert departure(intent) > departure(before)
    assert_sound(street)


# Previews


def test_a_preview_is_the_plan_that_a_submission_gets_next(street: Process) -> None:
    street.submit(STREET.submission("W", "E"))
    preview = asyncio.run(street.deconfliction.preview(STREET.submission("W", "E")))
    intent = street.submit(STREET.submission("W", "E"))
    assert intent.trajectory is not None
    assert isinstance(preview, PreviewPlan)
    for column in ("block", "arrive_ms", "depart_ms"):
        assert getattr(preview.trajectory, column).tolist() == getattr(intent.trajectory, column).tolist()
    for column in ("block", "enter_ms", "exit_ms"):
        assert getattr(preview.reservations, column).tolist() == getattr(intent.reservations, column).tolist()


def test_a_preview_leaves_ledger_and_index_as_they_were(street: Process) -> None:
    asyncio.run(street.deconfliction.preview(STREET.submission("W", "E")))
    assert (len(street.ledger.everything()[0]), street.ledger.revision()) == (0, 0)
    assert street.indexed(0) == {}


# Neighbours in a batch


def reserve_secretly(location: str, hold: Hold, sequence: int) -> None:
    """Insert a reservation as somebody would who knows nothing of the journal."""
    with database(location) as connection:
        connection.execute("INSERT INTO reservations VALUES (?, ?, ?, ?)", (*hold, sequence))


def test_a_request_that_the_database_refuses_harms_no_neighbour_in_its_batch(square: Process) -> None:
    with database(square.location) as connection:
        connection.execute("CREATE UNIQUE INDEX one_flight_each ON flight_intents (operator)")
    answers = outcomes(
        square,
        SQUARE.submission("N", "S", operator="a"),
        SQUARE.submission("N", "S", operator="a"),
        SQUARE.submission("S", "N", operator="b"),
    )
    before, refused, after = answers
    assert isinstance(before, Outcome)
    assert isinstance(after, Outcome)
    assert [before.intent.sequence, after.intent.sequence] == [1, 2]
    assert isinstance(refused, LedgerUnavailable)
    assert_sound(square)


@on_postgresql
def test_text_that_the_database_cannot_take_harms_only_who_sent_it(square: Process) -> None:
    before, refused, after = outcomes(
        square,
        SQUARE.submission("N", "S"),
        SQUARE.submission("N", "S", operator="a\x00b"),
        SQUARE.submission("S", "N"),
    )
    assert isinstance(before, Outcome)
    assert isinstance(after, Outcome)
    assert isinstance(refused, LedgerUnavailable)
    assert [before.intent.sequence, after.intent.sequence] == [1, 2]
    assert square.writer.trouble is None
    assert_sound(square)


@on_postgresql
def test_a_process_whose_database_was_replaced_by_an_older_one_loads_it_afresh(
    ledgers: Ledgers, clock: FakeClock
) -> None:
    ledger = ledgers.migrated()
    with Process(ledger, STREET.airspace, clock) as process:
        process.submit(STREET.submission("W", "E", earliest_ms=DEPARTURE_MS + 300_000))
    older = ledgers.copy(ledger)
    with Process(ledger, STREET.airspace, clock) as process:
        lost = process.submit(STREET.submission("W", "E", window_ms=0))
        # As after a failover to a standby that had not received the last commits.
        name, other = (urlsplit(location).path.removeprefix("/") for location in (ledger, older))
        with database(older.replace(other, "postgres")) as admin:
            admin.execute("SELECT pg_terminate_backend(pid, 5000) FROM pg_stat_activity WHERE datname = ?", [name])
            admin.execute(f"ALTER DATABASE {name} RENAME TO {name}_gone")
            admin.execute(f"ALTER DATABASE {other} RENAME TO {name}")
        with Process(ledger, STREET.airspace, clock) as survivor:
            survivor.submit(STREET.submission("W", "E", earliest_ms=DEPARTURE_MS + 600_000))
        again = process.submit(STREET.submission("W", "E", window_ms=0))
        assert (again.state, departure(again)) == (State.ACCEPTED, departure(lost))
        assert_sound(process)
        with database(ledger.replace(name, "postgres")) as admin:
            admin.execute("SELECT pg_terminate_backend(pid, 5000) FROM pg_stat_activity WHERE datname = ?", [name])
            admin.execute(f"ALTER DATABASE {name} RENAME TO {other}")
            admin.execute(f"ALTER DATABASE {name}_gone RENAME TO {name}")


def test_reservations_that_the_index_had_missed_are_planned_around_as_soon_as_the_database_shows_them(
    square: Process,
) -> None:
    first = square.submit(SQUARE.submission("N", (1, 2, 0)))
    secret = (SQUARE.block((1, 1, 0)), START_MS + 600_000, START_MS + 700_000)
    reserve_secretly(square.location, secret, first.sequence)
    intent = square.submit(SQUARE.submission((1, 0, 0), (1, 1, 0), earliest_ms=START_MS + 600_000, window_ms=600_000))
    # It arrives, and then stays no longer; its first moment there is the first free one.
    (entered,) = [enter for block, enter, _ in held(intent) if block == secret[0]]
    assert (intent.sequence, entered) == (2, secret[2])
    assert_sound(square)


def test_who_was_being_written_when_the_writer_died_hears_that_nobody_knows(ledger: str, clock: FakeClock) -> None:
    class PowerCut(BaseException):
        pass

    def render(_: Outcome) -> Never:
        raise PowerCut

    died = threading.Event()
    with Process(ledger, SQUARE.airspace, clock, on_death=died.set) as process:
        with pytest.raises(OutcomeUnknown, match="the ledger writer has died"):
            process.submit(SQUARE.submission("N", "S"), IdempotencyKey("key", "digest", render))
        assert died.wait(10)
        with pytest.raises(LedgerUnavailable, match="has stopped"):
            process.submit(SQUARE.submission("N", "S"))


# Work that plans nothing


def test_work_is_done_under_the_write_lock_and_durable_before_its_answer(square: Process) -> None:
    request = SQUARE.submission("N", "S")

    def record(transaction: Transaction, now: int) -> FlightIntent:
        return transaction.record(intent_id="an id", submission=request, now_ms=now, refusal=Refusal("why", "because"))

    recorded = asyncio.run(square.writer.perform(record, lambda: None))
    found = square.ledger.find("an id")
    assert found is not None
    assert (found.sequence, found.received_ms) == (recorded.sequence, START_MS) == (1, START_MS)


def test_work_that_fails_after_it_has_written_is_undone(square: Process) -> None:
    def record_and_fail(transaction: Transaction, now: int) -> Never:
        transaction.record(
            intent_id="an id", submission=SQUARE.submission("N", "S"), now_ms=now, refusal=Refusal("why", "because")
        )
        raise IllegalTransition("after all, no")

    with pytest.raises(IllegalTransition):
        asyncio.run(square.writer.perform(record_and_fail, lambda: None))
    assert square.ledger.find("an id") is None
    assert_gapless(square.location)


@pytest.mark.parametrize("answer", [0, "", [], False])
def test_what_was_done_although_its_commit_was_lost_is_answered_however_little_it_is(
    square: Process, answer: object
) -> None:
    with on_next_commit(commit_and_fail):
        assert asyncio.run(square.writer.perform(lambda *_: answer, lambda: answer)) == answer


def test_what_is_not_found_after_its_commit_was_lost_was_not_recorded(square: Process) -> None:
    with on_next_commit(fail), pytest.raises(LedgerUnavailable, match="nothing was recorded"):
        asyncio.run(square.writer.perform(lambda *_: 1, lambda: None))


def test_the_seconds_of_work_are_reported_only_if_it_plans(ledger: str, clock: FakeClock) -> None:
    reports: list[BatchReport] = []
    with Process(ledger, SQUARE.airspace, clock, observers=[reports.append]) as process:
        intent = process.submit(SQUARE.submission("N", "S"))
        process.cancel(intent)
    assert [len(report.requests) for report in reports] == [1, 1]
    assert [(len(report.queue_s), len(report.plan_s)) for report in reports] == [(1, 1), (0, 0)]


def test_an_observer_that_fails_harms_neither_the_others_nor_the_writer(ledger: str, clock: FakeClock) -> None:
    reports: list[BatchReport] = []

    def fail_to_observe(_: BatchReport) -> Never:
        raise RuntimeError("a bug")

    with Process(ledger, SQUARE.airspace, clock, observers=[fail_to_observe, reports.append]) as process:
        for _ in range(2):
            process.submit(SQUARE.submission("N", "S"))
    assert len(reports) == 2
