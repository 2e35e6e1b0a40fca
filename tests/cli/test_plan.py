"""`airmatrix plan`: one path, offline, as a table and as GeoJSON."""

import json
import re
from pathlib import Path

import pytest

from tests.cli.conftest import AIRCRAFT_TYPES, Outcome, Run
from tests.cli.town import place

DEPARTURE = ("--departure", "2030-01-01T00:00:00Z")
TIMES = ["00:00:00.000", "00:00:01.852", "00:00:03.704", "00:00:05.556"]


def stops(outcome: Outcome) -> list[list[str]]:
    """Return the cells of the printed stops: block, longitude, latitude, altitude, arrival and departure."""
    return [re.split(r"\s{2,}", line.strip()) for line in outcome.out.splitlines() if line.startswith("  [")]


def ends(origin: tuple[int, int, int], destination: tuple[int, int, int]) -> tuple[object, ...]:
    """Return the options for a flight between the centres of two blocks."""
    return ("--from", *place(origin), "--to", *place(destination))


def test_a_straight_flight_is_printed_stop_by_stop(airmatrix: Run, town_file: Path) -> None:
    outcome = airmatrix("plan", "--airspace", town_file, *DEPARTURE, *ends((0, 0, 0), (3, 0, 0)))
    assert outcome.status == 0
    assert outcome.err == ""
    assert "dji-matrice-600-pro: 5.556 s, 4 reservations" in outcome.out
    expected = []
    for i, time in enumerate(TIMES):
        lon, lat, _ = place((i, 0, 0))
        expected.append([f"[{i}, 0, 0]", f"{lon:.7f}", f"{lat:.7f}", "20", time, time])
    assert stops(outcome) == expected


def test_a_path_goes_round_a_building_and_not_through_its_corner(airmatrix: Run, town_file: Path) -> None:
    outcome = airmatrix("plan", "--airspace", town_file, *DEPARTURE, *ends((3, 4, 0), (5, 4, 0)))
    blocks = [json.loads(stop[0]) for stop in stops(outcome)]
    assert blocks[0] == [3, 4, 0]
    assert blocks[-1] == [5, 4, 0]
    assert blocks in [[[3, 4, 0], [3, j, 0], [4, j, 0], [5, j, 0], [5, 4, 0]] for j in (3, 5)]


@pytest.mark.parametrize("search", ["greedy", "safe-interval"])
def test_both_searches_find_the_same_way_without_traffic(airmatrix: Run, town_file: Path, search: str) -> None:
    outcome = airmatrix("plan", "--airspace", town_file, "--search", search, *ends((0, 0, 0), (9, 0, 0)))
    assert "dji-matrice-600-pro: 16.668 s, 10 reservations" in outcome.out


def test_geojson_on_stdout_is_nothing_but_geojson(airmatrix: Run, town_file: Path) -> None:
    options = ("--geojson", "-", *DEPARTURE, *ends((0, 0, 0), (2, 0, 0)))
    outcome = airmatrix("plan", "--airspace", town_file, *options)
    feature = json.loads(outcome.out)
    assert outcome.status == 0
    assert feature["type"] == "Feature"
    assert feature["geometry"]["type"] == "LineString"
    for position, i in zip(feature["geometry"]["coordinates"], range(3), strict=True):
        assert position == pytest.approx(place((i, 0, 0)), abs=1e-9)
    assert feature["properties"] == {
        "aircraft_type": "dji-matrice-600-pro",
        "flight_time_s": 3.704,
        "hover_s": 0.0,
        "blocks": [[0, 0, 0], [1, 0, 0], [2, 0, 0]],
        "arrive": ["2030-01-01T00:00:00.000Z", "2030-01-01T00:00:01.852Z", "2030-01-01T00:00:03.704Z"],
        "depart": ["2030-01-01T00:00:00.000Z", "2030-01-01T00:00:01.852Z", "2030-01-01T00:00:03.704Z"],
    }


def test_geojson_in_a_file_is_what_stdout_would_have_had(airmatrix: Run, town_file: Path, tmp_path: Path) -> None:
    options = ("--airspace", town_file, *DEPARTURE, *ends((0, 0, 0), (2, 0, 2)))
    printed = airmatrix("plan", *options, "--geojson", "-").out
    outcome = airmatrix("plan", *options, "--geojson", "path.geojson")
    assert (tmp_path / "path.geojson").read_text() == printed
    assert len(stops(outcome)) == 3


def test_a_users_aircraft_can_be_planned_for(airmatrix: Run, town_file: Path, tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text(AIRCRAFT_TYPES)
    own = ("--aircraft-types", "own.toml", "--aircraft", "courier-1")
    outcome = airmatrix("plan", "--airspace", town_file, *own, *ends((0, 0, 0), (3, 0, 0)))
    # 20 m at 0.6 x 20 m/s, rounded up to an even millisecond: 1.668 s a link.
    assert "courier-1: 5.004 s, 4 reservations" in outcome.out


def test_the_shipped_airspace_is_the_default(airmatrix: Run) -> None:
    outcome = airmatrix("plan", "--from", 71.4200, 51.1160, 100, "--to", 71.4360, 51.1280, 100)
    assert outcome.status == 0
    assert json.loads(stops(outcome)[0][0])[2] == 2


# One metre below the roof of the block, so that the block above is nearer than those beside.
UNDER_A_ROOF = {"--from": ((4, 4, 1), "[4, 4, 1]", "[4, 4, 2]"), "--to": ((0, 9, 0), "[0, 9, 0]", "[0, 9, 1]")}


@pytest.mark.parametrize(("blocked", "other"), [("--from", "--to"), ("--to", "--from")])
def test_an_end_in_a_building_is_refused_with_the_nearest_free_block(
    airmatrix: Run, town_file: Path, blocked: str, other: str
) -> None:
    block, name, nearest = UNDER_A_ROOF[blocked]
    lon, lat, alt_m = place(block)
    outcome = airmatrix("plan", "--airspace", town_file, blocked, lon, lat, alt_m + 19, other, *place((7, 7, 0)))
    outcome.assert_refused(f"in block {name}, which a building occupies; the nearest free block is {nearest}")


@pytest.mark.parametrize(
    "position", [(0, 0, 0), ("nan", "nan", "nan"), ("inf", 51.114, 20), (1e300, 51.114, 20), (71.414, 51.114, -1)]
)
def test_a_position_outside_the_airspace_is_refused(
    airmatrix: Run, town_file: Path, position: tuple[object, ...]
) -> None:
    outcome = airmatrix("plan", "--airspace", town_file, "--from", *position, "--to", *place((0, 0, 0)))
    outcome.assert_refused("lies outside the airspace (lon 71.41335 to 71.41630, lat 51.11347 to 51.11533, 0 to 120 m)")


def test_a_flight_within_one_block_is_refused(airmatrix: Run, town_file: Path) -> None:
    refusal = "origin and destination lie in one block, [2, 2, 0]"
    airmatrix("plan", "--airspace", town_file, *ends((2, 2, 0), (2, 2, 0))).assert_refused(refusal)


@pytest.mark.parametrize("aircraft", ["zeppelin", "", "[/b]", "[red]zeppelin"])
def test_an_unknown_aircraft_is_refused_with_the_known_ones(airmatrix: Run, town_file: Path, aircraft: str) -> None:
    outcome = airmatrix("plan", "--airspace", town_file, "--aircraft", aircraft, *ends((0, 0, 0), (1, 0, 0)))
    outcome.assert_refused(f"unknown aircraft type '{aircraft}'", "dji-mavic-air", "self-built-drone")


@pytest.mark.parametrize("departure", ["tomorrow", "2030-01-01T00:00:00", "2030-13-01T00:00:00Z", ""])
def test_a_departure_that_is_no_time_with_an_offset_is_refused(airmatrix: Run, town_file: Path, departure: str) -> None:
    outcome = airmatrix("plan", "--airspace", town_file, *ends((0, 0, 0), (1, 0, 0)), "--departure", departure)
    outcome.assert_misused("--departure")


@pytest.mark.parametrize("departure", ["1970-01-01T00:00:00Z", "9999-12-31T23:59:59.999Z"])
def test_any_time_can_be_planned_for(airmatrix: Run, town_file: Path, departure: str) -> None:
    outcome = airmatrix("plan", "--airspace", town_file, *ends((0, 0, 0), (1, 0, 0)), "--departure", departure)
    assert outcome.status == 0
    assert stops(outcome)[0][4] == departure[11:19] + (".999" if "." in departure else ".000")


def test_a_terminal_of_80_columns_shows_every_digit(airmatrix: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    outcome = airmatrix("plan", *DEPARTURE, "--from", 71.4200, 51.1160, 100, "--to", 71.4220, 51.1170, 100)
    assert outcome.status == 0
    assert "…" not in outcome.out


def test_a_missing_end_is_refused(airmatrix: Run) -> None:
    airmatrix("plan", "--from", *place((0, 0, 0))).assert_misused("--to")


def test_a_geojson_file_that_cannot_be_written_is_refused(airmatrix: Run, town_file: Path) -> None:
    options = ("--geojson", "nowhere/path.geojson", *ends((0, 0, 0), (1, 0, 0)))
    airmatrix("plan", "--airspace", town_file, *options).assert_refused("nowhere/path.geojson")


def test_an_airspace_file_that_is_none_is_refused(airmatrix: Run, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("not an airspace")
    airmatrix("plan", "--airspace", "notes.txt", *ends((0, 0, 0), (1, 0, 0))).assert_refused("notes.txt")


def test_an_aircraft_file_that_is_none_is_refused(airmatrix: Run, tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text('[[aircraft]]\nid = "half"\n')
    types = ("--aircraft-types", "own.toml")
    airmatrix("plan", *types, *ends((0, 0, 0), (1, 0, 0))).assert_refused("own.toml", "'half' lacks name")
