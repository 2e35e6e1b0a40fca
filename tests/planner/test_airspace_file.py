"""Airspace files: what is written is read again, and damage never goes unnoticed."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.airmatrix import AirMatrix
from planner.airspace import Airspace, Building, OccupancyRule, read_airspace
from planner.errors import AirspaceFileError

GRID = AirMatrix(32642, 668_920.0, 5_665_220.0, 20.0, 40.0, (3, 2, 2))
BUILDING = Building(
    "tower-1",
    55.5,
    "osm_levels",
    {
        "type": "Polygon",
        "coordinates": [[[71.4134, 51.1136], [71.4136, 51.1136], [71.4136, 51.1137], [71.4134, 51.1136]]],
    },
)


def airspace(**change: Any) -> Airspace:
    """A small airspace with one building over its first column."""
    occupied = np.zeros(12, dtype=np.bool_)
    occupied[[0, 6]] = True
    parts: dict[str, Any] = {
        "id": "small",
        "name": "Små",
        "grid": GRID,
        "ceiling_m": 90.0,
        "occupied": occupied,
        "attribution": "© somebody",
        "licence": "ODbL-1.0",
        "buildings": (BUILDING,),
    }
    return Airspace(**(parts | change))


def damaged(path: Path, **header: Any) -> Path:
    """Change members of a written file's header; None removes."""
    document = json.loads(path.read_text(encoding="utf-8"))
    document["airmatrix"].update(header)
    path.write_text(json.dumps(document).replace("Infinity", "1e999"), encoding="utf-8")
    return path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "small.geojson"
    airspace().write(path)
    return path


airspaces = st.builds(
    lambda grid, bits, **parts: airspace(
        grid=grid, occupied=np.random.default_rng(bits).random(grid.block_count) < 0.3, **parts
    ),
    st.builds(
        AirMatrix,
        st.sampled_from([32642, 3414]),
        st.floats(-1e6, 1e6),
        st.floats(-1e7, 1e7),
        st.floats(0.1, 1000.0),
        st.floats(0.1, 1000.0),
        st.tuples(st.integers(1, 6), st.integers(1, 6), st.integers(1, 4)),
    ),
    st.integers(0, 2**32),
    id=st.text(st.characters(codec="utf-8"), min_size=1),
    name=st.text(st.characters(codec="utf-8")),
    ceiling_m=st.floats(1.0, 1000.0),
    rule=st.sampled_from(OccupancyRule),
    terminal_dwell_ms=st.integers(0, 10**6),
    ground_w84_m=st.none() | st.floats(-100.0, 9000.0),
    buildings=st.sampled_from([(), (BUILDING,), (BUILDING, dataclasses.replace(BUILDING, id="b", height_m=3.0))]),
)


@settings(deadline=None)
@given(original=airspaces)
def test_a_written_airspace_is_read_as_it_was(tmp_path_factory: pytest.TempPathFactory, original: Airspace) -> None:
    path = tmp_path_factory.getbasetemp() / "roundtrip.geojson"
    original.write(path)
    read = read_airspace(path)
    for field in dataclasses.fields(Airspace):
        if field.name != "occupied":
            assert getattr(read, field.name) == getattr(original, field.name), field.name
    assert read.occupied.tolist() == original.occupied.tolist()
    assert read.fingerprint == original.fingerprint


def test_an_airspace_file_is_geojson_of_its_buildings(path: Path) -> None:
    document = json.loads(path.read_text(encoding="utf-8"))
    assert document["type"] == "FeatureCollection"
    assert document["features"] == [
        {
            "type": "Feature",
            "id": "tower-1",
            "properties": {"id": "tower-1", "height": 55.5, "height_source": "osm_levels"},
            "geometry": BUILDING.footprint,
        }
    ]


@settings(deadline=None)
@given(data=st.data())
def test_a_file_cut_off_anywhere_is_refused(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    path = tmp_path_factory.getbasetemp() / "cut.geojson"
    airspace().write(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 2))])  # the last byte is a line feed
    with pytest.raises(AirspaceFileError, match="cannot read airspace file"):
        read_airspace(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"no json", "cannot read airspace file"),
        (b"\xff\xfe", "cannot read airspace file"),
        (b"[" * 100_000, "cannot read airspace file"),
        (b"[]", "is not an airspace file; build one with: airmatrix airspace build"),
        (b'{"type": "FeatureCollection", "features": []}', "is not an airspace file"),
        (b'{"airmatrix": 3}', "is not an airspace file"),
        (b'{"airmatrix": {"format": "airmatrix-airspace/2"}}', "format 'airmatrix-airspace/2', expected"),
        (b'{"airmatrix": {"format": "airmatrix-airspace/1"}}', "is damaged: KeyError"),
    ],
)
def test_a_file_of_another_kind_is_refused_with_its_reason(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "other.geojson"
    path.write_bytes(content)
    with pytest.raises(AirspaceFileError, match=message):
        read_airspace(path)


def test_an_absent_file_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(AirspaceFileError, match=r"cannot read airspace file .*absent\.geojson"):
        read_airspace(tmp_path / "absent.geojson")


@pytest.mark.parametrize(
    "change",
    [
        {"epsg": 32643},
        {"origin_m": [668_920.5, 5_665_220.0]},
        {"block_side_m": 25.0},
        {"block_height_m": 30.0},
        {"dimensions": [2, 3, 2]},
        {"occupancy_rule": "midpoint"},
        {"terminal_dwell_ms": 1},
        {"occupied_zlib_base64": "eJxjYAAAAAIAAQ=="},
        {"fingerprint": "0" * 64},
        {"fingerprint": None},
    ],
)
def test_a_header_that_contradicts_the_fingerprint_is_refused(path: Path, change: dict[str, Any]) -> None:
    with pytest.raises(AirspaceFileError, match="does not match its fingerprint"):
        read_airspace(damaged(path, **change))


@pytest.mark.parametrize(
    "change",
    [
        {"epsg": "x"},
        {"epsg": float("inf")},
        {"origin_m": []},
        {"origin_m": 3},
        {"block_side_m": None},
        {"dimensions": [3, 2]},
        {"dimensions": 5},
        {"ceiling_m": "high"},
        {"occupancy_rule": "none"},
        {"terminal_dwell_ms": float("inf")},
        {"occupied_zlib_base64": ""},
        {"occupied_zlib_base64": 3},
        {"occupied_zlib_base64": "é"},
    ],
)
def test_a_malformed_header_is_refused_as_damage(path: Path, change: dict[str, Any]) -> None:
    with pytest.raises(AirspaceFileError, match="is damaged"):
        read_airspace(damaged(path, **change))


@pytest.mark.parametrize("dimensions", [[0, 1, 1], [-3, 2, 2], [10**5, 10**5, 10**5], [10**30, 1, 1]])
def test_impossible_dimensions_are_refused_before_anything_is_allocated(path: Path, dimensions: list[int]) -> None:
    with pytest.raises(AirspaceFileError, match=r"at least one block|blocks at most"):
        read_airspace(damaged(path, dimensions=dimensions))


@pytest.mark.parametrize("features", [None, 3, ["x"], [{}], [{"properties": {"id": "x"}, "geometry": {}}]])
def test_malformed_buildings_are_refused_as_damage(path: Path, features: Any) -> None:
    document = json.loads(path.read_text(encoding="utf-8"))
    document["features"] = features
    path.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(AirspaceFileError, match="is damaged"):
        read_airspace(path)


def test_a_failed_write_leaves_the_file_that_was_there(path: Path) -> None:
    before = path.read_bytes()
    with pytest.raises(UnicodeEncodeError):
        airspace(name="half a surrogate pair \ud800").write(path)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    "change",
    [
        {"grid": dataclasses.replace(GRID, origin_x_m=0.0)},
        {"grid": dataclasses.replace(GRID, dimensions=(2, 3, 2))},
        {"occupied": np.zeros(12, dtype=np.bool_)},
        {"rule": OccupancyRule.MIDPOINT},
        {"terminal_dwell_ms": 1000},
    ],
)
def test_what_decides_over_reservations_is_in_the_fingerprint(change: dict[str, Any]) -> None:
    assert airspace(**change).fingerprint != airspace().fingerprint


def test_names_and_notices_are_not_in_the_fingerprint() -> None:
    assert airspace(id="x", name="y", attribution="", ground_w84_m=3.0).fingerprint == airspace().fingerprint


def test_occupancy_of_another_size_than_the_grids_is_refused() -> None:
    with pytest.raises(AirspaceFileError, match=r"static occupancy has shape \(11,\), the grid has 12 blocks"):
        airspace(occupied=np.zeros(11, dtype=np.bool_))


def test_a_negative_terminal_dwell_is_refused() -> None:
    with pytest.raises(AirspaceFileError, match="dwell must lie between 0 and an hour"):
        airspace(terminal_dwell_ms=-1)


def test_static_occupancy_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        airspace().occupied[3] = True


def test_occupied_blocks_are_counted_per_layer_lowest_first() -> None:
    occupied = np.zeros(12, dtype=np.bool_)
    occupied[[0, 1, 2, 6]] = True
    assert airspace(occupied=occupied).occupied_per_layer == [3, 1]


def test_the_nearest_free_block_is_the_one_with_the_nearest_centre() -> None:
    lon, lat = GRID.unproject(668_935.0, 5_665_225.0)  # in (0, 0, 0), towards (1, 0, 0)
    assert airspace().nearest_free_block(float(lon), float(lat), 10.0) == (1, 0, 0)


def test_a_full_airspace_has_no_nearest_free_block() -> None:
    assert airspace(occupied=np.ones(12, dtype=np.bool_)).nearest_free_block(71.4134, 51.1136, 10.0) is None
