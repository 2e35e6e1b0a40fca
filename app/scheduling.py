"""Who flies when: plans against what is reserved, and makes way for what comes first (domain: strategic deconfliction).

A flight of higher priority is planned as if those of lower priority that can still move were not there, and closed
airspace moves whom it hits. Who has to make way is planned again in the same transaction, by priority and then by
sequence, around everything and displacing nobody. All of it runs in the writer's thread.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from app.errors import BeyondHorizon, DepartureInThePast, IllegalTransition, NotChangeable
from app.flight_intents import Displacement, FlightIntent, Refusal, Reservations, State, Submission
from app.ledger import Rewriting, Transaction
from app.submitted_paths import path_refusal
from app.times import format_time
from planner.airmatrix import IntArray
from planner.cfa_star import Performance, Planner, PlanRequest
from planner.errors import NoPlan, SearchTooLong
from planner.holds import holds_of
from planner.kernels.intervals import FAR_FUTURE
from planner.occupancy import Closure, OccupancyIndex
from planner.path import Plan
from planner.submitted import PathConflicts, SubmittedPath, conflicts

# A departure window may have opened before the intent came, but not longer ago than this.
_OPEN_FOR_MS = 86_400_000
# Up to so many flights that make way are each worth a second search, and planned while the writer waits.
FEW = 16


class AircraftTypeGone(NoPlan):
    """A flight was accepted when its aircraft type was known, which it is no more."""

    reason = "aircraft_type_gone"


class TooManyAtOnce(NoPlan):
    """So many flights had to make way at once that there was no time to plan this one again."""

    reason = "too_many_at_once"


@dataclass(frozen=True)
class Limits:
    """How far ahead flights may depart, how long before its departure a flight can no longer be moved, and from how
    soon on a flight in the air can be planned anew: in ms. After how many expansions of the search flights that have to
    make way are no longer planned again: some seconds' work.
    """

    horizon_ms: int
    notice_ms: int = 60_000
    lead_ms: int = 5_000
    most_expansions: int = 3_000_000


@dataclass(frozen=True)
class Cause:
    """Why flights had to make way: a flight intent or a constraint."""

    flight_intent_id: str | None = None
    constraint_id: str | None = None

    def __str__(self) -> str:
        if self.flight_intent_id is not None:
            return f"flight intent {self.flight_intent_id}, which has a higher priority"
        return f"constraint {self.constraint_id}"

    def member(self) -> dict[str, str]:
        """Return it as a member of a journal entry's details."""
        if self.flight_intent_id is not None:
            return {"flight_intent_id": self.flight_intent_id}
        return {"constraint_id": str(self.constraint_id)}


@dataclass(frozen=True, eq=False)
class Foreseen:
    """What planning a flight again has given before it had to make way, while it had this version, and the ledger this
    revision.
    """

    version: int
    revision: int
    outcome: Plan | NoPlan

    def holds_at(self, revision: int) -> bool:
        """Tell whether it may still be so: where there was no plan, others may have left room since."""
        return isinstance(self.outcome, Plan) or self.revision == revision

    def renumbered(self, old: int, new: int) -> "Foreseen":
        """Return it with another number for a constraint that is in the way."""
        if isinstance(self.outcome, Plan):
            return self
        told = copy(self.outcome)
        told.conflicting_owners = tuple(-new if owner == -old else owner for owner in told.conflicting_owners)
        return replace(self, outcome=told)


class Scheduler:
    """Plans flights, and moves those that have to make way. Changes the planner's index as it changes the ledger."""

    def __init__(self, planner: Planner, performances: Mapping[str, Performance], limits: Limits) -> None:
        self.planner = planner
        self._performances = performances
        self._limits = limits

    @property
    def index(self) -> OccupancyIndex:
        """All that is reserved and closed."""
        return self.planner.index

    def plan(self, transaction: Transaction, now: int, submission: Submission, own: FlightIntent | None = None) -> Plan:
        """Return a plan around all that may not be moved for this submission, and around nothing of its `own`; the
        submission's own path, if it has one.

        Raises
        ------
        DepartureInThePast, BeyondHorizon, NoPlan
        """
        self.check_window(submission, now)
        with self._freed(own, now):
            if submission.path is not None:
                index = self._unyielding(transaction, now, submission)
                return self._as_submitted(submission, submission.path, now, index, own)
            request = self.request(submission, now)
            if submission.priority <= transaction.lowest_priority:
                return self.planner.plan(request)
            with suppress(NoPlan):
                plan = self.planner.plan(request, outlook=False)
                if not plan.delay_ms:
                    # As early as can be, and nobody has to make way.
                    return plan
            until_ms = self.planner.ends_by(request)
            index = self._unyielding(transaction, now, submission, request.earliest_departure_ms, until_ms)
            try:
                return self.planner.plan(request, index, outlook=False, continues=True)
            except SearchTooLong:
                raise
            except NoPlan as error:
                # When else it could fly depends on what is reserved later.
                index = self._unyielding(transaction, now, submission)
                try:
                    return self.planner.plan(request, index, continues=True)
                except SearchTooLong:
                    raise error from None

    def _as_submitted(
        self,
        submission: Submission,
        path: SubmittedPath,
        now: int,
        index: OccupancyIndex,
        own: FlightIntent | None,
    ) -> Plan:
        """Return an operator's own path as a plan; raises `DepartureInThePast` and `PathConflicts`."""
        if path.departure_ms < now:
            raise DepartureInThePast(
                f"the path begins at {format_time(path.departure_ms)}, which has passed; it is {format_time(now)}"
            )
        request = self.request(submission, now)
        found = conflicts(self.planner.airspace.grid, index, path)
        if not found.count:
            return path.plan(self.planner.unconstrained(request), self.planner.airspace.terminal_dwell_ms)
        try:
            proposal = self.planner.plan(request, index)
        except NoPlan:
            raise PathConflicts(found, None) from None
        raise PathConflicts(found, proposal, self.in_the_way(proposal, own))

    def continued(self, transaction: Transaction, now: int, submission: Submission, own: FlightIntent) -> Plan:
        """Return a plan for a flight in the air: as it was planned until soon, then to where it wants to go now.

        It leaves its path at the first block centre that it reaches after the lead, that is not closed, and that is
        not where it is to land.

        Raises
        ------
        NotChangeable, IllegalTransition, NotPlannable, NoPlan
        """
        assert own.trajectory is not None
        self._check_unchanged(own.submission, submission)
        path = own.trajectory
        if submission.path is not None:
            raise NotChangeable("the flight is in the air, where no path can be submitted")
        needed = holds_of(self.planner.airspace, path.block, path.arrive_ms, path.depart_ms)
        if not all(map(np.array_equal, needed, _columns(own.reservations))):
            raise NotChangeable("the flight is in the air and flies in volumes: nobody knows where it will be")
        from_ms = max(now + self._limits.lead_ms, path.departure_ms + path.terminal_dwell_ms)
        with self._freed(own, now):
            index = self._unyielding(transaction, now, submission)
            for place in range(int(np.searchsorted(path.depart_ms, from_ms)), len(path.block) - 1):
                block, start_ms = int(path.block[place]), max(int(path.arrive_ms[place]), from_ms)
                if block != submission.destination_block and not index.owners(block, start_ms, start_ms + 1):
                    flown = replace(
                        path,
                        block=path.block[: place + 1],
                        arrive_ms=path.arrive_ms[: place + 1],
                        depart_ms=path.depart_ms[: place + 1],
                    )
                    performance = self._performances[submission.aircraft_type]
                    request = PlanRequest(block, submission.destination_block, performance, start_ms, start_ms)
                    return self.planner.continued(flown, request, index)
        raise IllegalTransition(
            f"flight intent {own.id} is about to land, or leaves closed airspace only where it lands: "
            "it can no longer be planned anew"
        )

    def is_free(self, plan: Plan) -> bool:
        """Tell whether nobody has reserved, and nothing closes, any of what a plan holds."""
        return not self.index.owners_within(plan.hold_block, plan.hold_enter_ms, plan.hold_exit_ms)

    def in_the_way(self, plan: Plan, own: FlightIntent | None = None) -> tuple[int, ...]:
        """Return the sequence numbers of the flights that would have to make way for a plan."""
        owners = self.index.owners_within(plan.hold_block, plan.hold_enter_ms, plan.hold_exit_ms)
        return tuple(owner for owner in owners if owner > 0 and (own is None or owner != own.sequence))

    def within(self, transaction: Transaction, now: int, closure: Closure) -> "Hit":
        """Return the flights that hold, from now on, some of what is to be closed."""
        to_come = closure.exit_ms > now
        owners = self.index.owners_within(
            closure.block[to_come], np.maximum(closure.enter_ms, now)[to_come], closure.exit_ms[to_come]
        )
        movable = set(transaction.movable(None, now + self._limits.notice_ms).tolist())
        flights = [owner for owner in owners if owner > 0]
        return Hit(
            tuple(owner for owner in flights if owner in movable),
            tuple(owner for owner in flights if owner not in movable),
        )

    def vacate(self, transaction: Transaction, now: int, sequences: Sequence[int]) -> list[FlightIntent]:
        """Take away all that some flights hold, in the index too; return them as they were."""
        if not sequences:
            return []
        intents = transaction.find_all(sequences)
        transaction.vacate(intents)
        for intent in intents:
            self.index.release(*_columns(intent.reservations.beyond(now)))
        return intents

    def foresee(
        self,
        intents: Sequence[FlightIntent],
        index: OccupancyIndex,
        now: int,
        revision: int,
        should_stop: Callable[[], bool],
    ) -> dict[int, Foreseen]:
        """Plan flights, by sequence number, as `settle` would, with an index of the caller's and another planner.

        The index is of `revision`. It `should_stop` before one or another: the rest is left out. Safe in any thread.
        """
        planner = self.planner.another()
        foreseen: dict[int, Foreseen] = {}
        for intent in _in_turn(intents):
            if should_stop():
                break
            outcome = self._again(planner, index, intent, now, outlook=False)
            if isinstance(outcome, Plan):
                index.reserve(outcome.hold_block, outcome.hold_enter_ms, outcome.hold_exit_ms, intent.sequence)
            foreseen[intent.sequence] = Foreseen(intent.version, revision, outcome)
        return foreseen

    def settle(
        self,
        transaction: Transaction,
        now: int,
        vacated: Sequence[FlightIntent],
        cause: Cause,
        foreseen: Mapping[int, Foreseen] = MappingProxyType({}),
    ) -> tuple[Displacement, ...]:
        """Plan vacated flights again, by priority and then by sequence; who finds no place is displaced.

        They depart after their operators have had notice. What was `foreseen` is so, if it still holds. The write lock
        is held meanwhile: beyond an amount of work, those that are left are displaced, and can be changed one by one.
        """
        changes, displaced, spent = [], [], 0
        for intent in _in_turn(vacated):
            outcome = self._as_foreseen(foreseen.get(intent.sequence), intent, now)
            if outcome is None and spent > self._limits.most_expansions:
                outcome = TooManyAtOnce("too many flights had to make way at once to plan all of them again")
            elif outcome is None:
                # Where many have to make way, nobody looks for when else those could fly who find no place.
                outcome = self._again(self.planner, self.index, intent, now, outlook=len(vacated) <= FEW)
                spent += outcome.expansions
            if isinstance(outcome, NoPlan):
                reason: str | None = outcome.reason
                after = self._displaced(transaction, intent, outcome, cause)
            else:
                reason = None
                after = replace(intent, trajectory=outcome, reservations=reservations(outcome))
            self.reserve(after, now)
            changes.append(Rewriting(intent, after, details_of(intent, after, cause, reason)))
            operator, moved = intent.submission.operator, moved_ms(intent, after)
            displaced.append(Displacement(intent.sequence, intent.id, operator, after.state, *moved, reason))
        transaction.rewrite(changes, now)
        return tuple(displaced)

    def _again(
        self, planner: Planner, index: OccupancyIndex, intent: FlightIntent, now: int, *, outlook: bool
    ) -> Plan | NoPlan:
        """Plan a flight that has to make way, with notice for its operator."""
        try:
            request = self.request(intent.submission, now + self._limits.notice_ms)
            return planner.plan(request, index, outlook=outlook)
        except NoPlan as error:
            return error

    def _as_foreseen(self, known: Foreseen | None, intent: FlightIntent, now: int) -> Plan | NoPlan | None:
        """Return what was foreseen of a flight, None where that is nothing or does not hold any more."""
        if known is None or known.version != intent.version:
            return None
        plan = known.outcome
        if isinstance(plan, Plan) and (plan.departure_ms < now + self._limits.notice_ms or not self.is_free(plan)):
            return None
        return plan

    def reserve(self, intent: FlightIntent, now: int) -> None:
        """Bring what an intent still holds into the index."""
        self.index.reserve(*_columns(intent.reservations.beyond(now)), intent.sequence)

    def _displaced(self, transaction: Transaction, intent: FlightIntent, error: NoPlan, cause: Cause) -> FlightIntent:
        """Return a vacated flight for which there is no plan."""
        told = refusal(error, transaction)
        return replace(
            intent,
            state=State.DISPLACED,
            trajectory=None,
            reservations=Reservations.none(),
            refusal=replace(told, detail=f"displaced by {cause}, and then: {told.detail}"),
        )

    @contextmanager
    def _freed(self, own: FlightIntent | None, now: int) -> Iterator[None]:
        """Have an index without what a flight holds that is planned anew."""
        held = Reservations.none() if own is None else own.reservations.beyond(now)
        self.index.release(*_columns(held))
        try:
            yield
        finally:
            if own is not None:
                self.index.reserve(*_columns(held), own.sequence)

    def _unyielding(
        self,
        transaction: Transaction,
        now: int,
        submission: Submission,
        from_ms: int = 0,
        until_ms: int = FAR_FUTURE,
    ) -> OccupancyIndex:
        """Return an index of what a submission has to be planned around, as far as it overlaps [from, until)."""
        if submission.priority <= transaction.lowest_priority:
            return self.index
        yielding = transaction.movable(submission.priority, now + self._limits.notice_ms, until_ms)
        return self.index.without(yielding, from_ms, until_ms) if len(yielding) else self.index

    def request(self, submission: Submission, from_ms: int) -> PlanRequest:
        """Return what to ask of the planner for a departure at a time or later; raises `AircraftTypeGone`."""
        performance = self._performances.get(submission.aircraft_type)
        if performance is None:
            raise AircraftTypeGone(f"the service no longer knows the aircraft type {submission.aircraft_type!r}")
        return PlanRequest(
            submission.origin_block,
            submission.destination_block,
            performance,
            max(submission.earliest_departure_ms, from_ms),
            submission.latest_departure_ms,
        )

    def check_window(self, submission: Submission, now: int) -> None:
        """Raise `DepartureInThePast` or `BeyondHorizon` where a departure window is not one to plan for."""
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
        horizon = now + self._limits.horizon_ms
        if submission.latest_departure_ms > horizon:
            raise BeyondHorizon(f"flights can be planned to depart until {format_time(horizon)}; submit this one later")

    def _check_unchanged(self, before: Submission, after: Submission) -> None:
        """Raise `NotChangeable` for what a flight in the air cannot change any more."""
        for name in ("aircraft_type", "origin_block", "earliest_departure_ms", "latest_departure_ms"):
            if getattr(before, name) != getattr(after, name):
                field = name.removesuffix("_ms").removesuffix("_block")
                raise NotChangeable(
                    f"the flight is in the air, so `{field}` has to stay as it is; "
                    "destination, reference and priority can change"
                )


@dataclass(frozen=True)
class Hit:
    """The flights that hold what is to be closed, by sequence number: who can make way, and who no longer can."""

    movable: tuple[int, ...]
    unmovable: tuple[int, ...]


def _in_turn(intents: Sequence[FlightIntent]) -> list[FlightIntent]:
    """Return flights in the order in which they are planned again."""
    return sorted(intents, key=lambda intent: (-intent.submission.priority, intent.sequence))


def reservations(plan: Plan) -> Reservations:
    """Return what a plan holds."""
    return Reservations(plan.hold_block, plan.hold_enter_ms, plan.hold_exit_ms)


def refusal(error: NoPlan, transaction: Transaction) -> Refusal:
    """Return why there is no plan, with the ids of the flights and constraints in the way."""
    flights = [owner for owner in error.conflicting_owners if owner > 0]
    ids = transaction.ids(flights)
    closed = transaction.constraint_ids(-owner for owner in error.conflicting_owners if owner < 0)
    told = Refusal(
        reason=error.reason,
        detail=str(error),
        conflicting_intents=tuple(ids[owner] for owner in flights if owner in ids),
        earliest_feasible_departure_ms=error.earliest_feasible_departure_ms,
        conflicting_constraints=closed,
    )
    return path_refusal(told, error, transaction) if isinstance(error, PathConflicts) else told


def moved_ms(before: FlightIntent, after: FlightIntent) -> tuple[int | None, int | None]:
    """Return how much later a flight departs and arrives than before; None where it has or had no plan."""
    old, new = before.trajectory, after.trajectory
    if old is None or new is None:
        return None, None
    return new.departure_ms - old.departure_ms, new.arrival_ms - old.arrival_ms


def details_of(
    before: FlightIntent, after: FlightIntent, cause: Cause | None = None, reason: str | None = None
) -> dict[str, object]:
    """Return the details of a journal entry about a flight that was planned again."""
    departure_ms, arrival_ms = moved_ms(before, after)
    return {
        "cause": None if cause is None else cause.member(),
        "departure_moved_s": None if departure_ms is None else departure_ms / 1000,
        "arrival_moved_s": None if arrival_ms is None else arrival_ms / 1000,
        "reason": reason,
    }


def _columns(held: Reservations) -> tuple[IntArray, IntArray, IntArray]:
    return held.block, held.enter_ms, held.exit_ms
