"""Whoever comes, changes, or closes airspace: nobody overlaps, and only who may be moved is moved, all at once."""

import asyncio
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import Connection, Engine, event
from sqlalchemy.exc import IntegrityError, OperationalError
from structlog.testing import capture_logs

from app.batches import BatchOutcome
from app.commands.verify import checked
from app.constraints import UNMOVED, Constraint
from app.deconfliction import Outcome, PreviewPlan
from app.errors import IllegalTransition, LedgerUnavailable, OutcomeUnknown, PreconditionFailed, RequestError
from app.flight_intents import Displacement, FlightIntent, Refusal, State, Submission
from app.ledger import JournalEntry
from app.replica import OccupancyReplica
from app.scheduling import Limits
from app.trespasses import trespasses
from planner.aircraft import shipped_aircraft_types
from planner.cfa_star import Performance, Planner, PlanRequest
from planner.errors import Block, NoPlan, PlannerError
from planner.occupancy import OccupancyIndex
from planner.separation import verify
from tests.ledger.commits import commit_and_fail, fail, on_commit, on_next_commit
from tests.ledger.district import AIRCRAFT, DEPARTURE_MS, START_MS, STREET, district
from tests.ledger.locations import Ledgers, on_sqlite
from tests.ledger.process import (
    HORIZON_MS,
    FakeClock,
    Process,
    assert_gapless,
    assert_journal_tells_states,
    assert_no_overlaps,
    assert_sound,
    closing,
    content,
    held,
    reserved,
    until,
)

YARD = district(".....\n..#..\n.....", ".....\n.....\n.....")
# All flights begin and end in the lower layer, so that they meet.
GROUND: list[Block] = [YARD.airspace.grid.block(block) for block in range(15) if not YARD.airspace.occupied[block]]
PERIODS = Limits(HORIZON_MS, notice_ms=20_000, lead_ms=2_000)
PERFORMANCE = {
    type_.id: Performance.of(type_, YARD.airspace.grid) for type_ in shipped_aircraft_types() if type_.id == AIRCRAFT
}

Flights = Mapping[int, FlightIntent]
Held = tuple[int, int, int]
Ends = Sequence[Block]


def described(intent: FlightIntent) -> tuple[object, ...]:
    """Return all that is recorded of an intent, so that it can be compared."""
    path = intent.trajectory
    course = None if path is None else (path.block.tolist(), path.arrive_ms.tolist(), path.depart_ms.tolist())
    return intent.version, intent.state, intent.submission, course, held(intent), intent.refusal, intent.activated_ms


def meet(some: set[Held], others: set[Held]) -> bool:
    """Tell from the definition whether two sets of reservations overlap."""
    return any(
        block == other_block and enter < other_leave and other_enter < leave
        for block, enter, leave in some
        for other_block, other_enter, other_leave in others
    )


def everything(process: Process) -> dict[int, FlightIntent]:
    """Return all flight intents by sequence number."""
    intents, strays = process.ledger.everything()
    assert strays == {}
    return {intent.sequence: intent for intent in intents}


def may_be_moved(intent: FlightIntent, now_ms: int, below: int | None) -> bool:
    """Tell from the definition whether an intent has to make way for a priority, or (None) for closed airspace."""
    return (
        intent.state is State.ACCEPTED
        and intent.activated_ms is None
        and intent.trajectory is not None
        and intent.trajectory.departure_ms >= now_ms + PERIODS.notice_ms
        and (below is None or intent.submission.priority < below)
    )


@dataclass(frozen=True)
class Model:
    """A plain planner that is told what a flight of some priority has to respect, and nothing else."""

    planner: Planner

    def arrival(
        self, submission: Submission, now_ms: int, flights: Sequence[FlightIntent], closed: Mapping[int, Constraint]
    ) -> int | None:
        """Return when a flight arrives that goes around some others, None if there is no way."""
        index = self.planner.index
        index.clear()
        for flight in flights:
            columns = flight.reservations.beyond(now_ms)
            index.reserve(columns.block, columns.enter_ms, columns.exit_ms, flight.sequence)
        for number, constraint in closed.items():
            index.close({number: constraint.closure})
        request = PlanRequest(
            submission.origin_block,
            submission.destination_block,
            PERFORMANCE[AIRCRAFT],
            max(submission.earliest_departure_ms, now_ms),
            submission.latest_departure_ms,
        )
        try:
            return self.planner.plan(request).arrival_ms
        except NoPlan:
            return None


class World:
    """Two processes write in turn; each step is judged by who may be moved, and for whom, from the definitions."""

    def __init__(self, processes: Sequence[Process], clock: FakeClock) -> None:
        self.process, self.other = processes
        self.clock = clock
        self.model = Model(Planner(YARD.airspace))
        self.intents: list[FlightIntent] = []
        self.constraints: list[Constraint] = []
        self.in_force: dict[int, Constraint] = {}
        # Who may hold what is closed: it was there before, and could not be moved.
        self.stayed: set[tuple[int, int]] = set()

    def submit(self, ends: Ends, after_ms: int, window_ms: int, priority: int) -> None:
        """Submit a flight: it gets the plan that it would have if nobody who may be moved were there."""
        now_ms = self.clock.now_ms
        request = YARD.submission(*ends, earliest_ms=now_ms + after_ms, window_ms=window_ms)
        request = replace(request, priority=priority)
        before, revision = everything(self.process), self.process.ledger.revision()
        outcome = asyncio.run(self.process.deconfliction.submit(request))
        self.judge(before, revision, outcome.intent, outcome.displaced)
        around = [flight for flight in before.values() if not may_be_moved(flight, now_ms, priority)]
        path = outcome.intent.trajectory
        assert (None if path is None else path.arrival_ms) == self.model.arrival(request, now_ms, around, self.in_force)
        self.intents.append(outcome.intent)

    def change(self, which: int, ends: Ends, after_ms: int | None, window_ms: int, priority: int) -> None:
        """Change a flight; without `after_ms` only its destination and its priority, as one in the air has to."""
        if not self.intents:
            return
        intent = self.intents[which % len(self.intents)]
        if after_ms is None:
            request = replace(
                intent.submission, destination=YARD.centre(ends[1]), destination_block=YARD.block(ends[1])
            )
        else:
            request = YARD.submission(*ends, earliest_ms=self.clock.now_ms + after_ms, window_ms=window_ms)
        request = replace(request, priority=priority)
        before, revision = everything(self.process), self.process.ledger.revision()
        outcome = self.tried(self.process.deconfliction.change(intent.id, request, None))
        if not isinstance(outcome, Outcome):
            self.assert_unchanged(before, revision)
            return
        self.judge(before, revision, outcome.intent, outcome.displaced)
        old, new = before[intent.sequence], outcome.intent
        assert new.submission == request
        assert new.state is (State.ACCEPTED if old.activated_ms is None else State.ACTIVATED)
        if old.trajectory is not None and old.trajectory.departure_ms <= self.clock.now_ms:
            # In the air it keeps to what was planned for as long as the lead.
            assert new.trajectory is not None
            kept = int(np.sum(old.trajectory.depart_ms < self.clock.now_ms + PERIODS.lead_ms)) + 1
            assert new.trajectory.block[:kept].tolist() == old.trajectory.block[:kept].tolist()
            assert new.trajectory.arrive_ms[:kept].tolist() == old.trajectory.arrive_ms[:kept].tolist()

    def move(self, which: int, verb: str) -> None:
        """Cancel, activate or end a flight: nobody else hears of it."""
        if not self.intents:
            return
        intent = self.intents[which % len(self.intents)]
        before, revision = everything(self.process), self.process.ledger.revision()
        changed = self.tried(getattr(self.process.deconfliction, verb)(intent.id))
        if isinstance(changed, FlightIntent):
            before = {n: flight for n, flight in before.items() if n != intent.sequence}
            after = everything(self.process)
            assert [described(after[n]) for n in before] == [described(flight) for flight in before.values()]
        else:
            assert isinstance(changed, IllegalTransition)
            self.assert_unchanged(before, revision)

    def close(self, blocks: list[int], after_ms: int, lasts_ms: int | None) -> None:
        """Close airspace: who holds some of it makes way, or is named because it no longer can."""
        now_ms = self.clock.now_ms
        until_ms = None if lasts_ms is None else now_ms + after_ms + lasts_ms
        before, revision = everything(self.process), self.process.ledger.revision()
        outcome = asyncio.run(self.process.airspace_closing.close(closing(blocks, now_ms + after_ms, until_ms)))
        constraint = outcome.constraint
        hit = [flight for flight in before.values() if meet(closed(constraint, now_ms), held(flight))]
        movable = {flight.sequence for flight in hit if may_be_moved(flight, now_ms, None)}
        assert {flight.sequence for flight in outcome.displaced} == movable
        stay = [flight for flight in hit if flight.sequence not in movable]
        assert set(outcome.unmoved) == {flight.id for flight in stay}
        self.stayed |= {(constraint.number, flight.sequence) for flight in stay}
        self.judge(before, revision, constraint, outcome.displaced, outcome.unmoved)
        self.in_force[constraint.number] = constraint
        self.constraints.append(constraint)

    def batch(self, flights: list[Ends], after_ms: int, priority: int, meanwhile: tuple[Any, ...]) -> None:
        """Submit flights together; something else happens after they are planned, and before they are recorded."""
        requests = [
            replace(YARD.submission(*ends, earliest_ms=self.clock.now_ms + after_ms), priority=priority)
            for ends in flights
        ]
        asked, seen = 0, [(everything(self.process), self.process.ledger.revision())]

        def stop() -> bool:
            nonlocal asked
            asked += 1
            # Each flight has to be planned once.
            if asked == len(flights) + 1:
                verb, *arguments = meanwhile
                getattr(self, verb)(*arguments)
                seen[:] = [(everything(self.process), self.process.ledger.revision())]
            return asked > len(flights)

        outcome = self.tried(self.process.batches.submit(requests, 1.0, None, stop))
        before, revision = seen[0]
        if not isinstance(outcome, BatchOutcome):
            self.assert_unchanged(before, revision)
            return
        after = everything(self.process)
        assert [described(after[n]) for n in before] == [described(flight) for flight in before.values()]
        assert [described(after[flight.sequence]) for flight in outcome.intents] == [
            described(flight) for flight in outcome.intents
        ]
        self.intents += outcome.intents

    def reopen(self, which: int) -> None:
        """Remove a constraint: everybody stays where they are."""
        if not self.constraints:
            return
        constraint = self.constraints[which % len(self.constraints)]
        before = everything(self.process)
        asyncio.run(self.process.airspace_closing.reopen(constraint.id))
        self.in_force.pop(constraint.number, None)
        assert [described(flight) for flight in everything(self.process).values()] == [
            described(flight) for flight in before.values()
        ]

    def wait(self, ms: int) -> None:
        """Let time pass, and the other process do the next step."""
        self.clock.advance(ms=ms)
        self.process, self.other = self.other, self.process

    def tried(self, request: Coroutine[Any, Any, object]) -> object:
        """Return an answer, or the error that is the answer."""
        try:
            return asyncio.run(request)
        except (RequestError, PlannerError) as error:
            return error

    def assert_unchanged(self, before: Flights, revision: int) -> None:
        assert self.process.ledger.revision() == revision
        after = everything(self.process)
        assert [described(flight) for flight in after.values()] == [described(flight) for flight in before.values()]

    def judge(
        self,
        before: Flights,
        revision: int,
        cause: FlightIntent | Constraint,
        displaced: Sequence[Displacement],
        unmoved: Sequence[str] = (),
    ) -> None:
        """Compare what has changed with what was answered, what the journal says, and who may be moved."""
        now_ms = self.clock.now_ms
        after = everything(self.process)
        entry, *entries = self.process.ledger.journal_after(revision, 1_000)
        assert {each.revision for each in (entry, *entries)} == {revision + 1}
        assert [each.place for each in (entry, *entries)] == list(range(1 + len(entries)))
        entries, told_last = entries[: len(displaced)], entries[len(displaced) :]
        assert [(told.intent_id, told.kind, told.details) for told in told_last] == [
            (id_, UNMOVED, {"cause": {"constraint_id": cause.id}}) for id_ in unmoved
        ]
        own = cause.sequence if isinstance(cause, FlightIntent) else 0
        below = cause.submission.priority if isinstance(cause, FlightIntent) else None
        assert entry.sequence == own
        others = {n: flight for n, flight in before.items() if n != own}
        moved = {n for n, flight in others.items() if described(after[n]) != described(flight)}
        assert moved == {flight.sequence for flight in displaced}
        if isinstance(cause, FlightIntent):
            assert moved == {n for n, flight in others.items() if meet(held(flight), held(after[own]))}
        assert [each.sequence for each in entries] == [flight.sequence for flight in displaced]
        assert [flight.sequence for flight in displaced] == sorted(
            moved, key=lambda n: (-before[n].submission.priority, n)
        )
        for told, flight in zip(entries, displaced, strict=True):
            old, new = before[flight.sequence], after[flight.sequence]
            assert may_be_moved(old, now_ms, below)
            assert new.submission == old.submission
            assert (new.version, new.state) == (revision + 1, flight.state)
            self.judge_move(old, new, flight, told, cause)

    def judge_move(
        self,
        old: FlightIntent,
        new: FlightIntent,
        flight: Displacement,
        told: JournalEntry,
        cause: FlightIntent | Constraint,
    ) -> None:
        """Compare what became of one flight with what was told of it."""
        name = "flight_intent_id" if isinstance(cause, FlightIntent) else "constraint_id"
        assert (told.kind, told.details["cause"]) == (flight.state, {name: cause.id})
        assert told.details["reason"] == flight.reason
        assert old.trajectory is not None
        if flight.state is State.DISPLACED:
            assert (new.trajectory, held(new)) == (None, set())
            assert new.refusal is not None
            assert (new.refusal.reason, flight.departure_moved_ms, flight.arrival_moved_ms) == (
                flight.reason,
                None,
                None,
            )
            assert cause.id in new.refusal.detail
            return
        assert new.trajectory is not None
        assert (flight.state, flight.reason, new.refusal) == (State.ACCEPTED, None, None)
        assert new.trajectory.departure_ms >= self.clock.now_ms + PERIODS.notice_ms
        assert new.trajectory.departure_ms <= new.submission.latest_departure_ms
        assert flight.departure_moved_ms == new.trajectory.departure_ms - old.trajectory.departure_ms
        assert flight.arrival_moved_ms == new.trajectory.arrival_ms - old.trajectory.arrival_ms
        assert told.details["departure_moved_s"] == flight.departure_moved_ms / 1000
        assert told.details["arrival_moved_s"] == flight.arrival_moved_ms / 1000

    def judge_all(self) -> None:
        """Judge what is held now, whoever holds it, and what the processes know of it."""
        now_ms = self.clock.now_ms
        assert_no_overlaps(self.process.location)
        assert_gapless(self.process.location)
        assert_journal_tells_states(self.process.location)
        flights = everything(self.process)
        flown = [checked(flight) for flight in flights.values() if flight.trajectory is not None]
        assert verify(YARD.airspace, flown).violations == ()
        with self.process.ledger.snapshot() as snapshot:
            assert trespasses(snapshot, snapshot.intents()[0]) == []
        inside = {
            (number, flight.sequence)
            for number, constraint in self.in_force.items()
            for flight in flights.values()
            if meet(closed(constraint, now_ms), held(flight))
        }
        assert inside <= self.stayed
        fresh = OccupancyIndex(YARD.airspace.grid.block_count)
        with self.process.ledger.transaction() as transaction:
            OccupancyReplica(fresh).catch_up(transaction, now_ms, None)
        for process in (self.process, self.other):
            catch_up(process)
            assert process.indexed(now_ms) == reserved(process.location, now_ms)
            assert from_now(process.planner.index, now_ms) == from_now(fresh, now_ms)


def catch_up(process: Process) -> None:
    """Do nothing under the write lock: it begins with catching up with the journal."""
    asyncio.run(process.writer.perform(lambda *_: True, lambda: None))


def closed(constraint: Constraint, now_ms: int) -> set[Held]:
    """Return what a constraint closes from a time on."""
    closure = constraint.closure
    columns = (closure.block.tolist(), np.maximum(closure.enter_ms, now_ms).tolist(), closure.exit_ms.tolist())
    return {hold for hold in zip(*columns, strict=True) if hold[1] < hold[2]}


def from_now(index: OccupancyIndex, now_ms: int) -> dict[Held, int]:
    """Return what an index has that is not over; of what has begun, the rest."""
    return {
        (block, max(enter, now_ms), leave): owner
        for (block, enter, leave), owner in content(index).items()
        if leave > now_ms
    }


ENDS = st.lists(st.sampled_from(GROUND), min_size=2, max_size=2, unique=True)
PRIORITIES, WHICH = st.integers(-2, 3), st.integers(0, 30)
DELAYS_MS, WINDOWS_MS = st.sampled_from([30_000, 25_000, 0]), st.sampled_from([10_000, 0, 300_000])
SUBMISSIONS = st.tuples(st.just("submit"), ENDS, DELAYS_MS, WINDOWS_MS, PRIORITIES)
CHANGES = st.tuples(st.just("change"), WHICH, ENDS, st.one_of(st.none(), DELAYS_MS), WINDOWS_MS, PRIORITIES)
MOVES = st.tuples(st.just("move"), WHICH, st.sampled_from(["activate", "activate", "activate", "cancel", "end"]))
CLOSINGS = st.tuples(
    st.just("close"),
    st.lists(st.integers(0, YARD.airspace.grid.block_count - 1), min_size=1, max_size=3, unique=True),
    st.sampled_from([0, 10_000, 30_000]),
    st.sampled_from([5_000, 10_000, None]),
)
REOPENINGS = st.tuples(st.just("reopen"), WHICH)
BATCHES = st.tuples(
    st.just("batch"),
    st.lists(ENDS, min_size=1, max_size=4),
    DELAYS_MS,
    PRIORITIES,
    st.one_of(CLOSINGS, SUBMISSIONS, CHANGES, MOVES, REOPENINGS),
)
STEPS = st.one_of(
    SUBMISSIONS,
    SUBMISSIONS,
    SUBMISSIONS,
    BATCHES,
    CHANGES,
    MOVES,
    CLOSINGS,
    REOPENINGS,
    st.tuples(st.just("wait"), st.sampled_from([1, 2_000, 5_000, 10_000, 21_000])),
)


@pytest.mark.compiled
@on_sqlite
@settings(deadline=None, max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(flights=st.lists(SUBMISSIONS, min_size=6, max_size=6), steps=st.lists(STEPS, min_size=15, max_size=30))
def test_whatever_happens_only_who_may_be_moved_is_moved_and_nobody_overlaps(
    ledgers: Ledgers, flights: list[tuple[Any, ...]], steps: list[tuple[Any, ...]]
) -> None:
    clock, location = FakeClock(), ledgers.migrated()
    with (
        Process(location, YARD.airspace, clock, limits=PERIODS) as one,
        # Whoever has to make way for what this one closes is planned ahead.
        Process(location, YARD.airspace, clock, limits=PERIODS, few=0) as other,
    ):
        world = World((one, other), clock)
        for verb, *arguments in flights + steps:
            getattr(world, verb)(*arguments)
            world.judge_all()


# One street, where whoever flies is in the way of everybody


@pytest.fixture
def street(ledger: str, clock: FakeClock) -> Iterator[Process]:
    with Process(ledger, STREET.airspace, clock) as process:
        yield process


def along(priority: int = 0, *, earliest_ms: int = DEPARTURE_MS, window_ms: int = 300_000) -> Submission:
    request = STREET.submission("W", "E", earliest_ms=earliest_ms, window_ms=window_ms)
    return replace(request, priority=priority)


def submitted(process: Process, request: Submission) -> Outcome:
    return asyncio.run(process.deconfliction.submit(request))


def departures(process: Process) -> dict[int, int | None]:
    """Return how long after the usual departure each flight departs, None for who does not."""
    return {
        n: None if flight.trajectory is None else flight.trajectory.departure_ms - DEPARTURE_MS
        for n, flight in everything(process).items()
    }


HOUR_MS = 3_600_000
# How long a flight holds the first block, and with it the street: no shorter distance keeps two apart.
HOLD_MS = 2 * 1668 + 1
# How long after a flight one can set off from the other end.
CROSSING_MS = 7 * 1668 + 1


def test_who_comes_first_is_served_first_among_equals_and_last_among_lower_ones(street: Process) -> None:
    for priority in (0, 0, 1, 1, -1):
        submitted(street, along(priority))
    assert departures(street) == {
        3: 0,
        4: HOLD_MS,
        1: 2 * HOLD_MS,
        2: 3 * HOLD_MS,
        5: 4 * HOLD_MS,
    }
    assert_sound(street)


def test_who_makes_way_is_planned_again_by_priority_and_then_by_sequence(street: Process) -> None:
    for n, priority in enumerate((0, 1, 0, 1)):
        submitted(street, along(priority, earliest_ms=DEPARTURE_MS + n * HOLD_MS))
    # Its way back is in everybody's way.
    back = replace(STREET.submission("E", "W", earliest_ms=DEPARTURE_MS), priority=5)
    outcome = submitted(street, back)
    assert [flight.sequence for flight in outcome.displaced] == [2, 4, 1, 3]
    found = departures(street)
    assert sorted(found, key=lambda n: found[n] or 0) == [5, 2, 4, 1, 3]
    assert_sound(street)


@pytest.mark.parametrize(("ms", "is_moved"), [(0, True), (1, False)])
def test_a_flight_that_departs_within_the_notice_is_not_moved(
    street: Process, clock: FakeClock, ms: int, is_moved: bool
) -> None:
    submitted(street, along())
    clock.advance(ms=ms)
    outcome = submitted(street, along(9))
    assert bool(outcome.displaced) == is_moved
    assert departures(street) == ({1: HOLD_MS, 2: 0} if is_moved else {1: 0, 2: HOLD_MS})


def test_when_else_an_urgent_flight_could_fly_depends_on_who_flies_long_after_its_window(street: Process) -> None:
    """Somebody who would make way is there, but not in the way."""
    base_ms = DEPARTURE_MS + 100_000
    back = STREET.submission("E", "W", earliest_ms=base_ms - CROSSING_MS, window_ms=0)
    assert submitted(street, back).intent.state is State.ACCEPTED
    count = 320_000 // HOLD_MS
    for n in range(count):
        submitted(street, along(1, earliest_ms=base_ms + n * HOLD_MS, window_ms=0))
    refused = submitted(street, along(1, earliest_ms=base_ms, window_ms=0)).intent.refusal
    assert refused is not None
    # The last one has left the first block by then.
    assert refused.earliest_feasible_departure_ms == base_ms + (count - 1) * HOLD_MS + 1_669


def test_an_urgent_flight_takes_no_more_work_than_any_other(street: Process, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is planned around everybody, and around those who stay: together for what one request may take."""
    submitted(street, along(window_ms=0))
    request, run, took = along(1, window_ms=60_000), street.planner._run, []

    def counted(*arguments: Any, **named: Any) -> tuple[int, int, int]:
        outcome = run(*arguments, **named)
        took.append(outcome[2])
        return outcome

    monkeypatch.setattr(street.planner, "_run", counted)
    assert isinstance(asyncio.run(street.deconfliction.preview(request)), PreviewPlan)
    assert len(took) == 2
    street.planner.most_expansions = sum(took)
    assert isinstance(asyncio.run(street.deconfliction.preview(request)), PreviewPlan)
    street.planner.most_expansions = sum(took[:2]) - 1
    refused = asyncio.run(street.deconfliction.preview(request))
    assert isinstance(refused, Refusal)
    assert refused.reason == "search_too_long"


def test_a_flight_that_was_activated_is_not_moved(street: Process) -> None:
    first = submitted(street, along(earliest_ms=DEPARTURE_MS + 60_000)).intent
    asyncio.run(street.deconfliction.activate(first.id))
    outcome = submitted(street, along(9, earliest_ms=DEPARTURE_MS + 60_000))
    assert outcome.displaced == ()
    assert departures(street) == {1: 60_000, 2: 60_000 + HOLD_MS}


def test_who_has_made_way_departs_after_its_operator_has_had_notice(street: Process) -> None:
    shut = closing([STREET.block("W")], START_MS, START_MS + 70_000)
    asyncio.run(street.airspace_closing.close(shut))
    submitted(street, along(earliest_ms=START_MS))
    asyncio.run(street.airspace_closing.reopen(shut.id))
    assert departures(street) == {1: 10_000}
    # From now on the street is free, but nobody is sent off at once.
    submitted(street, along(1, earliest_ms=START_MS + 70_000))
    assert departures(street) == {1: 0, 2: 10_000}


def test_who_finds_no_place_any_more_holds_nothing_and_says_why(street: Process) -> None:
    first = submitted(street, along(window_ms=0)).intent
    outcome = submitted(street, along(1))
    assert outcome.displaced == (Displacement(1, first.id, "acme-air", State.DISPLACED, reason="no_departure_slot"),)
    flight = everything(street)[1]
    assert (flight.state, flight.trajectory, held(flight), flight.version) == (State.DISPLACED, None, set(), 2)
    assert flight.refusal is not None
    assert flight.refusal.detail == (
        f"displaced by flight intent {outcome.intent.id}, which has a higher priority, and then: "
        "the first block is reserved or closed throughout the departure window"
    )
    assert flight.refusal.conflicting_intents == (outcome.intent.id,)
    assert flight.refusal.earliest_feasible_departure_ms == DEPARTURE_MS + 1_669
    assert_sound(street)


def test_who_was_displaced_does_not_come_back_by_itself(street: Process) -> None:
    submitted(street, along(window_ms=0))
    urgent = submitted(street, along(1)).intent
    asyncio.run(street.deconfliction.cancel(urgent.id))
    assert everything(street)[1].state is State.DISPLACED


def test_one_revision_tells_of_all_that_moved(street: Process) -> None:
    for _ in range(2):
        submitted(street, along())
    outcome = submitted(street, replace(STREET.submission("E", "W"), priority=1))
    entries = street.ledger.journal_after(2, 1)
    assert [(each.revision, each.place, each.sequence) for each in entries] == [(3, 0, 3), (3, 1, 1), (3, 2, 2)]
    assert entries[0].details == {}
    assert entries[1].details == {
        "cause": {"flight_intent_id": outcome.intent.id},
        "departure_moved_s": CROSSING_MS / 1000,
        "arrival_moved_s": CROSSING_MS / 1000,
        "reason": None,
    }


def test_a_negative_priority_is_higher_than_a_more_negative_one(street: Process) -> None:
    for priority in (-1, -2, -1):
        submitted(street, along(priority))
    assert departures(street) == {1: 0, 3: HOLD_MS, 2: 2 * HOLD_MS}


def test_retention_leaves_the_newest_revision_and_parts_none(street: Process, clock: FakeClock) -> None:
    for priority in range(3):
        submitted(street, along(priority))
    clock.advance(seconds=3600)
    with street.ledger.transaction() as transaction:
        # The second of its entries belongs to a revision with a third.
        removed = [transaction.remove_journal(clock.now_ms, limit) for limit in (2, 10)]
        assert transaction.newest_change() == START_MS
    assert removed == [2, 0]
    assert [(entry.revision, entry.place) for entry in street.ledger.journal_after(0, 10)] == [(3, 0), (3, 1)]


def test_a_change_keeps_its_sequence_number_and_its_place_against_nobody(street: Process) -> None:
    first, second = (submitted(street, along()).intent for _ in range(2))
    later = replace(first.submission, earliest_departure_ms=DEPARTURE_MS + 1)
    outcome = asyncio.run(street.deconfliction.change(first.id, later, frozenset({first.version})))
    assert isinstance(outcome, Outcome)
    # Who was there is not moved for it, although it came later.
    assert (outcome.intent.sequence, outcome.intent.version, outcome.displaced) == (1, 3, ())
    assert departures(street) == {1: 2 * HOLD_MS, 2: HOLD_MS}
    assert described(everything(street)[2]) == described(second)


def test_a_change_to_a_higher_priority_moves_who_is_lower_now(street: Process) -> None:
    _, second = (submitted(street, along()).intent for _ in range(2))
    outcome = asyncio.run(street.deconfliction.change(second.id, along(1), None))
    assert isinstance(outcome, Outcome)
    assert [flight.sequence for flight in outcome.displaced] == [1]
    assert departures(street) == {1: HOLD_MS, 2: 0}
    assert_sound(street)


def test_the_version_that_a_change_is_about_is_compared_under_the_write_lock(street: Process) -> None:
    first = submitted(street, along()).intent
    changes = (
        street.deconfliction.change(first.id, along(earliest_ms=DEPARTURE_MS + ms), frozenset({first.version}))
        for ms in (1, 2)
    )
    done, refused = street.together(*changes)
    assert isinstance(done, Outcome)
    assert isinstance(refused, PreconditionFailed)
    assert departures(street) == {1: 1}


def test_two_processes_displace_what_the_other_has_accepted(pair: tuple[Process, Process]) -> None:
    one, other = pair
    for priority in range(6):
        submitted((one, other)[priority % 2], along(priority))
    # Each has taken the first slot from the one before, who then went behind everybody, displacing nobody.
    assert departures(one) == {6: 0} | {n: n * HOLD_MS for n in range(1, 6)}
    for process in pair:
        catch_up(process)
        assert_sound(process)


# Faults in the middle


@contextmanager
def failing(begins: str, error: Callable[[str], Exception]) -> Iterator[list[str]]:
    """Fail the first statement that begins like this."""
    failed: list[str] = []

    def listener(_connection: object, _cursor: object, text: str, *_: object) -> None:
        if text.startswith(begins) and not failed:
            failed.append(text)
            raise error(text)

    event.listen(Engine, "before_cursor_execute", listener)
    try:
        yield failed
    finally:
        event.remove(Engine, "before_cursor_execute", listener)


def broken(text: str) -> Exception:
    return OperationalError(text, {}, Exception("disk I/O error"))


def refused(text: str) -> Exception:
    return IntegrityError(text, {}, Exception("reservations_no_overlap"))


@pytest.mark.parametrize("statement", ["DELETE FROM reservations", "UPDATE flight_intents", "INSERT INTO journal"])
def test_when_the_ledger_fails_in_the_middle_nobody_has_moved(street: Process, statement: str) -> None:
    submitted(street, along())
    before = [described(flight) for flight in everything(street).values()]
    with failing(statement, broken) as failed, pytest.raises(LedgerUnavailable):
        submitted(street, along(1))
    assert failed
    assert [described(flight) for flight in everything(street).values()] == before
    assert len(street.ledger.journal_after(0, 10)) == 1
    # As if it had not been tried.
    submitted(street, along(1))
    assert departures(street) == {1: HOLD_MS, 2: 0}
    assert_sound(street)


@pytest.mark.parametrize("statement", ["UPDATE flight_intents", "INSERT INTO reservations"])
def test_when_the_database_refuses_rows_in_the_middle_all_of_it_is_done_again(street: Process, statement: str) -> None:
    submitted(street, along())
    with failing(statement, refused) as failed:
        outcome = submitted(street, along(1))
    assert failed
    assert [flight.sequence for flight in outcome.displaced] == [1]
    assert (outcome.intent.sequence, outcome.intent.version) == (2, 2)
    assert departures(street) == {1: HOLD_MS, 2: 0}
    assert_sound(street)


def test_who_made_way_is_told_also_where_the_commit_was_lost(street: Process) -> None:
    first = submitted(street, along()).intent
    with on_next_commit(commit_and_fail):
        outcome = submitted(street, along(1))
    assert outcome.displaced == (Displacement(1, first.id, "acme-air", State.ACCEPTED, HOLD_MS, HOLD_MS),)


def test_who_made_way_for_a_change_is_told_also_where_the_commit_was_lost(street: Process) -> None:
    first, second = (submitted(street, along()).intent for _ in range(2))
    with on_next_commit(commit_and_fail):
        outcome = asyncio.run(street.deconfliction.change(second.id, along(1), frozenset({second.version})))
    assert isinstance(outcome, Outcome)
    assert [flight.id for flight in outcome.displaced] == [first.id]


def test_a_change_whose_commit_was_lost_is_not_taken_for_one_that_was_there_before(street: Process) -> None:
    first = submitted(street, along()).intent
    with on_next_commit(fail), pytest.raises(LedgerUnavailable):
        asyncio.run(street.deconfliction.change(first.id, along(), None))
    assert everything(street)[1].version == first.version


@pytest.mark.parametrize("lost", [fail, commit_and_fail])
def test_whether_a_change_was_made_before_somebody_else_made_another_is_not_known(
    pair: tuple[Process, Process], monkeypatch: pytest.MonkeyPatch, lost: Callable[[Connection], None]
) -> None:
    one, other = pair
    first = submitted(one, along()).intent
    find = one.ledger.find

    def find_too_late(intent_id: str) -> FlightIntent | None:
        other.cancel(first)
        return find(intent_id)

    monkeypatch.setattr(one.ledger, "find", find_too_late)
    with on_next_commit(lost), pytest.raises(OutcomeUnknown, match="somebody else changed"):
        asyncio.run(one.deconfliction.change(first.id, along(1), None))


def test_a_constraint_whose_commit_was_lost_is_in_force(street: Process) -> None:
    first = submitted(street, along()).intent
    shut = closing([STREET.block("W")], DEPARTURE_MS, DEPARTURE_MS + 5_000)
    # The first commit is that of a look at who has to make way.
    commits: list[Callable[[Connection], object]] = [commit_and_fail, bool]
    with on_commit(lambda connection: commits.pop()(connection) if commits else None):
        closed = asyncio.run(street.airspace_closing.close(shut))
    assert closed.constraint.id == shut.id
    assert [flight.id for flight in closed.displaced] == [first.id]
    assert commits == []
    assert_sound(street)


def test_nobody_pays_for_low_priorities_that_are_over(street: Process, clock: FakeClock) -> None:
    def is_lowest(priority: int) -> bool:
        with street.ledger.transaction() as transaction:
            return transaction.lowest_priority == priority

    low, lower = (
        submitted(street, along(priority, earliest_ms=DEPARTURE_MS + HOUR_MS)).intent for priority in (-2, -5)
    )
    assert is_lowest(-5)
    for left, flight in ((-2, lower), (0, low)):
        clock.advance(seconds=61)
        street.cancel(flight)
        asyncio.run(until(partial(is_lowest, left)))


@pytest.mark.parametrize("row", [0, 2])
def test_whoever_can_fly_without_delay_moves_nobody(ledgers: Ledgers, clock: FakeClock, row: int) -> None:
    """Around the building there are two ways, one as short as the other."""
    with Process(ledgers.migrated(), YARD.airspace, clock) as process:
        submitted(process, YARD.submission((0, row, 0), (4, row, 0)))
        urgent = submitted(process, replace(YARD.submission((0, 1, 0), (4, 1, 0)), priority=1))
        assert urgent.displaced == ()
        assert urgent.intent.trajectory is not None
        assert urgent.intent.trajectory.flight_time_ms == urgent.intent.trajectory.unconstrained_ms


def test_who_changes_to_a_lower_priority_makes_way(street: Process) -> None:
    first = submitted(street, along()).intent
    asyncio.run(street.deconfliction.change(first.id, along(-5), None))
    assert [flight.sequence for flight in submitted(street, along()).displaced] == [1]
    assert departures(street) == {1: HOLD_MS, 2: 0}


def test_a_flight_in_the_air_can_be_changed_twice_at_once(street: Process, clock: FakeClock) -> None:
    flight = submitted(street, along()).intent
    asyncio.run(street.deconfliction.activate(flight.id))
    clock.advance(seconds=(DEPARTURE_MS - clock.now_ms) / 1000 + 1)
    changes = [street.deconfliction.change(flight.id, along(), None) for _ in range(2)]
    with capture_logs() as logs:
        outcomes = street.together(*changes)
    assert [outcome.intent.version for outcome in outcomes] == [3, 4]
    assert not [entry for entry in logs if entry["event"].startswith("batch is written again")]
    assert_sound(street)


def test_of_too_many_that_have_to_make_way_at_once_the_last_are_displaced(ledger: str, clock: FakeClock) -> None:
    limits = Limits(HORIZON_MS, most_expansions=0)
    with Process(ledger, STREET.airspace, clock, limits=limits) as process:
        for _ in range(3):
            submitted(process, along())
        outcome = submitted(process, replace(STREET.submission("E", "W"), priority=1))
        told = [(flight.sequence, flight.state, flight.reason) for flight in outcome.displaced]
        assert told[0] == (1, State.ACCEPTED, None)
        assert set(told[1:]) == {(2, State.DISPLACED, "too_many_at_once"), (3, State.DISPLACED, "too_many_at_once")}
        assert_sound(process)
