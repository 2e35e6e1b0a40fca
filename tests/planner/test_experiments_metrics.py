"""The experiments' measures against their definitions, on drawn trajectories and random ones."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.airmatrix import AirMatrix
from planner.airspace import OccupancyRule
from planner.errors import Block
from planner.experiments.metrics import (
    CornerCuts,
    conflicts_added,
    corner_cuts,
    encounter,
    positions,
    seconds_in_use,
)
from planner.path import Plan, Trajectory
from tests.planner.drawing import Drawing, drawn

GRID = AirMatrix(3414, 1000.0, 2000.0, 20.0, 40.0, (6, 5, 4))

Hold = tuple[int, int, int]


def plan_holding(*holds: Hold) -> Plan:
    """Return a plan of which only the holds (block, enter, exit) matter."""
    block, enter_ms, exit_ms = np.array(holds, dtype=np.int64).reshape(-1, 3).T
    nowhere = np.zeros(1, dtype=np.int64)
    return Plan(nowhere, nowhere, nowhere, 0, 0, block, enter_ms, exit_ms, 0, 0, 0, 0, 0)


def flight(*stops: tuple[Block, int, int], grid: AirMatrix = GRID) -> Trajectory:
    """Return a trajectory of (block, arrival, departure)."""
    block, arrive_ms, depart_ms = zip(
        *((grid.index(block), arrive, depart) for block, arrive, depart in stops), strict=True
    )
    return Trajectory(np.array(block), np.array(arrive_ms), np.array(depart_ms), 0, 0)


# Conflicts


def plain_conflicts(plans: list[list[Hold]], in_whole_seconds: bool) -> list[int]:
    """Count, plan by plan, the blocks and ticks that get their second visitor."""
    visitors: dict[tuple[int, int], set[int]] = {}
    added = []
    for number, holds in enumerate(plans):
        count = 0
        cells = set()
        for block, enter_ms, exit_ms in holds:
            leave_ms = exit_ms - 1
            for tick in range(-5, 30):
                inside = enter_ms <= 1000 * tick <= leave_ms
                near = enter_ms - 1000 < 1000 * tick < leave_ms + 1000
                if near if in_whole_seconds else inside:
                    cells.add((block, tick))
        for cell in cells:
            visitors.setdefault(cell, set()).add(number)
            count += len(visitors[cell]) == 2
        added.append(count)
    return added


holds = st.builds(
    lambda block, enter, length: (block, enter, enter + length),
    st.integers(0, 2),
    st.integers(-3000, 15_000),
    st.one_of(st.integers(1, 4000), st.sampled_from([1, 1000, 1001, 2001])),
)


@settings(deadline=None)
@given(st.lists(st.lists(holds, max_size=5), max_size=5), st.booleans())
def test_conflicts_are_blocks_and_ticks_with_a_second_flight(plans: list[list[Hold]], in_whole_seconds: bool) -> None:
    counted = conflicts_added([plan_holding(*held) for held in plans], in_whole_seconds=in_whole_seconds)
    assert counted.tolist() == plain_conflicts(plans, in_whole_seconds)


def test_a_conflict_counts_once_however_many_flights_meet() -> None:
    plans = [plan_holding((7, 500, 2501)) for _ in range(4)]
    assert conflicts_added(plans).tolist() == [0, 2, 0, 0]


def test_entry_and_exit_are_included() -> None:
    touching = [plan_holding((7, 0, 3001)), plan_holding((7, 3000, 3001))]
    assert conflicts_added(touching).tolist() == [0, 1]
    apart = [plan_holding((7, 0, 3000)), plan_holding((7, 3000, 3001))]
    assert conflicts_added(apart).tolist() == [0, 0]


def test_whole_seconds_make_neighbours_in_time_conflict() -> None:
    plans = [plan_holding((7, 100, 1400)), plan_holding((7, 1600, 1701))]
    assert conflicts_added(plans).tolist() == [0, 0]
    assert conflicts_added(plans, in_whole_seconds=True).tolist() == [0, 2]


def test_without_flights_there_are_no_conflicts() -> None:
    assert conflicts_added([]).tolist() == []


# Use


def test_use_is_the_time_from_entry_to_exit_over_all_flights() -> None:
    plans = [plan_holding((1, 0, 1001), (2, 500, 2001)), plan_holding((1, 5000, 5251))]
    assert seconds_in_use(plans, 4).tolist() == [0, 1.25, 1.5, 0]
    assert seconds_in_use([], 2).tolist() == [0, 0]


# Corners


def cuts_of(drawing: Drawing, *signs: str) -> CornerCuts:
    """Return the cuts of a path through these signs, a second a link."""
    block = np.array([drawing[sign] for sign in signs])
    times = 1000 * np.arange(len(block))
    return corner_cuts(drawing.airspace, [Trajectory(block, times, times, 0, 0)])


@pytest.mark.parametrize(
    ("layers", "path", "expected"),
    [
        (("a#  .b",), "ab", CornerCuts(1, 1)),
        (("#a  b.",), "ab", CornerCuts(1, 1)),
        (("#a  b#",), "ab", CornerCuts(1, 1)),
        (("a.#  .b#",), "ab", CornerCuts(1, 0)),
        (("ab#  ..#",), "ab", CornerCuts(0, 0)),
        (("a#  #.", "#.  .b"), "ab", CornerCuts(1, 1)),
        (("a.  ..", "..  .b"), "ab", CornerCuts(1, 0)),
        (("a.  ##", "#b  ##"), "ab", CornerCuts(1, 1)),
        (("abc  ##.", "..d  ..."), "abcd", CornerCuts(0, 0)),
    ],
)
def test_a_diagonal_link_cuts_a_corner_if_a_building_is_in_its_box(
    layers: tuple[str, ...], path: str, expected: CornerCuts
) -> None:
    assert cuts_of(drawn(*layers, rule=OccupancyRule.MIDPOINT), *path) == expected


def test_no_flights_cut_no_corners() -> None:
    assert corner_cuts(drawn("ab").airspace, []) == CornerCuts(0, 0)


# Encounters


def test_flights_that_pass_abreast_are_a_block_apart() -> None:
    west_to_east = flight(((0, 0, 0), 0, 0), ((1, 0, 0), 2000, 2000), ((2, 0, 0), 4000, 4000))
    east_to_west = flight(((2, 1, 0), 0, 0), ((1, 1, 0), 2000, 2000), ((0, 1, 0), 4000, 4000))
    met = encounter(GRID, west_to_east, east_to_west)
    assert met is not None
    assert (met.time_ms, met.horizontal_m, met.vertical_m) == (2000, 20.0, 0.0)
    assert met.separation == 1


def test_flights_on_opposite_diagonals_meet_at_the_edge() -> None:
    first = flight(((0, 0, 1), 0, 0), ((1, 1, 1), 3000, 3000))
    second = flight(((1, 0, 1), 500, 500), ((0, 1, 1), 2500, 2500))
    met = encounter(GRID, first, second)
    assert met is not None
    assert met.separation == pytest.approx(0, abs=1e-12)
    assert met.time_ms == 1500


def test_climbing_past_each_other_is_measured_in_block_heights() -> None:
    up = flight(((0, 0, 0), 0, 0), ((0, 0, 1), 4000, 4000))
    down = flight(((1, 0, 1), 0, 0), ((1, 0, 0), 4000, 4000))
    met = encounter(GRID, up, down)
    assert met is not None
    # A side apart all the time: the separation is 1 from when they are less than a height apart.
    assert met.separation == 1
    assert met.horizontal_m == 20
    assert met.vertical_m <= 40


def test_distances_that_shrink_alike_in_blocks_are_least_where_they_are_equal() -> None:
    # Relative to each other both move by a block a link along each axis: the quadratic's leading term all but vanishes.
    first = flight(((0, 0, 2), 0, 0), ((0, 1, 2), 200, 200))
    second = flight(((0, 0, 3), 1, 1), ((0, 0, 2), 201, 201))
    met = encounter(GRID, first, second)
    assert met is not None
    assert met.separation == pytest.approx(0.5, abs=0.01)


def test_a_meeting_at_a_single_instant_counts_and_none_does_not() -> None:
    early = flight(((0, 0, 0), 0, 0), ((1, 0, 0), 2000, 2000))
    late = flight(((1, 0, 0), 2000, 2000), ((2, 0, 0), 4000, 4000))
    later = flight(((1, 0, 0), 2001, 2001), ((2, 0, 0), 4001, 4001))
    met = encounter(GRID, early, late)
    assert met is not None
    assert met.separation == 0
    assert encounter(GRID, early, later) is None


@st.composite
def trajectories(draw: st.DrawFn) -> Trajectory:
    """Draw a walk of a few links with stops between."""
    block = tuple(draw(st.integers(0, count - 1)) for count in GRID.dimensions)
    time = draw(st.integers(0, 3000))
    stops: list[tuple[Block, int, int]] = []
    for _ in range(draw(st.integers(1, 4))):
        wait = draw(st.sampled_from([0, 0, 7, 400]))
        stops.append(((block[0], block[1], block[2]), time, time + wait))
        time += wait + draw(st.integers(200, 1000))
        step = draw(st.sampled_from([step for step in itertools.product((-1, 0, 1), repeat=3) if any(step)]))
        block = tuple(
            min(max(part + move, 0), count - 1) for part, move, count in zip(block, step, GRID.dimensions, strict=True)
        )
    return flight(*stops)


@settings(deadline=None)
@given(trajectories(), trajectories())
def test_no_sampled_instant_has_a_smaller_separation(first: Trajectory, second: Trajectory) -> None:
    begin, end = max(first.departure_ms, second.departure_ms), min(first.arrival_ms, second.arrival_ms)
    met = encounter(GRID, first, second)
    if begin > end:
        assert met is None
        return
    times = np.arange(begin, end + 1)
    apart = np.abs(positions(GRID, first, times) - positions(GRID, second, times))
    sampled = np.maximum(np.hypot(apart[:, 0], apart[:, 1]) / 20, apart[:, 2] / 40)
    assert met is not None
    assert met.separation <= sampled.min() + 1e-6
    # No link takes less than 200 ms, so that between two samples the separation changes by less than this.
    change = 2 * np.sqrt(2) / 200
    assert met.separation >= sampled.min() - change
    assert met.separation == pytest.approx(max(met.horizontal_m / 20, met.vertical_m / 40))
    assert begin <= met.time_ms <= end
    here = int(np.abs(times - met.time_ms).argmin())
    assert abs(sampled[here] - met.separation) <= change


def test_positions_are_metres_from_the_grids_corner() -> None:
    walk = flight(((0, 0, 0), 0, 1000), ((1, 0, 1), 3000, 3000))
    assert positions(GRID, walk, np.array([0, 1000, 2000, 3000])).tolist() == [
        [10, 10, 20], [10, 10, 20], [20, 10, 40], [30, 10, 60],
    ]  # fmt: skip
