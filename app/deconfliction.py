"""First come, first served (paper 2.4; domain: strategic deconfliction): what the writer does for operators.

Each flight is planned in order of arrival against everything reserved before, but for those of lower priority that can
still make way. Each method is one piece of the writer's work: all of it is durable when it returns, or nothing.
"""

import asyncio
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import structlog
from uuid_utils import uuid7

from app.airspace_closing import Closed
from app.errors import (
    IdempotencyKeyReused,
    IllegalTransition,
    NotChangeable,
    OutcomeUnknown,
    PreconditionFailed,
    TooManyOpenIntents,
    UnknownFlightIntent,
)
from app.flight_intents import OPEN_STATES, Displacement, FlightIntent, Refusal, Reservations, State, Submission
from app.ledger import Ledger, Rewriting, Transaction
from app.scheduling import Cause, Scheduler, details_of, refusal, reservations
from app.surveillance import Aircraft, Sighting
from app.times import format_time
from app.writer import BatchReport, Writer
from planner.errors import NoPlan
from planner.path import Plan, Trajectory

log = structlog.get_logger()


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


@dataclass(frozen=True, eq=False)
class Recorded:
    """Flight intents that were recorded at once; `is_replayed` if that was before, and this a repetition."""

    intents: Sequence[FlightIntent]
    is_replayed: bool


@dataclass(frozen=True)
class Outcome:
    """What became of a submission or a change, and of the flights that had to make way for it. `replayed` is the body
    of the first answer, where this is a repetition; `rendered` the body of this one, where it had to be made already.
    """

    intent: FlightIntent
    displaced: tuple[Displacement, ...] = ()
    replayed: bytes | None = None
    rendered: bytes | None = None
    timing: Timing = Timing()


@dataclass(frozen=True, eq=False)
class PreviewPlan:
    """A plan that reserves nothing; `displaces` are the ids of the flights that would have to make way for it."""

    submission: Submission
    trajectory: Trajectory
    reservations: Reservations
    displaces: tuple[str, ...]


class Deconfliction:
    """Plans, records and changes flights by way of the writer. `freshness_ms`: for how long a position says where an
    aircraft is; `activation_lead_ms`: how long before its departure a flight may be activated (None: at any time).
    """

    def __init__(
        self,
        writer: Writer,
        ledger: Ledger,
        scheduler: Scheduler,
        freshness_ms: int,
        open_intents_limit: int | None = None,
        activation_lead_ms: int | None = None,
    ) -> None:
        self._writer = writer
        self._ledger = ledger
        self._scheduler = scheduler
        self._planner = scheduler.planner
        self._freshness_ms = freshness_ms
        self._open_intents_limit = open_intents_limit
        self._activation_lead_ms = activation_lead_ms

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
        # What the last attempt did, which is what was done if the intent is in the ledger.
        done: list[Outcome] = []

        def run(transaction: Transaction, now: int) -> Outcome:
            done[:] = [self._submit(transaction, now, intent_id, submission, key)]
            return done[0]

        def look_up() -> Outcome | None:
            if done and self._ledger.find(intent_id) is not None:
                return done[0]
            first = None if key is None else self._ledger.answer_to(submission.operator, key.key)
            if key is None or first is None or first.body_digest != key.body_digest:
                return None
            return Outcome(first.intent, replayed=first.answer)

        request = self._writer.enqueue(run, look_up, plans=True, has_key=key is not None)
        outcome = await asyncio.wrap_future(request.future)
        queue_s, plan_s = request.begun - request.arrived, request.ended - request.begun
        return replace(outcome, timing=Timing(queue_s, plan_s, time.perf_counter() - request.ended))

    async def preview(self, submission: Submission) -> PreviewPlan | Refusal:
        """Plan a submission, record nothing; raises as `submit`."""

        def run(transaction: Transaction, now: int) -> PreviewPlan | Refusal:
            try:
                plan = self._scheduler.plan(transaction, now, submission)
            except NoPlan as error:
                return refusal(error, transaction)
            ids = transaction.ids(self._scheduler.in_the_way(plan))
            return PreviewPlan(submission, plan, reservations(plan), tuple(ids.values()))

        return await self._writer.perform(run, lambda: None, plans=True)

    async def change(
        self, intent_id: str, submission: Submission, versions: frozenset[int] | None
    ) -> Outcome | Refusal:
        """Plan an intent anew as it is submitted now, if it still has one of these versions (None: any).

        One that is in the air goes on from where it will be soon. Where there is no plan, the refusal is returned, and
        the old plan stands.

        Raises
        ------
        UnknownFlightIntent, PreconditionFailed, IllegalTransition, NotChangeable, DepartureInThePast, BeyondHorizon,
        NotPlannable, QueueFull, LedgerUnavailable, OutcomeUnknown
            Nothing was changed.
        """

        # What the last attempt found, and what it did.
        before: list[FlightIntent] = []
        done: list[Outcome | Refusal] = []

        def run(transaction: Transaction, now: int) -> Outcome | Refusal:
            done.clear()
            before[:] = [_found(transaction, intent_id)]
            done[:] = [self._change(transaction, now, before[0], submission, versions)]
            return done[0]

        def look_up() -> Outcome | Refusal | None:
            if not done or isinstance(done[0], Refusal):
                return done[0] if done else None
            found = self._ledger.find(intent_id)
            if found is not None and _is_same(found, done[0].intent):
                return done[0]
            if found is None or found.version != before[0].version:
                raise OutcomeUnknown(
                    "the commit failed, and then somebody else changed the flight intent: it is not known whether this "
                    "change came before; read it, and change it again if it is not as you want it"
                )
            return None

        return await self._writer.perform(run, look_up, plans=True)

    async def cancel(self, intent_id: str) -> FlightIntent:
        """Cancel an intent that is accepted or displaced. Its reservations go if its aircraft is known to be down; else
        they stay until arrival, or until this is repeated when it is.

        Raises
        ------
        UnknownFlightIntent, IllegalTransition, QueueFull, LedgerUnavailable
        """
        return await self._finish(intent_id, State.CANCELLED, self._cancel)

    async def activate(self, intent_id: str) -> FlightIntent:
        """Take down that an accepted flight is about to fly, or flies; raises as `cancel`."""

        done: list[FlightIntent] = []

        def run(transaction: Transaction, now: int) -> FlightIntent:
            done[:] = [self._activate(transaction, now, intent_id)]
            return done[0]

        def look_up() -> FlightIntent | None:
            intent = self._ledger.find(intent_id)
            if intent is None or intent.activated_ms is not None:
                return intent
            # A change may have taken the activation away. One that has its very version came instead of it.
            if done and intent.version > done[0].version:
                raise OutcomeUnknown(
                    "the commit failed, and then somebody else changed the flight intent: it is not known whether it "
                    "was activated before; read it, and activate it again if that is still to be done"
                )
            return None

        return await self._writer.perform(run, look_up)

    async def end(self, intent_id: str) -> FlightIntent:
        """End a flight. One that has departed and was not reported landed keeps its reservations until its arrival, or
        until this is repeated when it was; raises as `cancel`.
        """

        def run(transaction: Transaction, now: int, intent_id: str) -> FlightIntent:
            intent = _found(transaction, intent_id)
            if intent.state is State.ENDED:
                return self._freed_if_down(transaction, now, intent)
            return self.move(transaction, now, intent, State.ENDED)

        return await self._finish(intent_id, State.ENDED, run)

    async def _finish(
        self, intent_id: str, state: State, run: Callable[[Transaction, int, str], FlightIntent]
    ) -> FlightIntent:
        """Have an intent brought to a state that it stays in, or more of what it holds freed there."""
        done: list[FlightIntent] = []

        def run_again(transaction: Transaction, now: int) -> FlightIntent:
            done[:] = [run(transaction, now, intent_id)]
            return done[0]

        def look_up() -> FlightIntent | None:
            intent = self._ledger.find(intent_id)
            # Whatever came later has freed it too.
            is_done = intent is not None and intent.state is state and bool(done) and intent.version >= done[0].version
            return intent if is_done else None

        return await self._writer.perform(run_again, look_up)

    def move(self, transaction: Transaction, now: int, intent: FlightIntent, state: State) -> FlightIntent:
        """Move an open flight to a state under the write lock; raises `IllegalTransition`.

        Ending or cancelling it frees its blocks where it has not departed, or was seen on the ground since.
        """
        if intent.state not in OPEN_STATES or intent.trajectory is None:
            raise IllegalTransition(f"flight intent {intent.id} is {intent.state} and cannot become {state}")
        is_over = state in (State.ENDED, State.CANCELLED)
        if is_over and self._is_down(transaction, now, intent, intent.trajectory):
            return self._freed(transaction, now, intent, state)
        return transaction.change(intent, state, now)

    def _freed_if_down(self, transaction: Transaction, now: int, intent: FlightIntent) -> FlightIntent:
        """Free what a flight that is over still holds, if its aircraft is known to be down by now."""
        # What is freed ends with this millisecond.
        holds = len(intent.reservations.beyond(now + 1)) > 0
        if holds and intent.trajectory is not None and self._is_down(transaction, now, intent, intent.trajectory):
            return self._freed(transaction, now, intent, intent.state)
        return intent

    def _freed(self, transaction: Transaction, now: int, intent: FlightIntent, state: State) -> FlightIntent:
        """Bring a flight to a state in which it holds nothing from now on."""
        changed = transaction.change(intent, state, now, is_free=True)
        freed, kept = intent.reservations.beyond(now), changed.reservations.beyond(now)
        self._planner.index.release(freed.block, freed.enter_ms, freed.exit_ms)
        self._planner.index.reserve(kept.block, kept.enter_ms, kept.exit_ms, intent.sequence)
        return changed

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
        self.check_open_intents(transaction, now, submission.operator)
        try:
            plan = self._scheduler.plan(transaction, now, submission)
        except NoPlan as error:
            outcome = Outcome(
                transaction.record(
                    intent_id=intent_id, submission=submission, now_ms=now, refusal=refusal(error, transaction)
                )
            )
        else:
            outcome = self._accept(transaction, now, intent_id, submission, plan)
        if key is not None:
            outcome = replace(outcome, rendered=key.render(outcome))
            assert outcome.rendered is not None
            transaction.remember_answer(
                submission.operator, key.key, key.body_digest, outcome.intent, outcome.rendered, now
            )
        return outcome

    def check_open_intents(self, transaction: Transaction, now: int, operator: str, more: int = 1) -> None:
        """Raise `TooManyOpenIntents` if an operator may not have so many more flights that are not over.

        One that is cancelled or ended counts for as long as it holds something.
        """
        limit = self._open_intents_limit
        if limit is not None and transaction.count_open(operator, limit, now) + more > limit:
            raise TooManyOpenIntents(
                f"operator {operator!r} may have {limit} flight intents that are not over, or still hold blocks"
            )

    def _accept(
        self, transaction: Transaction, now: int, intent_id: str, submission: Submission, plan: Plan
    ) -> Outcome:
        """Record a flight with its plan, and move those that are in its way."""
        scheduler = self._scheduler
        with transaction.one_revision():
            vacated = scheduler.vacate(transaction, now, scheduler.in_the_way(plan))
            intent = transaction.record(
                intent_id=intent_id,
                submission=submission,
                now_ms=now,
                trajectory=plan,
                reservations=reservations(plan),
            )
            scheduler.reserve(intent, now)
            return Outcome(intent, scheduler.settle(transaction, now, vacated, Cause(flight_intent_id=intent.id)))

    def _change(
        self,
        transaction: Transaction,
        now: int,
        before: FlightIntent,
        submission: Submission,
        versions: frozenset[int] | None,
    ) -> Outcome | Refusal:
        scheduler = self._scheduler
        if versions is not None and before.version not in versions:
            raise PreconditionFailed(
                f"flight intent {before.id} has version {before.version} by now; read it, and change that"
            )
        if before.submission.operator != submission.operator:
            raise NotChangeable("a flight intent stays with its operator")
        if before.state is State.DISPLACED:
            self.check_open_intents(transaction, now, submission.operator)
        is_on_ground = self._is_on_ground_for_change(transaction, now, before)
        try:
            if is_on_ground:
                plan = scheduler.plan(transaction, now, submission, before)
            else:
                plan = scheduler.continued(transaction, now, submission, before)
        except NoPlan as error:
            return refusal(error, transaction)
        # Who is activated when it is due, and then departs later, would be out of everybody's reach.
        activated_ms = None if is_on_ground and now < self._activated_from_ms(plan) else before.activated_ms
        after = replace(
            before,
            state=State.ACCEPTED if activated_ms is None else State.ACTIVATED,
            activated_ms=activated_ms,
            submission=submission,
            trajectory=plan,
            reservations=reservations(plan),
            refusal=None,
        )
        with transaction.one_revision():
            vacated = scheduler.vacate(transaction, now, [before.sequence, *scheduler.in_the_way(plan, before)])
            [after] = transaction.rewrite([Rewriting(before, after, details_of(before, after))], now)
            scheduler.reserve(after, now)
            others = [intent for intent in vacated if intent.sequence != before.sequence]
            return Outcome(after, scheduler.settle(transaction, now, others, Cause(flight_intent_id=after.id)))

    def _is_on_ground_for_change(self, transaction: Transaction, now: int, intent: FlightIntent) -> bool:
        """Tell whether a flight can be planned anew from its origin, False where that is from where it will be in the
        air; raises `IllegalTransition` where neither is known to be so.
        """
        if intent.state is State.DISPLACED:
            return True
        if intent.state not in OPEN_STATES or intent.trajectory is None:
            raise IllegalTransition(f"flight intent {intent.id} is {intent.state} and cannot be changed")
        if self._is_down(transaction, now, intent, intent.trajectory):
            seen = self._newest_sighting(transaction, intent)
            if now >= intent.trajectory.departure_ms and self._block_of(seen) == intent.trajectory.block[-1]:
                raise IllegalTransition(f"flight intent {intent.id} has landed; end it, and submit another")
            return True
        if intent.state is not State.ACTIVATED:
            raise IllegalTransition(
                f"flight intent {intent.id} is {intent.state} and may be in the air: it can be changed once it is "
                "activated and conforms, or reported on the ground"
            )
        return False

    def _cancel(self, transaction: Transaction, now: int, intent_id: str) -> FlightIntent:
        intent = _found(transaction, intent_id)
        if intent.state is State.CANCELLED:
            return self._freed_if_down(transaction, now, intent)
        if intent.state is State.DISPLACED:
            return transaction.change(intent, State.CANCELLED, now)
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
        seen anywhere but on its pad; or it was reported on the ground, where it was to land, or just now.
        """
        seen = self._newest_sighting(transaction, intent)
        if now < trajectory.departure_ms:
            if seen is None or seen.airborne is not None:
                return seen is None or seen.airborne is False
            return self._block_of(seen) == int(trajectory.block[0])
        if seen is None or seen.airborne is not False or seen.time_ms < trajectory.departure_ms:
            return False
        return self._block_of(seen) == trajectory.block[-1] or now - seen.time_ms <= self._freshness_ms

    def _newest_sighting(self, transaction: Transaction, intent: FlightIntent) -> Sighting | None:
        aircraft = Aircraft(intent.sequence)
        return transaction.newest_positions([aircraft]).get(aircraft)

    def _block_of(self, seen: Sighting | None) -> int | None:
        """Return the block of a position, -1 outside the grid."""
        if seen is None:
            return None
        return int(self._planner.airspace.grid.blocks_at(seen.lon, seen.lat, seen.alt_m)[0])

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
        if now < self._activated_from_ms(intent.trajectory):
            raise IllegalTransition(
                f"flight intent {intent_id} departs at {format_time(intent.trajectory.departure_ms)} "
                f"and may be activated from {format_time(self._activated_from_ms(intent.trajectory))} on"
            )
        # One that flew without having been activated becomes so as soon as it is seen to conform.
        state = State.ACTIVATED if intent.state is State.ACCEPTED else intent.state
        return transaction.change(intent, state, now, is_activated=True)

    def _activated_from_ms(self, trajectory: Trajectory) -> int:
        """Return from when on a flight may be activated."""
        lead_ms = self._activation_lead_ms
        return 0 if lead_ms is None else trajectory.departure_ms - lead_ms


def _is_same(found: FlightIntent, written: FlightIntent) -> bool:
    """Tell whether an intent in the ledger is as it was written: another change may have got the same version."""
    paths = [
        None if path is None else (path.block.tolist(), path.arrive_ms.tolist(), path.depart_ms.tolist())
        for path in (found.trajectory, written.trajectory)
    ]
    # The ledger keeps no submitted path but the trajectory.
    submitted = replace(written.submission, path=None)
    return (found.version, found.state, found.submission, paths[0]) == (
        written.version,
        written.state,
        submitted,
        paths[1],
    )


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
            _log_displaced(answer.displaced, request.context)
        elif isinstance(answer, Recorded) and not answer.is_replayed:
            # One line: the writer has other things to do than to write hundreds.
            log.info(
                "flight intents recorded",
                count=len(answer.intents),
                accepted=sum(intent.refusal is None for intent in answer.intents),
                first_sequence=answer.intents[0].sequence,
                **request.context,
            )
        elif isinstance(answer, Closed):
            log.info(
                "constraint in force",
                constraint=answer.constraint.id,
                unmoved=len(answer.unmoved),
                **request.context,
            )
            _log_displaced(answer.displaced, request.context)
        elif isinstance(answer, FlightIntent):
            _log_intent(answer, request.context)
        elif isinstance(answer, Moved):
            for sequence, intent_id, state in answer.flights:
                log.info(f"flight intent {state}", flight_intent=intent_id, sequence=sequence)


def _log_displaced(displaced: Sequence[Displacement], context: Mapping[str, object]) -> None:
    for flight in displaced:
        log.info(
            "flight intent made way" if flight.reason is None else "flight intent displaced",
            flight_intent=flight.id,
            sequence=flight.sequence,
            operator=flight.operator,
            departure_moved_ms=flight.departure_moved_ms,
            reason=flight.reason,
            **context,
        )


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
