"""Building files and static occupancy: what is accepted, repaired, refused, and which blocks are occupied."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.airmatrix import AirMatrix
from planner.airspace import Airspace, BoolArray, Building, OccupancyRule
from planner.buildings import (
    BuildingData,
    Window,
    build_airspace,
    read_buildings,
    shipped_airspace,
    statically_occupied,
)
from planner.errors import BuildingDataError
from tests.reference import buildings as reference

Metres = Sequence[tuple[float, float]]

DATA = Path(__file__).parents[3] / "shared" / "data"
needs_data = pytest.mark.skipif(
    not DATA.is_dir() and not os.environ.get("CI"), reason="the building data beside the project is absent"
)

GRID = AirMatrix(32642, 668_920.0, 5_665_220.0, 20.0, 40.0, (5, 4, 3))
SQUARE = [[[71.42, 51.12], [71.421, 51.12], [71.421, 51.121], [71.42, 51.121], [71.42, 51.12]]]


def ring(corners: Metres, grid: AirMatrix = GRID) -> list[list[float]]:
    """A closed ring in degrees of corners in metres from the grid's origin."""
    lon, lat = grid.unproject(
        [grid.origin_x_m + x for x, _ in [*corners, corners[0]]],
        [grid.origin_y_m + y for _, y in [*corners, corners[0]]],
    )
    return [[float(x), float(y)] for x, y in zip(lon, lat, strict=True)]


def rectangle(west: float, south: float, east: float, north: float) -> Metres:
    return [(west, south), (east, south), (east, north), (west, north)]


def building(*parts: Metres, height_m: float = 10.0, grid: AirMatrix = GRID) -> Building:
    """A building of one or more parts, corners in metres from the grid's origin."""
    polygons = [[ring(part, grid)] for part in parts]
    return Building("b", height_m, "height", {"type": "MultiPolygon", "coordinates": polygons})


def plan_of(occupied: BoolArray, grid: AirMatrix = GRID, layer: int = 0) -> list[str]:
    """One layer as rows of text, north up: # occupied, . free."""
    count_i, count_j, count_k = grid.dimensions
    rows = occupied.reshape(count_k, count_j, count_i)[layer]
    return ["".join("#" if cell else "." for cell in row) for row in rows[::-1]]


def feature(geometry: Any = None, **properties: Any) -> dict[str, Any]:
    geometry = {"type": "Polygon", "coordinates": SQUARE} if geometry is None else geometry
    return {"type": "Feature", "properties": {"height": 10.0} | properties, "geometry": geometry}


def read(tmp_path: Path, *features: Any, default_height_m: float | None = None, **members: Any) -> BuildingData:
    path = tmp_path / "town.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features} | members), encoding="utf-8")
    return read_buildings(path, default_height_m)


def polygon(*rings: list[list[float]]) -> dict[str, Any]:
    return {"type": "Polygon", "coordinates": list(rings)}


# Reading


def test_a_footprint_is_read_as_it_stands_with_its_height_and_the_heights_source(tmp_path: Path) -> None:
    data = read(tmp_path, feature(id="way-1", height=27.5, height_source="osm_levels"))
    assert data.buildings == (Building("way-1", 27.5, "osm_levels", polygon(*SQUARE)),)
    assert data.warnings == {}


@pytest.mark.parametrize(
    ("height", "height_m"),
    [(12, 12.0), (12.5, 12.5), ("12", 12.0), ("12 m", 12.0), ("12.5m", 12.5), (" 12. ", 12.0), (".5", 0.5)],
)
def test_a_height_may_be_a_number_or_a_text_in_metres(tmp_path: Path, height: Any, height_m: float) -> None:
    assert read(tmp_path, feature(height=height)).buildings[0].height_m == height_m


@pytest.mark.parametrize(("levels", "height_m"), [(1, 6.0), (8, 27.0), ("2.5", 10.5)])
def test_without_height_levels_count_three_metres_each_and_three_for_the_roof(
    tmp_path: Path, levels: Any, height_m: float
) -> None:
    data = read(tmp_path, feature(height=None, **{"building:levels": levels}))
    assert (data.buildings[0].height_m, data.buildings[0].height_source) == (height_m, "building:levels")
    assert data.warnings == {"heights derived from building:levels": 1}


def test_a_height_goes_before_levels(tmp_path: Path) -> None:
    assert read(tmp_path, feature(height=5, **{"building:levels": 8})).buildings[0].height_m == 5.0


@pytest.mark.parametrize("height", [0, -3, 10**400, 10_001, "tall", "40 ft", "1e400", "", True, [12], "-5", "nan"])
def test_an_unusable_height_counts_as_missing(tmp_path: Path, height: Any) -> None:
    data = read(tmp_path, feature(height=height), default_height_m=7.0)
    assert (data.buildings[0].height_m, data.buildings[0].height_source) == (7.0, "default")
    assert data.warnings == {"unusable heights ignored": 1, "heights assumed by default": 1}


@pytest.mark.parametrize("levels", [0, -1, "many", 1001, None])
def test_unusable_levels_count_as_missing(tmp_path: Path, levels: Any) -> None:
    data = read(tmp_path, feature(height=None, **{"building:levels": levels}), default_height_m=7.0)
    assert data.warnings == {"heights assumed by default": 1}


def test_buildings_without_height_are_refused_by_number_with_the_option_that_helps(tmp_path: Path) -> None:
    with pytest.raises(
        BuildingDataError,
        match=r"2 of 3 buildings have neither height nor building:levels \(first: 'b'\); .* --default-height METRES",
    ):
        read(tmp_path, feature(id="a"), feature(id="b", height=None), feature(id="c", height=None))


@pytest.mark.parametrize("default", [0.0, -1.0, float("nan"), float("inf"), 10_001.0])
def test_a_default_height_must_be_a_height(tmp_path: Path, default: float) -> None:
    with pytest.raises(BuildingDataError, match="the default height must be a number of metres above 0"):
        read(tmp_path, feature(), default_height_m=default)


def test_heights_that_the_data_calls_assumed_are_counted(tmp_path: Path) -> None:
    sources = ["assumed", "assumed_office", "osm_height"]
    data = read(tmp_path, *(feature(shifted(0.01 * n), height_source=s) for n, s in enumerate(sources)))
    assert data.warnings == {"heights assumed in the data": 2}


def shifted(degrees: float) -> dict[str, Any]:
    return polygon([[lon + degrees, lat] for lon, lat in SQUARE[0]])


def test_ids_come_from_the_feature_then_its_properties_then_its_place(tmp_path: Path) -> None:
    named = feature(shifted(0), id="in-properties") | {"id": 7}
    data = read(tmp_path, named, feature(shifted(0.1), id="in-properties"), feature(shifted(0.2)))
    assert [found.id for found in data.buildings] == ["7", "in-properties", "feature-2"]


def test_repeated_ids_are_made_unique_and_counted(tmp_path: Path) -> None:
    data = read(tmp_path, *(feature(shifted(0.1 * n), id=id_) for n, id_ in enumerate(["a", "a-2", "a", "a"])))
    assert [found.id for found in data.buildings] == ["a", "a-2", "a-3", "a-4"]
    assert data.warnings == {"repeated ids made unique": 2}


def test_a_polygon_that_crosses_itself_is_repaired_and_counted(tmp_path: Path) -> None:
    bow_tie = polygon([[71.0, 51.0], [71.2, 51.2], [71.2, 51.0], [71.0, 51.2], [71.0, 51.0]])
    data = read(tmp_path, feature(bow_tie))
    assert data.buildings[0].footprint["type"] == "MultiPolygon"
    assert data.warnings == {"invalid polygons repaired": 1}


def test_what_two_parts_of_a_building_both_enclose_is_no_hole() -> None:
    overlapping = building(rectangle(0, 0, 60, 20), rectangle(20, 0, 80, 20))
    assert plan_of(statically_occupied(GRID, [overlapping]))[-1] == "####."


def test_elevations_in_positions_are_dropped(tmp_path: Path) -> None:
    raised = polygon([[lon, lat, 350.0] for lon, lat in SQUARE[0]])
    assert read(tmp_path, feature(raised)).buildings[0].footprint == polygon(*SQUARE)


@pytest.mark.parametrize(
    ("geometry", "warning"),
    [
        ({"type": "Point", "coordinates": [71.4, 51.1]}, "points and lines skipped"),
        ({"type": "LineString", "coordinates": [[71.4, 51.1], [71.5, 51.1]]}, "points and lines skipped"),
        ({}, "features without geometry skipped"),
        (polygon(), "polygons without area skipped"),
        (polygon([[71.0, 51.0], [71.1, 51.1], [71.0, 51.0]]), "polygons without area skipped"),
        (polygon([[71.0, 51.0], [71.25, 51.25], [71.5, 51.5], [71.0, 51.0]]), "polygons without area skipped"),
    ],
)
def test_what_cannot_be_a_building_is_skipped_and_counted(
    tmp_path: Path, geometry: dict[str, Any], warning: str
) -> None:
    data = read(tmp_path, feature(id="kept"), feature(geometry, id="skipped", height=None))
    assert [found.id for found in data.buildings] == ["kept"]
    assert data.warnings == {warning: 1}


def test_a_feature_may_have_null_for_geometry_and_properties(tmp_path: Path) -> None:
    null = {"type": "Feature", "properties": None, "geometry": None}
    assert read(tmp_path, feature(), null).warnings == {"features without geometry skipped": 1}


@pytest.mark.parametrize(
    "coordinates",
    [
        "x",
        [[[71.0, 51.0], [71.1, 51.0], [71.1, 51.1], [71.0, 51.1]]],  # not closed
        [[[71.0, 51.0], [71.1, "51"], [71.1, 51.1], [71.0, 51.0]]],
        [[[71.0, 51.0], [None, 51.0], [71.1, 51.1], [71.0, 51.0]]],
        [[[71.0], [71.1, 51.0], [71.1, 51.1], [71.0, 51.0]]],
        [[[10**400, 51.0], [71.1, 51.0], [71.1, 51.1], [10**400, 51.0]]],
    ],
)
def test_a_malformed_polygon_is_refused_by_id(tmp_path: Path, coordinates: Any) -> None:
    with pytest.raises(BuildingDataError, match="feature 'way-9': malformed polygon"):
        read(tmp_path, feature(), feature({"type": "Polygon", "coordinates": coordinates}, id="way-9"))


@pytest.mark.parametrize("kind", ["GeometryCollection", "Circle", ["Polygon"], 3])
def test_a_geometry_of_another_kind_is_refused_by_id(tmp_path: Path, kind: Any) -> None:
    with pytest.raises(BuildingDataError, match=r"feature 'way-9': geometry is .*, not a Polygon or MultiPolygon"):
        read(tmp_path, feature({"type": kind, "geometries": []}, id="way-9"))


@pytest.mark.parametrize(
    "member", [3, None, "x", [], {"properties": 3, "geometry": None}, {"properties": {}, "geometry": [1]}]
)
def test_a_member_that_is_no_feature_is_refused_by_its_place(tmp_path: Path, member: Any) -> None:
    with pytest.raises(BuildingDataError, match=r"features\[1\] is not a GeoJSON feature"):
        read(tmp_path, feature(), member)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"<kml/>", "cannot read buildings from"),
        (b"\xff", "cannot read buildings from"),
        (b"[" * 100_000, "cannot read buildings from"),
        (b'{"type": "FeatureCollection", "features": [NaN]}', "NaN is not a JSON number"),
        (b'{"type": "FeatureCollection", "features": [-Infinity]}', "-Infinity is not a JSON number"),
        (b"[]", "is not a GeoJSON FeatureCollection"),
        (b'{"type": "Feature"}', "is not a GeoJSON FeatureCollection"),
        (b'{"type": "FeatureCollection"}', "needs a list of features"),
        (b'{"type": "FeatureCollection", "features": {}}', "needs a list of features"),
        (b'{"type": "FeatureCollection", "features": []}', "no polygon in it could be a building"),
    ],
)
def test_a_file_of_another_kind_is_refused_with_its_reason(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "town.geojson"
    path.write_bytes(content)
    with pytest.raises(BuildingDataError, match=message) as refusal:
        read_buildings(path)
    assert str(path) in str(refusal.value)


def test_an_absent_file_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(BuildingDataError, match=r"cannot read buildings from .*absent\.geojson"):
        read_buildings(tmp_path / "absent.geojson")


def test_a_byte_order_mark_is_no_obstacle(tmp_path: Path) -> None:
    path = tmp_path / "town.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature()]}), encoding="utf-8-sig")
    assert len(read_buildings(path).buildings) == 1


def test_coordinates_that_are_no_degrees_are_refused_by_number(tmp_path: Path) -> None:
    metres = polygon([[668_920, 5_665_220], [668_940, 5_665_220], [668_940, 5_665_240], [668_920, 5_665_220]])
    with pytest.raises(
        BuildingDataError, match=r"1 of 2 polygons are not in degrees .*\(first: 'm'\); convert the file to WGS84"
    ):
        read(tmp_path, feature(), feature(metres, id="m"))


@pytest.mark.parametrize(
    "name",
    [
        "urn:ogc:def:crs:OGC:1.3:CRS84",
        "http://www.opengis.net/def/crs/OGC/1.3/CRS84",
        "EPSG:4326",
        "urn:ogc:def:crs:EPSG::4326",
        "urn:ogc:def:crs:EPSG:6.6:4326",
    ],
)
def test_a_crs_member_may_name_wgs84(tmp_path: Path, name: str) -> None:
    assert len(read(tmp_path, feature(), crs={"type": "name", "properties": {"name": name}}).buildings) == 1


@pytest.mark.parametrize(
    "crs",
    [
        {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::3857"}},
        {"type": "name", "properties": {"name": "EPSG:14326"}},
        {"type": "name", "properties": {}},
        {"type": "link"},
        "EPSG:4326",
    ],
)
def test_any_other_crs_member_is_refused(tmp_path: Path, crs: Any) -> None:
    with pytest.raises(BuildingDataError, match=r"its CRS is .*; convert it to WGS84"):
        read(tmp_path, feature(), crs=crs)


def test_name_notices_and_window_come_from_the_file(tmp_path: Path) -> None:
    window = {"epsg": 32642, "x0": 668920.0, "y0": 5665220.0, "size_m": 2000}
    metadata = {"attribution": "© somebody", "licence": "ODbL-1.0", "window": window}
    data = read(tmp_path, feature(), name="astana", metadata=metadata)
    assert (data.name, data.attribution, data.licence) == ("astana", "© somebody", "ODbL-1.0")
    assert data.window == Window(32642, (668920.0, 5665220.0), (2000.0, 2000.0))


def test_a_window_may_be_longer_than_wide(tmp_path: Path) -> None:
    data = read(tmp_path, feature(), metadata={"window": {"epsg": 3414, "x0": 0, "y0": 0, "size_m": [2000, 500]}})
    assert data.window == Window(3414, (0.0, 0.0), (2000.0, 500.0))


@pytest.mark.parametrize("metadata", [None, "x", {}, {"generated": 3}])
def test_a_file_needs_no_metadata(tmp_path: Path, metadata: Any) -> None:
    data = read(tmp_path, feature(), metadata=metadata)
    assert (data.name, data.attribution, data.licence, data.window) == ("town", "", "", None)


@pytest.mark.parametrize(
    "window",
    [
        3,
        {},
        {"epsg": 32642, "x0": 0.0, "y0": 0.0},
        {"epsg": 32642, "x0": "a", "y0": 0.0, "size_m": 20},
        {"epsg": 32642, "x0": 10**400, "y0": 0.0, "size_m": 20},
        {"epsg": 32642, "x0": 0.0, "y0": 0.0, "size_m": [1, 2, 3]},
    ],
)
def test_a_malformed_window_is_refused(tmp_path: Path, window: Any) -> None:
    with pytest.raises(BuildingDataError, match=r"metadata\.window needs epsg, x0, y0 .* and size_m"):
        read(tmp_path, feature(), metadata={"window": window})


def test_footprints_that_overlap_are_counted_in_pairs(tmp_path: Path) -> None:
    inner = polygon([[71.4202, 51.1202], [71.4204, 51.1202], [71.4204, 51.1204], [71.4202, 51.1202]])
    data = read(tmp_path, feature(), feature(inner), feature(shifted(0.0005)), feature(shifted(0.5)))
    assert data.warnings == {"pairs of footprints that overlap": 2}


@pytest.mark.parametrize("offset_degrees", [0.001, 0.000999])
def test_a_shared_wall_or_a_sliver_is_no_overlap(tmp_path: Path, offset_degrees: float) -> None:
    assert read(tmp_path, feature(), feature(shifted(offset_degrees))).warnings == {}


# Static occupancy


def test_a_building_occupies_every_cell_that_it_overlaps() -> None:
    corner_block = building([(25, 25), (75, 25), (75, 35), (35, 35), (35, 55), (25, 55)])
    assert plan_of(statically_occupied(GRID, [corner_block])) == [
        ".....",
        ".#...",
        ".###.",
        ".....",
    ]


def test_a_courtyard_of_whole_cells_stays_free() -> None:
    outer, inner = ring(rectangle(5, 5, 95, 75)), ring(rectangle(20, 20, 80, 60))
    court = Building("court", 10.0, "height", polygon(outer, inner))
    assert plan_of(statically_occupied(GRID, [court])) == [
        "#####",
        "#...#",
        "#...#",
        "#####",
    ]


def test_a_building_that_only_touches_faces_occupies_nothing_beyond_them() -> None:
    assert plan_of(statically_occupied(GRID, [building(rectangle(20, 20, 60, 40))])) == [
        ".....",
        ".....",
        ".##..",
        ".....",
    ]


@pytest.mark.parametrize(
    ("overlap_m", "row"),
    [(1e-7, "##..."), (2e-8, "#....")],  # times 20 m: 2e-6 and 4e-7 square metres
)
def test_an_overlap_counts_from_a_millionth_of_a_square_metre(overlap_m: float, row: str) -> None:
    assert plan_of(statically_occupied(GRID, [building(rectangle(0, 0, 20 + overlap_m, 20))]))[-1] == row


WEST_SLIVER, EAST_SLIVER = rectangle(0, 0, 20 + 4e-8, 20), rectangle(40 - 4e-8, 0, 60, 20)


def test_the_parts_of_one_building_count_together() -> None:
    assert plan_of(statically_occupied(GRID, [building(WEST_SLIVER, EAST_SLIVER)]))[-1] == "###.."


def test_slivers_of_different_buildings_do_not_add_up() -> None:
    assert plan_of(statically_occupied(GRID, [building(WEST_SLIVER), building(EAST_SLIVER)]))[-1] == "#.#.."


@pytest.mark.parametrize(
    ("height_m", "layers"),
    [(0.1, 1), (40.0, 1), (40.001, 2), (80.0, 2), (80.001, 3), (120.0, 3), (500.0, 3)],
)
def test_a_building_occupies_the_layers_whose_floor_it_exceeds(height_m: float, layers: int) -> None:
    occupied = statically_occupied(GRID, [building(rectangle(1, 1, 2, 2), height_m=height_m)])
    assert [plan_of(occupied, layer=layer)[-1] for layer in range(3)] == ["#...."] * layers + ["....."] * (3 - layers)


def test_the_highest_building_over_a_cell_decides() -> None:
    low, high = building(rectangle(1, 1, 9, 9), height_m=10), building(rectangle(11, 11, 19, 19), height_m=90)
    for order in ([low, high], [high, low]):
        assert statically_occupied(GRID, order).reshape(3, -1)[:, 0].tolist() == [True, True, True]


def test_edges_are_straight_in_the_projected_plane() -> None:
    # Along 5 km a parallel of latitude leaves the straight line by half a metre, and so would a densified edge.
    grid = AirMatrix(32642, 668_920.0, 5_665_220.0, 20.0, 40.0, (250, 3, 1))
    occupied = statically_occupied(grid, [building(rectangle(0, 20, 5000, 40), grid=grid)])
    assert plan_of(occupied, grid) == ["." * 250, "#" * 250, "." * 250]


def test_buildings_across_the_grids_edge_count_inside_only() -> None:
    occupied = statically_occupied(GRID, [building(rectangle(-500, -500, 15, 500))])
    assert plan_of(occupied) == ["#....", "#....", "#....", "#...."]


@pytest.mark.parametrize(
    "corners",
    [
        rectangle(-30, 5, -1, 15),
        rectangle(101, 5, 130, 15),
        rectangle(5, -30, 15, -1),
        rectangle(5, 81, 15, 95),
        rectangle(-20, 0, 0, 80),
        rectangle(-1e5, -1e5, -9e4, -9e4),
    ],
)
def test_buildings_beyond_the_grid_occupy_nothing(corners: Metres) -> None:
    assert not statically_occupied(GRID, [building(corners)]).any()


def test_no_buildings_occupy_nothing() -> None:
    assert statically_occupied(GRID, []).tolist() == [False] * 60


def test_a_footprint_without_area_occupies_nothing() -> None:
    assert not statically_occupied(GRID, [Building("b", 9.0, "height", polygon())]).any()


def test_a_building_where_the_projection_is_undefined_is_refused_by_id() -> None:
    antipode = polygon([[159.0, 0.0], [159.1, 0.0], [159.1, 0.1], [159.0, 0.0]])
    with pytest.raises(BuildingDataError, match="building 'far' lies where EPSG:32642 is undefined; check --epsg"):
        statically_occupied(GRID, [Building("far", 9.0, "height", antipode)])


def test_progress_is_told_after_every_building() -> None:
    told: list[int] = []
    statically_occupied(GRID, [building(rectangle(1, 1, 2, 2))] * 3, told.append)
    assert told == [1, 2, 3]


# Coordinates in quarters of a metre: overlaps are either nothing or far above the threshold.
QUARTERS = st.tuples(st.integers(-100, 500), st.integers(-100, 420)).map(lambda p: (p[0] / 4, p[1] / 4))
HEIGHTS = st.sampled_from([5.0, 40.0, 40.5, 80.0, 300.0])


def area_of(corners: Metres) -> float:
    following = [*corners[1:], corners[0]]
    return sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(corners, following, strict=True)) / 2


rectangles = st.tuples(QUARTERS, QUARTERS).map(
    lambda c: rectangle(min(c[0][0], c[1][0]), min(c[0][1], c[1][1]), max(c[0][0], c[1][0]), max(c[0][1], c[1][1]))
)
triangles = st.tuples(QUARTERS, QUARTERS, QUARTERS).map(list)
shapes = (rectangles | triangles).filter(lambda corners: abs(area_of(corners)) > 1.0)


@settings(deadline=None, max_examples=60)
@given(st.lists(st.builds(lambda corners, height: building(corners, height_m=height), shapes, HEIGHTS), max_size=4))
def test_occupancy_equals_the_plain_twins(buildings: list[Building]) -> None:
    expected = reference.statically_occupied(GRID, buildings)
    assert statically_occupied(GRID, buildings).tolist() == expected.tolist()


# Airspaces


def built(*buildings: Building, grid: AirMatrix = GRID, **options: Any) -> Airspace:
    data = BuildingData(buildings, attribution="© somebody", licence="ODbL-1.0")
    return build_airspace(data, id="town", name="Town", grid=grid, ceiling_m=130.0, **options)


def test_an_airspace_carries_its_occupancy_rules_and_notices() -> None:
    airspace = built(
        building(rectangle(1, 1, 2, 2)),
        rule=OccupancyRule.MIDPOINT,
        terminal_dwell_ms=5000,
        ground_w84_m=312.5,
    )
    assert airspace.occupied_per_layer == [1, 0, 0]
    assert (airspace.id, airspace.name, airspace.grid, airspace.ceiling_m) == ("town", "Town", GRID, 130.0)
    assert (airspace.rule, airspace.terminal_dwell_ms, airspace.ground_w84_m) == (OccupancyRule.MIDPOINT, 5000, 312.5)
    assert (airspace.attribution, airspace.licence) == ("© somebody", "ODbL-1.0")


def test_containment_without_dwell_is_the_default() -> None:
    airspace = built()
    assert (airspace.rule, airspace.terminal_dwell_ms, airspace.ground_w84_m) == (OccupancyRule.CONTAINMENT, 0, None)


def test_buildings_within_one_block_side_of_the_grid_are_kept() -> None:
    inside, near, far = (building(rectangle(x, 5, x + 5, 9)) for x in (50, 115, 121))
    assert built(inside, near, far).buildings == (inside, near)


def test_buildings_that_all_miss_the_window_are_refused_with_a_hint() -> None:
    near, far = building(rectangle(105, 5, 115, 15)), building(rectangle(900, 900, 950, 950))
    with pytest.raises(
        BuildingDataError, match=r"none of the 2 buildings overlaps the window \(lon 71\.41.*check --epsg, --origin"
    ):
        built(near, far)


def test_an_airspace_may_have_no_buildings() -> None:
    assert not built().occupied.any()


@pytest.mark.parametrize(
    ("epsg", "origin_m"),
    [
        (3414, (668_920.0, 5_665_220.0)),
        (32642, (16_660.0, 34_900.0)),
        (32642, (-1e7, 5e6)),
        (32642, (1e9, 1e9)),
        (32642, (1e300, 0.0)),
    ],
)
def test_a_window_outside_its_crs_area_of_use_is_refused(epsg: int, origin_m: tuple[float, float]) -> None:
    grid = AirMatrix(epsg, *origin_m, 20.0, 40.0, (5, 4, 3))
    with pytest.raises(BuildingDataError, match=f"outside the area of use of EPSG:{epsg} .*check --epsg and --origin"):
        built(grid=grid)


def test_an_area_of_use_across_the_antimeridian_is_understood() -> None:
    grid = AirMatrix(3460, 2_185_000.0, 4_000_000.0, 20.0, 40.0, (5, 4, 3))  # Fiji, east of 180 degrees
    area = grid.crs.area_of_use
    assert area is not None
    assert area.west > area.east > grid.bounds[0] > -180
    assert built(grid=grid).grid is grid


# The counts that two independent implementations agree on


def airspace_of(data: BuildingData) -> Airspace:
    assert data.window is not None
    grid = AirMatrix.covering(
        epsg=data.window.epsg,
        origin_m=data.window.origin_m,
        size_m=data.window.size_m,
        ceiling_m=120.0,
        block_side_m=20.0,
        block_height_m=40.0,
    )
    return build_airspace(data, id="x", name="X", grid=grid, ceiling_m=120.0)


@needs_data
@pytest.mark.parametrize(
    ("file", "dimensions", "buildings", "per_layer", "warnings"),
    [
        (
            "singapore_jurong_east_2km.geojson",
            (100, 100, 3),
            505,
            [4390, 1326, 81],
            {"heights assumed in the data": 148, "pairs of footprints that overlap": 5},
        ),
        (
            "astana_2km.geojson",
            (100, 100, 3),
            368,
            [3514, 676, 114],
            {"heights assumed in the data": 129, "pairs of footprints that overlap": 51},
        ),
        (
            "astana_5km.geojson",
            (250, 250, 3),
            4190,
            [20420, 1892, 220],
            {"heights assumed in the data": 2630, "pairs of footprints that overlap": 90},
        ),
    ],
)
def test_real_cities_have_the_agreed_counts_of_occupied_blocks(
    file: str,
    dimensions: tuple[int, int, int],
    buildings: int,
    per_layer: list[int],
    warnings: Mapping[str, int],
) -> None:
    data = read_buildings(DATA / file)
    airspace = airspace_of(data)
    assert airspace.grid.dimensions == dimensions
    assert (len(data.buildings), len(airspace.buildings)) == (buildings, buildings)
    assert airspace.occupied_per_layer == per_layer
    assert data.warnings == warnings


def test_the_shipped_airspace_is_two_kilometres_of_astana() -> None:
    airspace = shipped_airspace()
    assert (airspace.id, airspace.ceiling_m, airspace.rule) == ("astana-2km", 120.0, OccupancyRule.CONTAINMENT)
    assert airspace.grid == AirMatrix(32642, 668_920.0, 5_665_220.0, 20.0, 40.0, (100, 100, 3))
    assert airspace.occupied_per_layer == [3514, 676, 114]
    assert len(airspace.buildings) == 368
    assert airspace.attribution.startswith("© OpenStreetMap contributors (ODbL 1.0)")
    assert airspace.licence == "ODbL-1.0"
