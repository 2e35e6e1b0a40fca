"""First come, first served: the arrival queue and its one writer (paper 2.4; domain: strategic deconfliction).

Requests wait in one queue. A writer thread takes them in batches: one write transaction, one `now`, one commit for all.
It brings the occupancy index up to the ledger's newest revision, plans each request in order against everything
before it, and answers only what is durable. Nobody else touches the index.
"""

import asyncio
import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import cast

import structlog
from uuid_utils import uuid7

from app.errors import (
    BeyondHorizon,
    DepartureInThePast,
    IdempotencyKeyReused,
    IllegalTransition,
    LedgerUnavailable,
    OutcomeUnknown,
    QueueFull,
    RequestError,
    UnknownFlightIntent,
)
from app.flight_intents import FlightIntent, Refusal, Reservations, State, Submission
from app.ledger.ledger import CommitUncertain, ConstraintViolated, Ledger, Transaction
from app.times import format_time, monotonic_ms
from planner.cfa_star import Performance, Planner, PlanRequest
from planner.errors import NoPlan, PlannerError
from planner.path import Plan, Trajectory

log = structlog.get_logger()

BATCH_REQUESTS = 64
BATCH_PLANNING_S = 0.020
# The index forgets the past in steps of this length; forgetting looks at every block once.
_FORGET_EVERY_MS = 10_000
# A departure window may have opened before the intent came, but not longer ago than this.
_OPEN_FOR_MS = 86_400_000
# A process that lags further behind than this many journal entries loads the ledger afresh.
_CATCH_UP_ENTRIES = 1_000
# Clocks are corrected by less than this all the time, and set back by more only if they were wrong.
_STEP_BACK_MS = 10_000
# How often the ledger is asked what became of a commit.
_RETRY_S = 0.1
# A ledger that failed counts as well again after a batch, or if it can be written for so long without one that fails.
_CALM_S = 2.0
# Without requests the writer wakes up this often; while there is something to remove, this often.
_IDLE_S, _PAUSE_S = 1.0, 0.01
# How often the ledger may do what spares the writer work.
_CHECKPOINT_S = 1.0
# How often retention looks for what has passed; and how much it removes at once, so that nobody waits long for it.
_HOUSE_MS = 60_000
_REMOVE_INTENTS, _REMOVE_ENTRIES, _REMOVE_ANSWERS = 32, 256, 64


@dataclass(frozen=True)
class IdempotencyKey:
    """A client's key with the digest of the parsed body, and how to write down the answer that is kept for it."""

    key: str
    body_digest: str
    render: Callable[["Outcome"], bytes]


@dataclass(frozen=True)
class Timing:
    """Where a request's time went, in seconds: waiting, being planned, and from then until it was durable."""

    queue_s: float = 0.0
    plan_s: float = 0.0
    commit_s: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """What became of a submission. `replayed` is the body of the first answer, where this is a repetition; `rendered`
    the body of this one, where it had to be made already."""

    intent: FlightIntent
    replayed: bytes | None = None
    rendered: bytes | None = None
    timing: Timing = Timing()


@dataclass(frozen=True, eq=False)
class PreviewPlan:
    """A plan that reserves nothing."""

    submission: Submission
    trajectory: Trajectory
    reservations: Reservations


@dataclass(frozen=True)
class Policy:
    """How far ahead flights may depart; how long answers to idempotency keys are kept, and flights once they have
    ended (None: for ever); how long the ledger is asked what became of a commit: in ms. How many requests may wait."""

    horizon_ms: int
    idempotency_ms: int
    queue_limit: int
    retention_ms: int | None = None
    look_up_ms: int = 10_000


@dataclass(frozen=True)
class BatchReport:
    """What became of a batch, for logs and metrics. Seconds; `answers` has an exception for a request that failed.

    For each request that was planned, `queue_s` from its arrival until then, `plan_s` for planning. `write_s` for
    writing the rows of all, `commit_s` for the commit; `index_size` in reservations.
    """

    requests: Sequence["Request"]
    answers: Sequence[object]
    failure: Exception | None
    queue_s: Sequence[float]
    plan_s: Sequence[float]
    write_s: float
    commit_s: float
    index_size: int


@dataclass(eq=False)
class Request:
    """One request in the queue: what to do under the write lock, how to find out whether it was done, whom to tell.

    Times are of `time.perf_counter`: when it arrived, when its planning began and ended.
    """

    run: Callable[[Transaction, int], object]
    look_up: Callable[[], object | None]
    future: "Future[object]"
    context: Mapping[str, object]
    arrived: float
    begun: float = 0.0
    planned: float = 0.0


class _Redo(Exception):
    """A batch cannot be written as a whole, so its requests have to be written one by one."""


class Deconfliction:
    """The only writer of a process. `start` it before submitting, `stop` it to finish what waits.

    `clock` says what time it is, and may be wrong; `elapsed_ms` how much has passed, and never jumps.
    `observe` is told of every batch after it was answered; `on_death` is called if the writer thread ends by itself.
    """

    def __init__(
        self,
        ledger: Ledger,
        planner: Planner,
        performances: Mapping[str, Performance],
        clock: Callable[[], int],
        policy: Policy,
        *,
        elapsed_ms: Callable[[], int] = monotonic_ms,
        observe: Callable[[BatchReport], None] = lambda _: None,
        on_death: Callable[[], None] = lambda: None,
    ) -> None:
        self._ledger = ledger
        self._planner = planner
        self._performances = performances
        self._clock = clock
        self._elapsed_ms = elapsed_ms
        self._policy = policy
        self._observe = observe
        self._on_death = on_death
        self._queue: queue.Queue[Request | None] = queue.Queue(policy.queue_limit)
        self._thread = threading.Thread(target=self._work, name="ledger-writer", daemon=True)
        self._ended = threading.Event()
        self._helper = threading.Thread(target=self._checkpoint, name="ledger-checkpoints", daemon=True)
        self._revision: int | None = None
        self._watermark_ms = 0
        self._forgotten_ms = 0
        self._known_ms = 0
        self._kept_house_ms = 0
        self._pause_s = _IDLE_S
        self._failed = 0.0
        self._stopping = False
        self._open = threading.Lock()
        self._closed = False
        self.trouble: str | None = None

    def start(self) -> None:
        """Load the index and begin to take requests; raises `LedgerUnavailable`."""
        with self._ledger.transaction() as transaction:
            now = self._now()
            self._catch_up(transaction, now, revision=None)
            newest_ms = transaction.newest_change()
        self._revision = transaction.revision
        self._kept_house_ms = now
        self._known_ms = (now if newest_ms is None else min(now, newest_ms)) - self._elapsed_ms()
        self._thread.start()
        self._helper.start()

    def stop(self) -> None:
        """Finish what is in the queue, then end the writer."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()
        if self._helper.is_alive():
            self._helper.join()

    @property
    def is_running(self) -> bool:
        """Whether the writer can take requests."""
        return self._thread.is_alive() and not self._closed

    @property
    def is_full(self) -> bool:
        """Whether no more requests may wait."""
        return self._queue.full()

    @property
    def waiting(self) -> int:
        """How many requests wait."""
        return self._queue.qsize()

    @property
    def waiting_s(self) -> float:
        """For how many seconds the first request in the queue has waited, 0 where there is none."""
        with self._queue.mutex:
            first = self._queue.queue[0] if self._queue.queue else None
        return 0.0 if first is None else time.perf_counter() - first.arrived

    def check(self, origin: int, destination: int) -> None:
        """Raise the `NotPlannable` that applies to two blocks whatever the traffic. Safe in any thread."""
        self._planner.check(origin, destination)

    async def submit(self, submission: Submission, key: IdempotencyKey | None = None) -> Outcome:
        """Plan and record a submission.

        Raises
        ------
        DepartureInThePast, BeyondHorizon, IdempotencyKeyReused, QueueFull, LedgerUnavailable
            Nothing was recorded.
        OutcomeUnknown
            The commit was lost, and the ledger cannot be asked.
        """
        intent_id = str(uuid7())

        def look_up() -> Outcome | None:
            intent = self._ledger.find(intent_id)
            if intent is not None:
                return Outcome(intent)
            first = None if key is None else self._ledger.answer_to(submission.operator, key.key)
            if key is None or first is None or first.body_digest != key.body_digest:
                return None
            return Outcome(first.intent, replayed=first.answer)

        request = self._enqueue(lambda tx, now: self._submit(tx, now, intent_id, submission, key), look_up)
        outcome = cast(Outcome, await asyncio.wrap_future(request.future))
        queue_s, plan_s = request.begun - request.arrived, request.planned - request.begun
        return replace(outcome, timing=Timing(queue_s, plan_s, time.perf_counter() - request.planned))

    async def preview(self, submission: Submission) -> PreviewPlan | Refusal:
        """Plan a submission, record nothing; raises as `submit`."""

        def run(transaction: Transaction, now: int) -> PreviewPlan | Refusal:
            try:
                plan = self._plan(submission, now)
            except NoPlan as error:
                return _refusal(error, transaction)
            return PreviewPlan(submission, plan, _reservations(plan))

        request = self._enqueue(run, lambda: None)
        return cast(PreviewPlan | Refusal, await asyncio.wrap_future(request.future))

    async def cancel(self, intent_id: str) -> FlightIntent:
        """Cancel an accepted intent. Before departure its reservations go, after it they stay until arrival.

        Raises
        ------
        UnknownFlightIntent, IllegalTransition, QueueFull, LedgerUnavailable
        """

        def look_up() -> FlightIntent | None:
            intent = self._ledger.find(intent_id)
            return intent if intent is not None and intent.state is State.CANCELLED else None

        request = self._enqueue(lambda tx, now: self._cancel(tx, now, intent_id), look_up)
        return cast(FlightIntent, await asyncio.wrap_future(request.future))

    def _enqueue(self, run: Callable[[Transaction, int], object], look_up: Callable[[], object | None]) -> Request:
        request = Request(
            run=run,
            look_up=look_up,
            future=Future(),
            context=structlog.contextvars.get_contextvars(),
            arrived=time.perf_counter(),
        )
        with self._open:
            if not self.is_running:
                raise LedgerUnavailable("the ledger writer has stopped")
            try:
                self._queue.put_nowait(request)
            except queue.Full:
                raise QueueFull(f"{self._policy.queue_limit} requests are waiting; try again in a second") from None
        return request

    def _now(self) -> int:
        """Return the clock, which never goes back by a little; by a lot, it and the index begin again from there."""
        clock_ms = self._clock()
        if clock_ms < self._watermark_ms - _STEP_BACK_MS:
            with suppress(OSError, ValueError):
                log.warning("the clock was set back", by_s=(self._watermark_ms - clock_ms) / 1000)
            self._watermark_ms, self._revision = clock_ms, None
        self._watermark_ms = max(self._watermark_ms, clock_ms)
        return self._watermark_ms

    def _surely(self, now: int) -> int:
        """Return a time that has passed for sure, even if the clock is ahead: what is old by it may be removed.

        That is `now`, or what the ledger knew when this process started and the time since then, if that is less.
        """
        return min(now, self._known_ms + self._elapsed_ms())

    def _work(self) -> None:
        try:
            self._serve()
        except BaseException as error:
            with suppress(OSError, ValueError):
                log.critical("the ledger writer has died", exc_info=error)
        finally:
            # Whoever still got into the queue hears of it; nobody gets in any more.
            self._ended.set()
            with self._open:
                self._closed = True
            while not self._queue.empty():
                request = self._queue.get_nowait()
                if request is not None and request.future.set_running_or_notify_cancel():
                    request.future.set_exception(
                        LedgerUnavailable("the ledger writer has stopped; nothing was recorded")
                    )
            if not self._stopping:
                self._on_death()

    def _checkpoint(self) -> None:
        while not self._ended.wait(_CHECKPOINT_S):
            self._ledger.checkpoint()

    def _serve(self) -> None:
        while not self._stopping:
            try:
                first = self._queue.get(timeout=self._pause_s)
            except queue.Empty:
                self._keep_house(idle=True)
                continue
            if first is None:
                self._stopping = True
            elif first.future.set_running_or_notify_cancel():
                self._answer([first])
                self._keep_house(idle=False)

    def _answer(self, taken: list[Request]) -> None:
        """Write the request in `taken` and those that wait behind it, and answer them."""
        failure: Exception | None = None
        answers: Sequence[object]
        transaction: Transaction | None = None
        try:
            self._see_to_trouble(taken)
            answers, transaction = self._write(taken)
            self.trouble = None
        except CommitUncertain as error:
            failure = error
            self._fail(error)
            answers = self._look_up(taken)
        except Exception as error:
            failure = error
            self._fail(error)
            unknown = LedgerUnavailable("the ledger writer failed; nothing was recorded")
            answers = [error if isinstance(error, LedgerUnavailable) else unknown] * len(taken)
        except BaseException:
            for request in taken:
                request.future.set_exception(
                    OutcomeUnknown("the ledger writer has died; repeat the request with the same Idempotency-Key")
                )
            raise
        for request, answer in zip(taken, answers, strict=True):
            if isinstance(answer, BaseException):
                request.future.set_exception(answer)
            else:
                request.future.set_result(answer)
        # What was never planned has no times.
        begun = [request for request in taken if request.planned]
        report = BatchReport(
            requests=taken,
            answers=answers,
            failure=failure,
            queue_s=[request.begun - request.arrived for request in begun],
            plan_s=[request.planned - request.begun for request in begun],
            write_s=0.0 if transaction is None else transaction.write_s,
            commit_s=0.0 if transaction is None else transaction.commit_s,
            index_size=len(self._planner.index),
        )
        # A log that cannot be written (its disk is full, its reader gone) must not stop the writer.
        with suppress(OSError, ValueError):
            _log_batch(report)
        try:
            self._observe(report)
        except Exception as error:
            with suppress(OSError, ValueError):
                log.error("batch could not be observed", exc_info=error)

    def _see_to_trouble(self, taken: list[Request]) -> None:
        """If the ledger failed, ask it again; in vain: take all that wait, and raise `LedgerUnavailable`."""
        if self.trouble is not None and not self._probe():
            taken += self._waiting()
            raise LedgerUnavailable(f"{self.trouble}; nothing was recorded")

    def _probe(self) -> bool:
        """Tell whether the ledger can be written. That ends the trouble only after a while: on a full disk there is
        often still room for this, but not for a batch.
        """
        try:
            with self._ledger.transaction() as transaction:
                transaction.touch()
        except Exception as error:
            self._fail(error)
            return False
        if time.monotonic() - self._failed >= _CALM_S:
            self.trouble = None
        return True

    def _fail(self, error: Exception) -> None:
        self.trouble = str(error) if isinstance(error, LedgerUnavailable | CommitUncertain) else repr(error)
        self._failed = time.monotonic()
        self._pause_s = _IDLE_S

    def _write(self, taken: list[Request]) -> tuple[list[object], Transaction]:
        """Run the requests in one transaction; return their answers, and the transaction.

        All rows are written at the end, in a few statements. Where that does not work, for one request's sake or
        because the index was wrong, it is all done again one by one, each under a savepoint.
        """
        try:
            return self._attempt(self._arrivals(taken), self._run)
        except (_Redo, ConstraintViolated) as error:
            with suppress(OSError, ValueError):
                log.warning("batch is written again, one by one", requests=len(taken), cause=str(error))
            return self._attempt(iter(taken), self._run_alone)

    def _attempt(
        self,
        requests: Iterator[Request],
        run: Callable[[Request, Transaction, int], object],
    ) -> tuple[list[object], Transaction]:
        now = self._now()
        # Until this transaction is known to be committed, the index is ahead of the ledger.
        revision, self._revision = self._revision, None
        answers: list[object] = []
        with self._ledger.transaction() as transaction:
            self._catch_up(transaction, now, revision)
            for request in requests:
                request.begun = time.perf_counter()
                answers.append(run(request, transaction, now))
                request.planned = time.perf_counter()
        self._revision = transaction.revision
        return answers, transaction

    def _arrivals(self, taken: list[Request]) -> Iterator[Request]:
        """Yield the request in `taken`, then append and yield waiting ones until the batch is full."""
        yield taken[0]
        until = time.perf_counter() + BATCH_PLANNING_S
        for request in self._waiting():
            taken.append(request)
            yield request
            if len(taken) == BATCH_REQUESTS or time.perf_counter() > until:
                return

    def _waiting(self) -> Iterator[Request]:
        """Take and yield the requests that wait; from then on nobody can give them up, so their answers have a place
        to go.
        """
        while not self._stopping:
            try:
                request = self._queue.get_nowait()
            except queue.Empty:
                return
            if request is None:
                self._stopping = True
            elif request.future.set_running_or_notify_cancel():
                yield request

    def _run(self, request: Request, transaction: Transaction, now: int) -> object:
        """Return a request's answer, or the exception that is its answer if it has changed nothing."""
        before = transaction.revision
        try:
            return request.run(transaction, now)
        except LedgerUnavailable:
            raise
        except (RequestError, PlannerError) as error:
            if transaction.revision == before:
                return error
            raise _Redo(repr(error)) from error
        except Exception as error:
            raise _Redo(repr(error)) from error

    def _run_alone(self, request: Request, transaction: Transaction, now: int) -> object:
        """Return a request's answer, or the exception that is its answer; its neighbours are not harmed."""
        try:
            with transaction.savepoint():
                return self._run(request, transaction, now)
        except LedgerUnavailable:
            raise
        except Exception as error:
            # Wherever it happened, the index may be ahead of what the savepoint left.
            self._catch_up(transaction, now, revision=None)
            if isinstance(error, ConstraintViolated):
                return LedgerUnavailable(f"the ledger refused the rows, nothing was recorded; try again ({error})")
            return error.__cause__ if isinstance(error, _Redo) else error

    def _look_up(self, taken: list[Request]) -> list[object]:
        """Return the answers to requests whose commit is uncertain: what the ledger has of them.

        After a commit that succeeded: it had the write lock, so the uncertain one has happened before it or never
        will, and it is durable, so what it saw is.
        """
        give_up = time.monotonic() + self._policy.look_up_ms / 1000
        while True:
            try:
                with self._ledger.transaction() as transaction:
                    transaction.touch()
                return [
                    request.look_up() or LedgerUnavailable("the commit failed; nothing was recorded")
                    for request in taken
                ]
            except Exception as error:
                if time.monotonic() > give_up:
                    unknown = OutcomeUnknown(
                        f"the commit failed, and then the ledger ({error}): it is not known whether this was recorded; "
                        "read the flight intents, or repeat the request with the same Idempotency-Key"
                    )
                    return [unknown] * len(taken)
            time.sleep(_RETRY_S)

    def _keep_house(self, *, idle: bool) -> None:
        """Between batches: see whether the ledger can be written again, keep up with others, remove what has passed."""
        if self.trouble is not None:
            self._probe()
            return
        try:
            if idle:
                self._keep_up()
            removed = self._remove_passed()
        except Exception as error:
            with suppress(OSError, ValueError):
                log.error("housekeeping failed", error=str(error))
            self._fail(error)
            return
        # As long as there is more to remove, after every batch.
        self._pause_s = _PAUSE_S if removed else _IDLE_S

    def _keep_up(self) -> None:
        """Bring the index up to the ledger's newest revision, so that it is not far behind when a request comes."""
        if self._revision is not None and self._ledger.revision() != self._revision:
            # First, for it may find that the index has to be loaded afresh.
            now = self._now()
            revision, self._revision = self._revision, None
            with self._ledger.transaction() as transaction:
                self._catch_up(transaction, now, revision)
            self._revision = transaction.revision

    def _remove_passed(self) -> int:
        """Remove a little of what is old enough, and return how much."""
        now = self._watermark_ms
        if abs(now - self._kept_house_ms) < _HOUSE_MS:
            return 0
        known_ms = self._surely(now)
        with self._ledger.transaction() as transaction:
            removed = transaction.remove_answers(known_ms - self._policy.idempotency_ms, _REMOVE_ANSWERS)
            if self._policy.retention_ms is not None:
                before_ms = known_ms - self._policy.retention_ms
                removed += transaction.remove_ended(before_ms, _REMOVE_INTENTS)
                removed += transaction.remove_journal(before_ms, _REMOVE_ENTRIES)
        if not removed:
            self._kept_house_ms = now
        return removed

    def _catch_up(self, transaction: Transaction, now: int, revision: int | None) -> None:
        """Bring the index from a revision (None: from nothing) to the transaction's; drop what has passed."""
        index = self._planner.index
        # After a failover that lost commits, revisions are not what they were.
        known = revision is not None and revision <= transaction.revision and not transaction.on_new_connection
        lags = revision is not None and transaction.revision - revision > _CATCH_UP_ENTRIES
        if revision is None or not known or lags or revision < transaction.journal_removed:
            index.clear()
            held = transaction.held_after(now)
            index.reserve(held.block, held.enter_ms, held.exit_ms, held.sequence)
            self._forgotten_ms = now
            with suppress(OSError, ValueError):
                log.info("index loaded", revision=transaction.revision, reservations=len(held.block))
        elif transaction.revision > revision:
            entries = transaction.journal_after(revision)
            for entry in entries:
                index.release(*entry.released.T.copy())
            held = transaction.held_after(now, sorted({entry.sequence for entry in entries}))
            index.release(held.block, held.enter_ms, held.exit_ms)
            index.reserve(held.block, held.enter_ms, held.exit_ms, held.sequence)
        transaction.seen()
        if now - self._forgotten_ms >= _FORGET_EVERY_MS:
            index.forget_before(now)
            self._forgotten_ms = now

    def _plan(self, submission: Submission, now: int) -> Plan:
        """Plan against the index; raises as `submit`, and `NoPlan`."""
        if submission.latest_departure_ms < now:
            raise DepartureInThePast(
                f"the latest departure, {format_time(submission.latest_departure_ms)}, has passed; "
                f"it is {format_time(now)}"
            )
        if submission.earliest_departure_ms < now - _OPEN_FOR_MS:
            raise DepartureInThePast(
                f"the earliest departure, {format_time(submission.earliest_departure_ms)}, is more than a day ago; "
                f"it is {format_time(now)}"
            )
        horizon = now + self._policy.horizon_ms
        if submission.latest_departure_ms > horizon:
            raise BeyondHorizon(f"flights can be planned to depart until {format_time(horizon)}; submit this one later")
        request = PlanRequest(
            submission.origin_block,
            submission.destination_block,
            self._performances[submission.aircraft_type],
            max(submission.earliest_departure_ms, now),
            submission.latest_departure_ms,
        )
        return self._planner.plan(request)

    def _submit(
        self, transaction: Transaction, now: int, intent_id: str, submission: Submission, key: IdempotencyKey | None
    ) -> Outcome:
        if key is not None:
            since_ms = self._surely(now) - self._policy.idempotency_ms
            first = transaction.answer_to(submission.operator, key.key, since_ms)
            if first is not None and first.body_digest != key.body_digest:
                raise IdempotencyKeyReused(
                    f"Idempotency-Key {key.key!r} came with another body before; use a new key for a new request"
                )
            if first is not None:
                return Outcome(first.intent, replayed=first.answer)
        refusal = plan = None
        try:
            plan = self._plan(submission, now)
        except NoPlan as error:
            refusal = _refusal(error, transaction)
        intent = transaction.record(
            intent_id=intent_id,
            submission=submission,
            now_ms=now,
            trajectory=plan,
            reservations=None if plan is None else _reservations(plan),
            refusal=refusal,
        )
        rendered = None
        if key is not None:
            rendered = key.render(Outcome(intent))
            transaction.remember_answer(submission.operator, key.key, key.body_digest, intent, rendered, now)
        held = intent.reservations
        self._planner.index.reserve(held.block, held.enter_ms, held.exit_ms, intent.sequence)
        return Outcome(intent, rendered=rendered)

    def _cancel(self, transaction: Transaction, now: int, intent_id: str) -> FlightIntent:
        intent = transaction.find(intent_id)
        if intent is None:
            raise UnknownFlightIntent(f"there is no flight intent {intent_id}")
        if intent.state is State.CANCELLED:
            return intent
        if intent.state is not State.ACCEPTED or intent.trajectory is None:
            raise IllegalTransition(f"flight intent {intent_id} is {intent.state} and cannot be cancelled")
        if intent.trajectory.arrival_ms < now:
            raise IllegalTransition(
                f"flight intent {intent_id} arrived at {format_time(intent.trajectory.arrival_ms)} "
                "and cannot be cancelled any more"
            )
        in_flight = intent.trajectory.departure_ms <= now
        cancelled = transaction.release(intent, State.CANCELLED, now, keep=in_flight)
        if not in_flight:
            held = intent.reservations
            self._planner.index.release(held.block, held.enter_ms, held.exit_ms)
        return cancelled


def _log_batch(report: BatchReport) -> None:
    """Log what became of a batch, after it was answered: each intent that was recorded or changed, and what failed."""
    failure = report.failure
    if isinstance(failure, CommitUncertain):
        log.error("commit uncertain, requests were looked up", error=str(failure), requests=len(report.requests))
    elif isinstance(failure, LedgerUnavailable):
        log.error("batch failed, nothing recorded", error=str(failure), requests=len(report.requests))
    elif failure is not None:
        log.error("batch failed, nothing recorded", requests=len(report.requests), exc_info=failure)
    for request, answer in zip(report.requests, report.answers, strict=True):
        if isinstance(answer, Outcome) and answer.replayed is None:
            _log_intent(answer.intent, request.context)
        elif isinstance(answer, FlightIntent):
            _log_intent(answer, request.context)


def _log_intent(intent: FlightIntent, context: Mapping[str, object]) -> None:
    reason = {} if intent.refusal is None else {"reason": intent.refusal.reason}
    log.info(
        f"flight intent {intent.state}",
        flight_intent=intent.id,
        sequence=intent.sequence,
        operator=intent.submission.operator,
        **reason,
        **context,
    )


def _reservations(plan: Plan) -> Reservations:
    return Reservations(plan.hold_block, plan.hold_enter_ms, plan.hold_exit_ms)


def _refusal(error: NoPlan, transaction: Transaction) -> Refusal:
    ids = transaction.ids(error.conflicting_owners)
    return Refusal(
        reason=error.reason,
        detail=str(error),
        conflicting_intents=tuple(ids[owner] for owner in error.conflicting_owners if owner in ids),
        earliest_feasible_departure_ms=error.earliest_feasible_departure_ms,
    )
