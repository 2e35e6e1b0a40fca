"""First come, first served (paper 2.4; domain: strategic deconfliction): what the writer does for operators.

Each flight is planned in order of arrival against everything reserved before. The occupancy index that the planner
reads is a replica of the ledger's reservations; only work in the writer's thread touches it.
"""

import asyncio
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import structlog
from uuid_utils import uuid7

from app.errors import BeyondHorizon, DepartureInThePast, IdempotencyKeyReused, IllegalTransition, UnknownFlightIntent
from app.flight_intents import OPEN_STATES, FlightIntent, Refusal, Reservations, State, Submission
from app.ledger import Ledger, Transaction
from app.surveillance import Aircraft
from app.times import format_time
from app.writer import BatchReport, Writer
from planner.cfa_star import Performance, Planner, PlanRequest
from planner.errors import NoPlan
from planner.occupancy import OccupancyIndex
from planner.path import Plan, Trajectory

log = structlog.get_logger()

# The index forgets the past in steps of this length; forgetting looks at every block once.
_FORGET_EVERY_MS = 10_000
# A departure window may have opened before the intent came, but not longer ago than this.
_OPEN_FOR_MS = 86_400_000
# A process that lags further behind than this many journal entries loads the ledger afresh.
_CATCH_UP_ENTRIES = 5_000
_STATES = frozenset(State)


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
class Moved:
    """Flights that moved to other states by themselves: sequence, id and new state of each."""

    flights: Sequence[tuple[int, str, State]]


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


class OccupancyReplica:
    """The occupancy index as a replica of the ledger's reservations."""

    def __init__(self, index: OccupancyIndex) -> None:
        self._index = index
        self._forgotten_ms = 0

    def __len__(self) -> int:
        return len(self._index)

    def catch_up(self, transaction: Transaction, now: int, revision: int | None) -> None:
        """Bring the index from a revision (None: from nothing) to the transaction's; drop what has passed."""
        index = self._index
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
            # What was remarked of aircraft changes no reservation.
            entries = [entry for entry in transaction.journal_after(revision) if entry.kind in _STATES]
            for entry in entries:
                index.release(*entry.released.T.copy())
            held = transaction.held_after(now, sorted({entry.sequence for entry in entries}))
            index.release(held.block, held.enter_ms, held.exit_ms)
            index.reserve(held.block, held.enter_ms, held.exit_ms, held.sequence)
        transaction.seen()
        if now - self._forgotten_ms >= _FORGET_EVERY_MS:
            index.forget_before(now)
            self._forgotten_ms = now


class Deconfliction:
    """Plans, records and changes flights by way of the writer.

    `horizon_ms` is how far ahead they may depart, `freshness_ms` for how long a position says where an aircraft is.
    """

    def __init__(
        self,
        writer: Writer,
        ledger: Ledger,
        planner: Planner,
        performances: Mapping[str, Performance],
        horizon_ms: int,
        freshness_ms: int,
    ) -> None:
        self._writer = writer
        self._ledger = ledger
        self._planner = planner
        self._performances = performances
        self._horizon_ms = horizon_ms
        self._freshness_ms = freshness_ms

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

        request = self._writer.enqueue(
            lambda transaction, now: self._submit(transaction, now, intent_id, submission, key), look_up, plans=True
        )
        outcome = await asyncio.wrap_future(request.future)
        queue_s, plan_s = request.begun - request.arrived, request.ended - request.begun
        return replace(outcome, timing=Timing(queue_s, plan_s, time.perf_counter() - request.ended))

    async def preview(self, submission: Submission) -> PreviewPlan | Refusal:
        """Plan a submission, record nothing; raises as `submit`."""

        def run(transaction: Transaction, now: int) -> PreviewPlan | Refusal:
            try:
                plan = self._plan(submission, now)
            except NoPlan as error:
                return _refusal(error, transaction)
            return PreviewPlan(submission, plan, _reservations(plan))

        return await self._writer.perform(run, lambda: None, plans=True)

    async def cancel(self, intent_id: str) -> FlightIntent:
        """Cancel an accepted intent. Before departure its reservations go, after it they stay until arrival.

        Raises
        ------
        UnknownFlightIntent, IllegalTransition, QueueFull, LedgerUnavailable
        """

        def look_up() -> FlightIntent | None:
            intent = self._ledger.find(intent_id)
            return intent if intent is not None and intent.state is State.CANCELLED else None

        return await self._writer.perform(lambda transaction, now: self._cancel(transaction, now, intent_id), look_up)

    async def activate(self, intent_id: str) -> FlightIntent:
        """Take down that an accepted flight is about to fly, or flies; raises as `cancel`."""

        def look_up() -> FlightIntent | None:
            intent = self._ledger.find(intent_id)
            return intent if intent is not None and intent.activated_ms is not None else None

        return await self._writer.perform(lambda transaction, now: self._activate(transaction, now, intent_id), look_up)

    async def end(self, intent_id: str) -> FlightIntent:
        """End a flight. One that has departed and was not reported landed keeps its reservations until its arrival;
        raises as `cancel`.
        """

        def look_up() -> FlightIntent | None:
            intent = self._ledger.find(intent_id)
            return intent if intent is not None and intent.state is State.ENDED else None

        def run(transaction: Transaction, now: int) -> FlightIntent:
            intent = _found(transaction, intent_id)
            return intent if intent.state is State.ENDED else self.move(transaction, now, intent, State.ENDED)

        return await self._writer.perform(run, look_up)

    def move(self, transaction: Transaction, now: int, intent: FlightIntent, state: State) -> FlightIntent:
        """Move an open flight to a state under the write lock; raises `IllegalTransition`.

        Ending or cancelling it frees its blocks where it has not departed, or was seen on the ground since.
        """
        if intent.state not in OPEN_STATES or intent.trajectory is None:
            raise IllegalTransition(f"flight intent {intent.id} is {intent.state} and cannot become {state}")
        is_over = state in (State.ENDED, State.CANCELLED)
        is_free = is_over and self._is_down(transaction, now, intent, intent.trajectory)
        changed = transaction.change(intent, state, now, is_free=is_free)
        if is_free:
            freed, kept = intent.reservations.beyond(now), changed.reservations.beyond(now)
            self._planner.index.release(freed.block, freed.enter_ms, freed.exit_ms)
            self._planner.index.reserve(kept.block, kept.enter_ms, kept.exit_ms, intent.sequence)
        return changed

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
        horizon = now + self._horizon_ms
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
            since_ms = self._writer.answers_kept_since(now)
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
        intent = _found(transaction, intent_id)
        if intent.state is State.CANCELLED:
            return intent
        if intent.state is not State.ACCEPTED or intent.trajectory is None:
            raise IllegalTransition(f"flight intent {intent_id} is {intent.state} and cannot be cancelled")
        if intent.trajectory.arrival_ms < now:
            raise IllegalTransition(
                f"flight intent {intent_id} arrived at {format_time(intent.trajectory.arrival_ms)} "
                "and cannot be cancelled any more"
            )
        return self.move(transaction, now, intent, State.CANCELLED)

    def _is_down(self, transaction: Transaction, now: int, intent: FlightIntent, trajectory: Trajectory) -> bool:
        """Tell whether a flight's aircraft is known not to be in the air: it should not have departed yet and was not
        seen flying; or it was reported on the ground, where it was to land, or just now.
        """
        aircraft = Aircraft(intent.sequence)
        seen = transaction.newest_positions([aircraft]).get(aircraft)
        if now < trajectory.departure_ms:
            return seen is None or seen.airborne is not True
        if seen is None or seen.airborne is not False or seen.time_ms < trajectory.departure_ms:
            return False
        block = int(self._planner.airspace.grid.blocks_at(seen.lon, seen.lat, seen.alt_m)[0])
        return block == trajectory.block[-1] or now - seen.time_ms <= self._freshness_ms

    def _activate(self, transaction: Transaction, now: int, intent_id: str) -> FlightIntent:
        intent = _found(transaction, intent_id)
        if intent.activated_ms is not None and intent.state in (State.ACTIVATED, State.NONCONFORMING):
            return intent
        if intent.state not in (State.ACCEPTED, State.NONCONFORMING) or intent.trajectory is None:
            raise IllegalTransition(f"flight intent {intent_id} is {intent.state} and cannot be activated")
        if intent.trajectory.arrival_ms < now:
            raise IllegalTransition(
                f"flight intent {intent_id} should have arrived at {format_time(intent.trajectory.arrival_ms)} "
                "and cannot be activated any more"
            )
        # One that flew without having been activated becomes so as soon as it is seen to conform.
        state = State.ACTIVATED if intent.state is State.ACCEPTED else intent.state
        return transaction.change(intent, state, now, is_activated=True)


def _found(transaction: Transaction, intent_id: str) -> FlightIntent:
    intent = transaction.find(intent_id)
    if intent is None:
        raise UnknownFlightIntent(f"there is no flight intent {intent_id}")
    return intent


def log_intents(report: BatchReport) -> None:
    """Log each flight intent that a batch has recorded or changed."""
    for request, answer in zip(report.requests, report.answers, strict=True):
        if isinstance(answer, Outcome) and answer.replayed is None:
            _log_intent(answer.intent, request.context)
        elif isinstance(answer, FlightIntent):
            _log_intent(answer, request.context)
        elif isinstance(answer, Moved):
            for sequence, intent_id, state in answer.flights:
                log.info(f"flight intent {state}", flight_intent=intent_id, sequence=sequence)


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
