"""Paths that operators bring: what they hold, what is refused and where, and what they meet.

In the stories' drawings an aircraft takes 4 ms for a level link or a vertical climb, 6 ms for a diagonal in a plane and
8 ms for one through space.
"""

import itertools
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from planner.airmatrix import IntArray
from planner.airspace import Airspace, OccupancyRule
from planner.cfa_star import Performance, PlanRequest
from planner.errors import (
    BeyondEndurance,
    Block,
    DwellTooShort,
    EntryOutside,
    InBuilding,
    NoPlan,
    NotAChain,
    NotFlyable,
    NotPlannable,
    OutOfOrder,
    OutOfReach,
    PathRefused,
    TooFast,
    TooLong,
)
from planner.occupancy import Closure, OccupancyIndex
from planner.path import Plan
from planner.separation import CheckedFlight, verify
from planner.submitted import (
    MAX_CONFLICTS,
    Conflict,
    SubmittedPath,
    conflicts,
    trajectory_path,
    volumes_path,
)
from tests.planner.drawing import Drawing, drawn
from tests.planner.traffic import (
    EITHER_RULE,
    TIMES,
    Situation,
    airspaces,
    holds_in,
    planner_in,
    requests_in,
    reservations_in,
    situations,
    trajectory_of,
)
from tests.reference.planning import Hold, Visit, earliest_arrival, holds_of

MIDPOINT, CONTAINMENT = OccupancyRule.MIDPOINT, OccupancyRule.CONTAINMENT

unhurried = settings(deadline=None, max_examples=60)

Entry = tuple[Block, int, int]

# Longer than anything in the drawings but what is said to last for as long, or for longer.
LONGEST_MS = 3_600_000


def entries(rows: Sequence[Entry]) -> tuple[IntArray, IntArray, IntArray]:
    blocks, first, second = zip(*rows, strict=True)
    return np.array(blocks, dtype=np.int64), np.array(first, dtype=np.int64), np.array(second, dtype=np.int64)


def flown(airspace: Airspace, *stops: Entry, endurance_ms: int | None = None) -> SubmittedPath:
    return trajectory_path(airspace, Performance(TIMES, endurance_ms), *entries(stops), longest_ms=LONGEST_MS)


def through(city: Drawing, *volumes: Entry, endurance_ms: int | None = None) -> SubmittedPath:
    """Return the path from A to B inside volumes."""
    return volumes_path(
        city.airspace,
        Performance(TIMES, endurance_ms),
        city["A"],
        city["B"],
        *entries(volumes),
        longest_ms=LONGEST_MS,
    )


def held(path: SubmittedPath) -> list[Hold]:
    columns = (path.hold_block.tolist(), path.hold_enter_ms.tolist(), path.hold_exit_ms.tolist())
    return [Hold(*hold) for hold in zip(*columns, strict=True)]


def stops(path: SubmittedPath) -> list[Visit]:
    columns = (path.block.tolist(), path.arrive_ms.tolist(), path.depart_ms.tolist())
    return [Visit(*stop) for stop in zip(*columns, strict=True)]


def checked(name: str, path: SubmittedPath) -> CheckedFlight:
    return CheckedFlight(
        name, path.block, path.arrive_ms, path.depart_ms, path.hold_block, path.hold_enter_ms, path.hold_exit_ms
    )


def planned(situation: Situation) -> Plan:
    """Return the situation's plan, for situations that have one."""
    try:
        return planner_in(situation.airspace, situation.reservations).plan(situation.request)
    except (NoPlan, NotPlannable):
        assume(False)
        raise


def indices(airspace: Airspace, blocks: Iterable[int]) -> IntArray:
    return airspace.grid.ijk(np.array([*blocks], dtype=np.int64))


def performance_of(request: PlanRequest) -> Performance:
    return replace(request.performance, endurance_ms=None)


@st.composite
def slower_flights(draw: st.DrawFn, airspace: Airspace) -> SubmittedPath:
    """Draw a flight along a planned way: links as slow as it likes, of odd lengths too, and waits anywhere."""
    situation = Situation(airspace, (), draw(requests_in(airspace)))
    plan = planned(situation)
    arrive, depart, time = [], [], draw(st.integers(0, 30))
    for before, after in itertools.pairwise([*trajectory_of(plan), None]):
        assert before is not None
        stay = before.depart_ms - before.arrive_ms + draw(st.integers(0, 3))
        arrive.append(time)
        depart.append(time + stay)
        if after is not None:
            time += stay + after.arrive_ms - before.depart_ms + draw(st.sampled_from([0, 0, 1, 2, 5]))
    return trajectory_path(
        airspace,
        performance_of(situation.request),
        indices(airspace, plan.block.tolist()),
        np.array(arrive, dtype=np.int64),
        np.array(depart, dtype=np.int64),
        longest_ms=LONGEST_MS,
    )


# What a trajectory holds


@given(situations())
@unhurried
def test_what_our_own_planner_made_holds_what_the_planner_says(situation: Situation) -> None:
    plan = planned(situation)
    performance = performance_of(situation.request)
    blocks = indices(situation.airspace, plan.block)
    path = trajectory_path(
        situation.airspace, performance, blocks, plan.arrive_ms, plan.depart_ms, longest_ms=LONGEST_MS
    )
    assert held(path) == holds_in(plan)
    assert stops(path) == trajectory_of(plan)


@given(airspaces(EITHER_RULE).flatmap(lambda airspace: st.tuples(st.just(airspace), slower_flights(airspace))))
@unhurried
def test_slower_flights_hold_all_that_they_need_and_nothing_near_buildings(
    case: tuple[Airspace, SubmittedPath],
) -> None:
    airspace, path = case
    assert verify(airspace, [checked("one", path)]).violations == ()
    if airspace.rule is CONTAINMENT:
        assert held(path) == holds_of(stops(path), CONTAINMENT, airspace.grid)


@given(
    airspaces(EITHER_RULE).flatmap(
        lambda airspace: st.tuples(st.just(airspace), slower_flights(airspace), slower_flights(airspace))
    )
)
@unhurried
def test_of_two_slower_flights_either_one_is_in_conflict_or_both_are_separated(
    case: tuple[Airspace, SubmittedPath, SubmittedPath],
) -> None:
    airspace, one, other = case
    index = OccupancyIndex(airspace.grid.block_count)
    index.reserve(one.hold_block, one.hold_enter_ms, one.hold_exit_ms, owner=1)
    meets = conflicts(airspace.grid, index, other).count > 0
    assert bool(verify(airspace, [checked("one", one), checked("other", other)]).violations) == meets


def test_the_midpoint_of_an_odd_link_is_held_from_both_sides() -> None:
    city = drawn("AB.", rule=MIDPOINT)
    path = flown(city.airspace, ((0, 0, 0), 10, 10), ((1, 0, 0), 15, 20))
    assert held(path) == [Hold(city["A"], 10, 14), Hold(city["B"], 12, 21)]


def test_a_diagonal_holds_its_box_for_as_long_as_it_takes() -> None:
    city = drawn("bB Aa")
    path = flown(city.airspace, ((0, 0, 0), 0, 3), ((1, 1, 0), 12, 12))
    assert held(path) == [Hold(city["A"], 0, 13), *(Hold(city[sign], 3, 13) for sign in "baB")]


# Trajectories that are refused


OPEN = drawn("... ... ...")
THROUGH_A_CORNER = (((0, 0, 0), 0, 0), ((1, 1, 0), 6, 6))


@pytest.mark.parametrize(
    ("error", "entry", "stops"),
    [
        (NotAChain, None, [((0, 0, 0), 0, 0)]),
        (NotAChain, 1, [((0, 0, 0), 0, 0), ((2, 0, 0), 99, 99)]),
        (NotAChain, 1, [((0, 0, 0), 0, 0), ((0, 0, 0), 9, 9), ((1, 0, 0), 19, 19)]),
        (EntryOutside, 1, [((0, 0, 0), 0, 0), ((0, -1, 0), 4, 4)]),
        (EntryOutside, 0, [((3, 0, 0), 0, 0), ((2, 0, 0), 4, 4)]),
        (EntryOutside, 1, [((0, 0, 0), 0, 0), ((0, 0, 1), 4, 4)]),
        (OutOfOrder, 1, [((0, 0, 0), 0, 0), ((1, 0, 0), 9, 8), ((2, 0, 0), 20, 20)]),
        (OutOfOrder, 2, [((0, 0, 0), 0, 0), ((1, 0, 0), 9, 12), ((2, 0, 0), 11, 20)]),
        (TooFast, 1, [((0, 0, 0), 0, 0), ((1, 0, 0), 0, 0)]),
        (TooFast, 2, [((0, 0, 0), 0, 0), ((1, 0, 0), 4, 4), ((2, 1, 0), 9, 9)]),
        (TooLong, 1, [((0, 0, 0), 0, 0), ((1, 0, 0), LONGEST_MS, LONGEST_MS + 1)]),
        (OutOfOrder, 1, [((0, 0, 0), 0, 0), ((1, 0, 0), 9, 8), ((9, 0, 0), 20, 20)]),
    ],
)
def test_a_trajectory_that_cannot_be_flown_is_refused_for_its_first_wrong_entry(
    error: type[PathRefused], entry: int | None, stops: list[Entry]
) -> None:
    with pytest.raises(PathRefused) as refusal:
        flown(OPEN.airspace, *stops)
    assert (type(refusal.value), refusal.value.entry) == (error, entry)


def test_a_flight_as_fast_as_the_aircraft_is_planned_and_as_long_as_it_may_be_is_flown() -> None:
    path = flown(OPEN.airspace, ((0, 0, 0), 0, 0), ((1, 0, 0), 4, LONGEST_MS - 6), ((2, 1, 0), LONGEST_MS, LONGEST_MS))
    assert path.departure_ms == 0


@pytest.mark.parametrize(("rule", "is_refused"), [(CONTAINMENT, True), (MIDPOINT, False)])
def test_a_corner_that_a_building_occupies_is_cut_under_the_midpoint_rule_only(
    rule: OccupancyRule, is_refused: bool
) -> None:
    airspace = drawn("#. ..", rule=rule).airspace
    if not is_refused:
        assert len(held(flown(airspace, *THROUGH_A_CORNER))) == 2
        return
    with pytest.raises(InBuilding, match=r"entry 1: block \[0, 1, 0\]") as refusal:
        flown(airspace, *THROUGH_A_CORNER)
    assert refusal.value.entry == 1


@pytest.mark.parametrize("rule", OccupancyRule)
def test_nobody_starts_in_a_building(rule: OccupancyRule) -> None:
    with pytest.raises(InBuilding) as refusal:
        flown(drawn("#..", rule=rule).airspace, ((0, 0, 0), 0, 0), ((1, 0, 0), 4, 4))
    assert refusal.value.entry == 0


@pytest.mark.parametrize(
    ("times", "entry"),
    [(((0, 2), (6, 6), (10, 13)), 0), (((0, 3), (7, 7), (11, 13)), 2), (((0, 3), (7, 7), (11, 14)), None)],
)
def test_the_terminal_dwell_is_asked_for_at_both_ends(times: Sequence[tuple[int, int]], entry: int | None) -> None:
    airspace = drawn("...", terminal_dwell_ms=3).airspace
    stops = [((i, 0, 0), *span) for i, span in enumerate(times)]
    if entry is None:
        assert flown(airspace, *stops).plan(14, 3).hover_ms == 0
        return
    with pytest.raises(DwellTooShort) as refusal:
        flown(airspace, *stops)
    assert refusal.value.entry == entry


def test_a_flight_may_take_as_long_as_the_aircraft_can_stay_in_the_air_and_no_longer() -> None:
    stops: list[Entry] = [((0, 0, 0), 0, 0), ((1, 0, 0), 5, 9), ((2, 0, 0), 13, 13)]
    assert flown(OPEN.airspace, *stops, endurance_ms=13).departure_ms == 0
    with pytest.raises(BeyondEndurance) as refusal:
        flown(OPEN.airspace, *stops, endurance_ms=12)
    assert refusal.value.entry == 2


# Volumes


@given(situations())
@unhurried
def test_what_a_plan_holds_is_flyable_and_held_as_it_is(situation: Situation) -> None:
    plan = planned(situation)
    path = volumes_path(
        situation.airspace,
        performance_of(situation.request),
        situation.request.origin,
        situation.request.destination,
        indices(situation.airspace, plan.hold_block),
        plan.hold_enter_ms,
        plan.hold_exit_ms,
        longest_ms=LONGEST_MS,
    )
    assert (path.departure_ms, path.depart_ms[-1]) == (plan.departure_ms, plan.arrival_ms)
    assert sum(hold.exit_ms - hold.enter_ms for hold in held(path)) == sum(
        hold.exit_ms - hold.enter_ms for hold in holds_in(plan)
    )
    assert verify(situation.airspace, [checked("one", path)]).violations == ()


@st.composite
def volumes_in_traffic(draw: st.DrawFn) -> tuple[Situation, list[Hold]]:
    """Draw volumes wherever random reservations leave a block free from 0 to 60, the ends' all that time."""
    airspace = draw(airspaces(EITHER_RULE))
    request = replace(draw(requests_in(airspace)), earliest_departure_ms=0, latest_departure_ms=60)
    ends = (request.origin, request.destination)
    taken = [hold for hold in draw(reservations_in(airspace)) if hold.block not in ends]
    volumes = []
    for block in np.flatnonzero(~airspace.occupied).tolist():
        begins = 0
        for hold in [*(hold for hold in taken if hold.block == block), Hold(block, 60, 61)]:
            until = min(hold.enter_ms, 60)
            if begins < until:
                volumes.append(Hold(block, begins, until))
            begins = max(begins, hold.exit_ms)
    return Situation(airspace, tuple(taken), request), volumes


def hanging_together(airspace: Airspace, origin: int, volumes: Sequence[Hold]) -> set[Hold]:
    """Return the volumes that a chain leads to from the origin's: the definition, pair by pair."""
    (start,) = (volume for volume in volumes if volume.block == origin)
    reached, waiting = {start}, deque([start])
    while waiting:
        one = waiting.popleft()
        for other in volumes:
            steps = np.array(airspace.grid.block(one.block)) - airspace.grid.block(other.block)
            if (
                other not in reached
                and np.abs(steps).max() == 1
                and max(one.enter_ms, other.enter_ms) < min(one.exit_ms, other.exit_ms)
            ):
                reached.add(other)
                waiting.append(other)
    return reached


@given(volumes_in_traffic())
@unhurried
def test_volumes_are_flyable_just_when_the_reference_finds_a_way_inside(
    case: tuple[Situation, list[Hold]],
) -> None:
    situation, volumes = case
    airspace, request = situation.airspace, situation.request
    beyond = [Hold(block, 60, 90) for block in range(airspace.grid.block_count)]
    earliest = earliest_arrival(airspace, [*situation.reservations, *beyond], request)

    def path(volumes: Sequence[Hold]) -> SubmittedPath:
        columns = [np.array(column, dtype=np.int64) for column in zip(*volumes, strict=True)]
        blocks, ends = indices(airspace, columns[0]), (request.origin, request.destination)
        return volumes_path(airspace, request.performance, *ends, blocks, *columns[1:], longest_ms=LONGEST_MS)

    reached = hanging_together(airspace, request.origin, volumes)
    if len(reached) < len(volumes):
        with pytest.raises(OutOfReach) as refusal:
            path(volumes)
        assert refusal.value.entry == next(n for n, volume in enumerate(volumes) if volume not in reached)
        volumes = [volume for volume in volumes if volume in reached]
    if earliest is None:
        with pytest.raises(NotFlyable):
            path(volumes)
        return
    found = path(volumes)
    landing = found.arrive_ms[-1] + airspace.terminal_dwell_ms
    assert (found.departure_ms, landing, found.depart_ms[-1]) == (0, earliest, 59)
    assert verify(airspace, [checked("one", found)]).violations == ()


LANE = drawn("A.B#")


def test_volumes_of_a_block_that_overlap_or_touch_are_one() -> None:
    path = through(
        LANE, ((0, 0, 0), 0, 5), ((0, 0, 0), 5, 9), ((1, 0, 0), 8, 30), ((1, 0, 0), 1, 12), ((2, 0, 0), 2, 30)
    )
    assert held(path) == [Hold(LANE["A"], 0, 9), Hold(LANE["A"] + 1, 1, 30), Hold(LANE["B"], 2, 30)]
    assert stops(path) == [
        Visit(LANE["A"], 0, 1), Visit(LANE["A"] + 1, 5, 5), Visit(LANE["B"], 9, 29)
    ]  # fmt: skip


def test_who_comes_by_its_first_block_again_departs_from_it_the_first_time() -> None:
    again: Entry = ((0, 0, 0), 20, 30)
    path = through(LANE, ((0, 0, 0), 0, 9), ((1, 0, 0), 1, 30), again, ((2, 0, 0), 2, 30))
    assert (path.departure_ms, len(held(path))) == (0, 4)


WIDE: list[Entry] = [((0, 0, 0), 0, 40), ((1, 0, 0), 0, 40), ((2, 0, 0), 0, 40)]


@pytest.mark.parametrize(
    ("error", "entry", "volumes"),
    [
        (OutOfOrder, 1, [WIDE[0], ((1, 0, 0), 7, 7), WIDE[2]]),
        (EntryOutside, 3, [*WIDE, ((0, 1, 0), 0, 9)]),
        (InBuilding, 3, [*WIDE, ((3, 0, 0), 0, 9)]),
        (TooLong, 2, [*WIDE[:2], ((2, 0, 0), 0, LONGEST_MS + 1)]),
        (OutOfOrder, 1, [WIDE[0], ((1, 0, 0), -1, 40), WIDE[2]]),
        (OutOfOrder, 1, [WIDE[0], ((1, 0, 0), 0, 41), WIDE[2]]),
        (NotFlyable, None, [WIDE[0], ((1, 0, 0), 0, 8), WIDE[2]]),
        (OutOfReach, 1, [WIDE[0], WIDE[2]]),
        (NotFlyable, None, WIDE[1:]),
        (NotFlyable, None, WIDE[:2]),
    ],
)
def test_volumes_that_nobody_can_fly_in_are_refused(
    error: type[PathRefused], entry: int | None, volumes: list[Entry]
) -> None:
    with pytest.raises(PathRefused) as refusal:
        through(LANE, *volumes)
    assert (type(refusal.value), refusal.value.entry) == (error, entry)


# Blocks beside the lane are of use; those that lie apart, in place or in time, are not.
PLAZA = drawn("..... A.B.. .....", ".....\n.....\n.....")


@pytest.mark.parametrize(
    ("entry", "further"),
    [
        (None, [((1, 2, 1), 39, 40)]),
        (None, [((3, 2, 1), 0, 9), ((4, 2, 1), 8, 12)]),
        (3, [((4, 1, 0), 0, 40)]),
        (4, [((3, 2, 1), 0, 9), ((4, 2, 1), 9, 12)]),
        (4, [((3, 2, 1), 9, 12), ((4, 2, 1), 0, 9)]),
        # Two beside each other, and nobody comes to either; the first of them is named.
        (3, [((4, 0, 0), 0, 40), ((4, 1, 0), 0, 40)]),
        # Of one block, what touches is one volume; what does not is another.
        (None, [((0, 1, 1), 0, 9), ((0, 1, 1), 9, 12)]),
        (None, [((0, 0, 0), 0, 9), ((0, 0, 0), 10, 12)]),
        (4, [((3, 0, 0), 0, 9), ((4, 0, 0), 20, 40), ((4, 0, 0), 3, 5)]),
    ],
)
def test_volumes_hang_together_beside_one_another_and_at_the_same_time(entry: int | None, further: list[Entry]) -> None:
    lane: list[Entry] = [((i, 1, 0), 0, 40) for i in range(3)]
    if entry is None:
        through(PLAZA, *lane, *further)
        return
    with pytest.raises(OutOfReach) as refusal:
        through(PLAZA, *lane, *further)
    assert refusal.value.entry == entry


def test_rows_of_blocks_that_follow_one_another_in_memory_only_are_apart() -> None:
    city = drawn("..B ..A")
    with pytest.raises(OutOfReach) as refusal:
        through(city, ((2, 0, 0), 0, 40), ((0, 1, 0), 0, 40), ((2, 1, 0), 0, 40))
    assert refusal.value.entry == 1


def test_an_aircraft_that_must_land_before_it_is_through_cannot_fly_there() -> None:
    assert through(LANE, *WIDE, endurance_ms=39).depart_ms[-1] == 39
    with pytest.raises(BeyondEndurance):
        through(LANE, *WIDE, endurance_ms=38)
    with pytest.raises(NotFlyable):
        through(LANE, *WIDE, endurance_ms=7)


# Conflicts


@given(situations())
@unhurried
def test_conflicts_are_the_overlaps_with_who_is_there_first_ones_first(situation: Situation) -> None:
    airspace = situation.airspace
    plan = planned(replace(situation, reservations=()))
    blocks, performance = indices(airspace, plan.block), performance_of(situation.request)
    path = trajectory_path(airspace, performance, blocks, plan.arrive_ms, plan.depart_ms, longest_ms=LONGEST_MS)
    overlaps = [
        Conflict(hold.block, max(hold.enter_ms, other.enter_ms), min(hold.exit_ms, other.exit_ms), owner)
        for hold in holds_in(plan)
        for owner, other in enumerate(situation.reservations)
        if hold.block == other.block and hold.enter_ms < other.exit_ms and other.enter_ms < hold.exit_ms
    ]
    overlaps.sort(key=lambda one: (one.enter_ms, airspace.grid.block(one.block)))
    found = conflicts(airspace.grid, planner_in(airspace, situation.reservations).index, path)
    assert (found.first, found.count) == (tuple(overlaps), len(overlaps))


def test_of_many_conflicts_the_first_are_named_and_all_are_counted() -> None:
    index = OccupancyIndex(OPEN.airspace.grid.block_count)
    enter = np.arange(0, 3 * MAX_CONFLICTS, 2, dtype=np.int64)
    index.reserve(np.zeros_like(enter), enter, enter + 1, owner=7)
    path = flown(OPEN.airspace, ((0, 0, 0), 0, 3 * MAX_CONFLICTS), ((1, 0, 0), 3 * MAX_CONFLICTS + 4, 999))
    found = conflicts(OPEN.airspace.grid, index, path)
    assert (len(found.first), found.count) == (MAX_CONFLICTS, 150)
    assert found.first[-1] == Conflict(0, 198, 199, 7)


def test_a_closed_block_is_a_conflict_with_the_negative_number_of_what_closed_it() -> None:
    index = OccupancyIndex(LANE.airspace.grid.block_count)
    index.close({3: Closure(*(np.array([value], dtype=np.int64) for value in (LANE["B"], 6, 1 << 62)))})
    path = flown(LANE.airspace, ((0, 0, 0), 0, 0), ((1, 0, 0), 4, 4), ((2, 0, 0), 8, 8))
    assert conflicts(LANE.airspace.grid, index, path).first == (Conflict(LANE["B"], 6, 9, -3),)
