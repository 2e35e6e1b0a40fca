"""H is the exact lattice distance: admissible, consistent, and never above the paper's case table."""

import itertools
import math

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from planner.aircraft import AircraftType, shipped_aircraft_types
from planner.airmatrix import AirMatrix
from planner.errors import AircraftProfileError, Block
from planner.heuristic import LatticeDistance, lattice_distance
from planner.links import LinkTimes, build_link_times
from tests.reference.lattice import STEPS, distances, paper_case_table, time_of

SPEEDS = st.floats(0.5, 40.0)


def grid_of(side_m: float, height_m: float, layers: int = 3) -> AirMatrix:
    return AirMatrix(32642, 668_920.0, 5_665_220.0, side_m, height_m, (4, 4, layers))


@st.composite
def link_times(draw: st.DrawFn) -> LinkTimes:
    slow, fast = sorted((draw(SPEEDS), draw(SPEEDS)))
    assume(slow < fast)
    overrides = draw(st.dictionaries(st.sampled_from(["alpha", "beta", "vertical"]), SPEEDS))
    aircraft = AircraftType("any", "Any", draw(st.floats(0.1, 50.0)), slow, fast, link_speed_overrides=overrides)
    try:
        return build_link_times(aircraft, grid_of(draw(st.floats(2.0, 80.0)), draw(st.floats(2.0, 80.0))))
    except AircraftProfileError:
        assume(False)
        raise


def h(table: LatticeDistance, offset: Block) -> int:
    """Read the table as the search kernels do."""
    dx, dy, dz = (abs(part) for part in offset)
    m, q = min(dx, dy), abs(dx - dy)
    m0, q0 = table.near.shape[1] - 1, table.near.shape[2] - 1
    beyond: int = table.diagonal * max(0, m - m0) + table.horizontal * max(0, q - q0)
    return int(table.near[dz, min(m, m0), min(q, q0)]) + beyond


@settings(deadline=None, max_examples=40)
@given(link_times(), st.integers(1, 5), st.integers(3, 14))
def test_h_equals_dijkstra_for_random_block_shapes_and_speeds(times: LinkTimes, layers: int, reach: int) -> None:
    table = lattice_distance(times, layers)
    start = (2, 1, 0)
    for block, time in distances(times, (reach + 2, reach, layers), start).items():
        offset = (block[0] - start[0], block[1] - start[1], block[2])
        assert h(table, offset) == time, offset


@settings(deadline=None, max_examples=20)
@given(link_times(), st.integers(1, 5))
def test_h_is_consistent_no_link_is_shorter_than_the_change_of_h_along_it(times: LinkTimes, layers: int) -> None:
    table = lattice_distance(times, layers)
    reach = range(2 * layers + 3)
    for x, y, z in itertools.product(reach, reach, range(layers)):
        for step in STEPS:
            if 0 <= z + step[2] < layers:
                change = h(table, (x + step[0], y + step[1], z + step[2])) - h(table, (x, y, z))
                assert abs(change) <= time_of(times, step)


@settings(deadline=None, max_examples=20)
@given(link_times(), st.integers(1, 5))
def test_h_is_never_above_the_papers_case_table(times: LinkTimes, layers: int) -> None:
    table = lattice_distance(times, layers)
    for x, y, z in itertools.product(range(12), range(12), range(layers)):
        assert h(table, (x, y, z)) <= paper_case_table(times, x, y, z)


@pytest.mark.parametrize(
    ("aircraft_id", "excess_ms", "excess_in_even_ms"),
    [
        ("dji-mavic-air", 5.394, 6),
        ("self-built-drone", 11.440, 12),
        ("dji-phantom-4", 2.943, 6),
        ("dji-matrice-600-pro", 7.642, 6),
    ],
)
def test_two_tilted_links_beat_the_papers_choice_at_1_1_2(
    aircraft_id: str, excess_ms: float, excess_in_even_ms: int
) -> None:
    aircraft = next(profile for profile in shipped_aircraft_types() if profile.id == aircraft_id)
    speeds = aircraft.link_speeds(20.0, 40.0)
    seconds = math.sqrt(2400) / speeds.beta + 40 / speeds.vertical - 2 * math.hypot(20, 40) / speeds.alpha
    assert round(1000 * seconds / 0.6, 3) == excess_ms

    times = build_link_times(aircraft, grid_of(20.0, 40.0))
    exact = h(lattice_distance(times, 3), (1, 1, 2))
    assert exact == 2 * times.alpha
    assert paper_case_table(times, 1, 1, 2) - exact == excess_in_even_ms


def test_the_papers_case_table_is_exact_in_two_dimensions() -> None:
    times = build_link_times(shipped_aircraft_types()[0], grid_of(20.0, 40.0))
    table = lattice_distance(times, 1)
    for x, y in itertools.product(range(8), repeat=2):
        assert paper_case_table(times, x, y, 0) == h(table, (x, y, 0))


def test_h_of_a_block_to_itself_is_zero() -> None:
    times = build_link_times(shipped_aircraft_types()[0], grid_of(20.0, 40.0))
    assert h(lattice_distance(times, 1), (0, 0, 0)) == 0


def test_link_times_are_even_milliseconds_rounded_up() -> None:
    # 20 m at 60 % of 19 m/s take 1754.386 ms, 40 m at 60 % of 4 m/s take 16666.667 ms.
    times = build_link_times(shipped_aircraft_types()[0], grid_of(20.0, 40.0))
    assert (times.horizontal, times.vertical) == (1756, 16668)


def test_a_profile_that_climbs_faster_than_it_cruises_is_refused() -> None:
    profile = AircraftType("rocket", "Rocket", 1.0, 4.0, 10.0, link_speed_overrides={"alpha": 100.0})
    with pytest.raises(AircraftProfileError, match="'rocket': a climb over a block takes less time"):
        build_link_times(profile, grid_of(20.0, 40.0))
