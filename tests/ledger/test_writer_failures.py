"""The one writer and a database that fails: who is told what, and that it goes on."""

import asyncio
import sqlite3
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Never
from urllib.parse import urlsplit

import pytest
import structlog
from sqlalchemy import Connection, Engine, event
from sqlalchemy.exc import OperationalError

from app.batches import BatchKey
from app.deconfliction import IdempotencyKey, Outcome
from app.errors import LedgerUnavailable, OutcomeUnknown
from app.flight_intents import FlightIntent, State, Submission
from app.ledger import open_ledger
from app.writer import BatchReport
from tests.ledger.commits import commit_and_fail, fail, on_commit, on_next_commit, unwritable
from tests.ledger.district import DEPARTURE_MS, SQUARE, STREET
from tests.ledger.locations import database, on_postgresql, on_sqlite
from tests.ledger.process import (
    POLICY,
    FakeClock,
    Process,
    assert_sound,
    departure,
    held,
    key,
    outcomes,
    reserved,
    until,
)


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
            process.submit(SQUARE.submission("N", "S"), key("once"))
        # It was there after all.
        assert process.submit(SQUARE.submission("N", "S")).sequence == 2
        assert_sound(process)


@pytest.mark.parametrize("what", ["submit", "change", "cancel"])
def test_without_a_key_nobody_is_told_to_ask_again_before_they_have_looked(
    ledger: str, clock: FakeClock, what: str
) -> None:
    policy = replace(POLICY, look_up_ms=200)
    request = SQUARE.submission("N", "S")
    with Process(ledger, SQUARE.airspace, clock, policy=policy) as process:
        flight = process.submit(request)
        asks: dict[str, Callable[[], Coroutine[Any, Any, object]]] = {
            "submit": lambda: process.deconfliction.submit(request),
            "change": lambda: process.deconfliction.change(flight.id, request, None),
            "cancel": lambda: process.deconfliction.cancel(flight.id),
        }
        with on_commit(commit_and_fail), pytest.raises(OutcomeUnknown, match="read first what there is") as unknown:
            asyncio.run(asks[what]())
    assert "Key" not in str(unknown.value)


@pytest.mark.parametrize("name", [None, "once"])
def test_a_batch_can_be_repeated_where_it_has_a_key(ledger: str, clock: FakeClock, name: str | None) -> None:
    reports: list[BatchReport] = []
    with Process(ledger, SQUARE.airspace, clock, observers=[reports.append]) as process:
        named = None if name is None else BatchKey(name, "digest")
        asyncio.run(process.batches.submit([SQUARE.submission("N", "S")], 0, named, lambda: False))
    assert {request.has_key for report in reports for request in report.requests} == {name is not None}


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


@contextmanager
def before_looking_up(process: Process, happens: Callable[[], object]) -> Iterator[None]:
    """Let something happen once a commit is uncertain, before the ledger is asked what came of it."""
    find = process.ledger.find

    def find_too_late(intent_id: str) -> FlightIntent | None:
        happens()
        return find(intent_id)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(process.ledger, "find", find_too_late)
        yield


def test_a_change_is_not_taken_for_one_that_moved_the_flight_elsewhere_under_the_same_version(
    pair: tuple[Process, Process],
) -> None:
    one, other = pair
    request = STREET.submission("W", "E")
    first = one.submit(request)
    with (
        before_looking_up(one, lambda: other.submit(replace(request, priority=1))),
        on_next_commit(fail),
        pytest.raises(OutcomeUnknown, match="somebody else changed"),
    ):
        asyncio.run(one.deconfliction.change(first.id, request, None))
    moved = one.ledger.find(first.id)
    assert moved is not None
    # Nothing but the path tells it from what was to be written.
    assert (moved.version, moved.state, moved.submission) == (2, State.ACCEPTED, first.submission)
    assert departure(moved) > departure(first)


def test_a_change_that_was_refused_at_first_and_not_even_tried_again_is_not_answered_by_that_refusal(
    street: Process, clock: FakeClock
) -> None:
    street.submit(STREET.submission("W", "E"))
    second = street.submit(STREET.submission("W", "E", earliest_ms=DEPARTURE_MS + 600_000))

    def render_late(_: Outcome) -> Never:
        clock.now_ms = DEPARTURE_MS + 1
        raise RuntimeError("the batch is done again, after the departure that was asked for")

    late = IdempotencyKey("key", "digest", render_late)
    with on_next_commit(fail):
        answers = street.together(
            street.deconfliction.change(second.id, STREET.submission("W", "E", window_ms=0), None),
            street.deconfliction.submit(STREET.submission("W", "E", earliest_ms=DEPARTURE_MS + 1_200_000), late),
        )
    assert [type(answer) for answer in answers] == [LedgerUnavailable] * 2


def test_an_activation_whose_commit_was_lost_is_answered_from_the_ledger(street: Process) -> None:
    first = street.submit(STREET.submission("W", "E"))
    with on_next_commit(commit_and_fail):
        activated = asyncio.run(street.deconfliction.activate(first.id))
    assert (activated.state, activated.version) == (State.ACTIVATED, 2)


def later(intent: FlightIntent, process: Process) -> None:
    """Put a flight off by a day; it is not activated then."""
    tomorrow = STREET.submission("W", "E", earliest_ms=DEPARTURE_MS + 86_400_000)
    assert isinstance(asyncio.run(process.deconfliction.change(intent.id, tomorrow, None)), Outcome)


def test_whether_a_flight_was_activated_before_somebody_put_it_off_is_not_known(ledger: str, clock: FakeClock) -> None:
    with (
        Process(ledger, STREET.airspace, clock, activation_lead_ms=3_600_000) as one,
        Process(ledger, STREET.airspace, clock, activation_lead_ms=3_600_000) as other,
    ):
        first = one.submit(STREET.submission("W", "E"))
        with (
            before_looking_up(one, lambda: later(first, other)),
            on_next_commit(commit_and_fail),
            pytest.raises(OutcomeUnknown, match="whether it was activated before"),
        ):
            asyncio.run(one.deconfliction.activate(first.id))
        found = one.ledger.find(first.id)
    assert found is not None
    assert (found.version, found.activated_ms) == (3, None)


def test_a_flight_that_was_put_off_under_the_version_of_its_activation_was_not_activated(
    pair: tuple[Process, Process],
) -> None:
    one, other = pair
    first = one.submit(STREET.submission("W", "E"))
    with (
        before_looking_up(one, lambda: later(first, other)),
        on_next_commit(fail),
        pytest.raises(LedgerUnavailable, match="nothing was recorded"),
    ):
        asyncio.run(one.deconfliction.activate(first.id))


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
