"""Batches: flight intents of equal standing, planned together (beyond the paper, which serves who comes first).

What is reserved is copied under the write lock; the batch is planned around the copy in a thread of its own, for as
long as was asked for; then, in one piece of the writer's work, each plan is checked against what is reserved by then,
those that no longer fit are made anew, and all are recorded. A batch displaces nobody, whatever its priority.
"""

import asyncio
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property

import numpy as np
import orjson
from anyio import to_thread
from uuid_utils import uuid7

from app.deconfliction import Deconfliction, Recorded
from app.errors import (
    BatchNotPlanned,
    BeyondHorizon,
    DepartureInThePast,
    IdempotencyKeyReused,
    ItemRefused,
    QueueFull,
    TooManyRequests,
)
from app.flight_intents import FlightIntent, Refusal, Submission
from app.ledger import Ledger, Transaction
from app.ledger.queries import IdempotencyRecord
from app.scheduling import Scheduler, refusal, reservations
from app.writer import Writer
from planner.cfa_star import Planner, PlanRequest
from planner.errors import NoPlan
from planner.occupancy import OccupancyIndex
from planner.path import Plan, Trajectory
from planner.together import Figures, Interrupted, Schedule, Together

# Those that wait for another one to be improved, and that one.
_MOST_AT_ONCE = 4
# All other batches wait while one is planned for the first time, and so does a client; hundreds of flights that meet
# nowhere take a second or two, as many that all want to land on one roof may take minutes.
_FIRST_COME_WITHIN_S = 20.0
# Everything else that is written waits while flights are planned under the write lock.
_AGAIN_WITHIN_S = 1.0


@dataclass(frozen=True)
class Improvement:
    """How long and how often better schedules were looked for. `stopped_by` is "time"; "optimal" where no flight was
    delayed by another of the batch any more; or "shutdown".
    """

    iterations: int
    elapsed_s: float
    stopped_by: str


@dataclass(frozen=True)
class Comparison:
    """What first come, first served would have given, what was recorded, and what was done for it."""

    first_come: Figures
    improved: Figures
    improvement: Improvement

    @classmethod
    def read(cls, document: bytes) -> "Comparison":
        """Return what `asdict` and JSON have made of one."""
        found = orjson.loads(document)
        return cls(Figures(**found["first_come"]), Figures(**found["improved"]), Improvement(**found["improvement"]))


@dataclass(frozen=True, eq=False)
class BatchOutcome(Recorded):
    """What became of a batch's intents, in its order."""

    comparison: Comparison


@dataclass(frozen=True)
class BatchKey:
    """A client's idempotency key with the digest of the parsed body."""

    key: str
    body_digest: str


@dataclass(frozen=True, eq=False)
class _Picture:
    """What is reserved, and what to plan around it."""

    reserved: OccupancyIndex
    requests: Sequence[PlanRequest]


@dataclass(frozen=True, eq=False)
class _Found:
    """The schedules that a batch was given, before others reserved anything else."""

    first_come: Schedule
    best: Schedule
    improvement: Improvement


@dataclass(frozen=True, eq=False)
class _Batch:
    """The submissions of a batch, all of one priority, under ids that they will have."""

    submissions: Sequence[Submission]
    ids: Sequence[str]
    key: BatchKey | None

    @property
    def operator(self) -> str:
        """Whose idempotency key it is."""
        return self.submissions[0].operator


class Batches:
    """Plans and records batches, one at a time and each operator's one after another; for one event loop."""

    def __init__(
        self,
        writer: Writer,
        ledger: Ledger,
        scheduler: Scheduler,
        deconfliction: Deconfliction,
        elapsed_s: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._writer = writer
        self._ledger = ledger
        self._scheduler = scheduler
        self._deconfliction = deconfliction
        self._elapsed_s = elapsed_s
        self._turn = asyncio.Lock()
        # Whose batches are being planned or wait for that.
        self._operators: set[str] = set()

    async def submit(
        self,
        submissions: Sequence[Submission],
        improve_for_s: float,
        key: BatchKey | None,
        is_closing: Callable[[], bool],
    ) -> BatchOutcome:
        """Plan submissions of one priority together, and record all of them; stop improving early `is_closing`.

        Whoever is cancelled gives its turn to the next; what is about to be written then may still be recorded.

        Raises
        ------
        ItemRefused, TooManyOpenIntents, IdempotencyKeyReused, BatchNotPlanned, TooManyRequests, QueueFull,
        LedgerUnavailable
            Nothing was recorded.
        OutcomeUnknown
            The commit was lost, and the ledger cannot be asked.
        """
        batch = _Batch(submissions, [str(uuid7()) for _ in submissions], key)
        if batch.operator in self._operators:
            raise TooManyRequests(f"operator {batch.operator!r} has another batch that is being planned: one at a time")
        if len(self._operators) == _MOST_AT_ONCE:
            raise QueueFull(f"{_MOST_AT_ONCE} batches are being planned or wait for that; try again in some seconds")
        self._operators.add(batch.operator)
        try:
            async with self._turn:
                picture = await self._writer.perform(
                    lambda transaction, now: self._picture(transaction, now, batch, improve_for_s),
                    lambda: None,
                    has_key=key is not None,
                )
                if isinstance(picture, IdempotencyRecord):
                    return await to_thread.run_sync(self._replayed, batch, picture)
                found = await self._planned(picture, improve_for_s, is_closing)
                outcome = await self._writer.perform(
                    lambda transaction, now: self._record(transaction, now, batch, found),
                    lambda: self._look_up(batch, found),
                    has_key=key is not None,
                )
                if isinstance(outcome, IdempotencyRecord):
                    return await to_thread.run_sync(self._replayed, batch, outcome)
                return outcome
        finally:
            self._operators.remove(batch.operator)

    @cached_property
    def _planner(self) -> Planner:
        """A planner of its own, for the writer's serves the writer meanwhile."""
        return self._scheduler.planner.another()

    def _picture(
        self, transaction: Transaction, now: int, batch: _Batch, improve_for_s: float
    ) -> _Picture | IdempotencyRecord:
        first = self._first_answer(transaction, now, batch)
        if first is not None:
            return first
        self._check(transaction, now, batch)
        # Who departs sooner than it is recorded would have to be planned anew.
        from_ms = now + int(improve_for_s * 1000)
        requests = [
            self._scheduler.request(submission, min(from_ms, submission.latest_departure_ms))
            for submission in batch.submissions
        ]
        return _Picture(self._scheduler.index.copy(), requests)

    async def _planned(self, picture: _Picture, improve_for_s: float, is_closing: Callable[[], bool]) -> _Found:
        """Plan in a thread. If that is cancelled, tell the thread, and wait for it: the planner is in its hands."""
        is_cancelled = threading.Event()

        def should_stop() -> bool:
            return is_cancelled.is_set() or is_closing()

        planning = asyncio.ensure_future(to_thread.run_sync(self._improved, picture, improve_for_s, should_stop))
        try:
            return await asyncio.shield(planning)
        except asyncio.CancelledError:
            is_cancelled.set()
            await asyncio.wait([planning])
            raise

    def _improved(self, picture: _Picture, improve_for_s: float, should_stop: Callable[[], bool]) -> _Found:
        began = self._elapsed_s()
        try:
            together = Together(
                self._planner,
                picture.requests,
                picture.reserved,
                should_stop=lambda: self._elapsed_s() - began >= _FIRST_COME_WITHIN_S or should_stop(),
            )
        except Interrupted:
            raise BatchNotPlanned(
                f"{len(picture.requests)} flight intents were not planned within {_FIRST_COME_WITHIN_S:g} s, or the "
                "service is about to stop"
            ) from None
        began = self._elapsed_s()
        together.improve(lambda: self._elapsed_s() - began >= improve_for_s or should_stop())
        elapsed_s = self._elapsed_s() - began
        stopped_by = "optimal" if together.is_best_possible else "shutdown" if elapsed_s < improve_for_s else "time"
        return _Found(together.first_come, together.best, Improvement(together.iterations, elapsed_s, stopped_by))

    def _record(
        self, transaction: Transaction, now: int, batch: _Batch, found: _Found
    ) -> BatchOutcome | IdempotencyRecord:
        first = self._first_answer(transaction, now, batch)
        if first is not None:
            return first
        self._check(transaction, now, batch)
        outcomes = self._settled(transaction, now, batch, found.best.plans)
        intents = tuple(
            transaction.record(
                intent_id=intent_id,
                submission=submission,
                now_ms=now,
                trajectory=None if isinstance(outcome, Refusal) else outcome,
                reservations=None if isinstance(outcome, Refusal) else reservations(outcome),
                refusal=outcome if isinstance(outcome, Refusal) else None,
            )
            for intent_id, submission, outcome in zip(batch.ids, batch.submissions, outcomes, strict=True)
        )
        outcome = BatchOutcome(intents, False, _compared(batch, found, intents))
        if batch.key is not None:
            transaction.remember_answer(
                batch.operator,
                batch.key.key,
                batch.key.body_digest,
                intents[0],
                orjson.dumps(asdict(outcome.comparison)),
                now,
            )
        return outcome

    def _settled(
        self, transaction: Transaction, now: int, batch: _Batch, plans: Sequence[Plan | None]
    ) -> list[Plan | Refusal]:
        """Reserve the plans that still hold, then plan the other flights around all of those, in their order.

        They are recorded right after this, so it is known which sequence numbers they will have. Raises
        `BatchNotPlanned` if there are more to plan than others can wait for; then the index is as it was.
        """
        index = self._scheduler.index
        first = transaction.sequence + 1
        settled: list[Plan | Refusal | None] = [None] * len(plans)
        for number, plan in enumerate(plans):
            if plan is not None and plan.departure_ms >= now and self._scheduler.is_free(plan):
                index.reserve(plan.hold_block, plan.hold_enter_ms, plan.hold_exit_ms, first + number)
                settled[number] = plan
        mates = dict(enumerate(batch.ids, start=first))
        began = self._elapsed_s()
        for number, submission in enumerate(batch.submissions):
            if settled[number] is None:
                if self._elapsed_s() - began >= _AGAIN_WITHIN_S:
                    for outcome in settled:
                        if isinstance(outcome, Plan):
                            index.release(outcome.hold_block, outcome.hold_enter_ms, outcome.hold_exit_ms)
                    raise BatchNotPlanned("others have reserved too much of what the batch was planned to fly in")
                try:
                    plan = self._scheduler.planner.plan(self._scheduler.request(submission, now), outlook=False)
                except NoPlan as error:
                    settled[number] = _refusal(error, transaction, mates)
                else:
                    index.reserve(plan.hold_block, plan.hold_enter_ms, plan.hold_exit_ms, first + number)
                    settled[number] = plan
        return [outcome for outcome in settled if outcome is not None]

    def _check(self, transaction: Transaction, now: int, batch: _Batch) -> None:
        for operator, count in Counter(submission.operator for submission in batch.submissions).items():
            self._deconfliction.check_open_intents(transaction, now, operator, count)
        for number, submission in enumerate(batch.submissions):
            try:
                self._scheduler.check_window(submission, now)
            except (DepartureInThePast, BeyondHorizon) as error:
                raise ItemRefused(number, error) from error

    def _first_answer(self, transaction: Transaction, now: int, batch: _Batch) -> IdempotencyRecord | None:
        key = batch.key
        if key is None:
            return None
        first = transaction.answer_to(batch.operator, key.key, self._writer.answers_kept_since(now))
        if first is not None and first.body_digest != key.body_digest:
            raise IdempotencyKeyReused(
                f"Idempotency-Key {key.key!r} came with another body before; use a new key for a new request"
            )
        return first

    def _replayed(self, batch: _Batch, first: IdempotencyRecord) -> BatchOutcome:
        """Return what became of a batch that came before: its intents as they are now."""
        intents = self._recorded(first.intent, len(batch.ids))
        return BatchOutcome(intents, True, Comparison.read(first.answer))

    def _look_up(self, batch: _Batch, found: _Found) -> BatchOutcome | None:
        """Return what the ledger has of a batch: all of it or nothing."""
        first = self._ledger.find(batch.ids[0])
        if first is None:
            return None
        intents = self._recorded(first, len(batch.ids))
        return BatchOutcome(intents, False, _compared(batch, found, intents))

    def _recorded(self, first: FlightIntent, count: int) -> tuple[FlightIntent, ...]:
        """Return a batch's intents, which have sequence numbers one after another."""
        beyond = first.sequence + count
        found = self._ledger.page(after_sequence=first.sequence - 1, limit=count)
        return tuple(intent for intent in found if intent.sequence < beyond)


def _compared(batch: _Batch, found: _Found, intents: Iterable[FlightIntent]) -> Comparison:
    return Comparison(
        _figures(batch, found.first_come.plans),
        _figures(batch, [intent.trajectory for intent in intents]),
        found.improvement,
    )


def _figures(batch: _Batch, paths: Sequence[Trajectory | None]) -> Figures:
    """Sum up flights by their delays, which count from when their operators wanted to depart."""
    flights = list(zip(batch.submissions, paths, strict=True))
    alone_ms = [0 if path is None else path.unconstrained_ms for _, path in flights]
    delay_ms = [
        -1 if path is None else path.arrival_ms - submission.earliest_departure_ms - path.unconstrained_ms
        for submission, path in flights
    ]
    return Figures.of(np.array(delay_ms, dtype=np.int64), np.array(alone_ms, dtype=np.int64))


def _refusal(error: NoPlan, transaction: Transaction, mates: dict[int, str]) -> Refusal:
    """Return why there is no plan; flights of the same batch, yet to be recorded, are among those in the way."""
    flights = [owner for owner in error.conflicting_owners if owner > 0]
    ids = mates | transaction.ids(owner for owner in flights if owner not in mates)
    told = refusal(error, transaction)
    return replace(told, conflicting_intents=tuple(ids[owner] for owner in flights if owner in ids))
