"""The one writer: order, batches, isolation of neighbours, failures of the database, cancellation."""

import asyncio
import contextlib
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Never
from urllib.parse import urlsplit

import pytest
import structlog
from sqlalchemy import Connection, Engine, event
from sqlalchemy.exc import OperationalError

from app.deconfliction import IdempotencyKey, Outcome, PreviewPlan
from app.errors import (
    BeyondHorizon,
    DepartureInThePast,
    IdempotencyKeyReused,
    IllegalTransition,
    LedgerUnavailable,
    OutcomeUnknown,
    QueueFull,
    UnknownFlightIntent,
)
from app.flight_intents import FlightIntent, Refusal, Reservations, State, Submission
from app.ledger import Transaction, open_ledger
from app.writer import BatchReport, Policy
from tests.ledger.district import DEPARTURE_MS, SQUARE, START_MS, STREET
from tests.ledger.locations import Ledgers, database, on_postgresql, on_sqlite, write_lock
from tests.ledger.process import (
    DAY_MS,
    HORIZON_MS,
    POLICY,
    FakeClock,
    Hold,
    Process,
    assert_gapless,
    assert_journal_tells_states,
    assert_no_overlaps,
    outcomes,
    reserved,
    until,
)


@pytest.fixture
def street(ledger: str, clock: FakeClock) -> Iterator[Process]:
    with Process(ledger, STREET.airspace, clock) as process:
        yield process


@pytest.fixture
def square(ledger: str, clock: FakeClock) -> Iterator[Process]:
    with Process(ledger, SQUARE.airspace, clock) as process:
        yield process


THREE_DAYS_MS = 3 * DAY_MS


def held(intent: FlightIntent) -> set[Hold]:
    """Return an intent's reservations."""
    columns: Reservations = intent.reservations
    return set(zip(columns.block.tolist(), columns.enter_ms.tolist(), columns.exit_ms.tolist(), strict=True))


def departure(intent: FlightIntent) -> int:
    assert intent.trajectory is not None
    return intent.trajectory.departure_ms


def arrival(intent: FlightIntent) -> int:
    assert intent.trajectory is not None
    return intent.trajectory.arrival_ms


def key(name: str, digest: str = "one body") -> IdempotencyKey:
    """Return a key whose answers are rendered as their sequence numbers."""
    return IdempotencyKey(name, digest, lambda outcome: str(outcome.intent.sequence).encode())


def submit(process: Process, digest: str = "one body", name: str = "key", **request: object) -> Outcome:
    """Submit a flight across the square with an idempotency key."""
    submission = SQUARE.submission("N", "S", **request)  # type: ignore[arg-type]
    return asyncio.run(process.deconfliction.submit(submission, key(name, digest)))


def assert_sound(process: Process, now_ms: int = 0) -> None:
    """Fail unless table, index, counters and journal agree and nothing overlaps."""
    assert_no_overlaps(process.location)
    assert_gapless(process.location)
    assert_journal_tells_states(process.location)
    assert process.indexed(now_ms) == reserved(process.location, now_ms)


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


# A database that fails


@contextmanager
def on_commit(handler: Callable[[Connection], object]) -> Iterator[None]:
    """Call a handler with each writing connection that is about to commit."""

    def listener(connection: Connection) -> None:
        is_sqlite = connection.dialect.name == "sqlite"
        query = "PRAGMA query_only" if is_sqlite else "SELECT current_setting('transaction_read_only')::bool::int"
        if connection.exec_driver_sql(query).scalar() == 0:
            handler(connection)

    event.listen(Engine, "commit", listener)
    try:
        yield
    finally:
        event.remove(Engine, "commit", listener)


@contextmanager
def on_next_commit(handler: Callable[[Connection], object]) -> Iterator[None]:
    """Call a handler with the writing connection that commits next; commits after that are left alone."""
    handlers = [handler]
    with on_commit(lambda connection: handlers.pop()(connection) if handlers else None):
        yield
    assert not handlers


@contextmanager
def unwritable() -> Iterator[None]:
    """Fail all transactions that write, from their beginning."""

    def listener(connection: Connection) -> None:
        if connection.engine.pool.size() == 1:  # type: ignore[attr-defined]
            raise OperationalError("BEGIN", {}, sqlite3.OperationalError("unable to open database file"))

    event.listen(Engine, "begin", listener)
    try:
        yield
    finally:
        event.remove(Engine, "begin", listener)


def fail(connection: Connection) -> None:
    """Fail instead of committing."""
    del connection
    raise OperationalError("COMMIT", {}, Exception("the connection was lost"))


def commit_and_fail(connection: Connection) -> None:
    """Commit, and then lose the connection."""
    connection.connection.commit()
    fail(connection)


def test_requests_whose_commit_failed_are_told_that_nothing_was_recorded(square: Process) -> None:
    square.submit(SQUARE.submission("N", "S"))
    with on_next_commit(fail):
        answers = outcomes(square, *[SQUARE.submission("N", "S") for _ in range(3)])
    assert [type(answer) for answer in answers] == [LedgerUnavailable] * 3
    assert len(square.ledger.everything()[0]) == 1


def test_after_a_commit_that_failed_the_service_goes_on_as_if_it_had_not_been_tried(square: Process) -> None:
    first = square.submit(SQUARE.submission("N", "S"))
    with on_next_commit(fail), pytest.raises(LedgerUnavailable):
        square.submit(SQUARE.submission("N", "S"))
    second = square.submit(SQUARE.submission("S", "N"))
    assert [first.sequence, second.sequence] == [1, 2]
    assert_sound(square)


def at_once(process: Process, *submissions: Submission) -> list[Outcome | BaseException]:
    """Submit together, in one batch or several; return outcomes and errors."""

    async def gather() -> list[Outcome | BaseException]:
        requests = (process.deconfliction.submit(submission) for submission in submissions)
        return await asyncio.gather(*requests, return_exceptions=True)

    return asyncio.run(gather())


def test_while_the_ledger_fails_nobody_waits_for_it(square: Process) -> None:
    with unwritable():
        failed = at_once(square, *[SQUARE.submission("N", "S") for _ in range(100)])
    assert [type(answer) for answer in failed] == [LedgerUnavailable] * 100
    assert "unable to open database file; nothing was recorded" in str(failed[-1])
    assert len(square.ledger.everything()[0]) == 0


def test_the_writer_notices_by_itself_that_the_ledger_can_be_written_again(square: Process) -> None:
    with unwritable(), pytest.raises(LedgerUnavailable):
        square.submit(SQUARE.submission("N", "S"))
    assert square.writer.trouble is not None
    asyncio.run(until(lambda: square.writer.trouble is None))
    assert square.submit(SQUARE.submission("N", "S")).sequence == 1
    assert_sound(square)


def test_a_commit_whose_fate_nobody_can_tell_is_answered_as_unknown(ledger: str, clock: FakeClock) -> None:
    policy = replace(POLICY, look_up_ms=200)
    with Process(ledger, SQUARE.airspace, clock, policy=policy) as process:
        with on_commit(commit_and_fail), pytest.raises(OutcomeUnknown, match="repeat the request with the same"):
            process.submit(SQUARE.submission("N", "S"))
        # It was there after all.
        assert process.submit(SQUARE.submission("N", "S")).sequence == 2
        assert_sound(process)


@on_sqlite
def test_writing_what_changes_nothing_writes(ledger: str) -> None:
    book = open_ledger(ledger, SQUARE.airspace, claim=True)
    with database(ledger) as connection:
        connection.execute("UPDATE airspace SET name = 'there is a log now'")
        before = Path(f"{ledger}-wal").stat().st_size
        with book.transaction() as transaction:
            transaction.touch()
        assert Path(f"{ledger}-wal").stat().st_size > before
        assert connection.rows("SELECT sequence, revision FROM counters") == [(0, 0)]
    book.close()


@contextmanager
def broken_log() -> Iterator[None]:
    """Let every attempt to log fail, as it does when the log's disk is full."""

    def fail_to_log(*_: object) -> Never:
        raise OSError("no space left on device")

    before = structlog.get_config()
    structlog.configure(processors=[fail_to_log])
    yield
    structlog.configure(**before)


def test_a_log_that_cannot_be_written_stops_nothing_and_reserves_nothing_twice(street: Process) -> None:
    with broken_log():
        first = street.submit(STREET.submission("W", "E"))
        with on_next_commit(fail), pytest.raises(LedgerUnavailable):
            street.submit(STREET.submission("W", "E"))
        asyncio.run(until(lambda: street.writer.trouble is None))
        with on_next_commit(commit_and_fail):
            second = street.submit(STREET.submission("W", "E"))
    assert (first.sequence, second.sequence) == (1, 2)
    assert_sound(street)


def test_a_request_that_fails_as_nobody_expected_holds_nothing(street: Process) -> None:
    def fail_to_render(_: Outcome) -> Never:
        raise RuntimeError("a bug")

    with pytest.raises(RuntimeError, match="a bug"):
        street.submit(STREET.submission("W", "E"), IdempotencyKey("key", "digest", fail_to_render))
    assert len(street.ledger.everything()[0]) == 0
    assert departure(street.submit(STREET.submission("W", "E"))) == DEPARTURE_MS
    assert_sound(street)


def test_requests_whose_commit_was_lost_after_it_happened_are_answered_from_the_ledger(street: Process) -> None:
    with on_next_commit(commit_and_fail):
        answers = outcomes(street, STREET.submission("W", "E", window_ms=0), STREET.submission("W", "E", window_ms=0))
    accepted, refused = (answer.intent for answer in answers if isinstance(answer, Outcome))
    assert (accepted.sequence, accepted.state, held(accepted)) == (1, State.ACCEPTED, set(reserved(street.location)))
    assert refused.refusal is not None
    assert (refused.sequence, refused.refusal.reason) == (2, "no_departure_slot")
    assert refused.refusal.conflicting_intents == (accepted.id,)


def test_after_a_commit_that_was_lost_the_service_goes_on_with_what_it_did(street: Process) -> None:
    with on_next_commit(commit_and_fail):
        street.submit(STREET.submission("W", "E"))
    second = street.submit(STREET.submission("W", "E"))
    assert second.sequence == 2
    assert_sound(street)


def test_a_cancellation_whose_commit_was_lost_is_answered_from_the_ledger(square: Process) -> None:
    intent = square.submit(SQUARE.submission("N", "S"))
    with on_next_commit(commit_and_fail):
        cancelled = square.cancel(intent)
    assert (cancelled.state, cancelled.version) == (State.CANCELLED, 2)
    assert_sound(square)


def test_a_cancellation_whose_commit_failed_has_not_happened(square: Process) -> None:
    intent = square.submit(SQUARE.submission("N", "S"))
    with on_next_commit(fail), pytest.raises(LedgerUnavailable):
        square.cancel(intent)
    found = square.ledger.find(intent.id)
    assert found is not None
    assert (found.state, held(found)) == (State.ACCEPTED, held(intent))
    square.submit(SQUARE.submission("S", "N"))
    assert_sound(square)


def test_a_repetition_whose_commit_was_lost_is_answered_with_the_first_answer(square: Process) -> None:
    first = submit(square)
    with on_next_commit(commit_and_fail):
        again = submit(square)
    assert (again.intent.id, again.replayed) == (first.intent.id, b"1")


def cut(location: str, *, after_commit: bool) -> Callable[[Connection], None]:
    """Return a handler for which somebody cuts the connection at the server."""

    def handler(connection: Connection) -> None:
        pid = connection.exec_driver_sql("SELECT pg_backend_pid()").scalar_one()
        if after_commit:
            connection.connection.commit()
        with database(location) as somebody:
            assert somebody.rows("SELECT pg_terminate_backend(?, 5000)", [pid]) == [(True,)]

    return handler


@on_postgresql
def test_requests_whose_connection_was_cut_before_the_commit_are_told_that_nothing_was_recorded(
    square: Process,
) -> None:
    with on_next_commit(cut(square.location, after_commit=False)):
        answers = outcomes(square, *[SQUARE.submission("N", "S") for _ in range(3)])
    assert [type(answer) for answer in answers] == [LedgerUnavailable] * 3
    assert square.submit(SQUARE.submission("N", "S")).sequence == 1
    assert_sound(square)


@on_postgresql
def test_a_request_whose_connection_was_cut_after_the_commit_is_answered_from_the_ledger(square: Process) -> None:
    with on_next_commit(cut(square.location, after_commit=True)):
        first = square.submit(SQUARE.submission("N", "S"))
    assert (first.sequence, held(first)) == (1, set(reserved(square.location)))
    assert square.submit(SQUARE.submission("S", "N")).sequence == 2
    assert_sound(square)


@on_postgresql
def test_a_connection_that_was_cut_between_two_requests_is_made_again_for_the_second(square: Process) -> None:
    square.submit(SQUARE.submission("N", "S"))
    with database(square.location) as somebody:
        others = "SELECT pg_terminate_backend(pid, 5000) FROM pg_stat_activity WHERE datname = current_database()"
        assert (True,) in somebody.rows(f"{others} AND pid <> pg_backend_pid()")
    assert square.submit(SQUARE.submission("S", "N")).sequence == 2
    assert_sound(square)


@on_postgresql
def test_a_commit_is_durable_before_its_answer_whatever_the_server_does_by_default(
    ledger: str, clock: FakeClock
) -> None:
    with database(ledger) as somebody:
        somebody.execute(f"ALTER DATABASE {urlsplit(ledger).path[1:]} SET synchronous_commit = off")
    waits: list[str] = []
    with (
        Process(ledger, SQUARE.airspace, clock) as process,
        on_commit(lambda connection: waits.append(connection.exec_driver_sql("SHOW synchronous_commit").scalar_one())),
    ):
        process.submit(SQUARE.submission("N", "S"))
    assert waits == ["on"]


@on_sqlite
def test_a_full_disk_fails_the_whole_batch_and_leaves_nothing_of_it(square: Process) -> None:
    square.submit(SQUARE.submission("N", "S"))
    small = SQUARE.submission("N", "S")
    too_big = replace(small, reference="x" * 1_000_000)

    def no_more_pages(connection: Connection) -> None:
        connection.exec_driver_sql("PRAGMA max_page_count = 1")

    event.listen(Engine, "begin", no_more_pages)
    try:
        answers = outcomes(square, small, too_big)
    finally:
        event.remove(Engine, "begin", no_more_pages)
    assert [type(answer) for answer in answers] == [LedgerUnavailable] * 2
    assert len(square.ledger.everything()[0]) == 1
    assert square.submit(SQUARE.submission("S", "N")).sequence == 2
    assert_sound(square)


@on_sqlite
def test_a_commit_that_fails_on_a_full_disk_has_surely_not_happened(square: Process) -> None:
    def disk_is_full(_: Connection) -> Never:
        error = sqlite3.OperationalError("database or disk is full")
        error.sqlite_errorcode = sqlite3.SQLITE_FULL
        raise OperationalError("COMMIT", {}, error)

    with on_commit(disk_is_full):
        answers = at_once(square, *[SQUARE.submission("N", "S") for _ in range(3)])
    assert [type(answer) for answer in answers] == [LedgerUnavailable] * 3
    assert square.submit(SQUARE.submission("N", "S")).sequence == 1


@on_sqlite
@pytest.mark.parametrize("replaced", [False, True], ids=["moved away", "replaced"])
def test_a_ledger_that_was_moved_is_noticed_before_anything_is_accepted(replaced: bool, square: Process) -> None:
    first = square.submit(SQUARE.submission("N", "S"))
    path = Path(square.location)
    path.rename(path.with_suffix(".moved"))
    if replaced:
        path.write_bytes(path.with_suffix(".moved").read_bytes())
    with pytest.raises(LedgerUnavailable, match="was moved or replaced" if replaced else "is gone"):
        square.submit(SQUARE.submission("N", "S"))
    with pytest.raises(LedgerUnavailable):
        square.ledger.find(first.id)
    assert path.exists() is replaced
    path.with_suffix(".moved").rename(path)
    asyncio.run(until(lambda: square.writer.trouble is None))
    assert square.submit(SQUARE.submission("N", "S")).sequence == 2
    assert_sound(square)


def test_an_unexpected_error_in_one_request_harms_neither_its_neighbours_nor_the_writer(square: Process) -> None:
    class Surprise(Exception):
        pass

    def render(_: Outcome) -> bytes:
        raise Surprise

    bad = IdempotencyKey("key", "digest", render)
    before, surprised, after = square.together(
        square.deconfliction.submit(SQUARE.submission("N", "S")),
        square.deconfliction.submit(SQUARE.submission("N", "S"), bad),
        square.deconfliction.submit(SQUARE.submission("S", "N")),
    )
    assert isinstance(surprised, Surprise)
    assert [before.intent.sequence, after.intent.sequence] == [1, 2]
    assert_sound(square)


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


# Requests that are given up


def test_a_request_that_is_given_up_while_it_is_planned_does_not_stop_the_writer(square: Process) -> None:
    async def give_up() -> Outcome:
        with write_lock(square.location):
            given_up = asyncio.create_task(square.deconfliction.submit(SQUARE.submission("N", "S")))
            last = asyncio.create_task(square.deconfliction.submit(SQUARE.submission("S", "N")))
            await until(lambda: square.writer.waiting == 1)
            given_up.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await given_up
        return await asyncio.wait_for(last, timeout=2)

    assert asyncio.run(give_up()).intent.sequence == 2
    assert square.writer.is_running
    assert_sound(square)


def test_a_request_that_is_given_up_in_the_queue_does_not_stop_the_writer(square: Process) -> None:
    async def give_up() -> Outcome:
        with write_lock(square.location):
            first = asyncio.create_task(square.deconfliction.submit(SQUARE.submission("N", "S")))
            given_up = asyncio.create_task(square.deconfliction.submit(SQUARE.submission("N", "S")))
            last = asyncio.create_task(square.deconfliction.submit(SQUARE.submission("S", "N")))
            await until(lambda: square.writer.waiting == 2)
            given_up.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await given_up
        await first
        return await asyncio.wait_for(last, timeout=2)

    assert asyncio.run(give_up()).intent.state is State.ACCEPTED
    assert square.writer.is_running
    assert_sound(square)


def test_a_request_to_a_writer_that_has_stopped_is_refused_at_once(square: Process) -> None:
    square.writer.stop()

    async def submit() -> None:
        await asyncio.wait_for(square.deconfliction.submit(SQUARE.submission("N", "S")), timeout=2)

    with pytest.raises(LedgerUnavailable):
        asyncio.run(submit())


def test_stopping_finishes_what_waits(square: Process) -> None:
    async def stop_meanwhile() -> list[Outcome]:
        with write_lock(square.location):
            tasks = [asyncio.create_task(square.deconfliction.submit(SQUARE.submission("N", "S"))) for _ in range(3)]
            await until(lambda: square.writer.waiting == 2)
            stopping = asyncio.create_task(asyncio.to_thread(square.writer.stop))
            await until(lambda: square.writer.waiting == 3)
        await stopping
        return await asyncio.gather(*tasks)

    assert [outcome.intent.sequence for outcome in asyncio.run(stop_meanwhile())] == [1, 2, 3]


def test_a_full_queue_takes_nothing(ledger: str, clock: FakeClock) -> None:
    policy = Policy(POLICY.idempotency_ms, queue_limit=1)
    with Process(ledger, SQUARE.airspace, clock, policy=policy) as process:

        async def overfill() -> list[Outcome]:
            with write_lock(process.location):
                first = asyncio.create_task(process.deconfliction.submit(SQUARE.submission("N", "S")))
                await asyncio.sleep(0)
                await until(lambda: process.writer.waiting == 0)
                second = asyncio.create_task(process.deconfliction.submit(SQUARE.submission("N", "S")))
                await asyncio.sleep(0)
                with pytest.raises(QueueFull, match="1 requests are waiting"):
                    await process.deconfliction.submit(SQUARE.submission("N", "S"))
            return [await first, await second]

        assert [outcome.intent.sequence for outcome in asyncio.run(overfill())] == [1, 2]
        assert len(process.ledger.everything()[0]) == 2


# Cancellation (domain 4)


def test_cancelling_before_departure_frees_the_space_at_once(street: Process) -> None:
    first = street.submit(STREET.submission("W", "E"))
    assert street.submit(STREET.submission("W", "E", window_ms=0)).state is State.REJECTED
    cancelled = street.cancel(first)
    again = street.submit(STREET.submission("W", "E", window_ms=0))
    assert (cancelled.state, held(cancelled)) == (State.CANCELLED, set())
    assert held(again) == held(first)
    assert_sound(street)


def test_cancelling_at_the_moment_of_departure_keeps_the_reservations_until_arrival(
    street: Process, clock: FakeClock
) -> None:
    first = street.submit(STREET.submission("W", "E"))
    clock.now_ms = departure(first)
    cancelled = street.cancel(first)
    assert (cancelled.state, held(cancelled)) == (State.CANCELLED, held(first))
    behind = street.submit(STREET.submission("W", "E", earliest_ms=clock.now_ms))
    assert departure(behind) > departure(first)
    assert_sound(street, clock.now_ms)


def test_a_millisecond_before_departure_the_reservations_still_go(street: Process, clock: FakeClock) -> None:
    first = street.submit(STREET.submission("W", "E"))
    clock.now_ms = DEPARTURE_MS - 1
    assert held(street.cancel(first)) == set()


def test_cancelling_at_the_moment_of_arrival_is_allowed(street: Process, clock: FakeClock) -> None:
    first = street.submit(STREET.submission("W", "E"))
    clock.now_ms = arrival(first)
    assert street.cancel(first).state is State.CANCELLED


def test_cancelling_after_arrival_is_an_illegal_transition(street: Process, clock: FakeClock) -> None:
    first = street.submit(STREET.submission("W", "E"))
    clock.now_ms = arrival(first) + 1
    with pytest.raises(IllegalTransition, match=r"arrived at 2026-11-22T08:01:11\.676Z"):
        street.cancel(first)
    found = street.ledger.find(first.id)
    assert found is not None
    assert (found.state, found.version) == (State.ACCEPTED, 1)


def test_cancelling_twice_changes_nothing_the_second_time(square: Process) -> None:
    intent = square.submit(SQUARE.submission("N", "S"))
    first = square.cancel(intent)
    second = square.cancel(intent)
    assert (second.state, second.version) == (State.CANCELLED, first.version)
    assert_gapless(square.location)


def test_a_refused_intent_cannot_be_cancelled(street: Process) -> None:
    street.submit(STREET.submission("W", "E"))
    refused = street.submit(STREET.submission("W", "E", window_ms=0))
    with pytest.raises(IllegalTransition, match="is rejected and cannot be cancelled"):
        street.cancel(refused)


def test_an_intent_that_does_not_exist_cannot_be_cancelled(square: Process) -> None:
    with pytest.raises(UnknownFlightIntent):
        asyncio.run(square.deconfliction.cancel("no such id"))


def test_what_a_flight_in_the_air_held_before_its_cancellation_is_in_the_journal_as_kept(
    street: Process, clock: FakeClock
) -> None:
    first = street.submit(STREET.submission("W", "E"))
    second = street.submit(STREET.submission("W", "E", earliest_ms=START_MS + 600_000))
    clock.now_ms = departure(first)
    street.cancel(first)
    street.cancel(second)
    entries = street.ledger.journal_after(2, 10)
    assert [entry.kind for entry in entries] == ["cancelled", "cancelled"]
    assert entries[0].released.tolist() == []
    assert {tuple(hold) for hold in entries[1].released.tolist()} == held(second)


# Idempotency keys


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
