"""The grid: indices, centres, which block a position is in, and what grids are refused."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.airmatrix import MAX_BLOCKS, AirMatrix
from planner.errors import AirspaceFileError, OutsideAirspace

GRID = AirMatrix(32642, 668_920.0, 5_665_220.0, 20.0, 40.0, (5, 4, 3))
COUNT = st.integers(1, 30)


def position(east_m: float, north_m: float) -> tuple[float, float]:
    """Longitude and latitude of a point given in metres from the grid's origin."""
    lon, lat = GRID.unproject(GRID.origin_x_m + east_m, GRID.origin_y_m + north_m)
    return float(lon), float(lat)


@given(st.tuples(COUNT, COUNT, COUNT), st.data())
def test_a_block_and_its_flat_index_determine_each_other(dimensions: tuple[int, int, int], data: st.DataObject) -> None:
    grid = AirMatrix(32642, 0.0, 0.0, 20.0, 40.0, dimensions)
    index = data.draw(st.integers(0, grid.block_count - 1))
    block = grid.block(index)
    assert grid.contains(block)
    assert grid.index(block) == index
    assert tuple(grid.ijk(np.array([index]))[0]) == block


def test_flat_indices_run_east_then_north_then_up() -> None:
    assert [GRID.index(block) for block in [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (4, 3, 2)]] == [
        0,
        1,
        5,
        20,
        59,
    ]


@pytest.mark.parametrize("block", [(-1, 0, 0), (5, 0, 0), (0, -1, 0), (0, 4, 0), (0, 0, -1), (0, 0, 3)])
def test_blocks_beyond_any_side_are_not_contained(block: tuple[int, int, int]) -> None:
    assert not GRID.contains(block)


def test_centres_are_half_a_block_from_the_lower_south_west_corner() -> None:
    assert GRID.centres(np.array([0, 59])).tolist() == [
        [668_930.0, 5_665_230.0, 20.0],
        [669_010.0, 5_665_290.0, 100.0],
    ]


@settings(deadline=None)
@given(st.integers(0, 59))
def test_a_blocks_centre_lies_in_the_block(index: int) -> None:
    x, y, height = GRID.centres(np.array([index]))[0]
    lon, lat = GRID.unproject(x, y)
    assert GRID.block_at(float(lon), float(lat), float(height)) == GRID.block(index)


@pytest.mark.parametrize(("alt_m", "layer"), [(0.0, 0), (39.999, 0), (40.0, 1), (79.999, 1), (80.0, 2), (120.0, 2)])
def test_a_position_on_a_floor_belongs_to_the_layer_above_and_on_the_ceiling_to_the_last(
    alt_m: float, layer: int
) -> None:
    assert GRID.block_at(*position(50, 50), alt_m) == (2, 2, layer)


@pytest.mark.parametrize(
    ("east_m", "north_m", "column"),
    [
        (20.001, 10, (1, 0)),
        (19.999, 10, (0, 0)),
        (10, 20.001, (0, 1)),
        (10, 19.999, (0, 0)),
        (99.999, 79.999, (4, 3)),
    ],
)
def test_columns_change_at_the_faces_between_them(east_m: float, north_m: float, column: tuple[int, int]) -> None:
    assert GRID.block_at(*position(east_m, north_m), 10.0)[:2] == column


@pytest.mark.parametrize(("west_m", "south_m", "column"), [(0, 0, (0, 0)), (40, 20, (2, 1)), (100, 80, (4, 3))])
def test_cells_own_their_south_and_west_faces_and_the_last_ones_all_faces(
    west_m: int, south_m: int, column: tuple[int, int]
) -> None:
    lon, lat = 71.42, 51.12
    x, y = GRID.project(lon, lat)  # the grid is laid so that this position is exactly on its faces
    grid = AirMatrix(32642, float(x) - west_m, float(y) - south_m, 20.0, 40.0, (5, 4, 3))
    assert (float(x) - grid.origin_x_m, float(y) - grid.origin_y_m) == (west_m, south_m)
    assert grid.block_at(lon, lat, 0.0)[:2] == column


@pytest.mark.parametrize(
    ("east_m", "north_m", "alt_m"),
    [(-0.01, 10, 10), (100.01, 10, 10), (10, -0.01, 10), (10, 80.01, 10), (10, 10, -0.01), (10, 10, 120.01)],
)
def test_a_position_beyond_any_face_is_outside(east_m: float, north_m: float, alt_m: float) -> None:
    with pytest.raises(OutsideAirspace, match=r"lies outside the airspace \(lon 71.41"):
        GRID.block_at(*position(east_m, north_m), alt_m)


@pytest.mark.parametrize(
    ("lon", "lat", "alt_m"),
    [
        (math.nan, 51.1, 10),
        (71.4, math.nan, 10),
        (71.4135, 51.114, math.nan),
        (math.inf, 51.1, 10),
        (71.4, 91.0, 10),
        (-109.0, 0.0, 10),
        (71.4135, 51.114, math.inf),
    ],
)
def test_a_position_that_is_nowhere_is_outside(lon: float, lat: float, alt_m: float) -> None:
    with pytest.raises(OutsideAirspace):
        GRID.block_at(lon, lat, alt_m)


@pytest.mark.parametrize(
    ("size_m", "ceiling_m", "dimensions"),
    [
        ((2000.0, 2000.0), 120.0, (100, 100, 3)),
        ((2000.0, 1000.0), 150.0, (100, 50, 3)),
        ((2019.9, 2000.0), 119.9, (100, 100, 2)),
    ],
)
def test_a_grid_covers_whole_blocks_only(
    size_m: tuple[float, float], ceiling_m: float, dimensions: tuple[int, int, int]
) -> None:
    grid = AirMatrix.covering(
        epsg=32642,
        origin_m=(0.0, 0.0),
        size_m=size_m,
        ceiling_m=ceiling_m,
        block_side_m=20.0,
        block_height_m=40.0,
    )
    assert grid.dimensions == dimensions


def test_counts_do_not_lose_a_block_to_rounding() -> None:
    grid = AirMatrix.covering(
        epsg=32642,
        origin_m=(0.0, 0.0),
        size_m=(0.3, 0.7),
        ceiling_m=0.6,
        block_side_m=0.1,
        block_height_m=0.2,
    )
    assert grid.dimensions == (3, 7, 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"block_side_m": 0.0}, "block side and height must be positive"),
        ({"block_height_m": -1.0}, "block side and height must be positive"),
        ({"block_side_m": math.nan}, "block side and height must be positive"),
        ({"origin_m": (math.nan, 0.0)}, "the origin finite"),
        ({"size_m": (math.inf, 100.0)}, "size and ceiling must be finite"),
        ({"size_m": (19.0, 100.0)}, r"at least one block in every direction, not \(0, 5, 3\)"),
        ({"ceiling_m": 39.0}, r"at least one block in every direction, not \(5, 5, 0\)"),
        ({"size_m": (1e9, 1e9)}, f"{MAX_BLOCKS} blocks at most"),
        ({"size_m": (1e300, 100.0), "block_side_m": 1e-300}, f"{MAX_BLOCKS} blocks at most"),
    ],
)
def test_an_impossible_grid_is_refused_with_its_reason(change: dict[str, object], message: str) -> None:
    asked: dict[str, object] = {
        "epsg": 32642,
        "origin_m": (0.0, 0.0),
        "size_m": (100.0, 100.0),
        "ceiling_m": 120.0,
        "block_side_m": 20.0,
        "block_height_m": 40.0,
    }
    with pytest.raises(AirspaceFileError, match=message):
        AirMatrix.covering(**(asked | change))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("epsg", "message"),
    [
        (99, "EPSG:99 is not a known coordinate reference system"),
        (4326, r"EPSG:4326 \(WGS 84\) is not a projected CRS in metres"),
        (2263, "is not a projected CRS in metres"),
    ],
)
def test_a_crs_that_is_unknown_or_not_in_metres_is_refused(epsg: int, message: str) -> None:
    grid = AirMatrix(epsg, 0.0, 0.0, 20.0, 40.0, (1, 1, 1))
    with pytest.raises(AirspaceFileError, match=message):
        grid.project(71.4, 51.1)


@settings(deadline=None)
@given(st.floats(-500, 2500), st.floats(-500, 2500))
def test_unprojecting_and_projecting_returns_to_the_point(east_m: float, north_m: float) -> None:
    x, y = GRID.project(*position(east_m, north_m))
    assert float(x) - GRID.origin_x_m == pytest.approx(east_m, abs=1e-6)
    assert float(y) - GRID.origin_y_m == pytest.approx(north_m, abs=1e-6)


def test_geodetic_bounds_enclose_the_corners_of_all_cells() -> None:
    west, south, east, north = GRID.bounds
    lon, lat = GRID.corners
    assert lon.shape == lat.shape == (5, 6)
    assert (west, east) == pytest.approx((lon.min(), lon.max()), abs=1e-9)
    assert (south, north) == pytest.approx((lat.min(), lat.max()), abs=1e-9)
