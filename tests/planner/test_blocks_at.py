"""Many positions at once: each lies in the block that it would lie in alone."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.airmatrix import AirMatrix
from planner.errors import OutsideAirspace

GRID = AirMatrix(32642, 668_920.0, 5_665_220.0, 20.0, 40.0, (5, 4, 3))

# As often on the floor of a layer or on the ceiling as between them.
ALTITUDE = st.one_of(st.sampled_from([-0.001, 0.0, 40.0, 80.0, 120.0, 120.001]), st.floats(-50, 170))
POINT = st.tuples(st.floats(-30, 130), st.floats(-30, 110), ALTITUDE)
NOWHERE = st.sampled_from([(math.nan, 51.1, 10.0), (71.4, 91.0, 10.0), (71.4, 51.1, math.inf), (-109.0, 0.0, 10.0)])

Position = tuple[float, float, float]


def position(east_m: float, north_m: float, alt_m: float) -> Position:
    """Return longitude, latitude and altitude of a point given in metres from the grid's origin."""
    lon, lat = GRID.unproject(GRID.origin_x_m + east_m, GRID.origin_y_m + north_m)
    return float(lon), float(lat), alt_m


def located(positions: list[Position]) -> list[int]:
    """Return the flat indices of the blocks of positions."""
    return [int(block) for block in GRID.blocks_at(*np.array(positions).reshape(-1, 3).T)]


def block_alone(where: Position) -> int:
    """Return the flat index of one position's block, -1 outside."""
    try:
        return GRID.index(GRID.block_at(*where))
    except OutsideAirspace:
        return -1


@settings(deadline=None)
@given(st.lists(st.one_of(POINT.map(lambda point: position(*point)), NOWHERE), max_size=12))
def test_positions_lie_in_the_same_blocks_together_as_alone(positions: list[Position]) -> None:
    assert located(positions) == [block_alone(where) for where in positions]


@settings(deadline=None)
@given(POINT)
def test_a_position_lies_in_the_block_with_the_nearest_centre_if_that_block_reaches_it(point: Position) -> None:
    """The definition, straight from the paper; midway between two centres either is as near."""
    where = position(*point)
    x, y = GRID.project(*where[:2])
    off = GRID.centres(np.arange(GRID.block_count)) - np.array([float(x), float(y), where[2]])
    distances = np.abs(off / np.array([20.0, 20.0, 40.0])).max(axis=1)
    (block,) = located([where])
    if distances.min() > 0.5 + 1e-9:
        assert block == -1
    elif distances.min() < 0.5 - 1e-9:
        assert block == distances.argmin()


def test_flat_indices_are_given_and_minus_one_outside() -> None:
    inside, outside = position(50, 30, 100), position(50, -1, 100)
    assert located([outside, inside, outside]) == [-1, GRID.index((2, 1, 2)), -1]


def test_the_upper_faces_of_the_grid_belong_to_its_last_blocks() -> None:
    at_the_ceiling, above = position(50, 30, 120.0), position(50, 30, 120.001)
    assert located([at_the_ceiling, above]) == [GRID.index((2, 1, 2)), -1]


@pytest.mark.parametrize("nowhere", [(math.nan, 51.1, 10.0), (71.4, 91.0, 10.0), (71.4, 51.1, math.inf)])
def test_a_position_that_is_nowhere_does_not_spoil_the_others(nowhere: Position) -> None:
    assert located([nowhere, position(10, 10, 10)]) == [-1, 0]


def test_no_positions_lie_in_no_blocks() -> None:
    assert located([]) == []
