"""`airmatrix airspace build` and `show`: from building files to airspace files, with clear words for what is wrong."""

import json
from pathlib import Path
from typing import Any

import pytest

from planner.airspace import OccupancyRule, read_airspace
from planner.errors import Block
from tests.cli.conftest import Run
from tests.cli.town import GRID, HALL, OCCUPIED, SHED, WINDOW, building, building_file, town_buildings

ORIGIN = ("--origin", GRID.origin_x_m, GRID.origin_y_m)
PLACED = ("--epsg", 32642, *ORIGIN, "--size", 200, 200)


def occupied_blocks(path: Path) -> list[Block]:
    """Return the statically occupied blocks of an airspace file, by index."""
    airspace = read_airspace(path)
    return [airspace.grid.block(int(index)) for index in airspace.occupied.nonzero()[0]]


def one_hall(path: Path, window: dict[str, Any] | None = WINDOW, **properties: Any) -> Path:
    """Write a building file with the hall alone, and these properties."""
    return building_file(path, building("hall", HALL, **properties), window=window)


def test_the_window_may_come_from_the_files_metadata(airmatrix: Run, tmp_path: Path) -> None:
    outcome = airmatrix(
        "airspace", "build", "--buildings", town_buildings(tmp_path / "b.geojson"), "--out", "t.geojson"
    )
    assert outcome.status == 0
    assert "warning" not in outcome.err
    assert outcome.out.startswith("town (t)")
    fingerprint = outcome.table.pop("fingerprint")
    assert fingerprint == read_airspace(tmp_path / "t.geojson").fingerprint
    assert outcome.table | {"fingerprint": ""} == {
        "blocks": "10 x 10 x 3 of 20 x 40 m",
        "bounds": "lon 71.413355 to 71.416303, lat 51.113472 to 51.115328",
        "projection": "EPSG:32642, origin 668920.0 5665220.0",
        "ceiling": "120 m",
        "occupancy rule": "containment",
        "terminal dwell": "0 s",
        "buildings": "2",
        "occupied 0-40 m": "2",
        "occupied 40-80 m": "1",
        "occupied 80-120 m": "0",
        "data": "nobody CC0",
        "fingerprint": "",
    }
    assert occupied_blocks(tmp_path / "t.geojson") == OCCUPIED
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.geojson", "t.geojson"]


def test_the_window_may_be_given_by_options(airmatrix: Run, tmp_path: Path) -> None:
    source = one_hall(tmp_path / "b.geojson", window=None, height=50)
    assert airmatrix("airspace", "build", "--buildings", source, "--out", "t.geojson", *PLACED).status == 0
    assert occupied_blocks(tmp_path / "t.geojson") == [(4, 4, 0), (4, 4, 1)]


def test_options_win_over_the_files_window(airmatrix: Run, tmp_path: Path) -> None:
    source = town_buildings(tmp_path / "b.geojson")
    shifted = ("--origin", GRID.origin_x_m + 20, GRID.origin_y_m, "--size", 100, 200)
    assert airmatrix("airspace", "build", "--buildings", source, "--out", "t.geojson", *shifted).status == 0
    # The shed is now outside, the hall one column farther west.
    assert read_airspace(tmp_path / "t.geojson").grid.dimensions == (5, 10, 3)
    assert occupied_blocks(tmp_path / "t.geojson") == [(3, 4, 0), (3, 4, 1)]


def test_every_option_reaches_the_file(airmatrix: Run, tmp_path: Path) -> None:
    source = town_buildings(tmp_path / "b.geojson")
    options = (
        "--block-side", 10, "--block-height", 30, "--ceiling", 100, "--rule", "midpoint",
        "--dwell", 2.5, "--ground-w84", -31.5, "--name", "Old Town",
    )  # fmt: skip
    assert airmatrix("airspace", "build", "--buildings", source, "--out", "fine.geojson", *options).status == 0
    airspace = read_airspace(tmp_path / "fine.geojson")
    assert (airspace.id, airspace.name) == ("fine", "Old Town")
    assert airspace.grid.dimensions == (20, 20, 3)
    assert (airspace.grid.block_side_m, airspace.grid.block_height_m, airspace.ceiling_m) == (10, 30, 100)
    assert airspace.rule is OccupancyRule.MIDPOINT
    assert (airspace.terminal_dwell_ms, airspace.ground_w84_m) == (2500, -31.5)
    # 50 m reach above the floor of the second layer, 30 m; four columns each.
    assert airspace.occupied_per_layer == [8, 4, 0]


def test_show_prints_what_build_printed(airmatrix: Run, town_file: Path) -> None:
    shown = airmatrix("airspace", "show", "--airspace", town_file)
    assert shown.status == 0
    assert shown.table["blocks"] == "10 x 10 x 3 of 20 x 40 m"
    assert shown.table["fingerprint"] == read_airspace(town_file).fingerprint


def test_show_describes_the_shipped_airspace_by_default(airmatrix: Run) -> None:
    outcome = airmatrix("airspace", "show")
    assert outcome.status == 0
    assert outcome.out.startswith("Astana, left bank, 2 km (astana-2km)")
    layers = ("occupied 0-40 m", "occupied 40-80 m", "occupied 80-120 m")
    assert [outcome.table[layer] for layer in layers] == ["3514", "676", "114"]
    assert outcome.table["buildings"] == "368"
    assert "© OpenStreetMap contributors" in outcome.table["data"]


def test_a_missing_window_lists_the_options_that_give_it(airmatrix: Run, tmp_path: Path) -> None:
    source = one_hall(tmp_path / "b.geojson", window=None, height=50)
    build = ("airspace", "build", "--buildings", source, "--out", "t.geojson")
    airmatrix(*build).assert_refused("no metadata.window; give --epsg, --origin, --size")
    outcome = airmatrix(*build, "--epsg", 32642)
    outcome.assert_refused("no metadata.window; give --origin, --size")
    assert not (tmp_path / "t.geojson").exists()


def test_a_half_written_window_is_refused(airmatrix: Run, tmp_path: Path) -> None:
    source = one_hall(tmp_path / "b.geojson", window={"epsg": 32642}, height=50)
    outcome = airmatrix("airspace", "build", "--buildings", source, "--out", "t.geojson")
    outcome.assert_refused("b.geojson", "metadata.window needs epsg, x0, y0")


def test_missing_heights_are_refused_with_the_option_that_helps(airmatrix: Run, tmp_path: Path) -> None:
    source = building_file(
        tmp_path / "b.geojson", building("hall", HALL), building("shed", SHED, height=10), window=WINDOW
    )
    outcome = airmatrix("airspace", "build", "--buildings", source, "--out", "t.geojson")
    outcome.assert_refused("1 of 2 buildings have neither height nor building:levels", "'hall'", "--default-height")
    assert not (tmp_path / "t.geojson").exists()


def test_a_default_height_is_assumed_and_counted(airmatrix: Run, tmp_path: Path) -> None:
    source = one_hall(tmp_path / "b.geojson")
    options = ("--out", "t.geojson", "--default-height", 41)
    outcome = airmatrix("airspace", "build", "--buildings", source, *options)
    assert outcome.status == 0
    assert outcome.err.strip() == "warning: 1 heights assumed by default"
    assert occupied_blocks(tmp_path / "t.geojson") == [(4, 4, 0), (4, 4, 1)]


@pytest.mark.parametrize(("levels", "layers"), [(12, 1), (13, 2)])
def test_levels_count_three_metres_each_and_three_for_the_roof(
    airmatrix: Run, tmp_path: Path, levels: int, layers: int
) -> None:
    source = building_file(tmp_path / "b.geojson", building("hall", HALL, **{"building:levels": levels}), window=WINDOW)
    outcome = airmatrix("airspace", "build", "--buildings", source, "--out", "t.geojson")
    assert outcome.err.strip() == "warning: 1 heights derived from building:levels"
    # Twelve levels are 39 m and stay in the lowest layer, thirteen are 42 m.
    assert occupied_blocks(tmp_path / "t.geojson") == [(4, 4, layer) for layer in range(layers)]


def test_warnings_are_counted_on_stderr(airmatrix: Run, tmp_path: Path) -> None:
    point = {"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": [71.414, 51.114]}}
    nothing: dict[str, Any] = {"type": "Feature", "properties": {}, "geometry": None}
    bow_tie = building("bow tie", (8, 8), height=20)
    corners = bow_tie["geometry"]["coordinates"][0]
    corners[1], corners[2] = corners[2], corners[1]
    source = building_file(
        tmp_path / "b.geojson",
        building("hall", HALL, height=50), building("hall", HALL, height="twelve", **{"building:levels": "3"}),
        point, point, nothing, bow_tie,
        window=WINDOW,
    )  # fmt: skip
    outcome = airmatrix("airspace", "build", "--buildings", source, "--out", "t.geojson")
    assert outcome.status == 0
    assert sorted(line for line in outcome.err.splitlines() if line) == [
        "warning: 1 features without geometry skipped",
        "warning: 1 heights derived from building:levels",
        "warning: 1 invalid polygons repaired",
        "warning: 1 pairs of footprints that overlap",
        "warning: 1 repeated ids made unique",
        "warning: 1 unusable heights ignored",
        "warning: 2 points and lines skipped",
    ]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--epsg", 3414), ("outside the area of use of EPSG:3414", "check --epsg and --origin")),
        (("--epsg", 4326), ("EPSG:4326 (WGS 84) is not a projected CRS in metres",)),
        (("--epsg", 2263), ("EPSG:2263", "not a projected CRS in metres")),
        (("--epsg", 0), ("EPSG:0 is not a known coordinate reference system",)),
        (("--origin", 500_000, 5_000_000), ("none of the 2 buildings overlaps the window", "check --epsg, --origin")),
        (("--origin", "nan", 0), ("the origin finite",)),
        (("--size", 10, 200), ("at least one block in every direction", "(0, 10, 3)")),
        (("--size", -200, -200), ("at least one block in every direction",)),
        (("--size", "inf", 200), ("size and ceiling must be finite",)),
        (("--ceiling", 39), ("at least one block in every direction", "(10, 10, 0)")),
        (("--block-side", 0), ("block side and height must be positive",)),
        (("--block-height", "nan"), ("block side and height must be positive",)),
        (("--block-side", 1e-6), ("20000000 blocks at most",)),
        (("--dwell", -1), ("the terminal dwell must lie between 0 and an hour",)),
        (("--dwell", "nan"), ("dwell",)),
        (("--dwell", "inf"), ("dwell",)),
        (("--dwell", 1e300), ("dwell",)),
        (("--ground-w84", "nan"), ("ground",)),
        (("--default-height", 0), ("the default height must be a number of metres above 0, not 0.0",)),
        (("--default-height", "nan"), ("the default height must be a number of metres above 0",)),
    ],
)
def test_an_option_that_makes_no_airspace_is_refused_and_nothing_is_written(
    airmatrix: Run, tmp_path: Path, options: tuple[object, ...], words: tuple[str, ...]
) -> None:
    source = town_buildings(tmp_path / "b.geojson")
    airmatrix("airspace", "build", "--buildings", source, "--out", "t.geojson", *options).assert_refused(*words)
    assert list(tmp_path.iterdir()) == [source]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ("cannot read buildings from b.geojson",)),
        ("Dear diary", ("cannot read buildings from b.geojson",)),
        ("[" * 100_000, ("cannot read buildings from b.geojson",)),
        ("[]", ("b.geojson is not a GeoJSON FeatureCollection",)),
        ('{"type": "Feature"}', ("b.geojson is not a GeoJSON FeatureCollection",)),
        ('{"type": "FeatureCollection"}', ("a FeatureCollection needs a list of features",)),
        ('{"type": "FeatureCollection", "features": []}', ("no polygon in it could be a building",)),
        ('{"type": "FeatureCollection", "features": [7]}', ("features[0] is not a GeoJSON feature",)),
        ('{"type": "FeatureCollection", "features": [], "crs": 3414}', ("its CRS is 3414",)),
    ],
)
def test_a_file_that_is_no_building_file_is_refused(
    airmatrix: Run, tmp_path: Path, text: str, words: tuple[str, ...]
) -> None:
    (tmp_path / "b.geojson").write_text(text)
    outcome = airmatrix("airspace", "build", "--buildings", "b.geojson", "--out", "t.geojson", *PLACED)
    outcome.assert_refused(*words)
    assert [path.name for path in tmp_path.iterdir()] == ["b.geojson"]


def test_a_missing_building_file_is_refused(airmatrix: Run) -> None:
    outcome = airmatrix("airspace", "build", "--buildings", "nowhere.geojson", "--out", "t.geojson")
    outcome.assert_refused("cannot read buildings from nowhere.geojson")


@pytest.mark.parametrize("out", ["nowhere/t.geojson", "folder", "."])
def test_an_output_that_cannot_be_written_is_refused_and_nothing_is_left(
    airmatrix: Run, tmp_path: Path, out: str
) -> None:
    source = town_buildings(tmp_path / "b.geojson")
    (tmp_path / "folder").mkdir()
    airmatrix("airspace", "build", "--buildings", source, "--out", out).assert_refused(f"cannot write {out}")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.geojson", "folder"]


def test_a_refused_build_leaves_an_older_file_as_it_was(airmatrix: Run, tmp_path: Path) -> None:
    source = town_buildings(tmp_path / "b.geojson")
    assert airmatrix("airspace", "build", "--buildings", source, "--out", "t.geojson").status == 0
    before = (tmp_path / "t.geojson").read_bytes()
    assert airmatrix("airspace", "build", "--buildings", source, "--out", "t.geojson", "--epsg", 0).status == 2
    assert (tmp_path / "t.geojson").read_bytes() == before


def test_the_building_file_is_not_overwritten_by_its_airspace(airmatrix: Run, tmp_path: Path) -> None:
    source = town_buildings(tmp_path / "b.geojson")
    before = source.read_bytes()
    assert airmatrix("airspace", "build", "--buildings", source, "--out", "b.geojson").status == 2
    assert source.read_bytes() == before


@pytest.mark.parametrize("name", ["[/b] town", "[red] town", ":cat: town"])
def test_a_name_is_printed_as_it_is(airmatrix: Run, tmp_path: Path, name: str) -> None:
    source = town_buildings(tmp_path / "b.geojson")
    outcome = airmatrix("airspace", "build", "--buildings", source, "--out", "t.geojson", "--name", name)
    assert outcome.status == 0
    assert outcome.out.startswith(f"{name} (t)")


@pytest.mark.parametrize("damage", [("epsg", 4326), ("dimensions", [9, 10, 3]), ("occupied_zlib_base64", "AAAA")])
def test_a_damaged_airspace_file_is_refused(
    airmatrix: Run, town_file: Path, tmp_path: Path, damage: tuple[str, object]
) -> None:
    document = json.loads(town_file.read_text())
    document["airmatrix"][damage[0]] = damage[1]
    (tmp_path / "t.geojson").write_text(json.dumps(document))
    airmatrix("airspace", "show", "--airspace", "t.geojson").assert_refused("t.geojson is damaged")


def test_a_building_file_is_no_airspace_file(airmatrix: Run, tmp_path: Path) -> None:
    source = town_buildings(tmp_path / "b.geojson")
    outcome = airmatrix("airspace", "show", "--airspace", source)
    outcome.assert_refused("b.geojson is not an airspace file", "airmatrix airspace build")
