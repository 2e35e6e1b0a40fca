"""Closed airspace: which blocks belong to a polygon with altitudes, and what is no such volume."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from shapely.geometry import shape

from planner.errors import VolumeError
from planner.volumes import MAX_VERTICES, volume_blocks
from tests.planner.test_buildings import GRID, SQUARE, Metres, plan_of, polygon, rectangle, ring

ABOVE_ALL = 1e6


def plan(geometry: dict[str, Any], base_m: float = 0.0, top_m: float | None = None, layer: int = 0) -> list[str]:
    """One layer as rows of text, north up: # belongs to the volume."""
    closed = np.zeros(GRID.block_count, dtype=np.bool_)
    closed[volume_blocks(GRID, geometry, base_m, top_m)] = True
    return plan_of(closed, layer=layer)


def layers(base_m: float, top_m: float | None) -> set[int]:
    blocks = volume_blocks(GRID, polygon(ring(rectangle(0, 0, 20, 20))), base_m, top_m)
    return set(GRID.ijk(blocks)[:, 2].tolist())


def test_blocks_belong_to_a_polygon_that_they_overlap_also_within_it() -> None:
    assert plan(polygon(ring(rectangle(10, 10, 70, 70)))) == [
        "####.",
        "####.",
        "####.",
        "####.",
    ]


def test_a_block_whose_face_is_touched_does_not_belong() -> None:
    assert plan(polygon(ring(rectangle(20, 20, 60, 40)))) == [".....", ".....", ".##..", "....."]


def test_a_hole_that_is_large_enough_is_open() -> None:
    hole = ring(rectangle(19, 19, 61, 61))[::-1]
    assert plan(polygon(ring(rectangle(0, 0, 100, 80)), hole)) == ["#####", "#..##", "#..##", "#####"]


def test_all_parts_of_a_multipolygon_belong() -> None:
    parts = [[ring(rectangle(1, 1, 2, 2))], [ring(rectangle(81, 61, 82, 62))]]
    assert plan({"type": "MultiPolygon", "coordinates": parts}) == ["....#", ".....", ".....", "#...."]


@pytest.mark.parametrize(
    ("base_m", "top_m", "closed"),
    [
        (0, None, {0, 1, 2}),
        (0, ABOVE_ALL, {0, 1, 2}),
        (-10, 1, {0}),
        (0, 40, {0}),
        (0, 40.001, {0, 1}),
        (40, 80, {1}),
        (39.999, 80, {0, 1}),
        (50, 60, {1}),
        (119.9, None, {2}),
    ],
)
def test_a_layer_belongs_where_it_shares_some_height(base_m: float, top_m: float | None, closed: set[int]) -> None:
    assert layers(base_m, top_m) == closed


def test_blocks_are_ascending_and_each_once() -> None:
    blocks = volume_blocks(GRID, polygon(ring(rectangle(-50, -50, 500, 500))), 0, None)
    assert blocks.tolist() == list(range(GRID.block_count))
    assert blocks.dtype == np.int64


def test_altitudes_of_vertices_are_ignored() -> None:
    flat = ring(rectangle(10, 10, 30, 30))
    assert plan(polygon([[*vertex, 5.0] for vertex in flat])) == plan(polygon(flat))


BOW = [[71.42, 51.12], [71.421, 51.121], [71.421, 51.12], [71.42, 51.121], [71.42, 51.12]]


@pytest.mark.parametrize(
    ("geometry", "words"),
    [
        ({"type": "Point", "coordinates": [71.42, 51.12]}, "must be a GeoJSON Polygon or MultiPolygon"),
        ({}, "must be a GeoJSON Polygon or MultiPolygon"),
        (polygon(SQUARE[0][:-1]), "malformed"),
        (polygon([[71.42, 51.12], [71.43, 51.13]]), "malformed"),
        ({"type": "Polygon", "coordinates": [[["x", 1], [2, 2], [3, 3], ["x", 1]]]}, "malformed"),
        ({"type": "Polygon", "coordinates": "everywhere"}, "malformed"),
        ({"type": "Polygon"}, "malformed"),
        (polygon([[float("nan"), 51.12], *SQUARE[0][1:-1], [float("nan"), 51.12]]), "malformed"),
        ({"type": "Polygon", "coordinates": []}, "no area"),
        (polygon(BOW), "not valid: Self-intersection"),
        (polygon([SQUARE[0][0]] * 4), "not valid: Too few points"),
        (polygon([[668_920, 5_665_220], [668_960, 5_665_220], [668_960, 5_665_260], [668_920, 5_665_220]]), "degrees"),
        (polygon(ring(rectangle(101, 0, 120, 20))), "outside the airspace"),
        (polygon(ring(rectangle(100, 0, 120, 20))), "outside the airspace"),
        (polygon([[10, 51], [11, 51], [11, 52], [10, 51]]), "outside the airspace"),
    ],
)
def test_what_is_no_volume_of_the_airspace_is_refused_with_the_reason(geometry: dict[str, Any], words: str) -> None:
    with pytest.raises(VolumeError, match=words):
        volume_blocks(GRID, geometry, 0, None)


@pytest.mark.parametrize(("base_m", "top_m"), [(120, None), (120, 200), (-40, 0), (-40, -20)])
def test_altitudes_outside_the_airspace_are_refused(base_m: float, top_m: float | None) -> None:
    with pytest.raises(VolumeError, match="outside the airspace"):
        layers(base_m, top_m)


@pytest.mark.parametrize("top_m", [40, 39])
def test_a_top_must_lie_above_the_base(top_m: float) -> None:
    with pytest.raises(VolumeError, match="the top"):
        layers(40, top_m)


@pytest.mark.parametrize(("vertices", "fits"), [(MAX_VERTICES, True), (MAX_VERTICES + 1, False)])
def test_vertices_are_bounded(vertices: int, fits: bool) -> None:
    turn = np.linspace(0, 2 * np.pi, vertices - 1, endpoint=False)
    around = polygon(ring(np.column_stack([50 + 30 * np.cos(turn), 40 + 30 * np.sin(turn)]).tolist()))
    if fits:
        assert len(volume_blocks(GRID, around, 0, None))
    else:
        with pytest.raises(VolumeError, match="1000 vertices"):
            volume_blocks(GRID, around, 0, None)


def test_where_the_projection_is_undefined_there_is_no_volume() -> None:
    antipode = polygon([[159.0, 0.0], [159.1, 0.0], [159.1, 0.1], [159.0, 0.0]])
    with pytest.raises(VolumeError, match="EPSG:32642 is undefined"):
        volume_blocks(GRID, antipode, 0, None)


metres = st.floats(-30, 130)
altitudes = st.floats(-50, 150)


@given(st.lists(st.tuples(metres, metres), min_size=3, max_size=7), altitudes, st.none() | altitudes)
@settings(deadline=None, max_examples=150)
def test_every_block_is_as_its_definition_says(corners: Metres, base_m: float, top_m: float | None) -> None:
    geometry = polygon(ring(corners))
    degrees = shape(geometry)
    assume(degrees.is_valid and degrees.area > 0)
    assume(top_m is None or base_m < top_m)
    expected = blocks_one_by_one(geometry, base_m, top_m)
    if expected:
        assert volume_blocks(GRID, geometry, base_m, top_m).tolist() == expected
    else:
        with pytest.raises(VolumeError):
            volume_blocks(GRID, geometry, base_m, top_m)


def blocks_one_by_one(geometry: dict[str, Any], base_m: float, top_m: float | None) -> Sequence[int]:
    """Plain twin: every block's box against the volume."""
    projected = shapely.make_valid(shapely.transform(shape(geometry), GRID.project, interleaved=False))
    side, height = GRID.block_side_m, GRID.block_height_m
    found = []
    for index in range(GRID.block_count):
        i, j, k = GRID.block(index)
        west, south = GRID.origin_x_m + i * side, GRID.origin_y_m + j * side
        shared_m2 = projected.intersection(shapely.box(west, south, west + side, south + side)).area
        shared_m = min(np.inf if top_m is None else top_m, (k + 1) * height) - max(base_m, k * height)
        if shared_m2 > 1e-6 and shared_m > 0:
            found.append(index)
    return found
