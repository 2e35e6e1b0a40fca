"""The search without traffic against plain Dijkstra, and what its bounds must be for the search with traffic."""

import heapq
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.airspace import Airspace, OccupancyRule
from planner.cfa_star import Planner, PlanRequest
from planner.errors import AircraftProfileError, NoPlan, NotPlannable
from planner.kernels.heap import MAX_H
from planner.kernels.labels import LAST_STAMP, new_workspace
from planner.kernels.static_search import Bounds, static_search, time_to_go
from planner.links import LinkTimes
from planner.occupancy import build_motion, open_links
from tests.planner.drawing import airspace_of
from tests.planner.traffic import (
    EITHER_RULE,
    Situation,
    flight,
    holds_in,
    planner_in,
    release,
    requests_in,
    reserve,
    situations,
    situations_with_endurance,
    trajectory_of,
)
from tests.reference.lattice import STEPS, time_of
from tests.reference.planning import Hold, link_times
from tests.reference.safe_interval import SafeIntervalPlanner

EITHER_SITUATION = st.one_of(situations(), situations_with_endurance())

unhurried = settings(deadline=None, max_examples=100)


@dataclass(frozen=True)
class Way:
    """Two blocks that buildings leave connected, and an aircraft that flies from one to the other."""

    airspace: Airspace
    times: LinkTimes
    origin: int
    destination: int


@st.composite
def uneven_times(draw: st.DrawFn) -> LinkTimes:
    """Draw link times of any parity, from the cheapest climb to the dearest."""
    horizontal = draw(st.integers(1, 9))
    diagonal = draw(st.integers(horizontal, 2 * horizontal))
    return link_times(
        horizontal=horizontal,
        diagonal=diagonal,
        vertical=draw(st.integers(1, 40)),
        alpha=horizontal + draw(st.integers(0, 20)),
        beta=diagonal + draw(st.integers(0, 20)),
    )


@st.composite
def ways(draw: st.DrawFn) -> Way:
    """Draw a grid down to a single row or layer, its buildings at random or as walls with a hole, and two blocks."""
    dimensions = draw(st.integers(1, 9)), draw(st.integers(1, 9)), draw(st.integers(1, 4))
    count_i, count_j, count_k = dimensions
    if count_i * count_j * count_k < 2:
        dimensions = count_i, count_j, count_k = 2, 1, 1
    random = np.random.default_rng(draw(st.integers(0, 1 << 32)))
    occupied = random.random((count_k, count_j, count_i)) < draw(st.sampled_from([0.0, 0.1, 0.3, 0.5]))
    for j in draw(st.sets(st.integers(0, count_j - 1), max_size=3)):
        walled = draw(st.integers(1, count_k))
        occupied[:walled, j] = True
        occupied[random.integers(walled), j, random.integers(count_i)] = False
    occupied.ravel()[random.choice(occupied.size, 2, replace=False)] = False
    airspace = airspace_of(dimensions, occupied.ravel(), rule=draw(EITHER_RULE), terminal_dwell_ms=0)
    origin = draw(st.sampled_from(np.flatnonzero(~airspace.occupied).tolist()))
    times = draw(uneven_times())
    reached = sorted(set(times_from(airspace, times, origin)) - {origin})
    if not reached:
        clear = airspace_of(
            dimensions, np.zeros(occupied.size, dtype=np.bool_), rule=airspace.rule, terminal_dwell_ms=0
        )
        return Way(clear, times, origin, (origin + 1) % occupied.size)
    return Way(airspace, times, origin, draw(st.sampled_from(reached)))


def times_from(airspace: Airspace, times: LinkTimes, origin: int) -> dict[int, int]:
    """Dijkstra: return the time to each block that can be reached. Links take as long there as back."""
    links = SafeIntervalPlanner(airspace).links
    found: dict[int, int] = {}
    queue = [(0, origin)]
    while queue:
        time, p = heapq.heappop(queue)
        if p not in found:
            found[p] = time
            for link in links[p]:
                heapq.heappush(queue, (time + time_of(times, STEPS[link.step]), link.to))
    return found


class TimeToGo(NamedTuple):
    """What `time_to_go` says of a block."""

    h: int
    rank: int


def searched(way: Way) -> tuple[Bounds, dict[int, TimeToGo]]:
    """Search without traffic; return its bounds, and the times to go of all blocks that can be reached."""
    grid = way.airspace.grid
    motion = build_motion(way.times, way.airspace)
    ws = new_workspace(grid.block_count, 1 << 10)
    sufficed, bounds = static_search(open_links(way.airspace), motion, ws, way.origin, way.destination, 1)
    assert sufficed
    reached = times_from(way.airspace, way.times, way.origin)
    return bounds, {
        block: TimeToGo(*time_to_go(ws.field, motion.shape, motion.near, bounds, block, *grid.block(block)))
        for block in reached
    }


def open_ways(way: Way, blocks: dict[int, TimeToGo]) -> Iterator[tuple[int, int, int]]:
    """Yield all open links between blocks that can be reached: from, to, ms."""
    links = SafeIntervalPlanner(way.airspace).links
    for p in blocks:
        for link in links[p]:
            yield p, link.to, time_of(way.times, STEPS[link.step])


def outcome(planner: Planner, request: PlanRequest) -> object:
    """Return everything that a plan or a refusal says."""
    try:
        plan = planner.plan(request)
    except NoPlan as refusal:
        return type(refusal), refusal.earliest_feasible_departure_ms, refusal.expansions
    except NotPlannable as refusal:
        return type(refusal)
    return trajectory_of(plan), holds_in(plan), plan.unconstrained_ms, plan.expansions, plan.interval_visits


@given(ways())
@unhurried
def test_the_static_optimum_is_the_length_of_the_shortest_path(way: Way) -> None:
    bounds, _ = searched(way)
    assert bounds.optimum == times_from(way.airspace, way.times, way.origin)[way.destination]


@given(ways())
@unhurried
def test_no_block_is_nearer_the_destination_than_its_time_to_go_says_and_exact_ones_are_exact(way: Way) -> None:
    _, blocks = searched(way)
    nearest = times_from(way.airspace, way.times, way.destination)
    for block, (h, rank) in blocks.items():
        assert 0 <= h <= nearest[block]
        assert rank > MAX_H or rank == h == nearest[block]


@given(ways())
@unhurried
def test_no_link_changes_the_time_to_go_by_more_than_it_takes(way: Way) -> None:
    _, blocks = searched(way)
    for p, n, ms in open_ways(way, blocks):
        assert blocks[p].h <= ms + blocks[n].h


@given(ways())
@unhurried
def test_at_both_ends_the_time_to_go_is_the_optimum_and_nothing(way: Way) -> None:
    bounds, blocks = searched(way)
    assert blocks[way.origin].h == bounds.optimum
    assert blocks[way.destination] == (0, 0)


@given(EITHER_SITUATION, st.data())
@unhurried
def test_what_was_planned_reserved_and_released_before_changes_nothing(
    situation: Situation, data: st.DataObject
) -> None:
    fresh = planner_in(situation.airspace, situation.reservations)
    used = planner_in(situation.airspace)
    others = data.draw(st.lists(requests_in(situation.airspace), max_size=3))
    for request in others:
        outcome(used, request)
    passing = [
        Hold(block, 1000 * n, 1000 * n + 1) for block in range(situation.airspace.grid.block_count) for n in range(6)
    ]
    reserve(used, passing, owner=99)
    release(used, passing)
    for owner, hold in enumerate(data.draw(st.permutations(situation.reservations))):
        reserve(used, [hold], owner)
    for request in others:
        outcome(used, request)
    assert outcome(used, situation.request) == outcome(fresh, situation.request)


@given(EITHER_SITUATION, st.integers(0, 8), st.integers(0, 3))
@unhurried
def test_plans_around_the_last_stamp_are_those_of_a_new_planner(
    situation: Situation, left: int, left_static: int
) -> None:
    new = planner_in(situation.airspace, situation.reservations)
    old = planner_in(situation.airspace, situation.reservations)
    outcome(old, situation.request)
    old._stamp, old._static_stamp = LAST_STAMP - left, LAST_STAMP - left_static
    for _ in range(3):
        assert outcome(old, situation.request) == outcome(new, situation.request)


@given(EITHER_SITUATION, st.integers(1, 40))
@unhurried
def test_a_workspace_too_small_at_first_changes_no_plan(situation: Situation, label_count: int) -> None:
    roomy = planner_in(situation.airspace, situation.reservations)
    cramped = planner_in(situation.airspace, situation.reservations)
    cramped._workspace = new_workspace(situation.airspace.grid.block_count, label_count)
    assert outcome(cramped, situation.request) == outcome(roomy, situation.request)


@given(situations(), st.data())
@unhurried
def test_with_surcharges_too_a_plan_says_nothing_of_those_before(situation: Situation, data: st.DataObject) -> None:
    layers = situation.airspace.grid.dimensions[2]
    request = replace(situation.request, layer_surcharge_ms=tuple(data.draw(st.integers(0, 5)) for _ in range(layers)))
    planner = planner_in(situation.airspace, situation.reservations)
    assert outcome(planner, request) == outcome(planner, request)


@given(ways())
@unhurried
def test_along_some_shortest_path_the_times_to_go_rank_as_exact(way: Way) -> None:
    _, blocks = searched(way)
    p = way.origin
    while p != way.destination:
        assert blocks[p].rank == blocks[p].h
        p = next(n for _, n, ms in open_ways(way, {p: blocks[p]}) if blocks[n].rank + ms == blocks[p].h)


@pytest.mark.parametrize("aircraft_ms", [400_000, 2_600_000])
def test_an_aircraft_too_slow_for_the_way_around_the_buildings_is_refused_and_does_not_hang(aircraft_ms: int) -> None:
    """Walls with a gap at alternating ends: 860 links between corners 40 apart."""
    side = 41
    walls = np.zeros((side, side), dtype=np.bool_)
    walls[1::2] = True
    walls[1::4, -1] = walls[3::4, 0] = False
    airspace = airspace_of((side, side, 1), walls.ravel(), rule=OccupancyRule.CONTAINMENT, terminal_dwell_ms=0)
    slow = link_times(
        horizontal=aircraft_ms, diagonal=2 * aircraft_ms, vertical=aircraft_ms, alpha=aircraft_ms, beta=2 * aircraft_ms
    )
    with pytest.raises(AircraftProfileError, match="too slow"):
        planner_in(airspace).plan(flight(0, side * side - 1, times=slow))
