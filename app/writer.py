"""The only writer of a process: a queue in order of arrival, and the thread that serves it.

Requests wait in one queue. The thread takes them in batches: one write transaction, one `now`, one commit for all.
It brings the replica up to the ledger's newest revision, lets each request do its work in order on what all before it
have left, and answers only what is durable. Between batches it keeps house.
"""

import asyncio
import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import structlog

from app.errors import LedgerUnavailable, OutcomeUnknown, QueueFull, RequestError
from app.ledger import CommitUncertain, ConstraintViolated, Ledger, Transaction
from app.times import monotonic_ms
from planner.errors import PlannerError

log = structlog.get_logger()

T = TypeVar("T")

BATCH_REQUESTS = 64
BATCH_PLANNING_S = 0.020
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
_REMOVE_INTENTS, _REMOVE_ENTRIES, _REMOVE_ANSWERS, _REMOVE_POSITIONS = 32, 256, 64, 2048


@dataclass(frozen=True)
class Policy:
    """How long answers to idempotency keys are kept, positions, and flights once they have ended (None: for ever); how
    long the ledger is asked what became of a commit: in ms. How many requests may wait."""

    idempotency_ms: int
    queue_limit: int
    retention_ms: int | None = None
    positions_ms: int = 3_600_000
    look_up_ms: int = 10_000


class Replica(Protocol):
    """A copy of some of the ledger in memory, which only the writer's thread touches."""

    def __len__(self) -> int:
        """Return how many reservations it has."""
        ...

    def catch_up(self, transaction: Transaction, now: int, revision: int | None) -> None:
        """Go from a revision (None: from nothing) to the transaction's, and drop what has passed.

        The transaction's own work is not in it yet: whoever does that work brings it into the replica too. If the
        transaction fails, the next call has no revision.
        """


@dataclass(eq=False)
class Request(Generic[T]):
    """One request in the queue: what to do under the write lock, how to find out whether it was done, whom to tell.

    `plans` tells whether it asks for a flight's plan, `has_key` whether asking again with the same Idempotency-Key does
    nothing twice. Times are of `time.perf_counter`: when it arrived, when the work on it began and ended.
    """

    run: Callable[[Transaction, int], T]
    look_up: Callable[[], T | None]
    plans: bool
    future: "Future[T]"
    context: Mapping[str, object]
    arrived: float
    has_key: bool = False
    begun: float = 0.0
    ended: float = 0.0

    def unknown(self, why: str) -> OutcomeUnknown:
        """Return the answer if nobody knows whether it was done: why, and what its sender can do."""
        if self.has_key:
            return OutcomeUnknown(f"{why}; repeat the request with the same Idempotency-Key")
        return OutcomeUnknown(f"{why}; read first what there is, then repeat the request if it is not done")


@dataclass(frozen=True)
class BatchReport:
    """What became of a batch, for logs and metrics. Seconds; `answers` has an exception for a request that failed.

    For each request that planned, `queue_s` from its arrival until then, `plan_s` for planning. `write_s` for
    writing the rows of all, `commit_s` for the commit; `index_size` in reservations.
    """

    requests: Sequence[Request[Any]]
    answers: Sequence[object]
    failure: Exception | None
    queue_s: Sequence[float]
    plan_s: Sequence[float]
    write_s: float
    commit_s: float
    index_size: int


class _Redo(Exception):
    """A batch cannot be written as a whole, so its requests have to be written one by one."""


class Writer:
    """The only writer of a process. `start` it before giving it work, `stop` it to finish what waits.

    `clock` says what time it is, and may be wrong; `elapsed_ms` how much has passed, and never jumps.
    `observers` are told of every batch after it was answered; `on_death` is called if the thread ends by itself.
    """

    def __init__(
        self,
        ledger: Ledger,
        replica: Replica,
        clock: Callable[[], int],
        policy: Policy,
        *,
        elapsed_ms: Callable[[], int] = monotonic_ms,
        observers: Sequence[Callable[[BatchReport], None]] = (),
        on_death: Callable[[], None] = lambda: None,
    ) -> None:
        self._ledger = ledger
        self._replica = replica
        self._clock = clock
        self._elapsed_ms = elapsed_ms
        self._policy = policy
        self._observers = observers
        self._on_death = on_death
        self._queue: queue.Queue[Request[Any] | None] = queue.Queue(policy.queue_limit)
        self._thread = threading.Thread(target=self._work, name="ledger-writer", daemon=True)
        self._ended = threading.Event()
        self._helper = threading.Thread(target=self._checkpoint, name="ledger-checkpoints", daemon=True)
        # That of the replica; None while it may be ahead of the ledger.
        self._revision: int | None = None
        self._watermark_ms = 0
        self._known_ms = 0
        self._kept_house_ms = 0
        self._pause_s = _IDLE_S
        self._failed = 0.0
        self._stopping = False
        self._open = threading.Lock()
        self._closed = False
        self.trouble: str | None = None

    def start(self) -> None:
        """Load the replica and begin to take requests; raises `LedgerUnavailable`."""
        with self._ledger.transaction() as transaction:
            now = self._now()
            self._replica.catch_up(transaction, now, revision=None)
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

    async def perform(
        self,
        run: Callable[[Transaction, int], T],
        look_up: Callable[[], T | None],
        *,
        plans: bool = False,
        has_key: bool = False,
    ) -> T:
        """Do work under the write lock, and return its answer once it is durable.

        `run(transaction, now)` is called in the writer's thread, after the work of all who came before, and perhaps
        again in another transaction: what it does outside the ledger and the replica has to bear that. An error of its
        own is raised here, and what it had written is undone; but a `RequestError` or `PlannerError` has to come before
        it writes anything that has no revision. `look_up` reads the answer from the ledger after a lost commit, None if
        the work was not done, and raises `OutcomeUnknown` if that cannot be told. `plans` says that it is the planning
        of a flight, for metrics; `has_key`, that it does nothing twice when it is asked for again.

        Raises
        ------
        QueueFull, LedgerUnavailable
            Nothing was written.
        OutcomeUnknown
            The commit was lost, and the ledger cannot be asked.
        """
        return await asyncio.wrap_future(self.enqueue(run, look_up, plans=plans, has_key=has_key).future)

    def enqueue(
        self,
        run: Callable[[Transaction, int], T],
        look_up: Callable[[], T | None],
        *,
        plans: bool = False,
        has_key: bool = False,
    ) -> Request[T]:
        """Queue work as `perform` does, and return the request, whose future has the answer.

        Raises
        ------
        QueueFull, LedgerUnavailable
            Nothing was taken.
        """
        request = Request(
            run=run,
            look_up=look_up,
            plans=plans,
            future=Future(),
            context=structlog.contextvars.get_contextvars(),
            arrived=time.perf_counter(),
            has_key=has_key,
        )
        with self._open:
            if not self.is_running:
                raise LedgerUnavailable("the ledger writer has stopped")
            try:
                self._queue.put_nowait(request)
            except queue.Full:
                raise QueueFull(f"{self._policy.queue_limit} requests are waiting; try again in a second") from None
        return request

    def answers_kept_since(self, now: int) -> int:
        """Return the time from which on answers to idempotency keys are kept."""
        return self._surely(now) - self._policy.idempotency_ms

    def _now(self) -> int:
        """Return the clock, which never goes back by a little; by a lot, it and the replica begin again from there."""
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

    def _answer(self, taken: list[Request[Any]]) -> None:
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
                request.future.set_exception(request.unknown("the ledger writer has died"))
            raise
        for request, answer in zip(taken, answers, strict=True):
            if isinstance(answer, BaseException):
                request.future.set_exception(answer)
            else:
                request.future.set_result(answer)
        # What was never begun has no times.
        planned = [request for request in taken if request.plans and request.ended]
        report = BatchReport(
            requests=taken,
            answers=answers,
            failure=failure,
            queue_s=[request.begun - request.arrived for request in planned],
            plan_s=[request.ended - request.begun for request in planned],
            write_s=0.0 if transaction is None else transaction.write_s,
            commit_s=0.0 if transaction is None else transaction.commit_s,
            index_size=len(self._replica),
        )
        # A log that cannot be written (its disk is full, its reader gone) must not stop the writer.
        with suppress(OSError, ValueError):
            _log_failure(report)
        for observe in self._observers:
            try:
                observe(report)
            except Exception as error:
                with suppress(OSError, ValueError):
                    log.error("batch could not be observed", exc_info=error)

    def _see_to_trouble(self, taken: list[Request[Any]]) -> None:
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

    def _write(self, taken: list[Request[Any]]) -> tuple[list[object], Transaction]:
        """Run the requests in one transaction; return their answers, and the transaction.

        All rows are written at the end, in a few statements. Where that does not work, for one request's sake or
        because the replica was wrong, it is all done again one by one, each under a savepoint.
        """
        try:
            return self._attempt(self._arrivals(taken), self._run)
        except (_Redo, ConstraintViolated) as error:
            with suppress(OSError, ValueError):
                log.warning("batch is written again, one by one", requests=len(taken), cause=str(error))
            return self._attempt(iter(taken), self._run_alone)

    def _attempt(
        self,
        requests: Iterator[Request[Any]],
        run: Callable[[Request[Any], Transaction, int], object],
    ) -> tuple[list[object], Transaction]:
        now = self._now()
        # Until this transaction is known to be committed, the replica is ahead of the ledger.
        revision, self._revision = self._revision, None
        answers: list[object] = []
        with self._ledger.transaction() as transaction:
            self._replica.catch_up(transaction, now, revision)
            for request in requests:
                request.begun = time.perf_counter()
                answers.append(run(request, transaction, now))
                request.ended = time.perf_counter()
        self._revision = transaction.revision
        return answers, transaction

    def _arrivals(self, taken: list[Request[Any]]) -> Iterator[Request[Any]]:
        """Yield the request in `taken`, then append and yield waiting ones until the batch is full."""
        yield taken[0]
        until = time.perf_counter() + BATCH_PLANNING_S
        for request in self._waiting():
            taken.append(request)
            yield request
            if len(taken) == BATCH_REQUESTS or time.perf_counter() > until:
                return

    def _waiting(self) -> Iterator[Request[Any]]:
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

    def _run(self, request: Request[Any], transaction: Transaction, now: int) -> object:
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

    def _run_alone(self, request: Request[Any], transaction: Transaction, now: int) -> object:
        """Return a request's answer, or the exception that is its answer; its neighbours are not harmed."""
        try:
            with transaction.savepoint():
                return self._run(request, transaction, now)
        except LedgerUnavailable:
            raise
        except Exception as error:
            # Wherever it happened, the replica may be ahead of what the savepoint left.
            self._replica.catch_up(transaction, now, revision=None)
            if isinstance(error, ConstraintViolated):
                return LedgerUnavailable(f"the ledger refused the rows, nothing was recorded; try again ({error})")
            return error.__cause__ if isinstance(error, _Redo) else error

    def _look_up(self, taken: list[Request[Any]]) -> list[object]:
        """Return the answers to requests whose commit is uncertain: what the ledger has of them.

        After a commit that succeeded: it had the write lock, so the uncertain one has happened before it or never
        will, and it is durable, so what it saw is.
        """
        give_up = time.monotonic() + self._policy.look_up_ms / 1000
        while True:
            try:
                with self._ledger.transaction() as transaction:
                    transaction.touch()
                found = [_looked_up(request) for request in taken]
                lost = LedgerUnavailable("the commit failed; nothing was recorded")
                return [lost if answer is None else answer for answer in found]
            except Exception as error:
                if time.monotonic() > give_up:
                    why = f"the commit failed, and then the ledger ({error}): it is not known whether this was recorded"
                    return [request.unknown(why) for request in taken]
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
        """Bring the replica up to the ledger's newest revision, so that it is not far behind when a request comes."""
        if self._revision is not None and self._ledger.revision() != self._revision:
            # First, for it may find that the replica has to be loaded afresh.
            now = self._now()
            revision, self._revision = self._revision, None
            with self._ledger.transaction() as transaction:
                self._replica.catch_up(transaction, now, revision)
            self._revision = transaction.revision

    def _remove_passed(self) -> int:
        """Remove a little of what is old enough, and return how much."""
        now = self._watermark_ms
        if abs(now - self._kept_house_ms) < _HOUSE_MS:
            return 0
        with self._ledger.transaction() as transaction:
            removed = transaction.remove_answers(self.answers_kept_since(now), _REMOVE_ANSWERS)
            removed += transaction.remove_positions(self._surely(now) - self._policy.positions_ms, _REMOVE_POSITIONS)
            if self._policy.retention_ms is not None:
                before_ms = self._surely(now) - self._policy.retention_ms
                removed += transaction.remove_ended(before_ms, _REMOVE_INTENTS)
                removed += transaction.forget_constraints(before_ms, _REMOVE_INTENTS)
                removed += transaction.remove_journal(before_ms, _REMOVE_ENTRIES)
            if not removed:
                transaction.refresh_lowest_priority()
        if not removed:
            self._kept_house_ms = now
        return removed


def _looked_up(request: Request[T]) -> T | OutcomeUnknown | None:
    try:
        return request.look_up()
    except OutcomeUnknown as error:
        return error


def _log_failure(report: BatchReport) -> None:
    """Log how a batch failed, if it did."""
    failure = report.failure
    if isinstance(failure, CommitUncertain):
        log.error("commit uncertain, requests were looked up", error=str(failure), requests=len(report.requests))
    elif isinstance(failure, LedgerUnavailable):
        log.error("batch failed, nothing recorded", error=str(failure), requests=len(report.requests))
    elif failure is not None:
        log.error("batch failed, nothing recorded", requests=len(report.requests), exc_info=failure)
