"""First come, first served: the arrival queue and its one writer (paper 2.4; domain: strategic deconfliction).

Requests wait in one queue. A writer thread takes them in batches: one write transaction, one `now`, one commit for all.
It brings the occupancy index up to the ledger's newest revision, plans each request in order against everything
before it, and answers only what is durable. Nobody else touches the index.
"""

import asyncio
import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeVar

import structlog
from uuid_utils import uuid7

from app.errors import (
    BeyondHorizon,
    DepartureInThePast,
    IdempotencyKeyReused,
    IllegalTransition,
    LedgerUnavailable,
    QueueFull,
    RequestError,
    UnknownFlightIntent,
)
from app.flight_intents import FlightIntent, Refusal, Reservations, State, Submission
from app.ledger.ledger import CommitUncertain, Ledger, ReservationOverlap, Transaction
from app.times import format_time
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

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class IdempotencyKey:
    """A client's key with the digest of the parsed body, and how to write down the answer that is kept for it."""

    key: str
    body_digest: str
    render: Callable[["Outcome"], bytes]


@dataclass(frozen=True)
class Outcome:
    """What became of a submission. `replayed` is the body of the first answer, where this is a repetition."""

    intent: FlightIntent
    replayed: bytes | None = None


@dataclass(frozen=True, eq=False)
class PreviewPlan:
    """A plan that reserves nothing."""

    submission: Submission
    trajectory: Trajectory
    reservations: Reservations


@dataclass(frozen=True, eq=False)
class _Job:
    """One request in the queue: what to do under the write lock, how to find out whether it was done, whom to tell."""

    run: Callable[[Transaction, int], object]
    look_up: Callable[[], object | None]
    future: "Future[object]"


@dataclass(frozen=True)
class Policy:
    """How far ahead flights may depart, and how long answers to idempotency keys are kept, in ms."""

    horizon_ms: int
    idempotency_ms: int
    queue_limit: int


class Deconfliction:
    """The only writer of a process. `start` it before submitting, `stop` it to finish what waits."""

    def __init__(
        self,
        ledger: Ledger,
        planner: Planner,
        performances: Mapping[str, Performance],
        clock: Callable[[], int],
        policy: Policy,
    ) -> None:
        self._ledger = ledger
        self._planner = planner
        self._performances = performances
        self._clock = clock
        self._policy = policy
        self._queue: queue.Queue[_Job | None] = queue.Queue(policy.queue_limit)
        self._thread = threading.Thread(target=self._work, name="ledger-writer", daemon=True)
        self._revision: int | None = None
        self._watermark_ms = 0
        self._forgotten_ms = 0
        self._stopping = False
        self._open = threading.Lock()
        self._closed = False

    def start(self) -> None:
        """Load the index and begin to take requests; raises `LedgerUnavailable`."""
        with self._ledger.transaction() as transaction:
            self._catch_up(transaction, self._now(), revision=None)
        self._revision = transaction.revision
        self._thread.start()

    def stop(self) -> None:
        """Finish what is in the queue, then end the writer."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()

    @property
    def is_running(self) -> bool:
        """Whether the writer can take requests."""
        return self._thread.is_alive() and not self._closed

    @property
    def waiting(self) -> int:
        """How many requests wait."""
        return self._queue.qsize()

    def check(self, origin: int, destination: int) -> None:
        """Raise the `NotPlannable` that applies to two blocks whatever the traffic. Safe in any thread."""
        self._planner.check(origin, destination)

    async def submit(self, submission: Submission, key: IdempotencyKey | None = None) -> Outcome:
        """Plan and record a submission.

        Raises
        ------
        DepartureInThePast, BeyondHorizon, IdempotencyKeyReused, QueueFull, LedgerUnavailable
            Nothing was recorded.
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

        return await self._enqueue(lambda tx, now: self._submit(tx, now, intent_id, submission, key), look_up)

    async def preview(self, submission: Submission) -> PreviewPlan | Refusal:
        """Plan a submission, record nothing; raises as `submit`."""

        def run(transaction: Transaction, now: int) -> PreviewPlan | Refusal:
            try:
                plan = self._plan(submission, now)
            except NoPlan as error:
                return _refusal(error, transaction)
            return PreviewPlan(submission, plan, _reservations(plan))

        return await self._enqueue(run, lambda: None)

    async def cancel(self, intent_id: str) -> FlightIntent:
        """Cancel an accepted intent. Before departure its reservations go, after it they stay until arrival.

        Raises
        ------
        UnknownFlightIntent, IllegalTransition, QueueFull, LedgerUnavailable
        """

        def look_up() -> FlightIntent | None:
            intent = self._ledger.find(intent_id)
            return intent if intent is not None and intent.state is State.CANCELLED else None

        return await self._enqueue(lambda tx, now: self._cancel(tx, now, intent_id), look_up)

    async def _enqueue(self, run: Callable[[Transaction, int], Answer], look_up: Callable[[], Answer | None]) -> Answer:
        future: Future[Answer] = Future()
        with self._open:
            if not self.is_running:
                raise LedgerUnavailable("the ledger writer has stopped")
            try:
                self._queue.put_nowait(_Job(run, look_up, future))  # type: ignore[arg-type]
            except queue.Full:
                raise QueueFull(f"{self._policy.queue_limit} requests are waiting; try again in a second") from None
        return await asyncio.wrap_future(future)

    def _now(self) -> int:
        self._watermark_ms = max(self._watermark_ms, self._clock())
        return self._watermark_ms

    def _work(self) -> None:
        try:
            self._serve()
        finally:
            # Whoever still got into the queue hears of it; nobody gets in any more.
            with self._open:
                self._closed = True
            while not self._queue.empty():
                job = self._queue.get_nowait()
                if job is not None and job.future.set_running_or_notify_cancel():
                    job.future.set_exception(LedgerUnavailable("the ledger writer has stopped; nothing was recorded"))

    def _serve(self) -> None:
        while not self._stopping and (first := self._queue.get()) is not None:
            if not first.future.set_running_or_notify_cancel():
                continue
            taken = [first]
            failure: Exception | None = None
            answers: list[object]
            try:
                answers = self._write(taken)
            except CommitUncertain as error:
                failure = error
                answers = [self._look_up(job) for job in taken]
            except Exception as error:
                failure = error
                known = isinstance(error, LedgerUnavailable)
                answers = [error if known else LedgerUnavailable("the ledger writer failed")] * len(taken)
            for job, answer in zip(taken, answers, strict=True):
                if isinstance(answer, BaseException):
                    job.future.set_exception(answer)
                else:
                    job.future.set_result(answer)
            # A log that cannot be written (its disk is full, its reader gone) must not stop the writer.
            with suppress(OSError, ValueError):
                _log_batch(answers, failure)

    def _write(self, taken: list[_Job]) -> list[object]:
        """Run the request in `taken` and those that wait behind it in one transaction; return their answers."""
        now = self._now()
        # Until this transaction is known to be committed, the index is ahead of the ledger.
        revision, self._revision = self._revision, None
        answers: list[object] = []
        with self._ledger.transaction() as transaction:
            self._catch_up(transaction, now, revision)
            for job in self._arrivals(taken):
                answers.append(self._run(job, transaction, now))
        self._revision = transaction.revision
        return answers

    def _arrivals(self, taken: list[_Job]) -> Iterator[_Job]:
        """Yield the request in `taken`, then append and yield waiting ones until the batch is full."""
        yield taken[0]
        until = time.perf_counter() + BATCH_PLANNING_S
        while len(taken) < BATCH_REQUESTS and time.perf_counter() < until:
            try:
                job = self._queue.get_nowait()
            except queue.Empty:
                return
            if job is None:
                self._stopping = True
                return
            # From here on nobody can give it up, so that its answer has a place to go.
            if job.future.set_running_or_notify_cancel():
                taken.append(job)
                yield job

    def _run(self, job: _Job, transaction: Transaction, now: int) -> object:
        """Return a request's answer, or the exception that is its answer; its neighbours are not harmed."""
        try:
            with transaction.savepoint():
                return job.run(transaction, now)
        except LedgerUnavailable:
            raise
        except (RequestError, PlannerError) as error:
            return error
        except ReservationOverlap as error:
            self._catch_up(transaction, now, revision=None)
            return LedgerUnavailable(f"the ledger refused the reservations, nothing was recorded; try again ({error})")
        except Exception as error:
            # Wherever it happened, the index may be ahead of what the savepoint left.
            self._catch_up(transaction, now, revision=None)
            return error

    def _look_up(self, job: _Job) -> object:
        """Return the answer to a request whose commit is uncertain: what the ledger has of it."""
        try:
            return job.look_up() or LedgerUnavailable("the commit failed; nothing was recorded")
        except Exception:
            return LedgerUnavailable(
                "the commit failed and the ledger cannot be read: it is not known whether this was recorded; "
                "read the flight intents, or repeat the request with the same Idempotency-Key"
            )

    def _catch_up(self, transaction: Transaction, now: int, revision: int | None) -> None:
        """Bring the index from a revision (None: from nothing) to the transaction's; drop what has passed."""
        index = self._planner.index
        if revision is None or transaction.revision - revision > _CATCH_UP_ENTRIES:
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
            transaction.forget_answers(now - self._policy.idempotency_ms)
            first = transaction.answer_to(submission.operator, key.key)
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
        if key is not None:
            answer = key.render(Outcome(intent))
            transaction.remember_answer(submission.operator, key.key, key.body_digest, intent, answer, now)
        held = intent.reservations
        self._planner.index.reserve(held.block, held.enter_ms, held.exit_ms, intent.sequence)
        return Outcome(intent)

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


def _log_batch(answers: list[object], failure: Exception | None) -> None:
    """Log what became of a batch, after it was answered: each intent that was recorded or changed, and what failed."""
    if isinstance(failure, CommitUncertain):
        log.error("commit uncertain, requests were looked up", error=str(failure), requests=len(answers))
    elif failure is not None:
        log.error("batch failed, nothing recorded", requests=len(answers), exc_info=failure)
    for answer in answers:
        if isinstance(answer, Outcome) and answer.replayed is None:
            _log_intent(answer.intent)
        elif isinstance(answer, FlightIntent):
            _log_intent(answer)
        elif failure is None and isinstance(answer, LedgerUnavailable):
            log.error("index was wrong, loaded afresh", error=str(answer))


def _log_intent(intent: FlightIntent) -> None:
    reason = {} if intent.refusal is None else {"reason": intent.refusal.reason}
    log.info(
        f"flight intent {intent.state}",
        flight_intent=intent.id,
        sequence=intent.sequence,
        operator=intent.submission.operator,
        **reason,
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
