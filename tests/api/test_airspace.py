"""The airspace over HTTP: what it is, who uses which block when."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.main import create_app
from app.routes.aircraft_types import AircraftTypeList
from app.routes.airspace import (
    AirspaceAnswer,
    BlockAnswer,
    FeatureCollection,
    OccupancyAnswer,
    StaticAnswer,
)
from app.routes.status import StatusAnswer
from app.times import format_time, parse_time
from planner.airmatrix import AirMatrix
from tests.api.bodies import SUBMIT, intent, problem
from tests.api.serving import Client, served, settings_for
from tests.ledger.district import AIRCRAFT, DEPARTURE_MS, OLD_TOWN, START_MS, STREET
from tests.ledger.locations import on_sqlite
from tests.ledger.process import FakeClock

STATUS = "/v1/airspace/status"
OCCUPANCY = "/v1/airspace/occupancy"
CLOCK = {"now": "2026-11-22T08:00:00.000Z", "rate": 1.0, "simulated": False}
LINK_MS = 1668
ARRIVAL_MS = DEPARTURE_MS + 7 * LINK_MS


@pytest.fixture
def flown(ledger: str, tmp_path: Path, clock: FakeClock) -> Iterator[Client]:
    """Return a client of a street that one flight uses from 08:01:00.000 to 08:01:11.676."""
    with served(create_app(settings_for(STREET, ledger, tmp_path), clock)) as client:
        assert client.post(SUBMIT, json=intent("W", "E", district=STREET)).status_code == 201
        yield client


def the_flight(client: Client) -> str:
    return str(client.get(SUBMIT).json()["items"][0]["id"])


def at(time_ms: int, **parameters: str) -> dict[str, Any]:
    return {"params": {"at": format_time(time_ms), **parameters}}


def blocks(answer: Any) -> list[list[int]]:
    return [entry["block"] for entry in answer.json()["blocks"]]


def corner(grid: AirMatrix, i: float, j: float) -> tuple[float, float]:
    """Return the degrees of a point of the grid, in blocks from its south-west corner."""
    lon, lat = grid.unproject(grid.origin_x_m + i * grid.block_side_m, grid.origin_y_m + j * grid.block_side_m)
    return float(lon), float(lat)


# What it is


@on_sqlite
def test_the_airspace_says_exactly_what_it_is(client: Client) -> None:
    answer = client.get("/v1/airspace").json()
    grid = OLD_TOWN.airspace.grid
    lon, lat = corner(grid, 0, 0)
    assert answer == {
        "id": "district",
        "name": "A district",
        "crs": "EPSG:32642",
        "bounds": list(grid.bounds),
        "origin": {"x": 668_920.0, "y": 5_665_220.0, "lon": lon, "lat": lat},
        "lattice": [[[round(degrees, 10) for degrees in corner(grid, i, j)] for i in (0, 4, 8)] for j in (0, 2.5, 5)],
        "block_side_m": 20.0,
        "block_height_m": 40.0,
        "dimensions": [8, 5, 2],
        "ceiling_m": 80.0,
        "ground_w84_m": None,
        "occupancy_rule": "containment",
        "search": "safe-interval",
        "statically_occupied": [4, 4],
        "attribution": "drawn by hand",
        "licence": "CC0",
        "fingerprint": OLD_TOWN.airspace.fingerprint,
        "settings": {
            "terminal_dwell_s": 0.0,
            "default_ground_hold_s": 300.0,
            "greedy_hover_limit_s": 60.0,
            "horizon_days": 30.0,
        },
    }
    AirspaceAnswer.model_validate(answer)


@on_sqlite
def test_buildings_are_geojson_with_heights(client: Client) -> None:
    response = client.get("/v1/airspace/buildings")
    answer = response.json()
    assert response.headers["content-type"] == "application/geo+json"
    assert set(answer) == {"type", "attribution", "licence", "features"}
    assert {feature["id"]: feature["properties"]["height"] for feature in answer["features"]} == {
        "building-3-2": 38.0,
        "building-6-0": 78.0,
        "building-6-1": 78.0,
        "building-7-1": 78.0,
    }
    assert {feature["geometry"]["type"] for feature in answer["features"]} == {"Polygon"}
    FeatureCollection.model_validate(answer)


@on_sqlite
@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ({}, [[6, 0, 0], [6, 1, 0], [7, 1, 0], [3, 2, 0], [6, 0, 1], [7, 0, 1], [6, 1, 1], [7, 1, 1]]),
        ({"layer": "0"}, [[6, 0, 0], [6, 1, 0], [7, 1, 0], [3, 2, 0]]),
        ({"layer": "1"}, [[6, 0, 1], [7, 0, 1], [6, 1, 1], [7, 1, 1]]),
    ],
)
def test_static_blocks_are_those_with_buildings(
    client: Client, parameters: dict[str, str], expected: list[list[int]]
) -> None:
    answer = client.get("/v1/airspace/static", params=parameters).json()
    assert answer == {"blocks": expected}
    StaticAnswer.model_validate(answer)


@on_sqlite
@pytest.mark.parametrize("path", ["/v1/airspace/static", STATUS, OCCUPANCY])
@pytest.mark.parametrize("layer", ["2", "-1", "top", "1" + "0" * 30])
def test_a_layer_that_does_not_exist_is_refused(client: Client, path: str, layer: str) -> None:
    answer = problem(client.get(path, params={"layer": layer}), 422, "validation-error")
    assert answer["errors"][0]["loc"] == ["query", "layer"]


@on_sqlite
def test_aircraft_types_are_the_paper_s(client: Client) -> None:
    answer = client.get("/v1/aircraft-types").json()
    assert set(answer) == {"items", "next_cursor"}
    assert {item["id"] for item in answer["items"]} == {
        "dji-mavic-air", "self-built-drone", "dji-phantom-4", "dji-matrice-600-pro", "dji-inspire-2",
    }  # fmt: skip
    AircraftTypeList.model_validate(answer)


@on_sqlite
def test_an_aircraft_type_has_its_speeds_at_full_power_and_as_planned(client: Client) -> None:
    items = client.get("/v1/aircraft-types").json()["items"]
    (phantom,) = [item for item in items if item["id"] == AIRCRAFT]
    assert set(phantom) == {
        "id", "name", "mass_kg", "max_vertical_speed_mps", "max_horizontal_speed_mps", "speed_factor", "endurance_s",
        "link_speeds_mps", "planned_link_speeds_mps",
    }  # fmt: skip
    # The two tilts are solved from the equations with blocks of 20 m x 20 m x 40 m (design: domain, 3).
    assert phantom["link_speeds_mps"] == pytest.approx(
        {"horizontal": 20, "vertical": 3, "alpha": 3.350, "beta": 3.664}, abs=5e-4
    )
    assert phantom["planned_link_speeds_mps"] == pytest.approx(
        {kind: 0.6 * speed for kind, speed in phantom["link_speeds_mps"].items()}
    )


# Status


def test_status_names_the_blocks_in_use_and_by_whom(flown: Client) -> None:
    answer = flown.get(STATUS, **at(DEPARTURE_MS + LINK_MS + 1)).json()
    flight = the_flight(flown)
    assert answer == {
        "at": format_time(DEPARTURE_MS + LINK_MS + 1),
        "clock": CLOCK,
        "removed_before": None,
        "positions_removed_before": None,
        "counts": {"green": 2, "yellow": 0, "red": 0},
        "blocks": [
            {"block": [i, 0, 0], "status": "green", "reasons": [], "flight_intents": [flight], "track_ids": []}
            for i in (1, 2)
        ],
    }
    StatusAnswer.model_validate(answer)


@pytest.mark.parametrize(
    ("time_ms", "columns"),
    [
        (DEPARTURE_MS - 1, []),
        (DEPARTURE_MS, [0, 1]),
        (DEPARTURE_MS + LINK_MS, [0, 1, 2]),
        (ARRIVAL_MS, [6, 7]),
        (ARRIVAL_MS + 1, []),
    ],
)
def test_status_is_exact_to_the_millisecond(flown: Client, time_ms: int, columns: list[int]) -> None:
    assert [block[0] for block in blocks(flown.get(STATUS, **at(time_ms)))] == columns


def test_status_is_of_now_by_default(flown: Client, clock: FakeClock) -> None:
    assert flown.get(STATUS).json() == {
        "at": "2026-11-22T08:00:00.000Z",
        "clock": CLOCK,
        "removed_before": None,
        "positions_removed_before": None,
        "counts": {"green": 0, "yellow": 0, "red": 0},
        "blocks": [],
    }
    clock.now_ms = DEPARTURE_MS
    assert blocks(flown.get(STATUS)) == [[0, 0, 0], [1, 0, 0]]


def test_status_of_the_past_comes_from_the_reservations(flown: Client, clock: FakeClock) -> None:
    clock.advance(seconds=86_400)
    assert blocks(flown.get(STATUS, **at(DEPARTURE_MS))) == [[0, 0, 0], [1, 0, 0]]


def test_a_flight_cancelled_before_departure_leaves_no_status(flown: Client) -> None:
    flown.delete(f"{SUBMIT}/{the_flight(flown)}")
    assert blocks(flown.get(STATUS, **at(DEPARTURE_MS))) == []


def test_a_flight_cancelled_in_the_air_stays_until_it_arrives(flown: Client, clock: FakeClock) -> None:
    clock.now_ms = DEPARTURE_MS
    flown.delete(f"{SUBMIT}/{the_flight(flown)}")
    assert blocks(flown.get(STATUS, **at(ARRIVAL_MS))) == [[6, 0, 0], [7, 0, 0]]
    assert blocks(flown.get(STATUS, **at(ARRIVAL_MS + 1))) == []


def test_a_long_flight_is_seen_among_short_ones(client: Client) -> None:
    """A status query looks back as far as the longest flight took."""
    long = client.post(SUBMIT, json=intent("A", (7, 4, 1), aircraft_type="self-built-drone")).json()
    for n in range(5):
        client.post(SUBMIT, json=intent("C", (1, 0, 0), earliest_ms=DEPARTURE_MS + 10_000 * n))
    last = long["reservations"][-1]
    status = client.get(STATUS, **at(parse_time(last["exit"]) - 1)).json()
    assert long["id"] in {flight for entry in status["blocks"] for flight in entry["flight_intents"]}


@pytest.mark.parametrize(("layer", "layers"), [(None, {0, 1}), ("0", {0}), ("1", {1})])
def test_status_of_one_layer_has_no_other(client: Client, layer: str | None, layers: set[int]) -> None:
    client.post(SUBMIT, json=intent("A", (0, 4, 1)))
    parameters = at(DEPARTURE_MS, **({} if layer is None else {"layer": layer}))
    answer = client.get(STATUS, **parameters)
    assert {block[2] for block in blocks(answer)} == layers
    assert answer.json()["counts"]["green"] == len(layers)


@pytest.mark.parametrize(("status", "count"), [("green", 2), ("yellow", 0), ("red", 0)])
def test_status_of_one_colour_has_no_other(flown: Client, status: str, count: int) -> None:
    assert len(blocks(flown.get(STATUS, **at(DEPARTURE_MS, status=status)))) == count


@on_sqlite
@pytest.mark.parametrize(
    ("west", "east", "columns"),
    [(-1.0, 9.0, [0, 1, 2]), (0.4, 0.6, [0]), (0.5, 1.5, [0, 1]), (1.5, 2.5, [1, 2]), (3.5, 8.0, []), (-2.0, -1.0, [])],
)
def test_status_within_a_box_has_the_blocks_that_meet_it(
    flown: Client, west: float, east: float, columns: list[int]
) -> None:
    grid = STREET.airspace.grid
    # North in the grid is a little west of true north: the box is high enough not to be turned inside out.
    box = [*corner(grid, west, 0.1), *corner(grid, east, 0.9)]
    answer = flown.get(STATUS, **at(DEPARTURE_MS + LINK_MS, bbox=",".join(map(str, box))))
    assert [block[0] for block in blocks(answer)] == columns
    assert answer.json()["counts"]["green"] == len(columns)


@on_sqlite
@pytest.mark.parametrize(("south", "north"), [(1.5, 2.0), (-2.0, -0.5)])
def test_status_within_a_box_north_or_south_of_the_street_is_empty(flown: Client, south: float, north: float) -> None:
    grid = STREET.airspace.grid
    box = [*corner(grid, 0, south), *corner(grid, 8, north)]
    assert blocks(flown.get(STATUS, **at(DEPARTURE_MS, bbox=",".join(map(str, box))))) == []


@on_sqlite
@pytest.mark.parametrize(
    "bbox", ["", "1,2,3", "1,2,3,4,5", "a,b,c,d", "72,51,71,52", "71,52,72,51", "nan,51,72,52", "71,51,72,nan"]
)
def test_a_box_that_is_none_is_refused(flown: Client, bbox: str) -> None:
    answer = problem(flown.get(STATUS, params={"bbox": bbox}), 422, "validation-error")
    assert [error["loc"] for error in answer["errors"]] == [["query", "bbox"]]


@on_sqlite
@pytest.mark.parametrize(
    ("parameter", "value"),
    [
        ("status", "idle"),
        ("f", "xml"),
        ("at", "2026-11-22T08:00:00"),
        ("at", "noon"),
        ("at", "9999-12-31T23:59:59.9999Z"),
        ("at", "9999-12-31T23:59:59-01:00"),
    ],
)
def test_a_status_that_cannot_be_given_is_refused(flown: Client, parameter: str, value: str) -> None:
    answer = problem(flown.get(STATUS, params={parameter: value}), 422, "validation-error")
    assert [error["loc"] for error in answer["errors"]] == [["query", parameter]]


@pytest.mark.parametrize("time", ["1970-01-01T00:00:00.000Z", "9999-12-31T23:59:59.999Z"])
def test_status_of_a_time_without_any_flight_is_empty(flown: Client, time: str) -> None:
    answer = flown.get(STATUS, params={"at": time}).json()
    assert (answer["at"], answer["blocks"]) == (time, [])


# GeoJSON


def test_status_as_geojson_has_footprints_and_heights(client: Client) -> None:
    client.post(SUBMIT, json=intent("A", (0, 4, 1)))
    response = client.get(STATUS, **at(DEPARTURE_MS, f="geojson"))
    answer = response.json()
    assert response.headers["content-type"] == "application/geo+json"
    assert set(answer) == {
        "type", "at", "clock", "removed_before", "positions_removed_before", "counts", "features",
    }  # fmt: skip
    assert answer["counts"] == {"green": 2, "yellow": 0, "red": 0}
    FeatureCollection.model_validate(answer)
    upper = answer["features"][1]
    assert set(upper) == {"type", "geometry", "properties"}
    (flight,) = upper["properties"]["flight_intents"]
    assert upper["properties"] == {
        "block": [0, 4, 1],
        "status": "green",
        "reasons": [],
        "flight_intents": [flight],
        "track_ids": [],
        "base_m": 40.0,
        "height_m": 40.0,
    }
    grid = OLD_TOWN.airspace.grid
    ring = [corner(grid, i, j) for i, j in [(0, 4), (1, 4), (1, 5), (0, 5), (0, 4)]]
    assert upper["geometry"]["type"] == "Polygon"
    assert np.array(upper["geometry"]["coordinates"]) == pytest.approx(np.array([ring]), rel=0, abs=1e-9)


@on_sqlite
@pytest.mark.parametrize(
    ("parameters", "accept", "media_type"),
    [
        ({}, "*/*", "application/json"),
        ({}, "application/json", "application/json"),
        ({}, "application/geo+json", "application/geo+json"),
        ({}, "application/geo+json, application/json;q=0.5", "application/geo+json"),
        ({"f": "geojson"}, "application/json", "application/geo+json"),
        ({"f": "json"}, "application/geo+json", "application/json"),
    ],
)
def test_f_chooses_the_format_and_without_it_accept_does(
    flown: Client, parameters: dict[str, str], accept: str, media_type: str
) -> None:
    response = flown.get(STATUS, headers={"Accept": accept}, **at(DEPARTURE_MS, **parameters))
    assert response.headers["content-type"] == media_type


# One block


def test_a_block_says_where_it_is_and_who_uses_it_when(flown: Client) -> None:
    answer = flown.get("/v1/airspace/blocks/1/0/0").json()
    grid = STREET.airspace.grid
    lons, lats = zip(*(corner(grid, i, j) for i in (1, 2) for j in (0, 1)), strict=True)
    assert answer == {
        "block": [1, 0, 0],
        "bounds": {
            "west": min(lons), "south": min(lats), "east": max(lons), "north": max(lats), "base_m": 0.0, "top_m": 40.0,
        },
        "statically_occupied": False,
        "status": "idle",
        "reasons": [],
        "constraints": [],
        "removed_before": None,
        "schedule": [
            {
                "flight_intent_id": the_flight(flown),
                "enter": format_time(DEPARTURE_MS),
                "exit": format_time(DEPARTURE_MS + 2 * LINK_MS + 1),
            }
        ],
    }  # fmt: skip
    BlockAnswer.model_validate(answer)


def test_a_block_has_the_status_of_now_whatever_the_span_asked_for(flown: Client, clock: FakeClock) -> None:
    clock.now_ms = DEPARTURE_MS
    answer = flown.get("/v1/airspace/blocks/1/0/0", params={"from": "2027-01-01T00:00:00Z"}).json()
    assert (answer["status"], answer["schedule"]) == ("green", [])


@on_sqlite
def test_a_block_with_a_building_says_so(client: Client) -> None:
    assert client.get("/v1/airspace/blocks/3/2/0").json()["statically_occupied"] is True
    assert client.get("/v1/airspace/blocks/3/2/1").json()["statically_occupied"] is False


@pytest.mark.parametrize(
    ("from_ms", "to_ms", "count"),
    [
        (DEPARTURE_MS + 2 * LINK_MS, None, 1),
        (DEPARTURE_MS + 2 * LINK_MS + 1, None, 0),
        (START_MS, DEPARTURE_MS, 0),
        (START_MS, DEPARTURE_MS + 1, 1),
        (START_MS, None, 1),
    ],
)
def test_a_schedule_has_the_reservations_that_overlap_its_span(
    flown: Client, from_ms: int, to_ms: int | None, count: int
) -> None:
    parameters = {"from": format_time(from_ms)} | ({} if to_ms is None else {"to": format_time(to_ms)})
    assert len(flown.get("/v1/airspace/blocks/1/0/0", params=parameters).json()["schedule"]) == count


def test_a_schedule_begins_now_by_default(flown: Client, clock: FakeClock) -> None:
    clock.now_ms = DEPARTURE_MS + 2 * LINK_MS + 1
    assert flown.get("/v1/airspace/blocks/1/0/0").json()["schedule"] == []


def test_a_schedule_is_in_the_order_of_time(flown: Client) -> None:
    for n in (3, 1, 2):
        flown.post(SUBMIT, json=intent("E", "W", district=STREET, earliest_ms=DEPARTURE_MS + 60_000 * n))
    enters = [entry["enter"] for entry in flown.get("/v1/airspace/blocks/1/0/0").json()["schedule"]]
    assert len(enters) == 4
    assert enters == sorted(enters)


@on_sqlite
@pytest.mark.parametrize("block", ["8/0/0", "0/5/0", "0/0/2", "0/0/" + "9" * 40])
def test_a_block_outside_the_airspace_is_unknown(client: Client, block: str) -> None:
    problem(client.get(f"/v1/airspace/blocks/{block}"), 404, "unknown-block")


@on_sqlite
@pytest.mark.parametrize("block", ["-1/0/0", "a/0/0", "0.5/0/0"])
def test_a_block_s_indices_are_whole_numbers_from_zero(client: Client, block: str) -> None:
    answer = problem(client.get(f"/v1/airspace/blocks/{block}"), 422, "validation-error")
    assert answer["errors"][0]["loc"] == ["path", "i"]


@on_sqlite
@pytest.mark.parametrize("path", ["/v1/airspace/blocks/0/0/0", OCCUPANCY])
@pytest.mark.parametrize("to", ["2026-11-22T08:00:00Z", "2026-11-22T07:59:59.999Z"])
def test_a_span_must_last(client: Client, path: str, to: str) -> None:
    answer = problem(client.get(path, params={"from": "2026-11-22T08:00:00Z", "to": to}), 422, "validation-error")
    assert answer["errors"] == [{"loc": ["query", "to"], "msg": "must be later than `from`", "type": "value_error"}]


# Occupancy


def test_occupancy_is_the_seconds_of_use_of_each_block(flown: Client) -> None:
    answer = flown.get(OCCUPANCY).json()
    # A block is held while the flight comes and while it goes; the first and the last for one link only.
    both, one = (2 * LINK_MS + 1) / 1000, (LINK_MS + 1) / 1000
    assert answer == {
        "from": "2026-11-22T08:00:00.000Z",
        "to": "2026-11-22T09:00:00.000Z",
        "removed_before": None,
        "blocks": [{"block": [i, 0, 0], "seconds": one if i in (0, 7) else both} for i in range(8)],
    }
    OccupancyAnswer.model_validate(answer)


def test_occupancy_counts_only_what_lies_within_the_span(flown: Client) -> None:
    span = {"from": format_time(DEPARTURE_MS + 1000), "to": format_time(DEPARTURE_MS + 2000)}
    assert flown.get(OCCUPANCY, params=span).json()["blocks"] == [
        {"block": [0, 0, 0], "seconds": 0.669},
        {"block": [1, 0, 0], "seconds": 1.0},
        {"block": [2, 0, 0], "seconds": 0.332},
    ]


def test_occupancy_adds_up_over_flights(flown: Client) -> None:
    flown.post(SUBMIT, json=intent("W", "E", district=STREET, earliest_ms=DEPARTURE_MS + 60_000))
    first = flown.get(OCCUPANCY).json()["blocks"][0]
    assert first == {"block": [0, 0, 0], "seconds": 2 * (LINK_MS + 1) / 1000}


@pytest.mark.parametrize(("layer", "layers"), [("0", {0}), ("1", {1})])
def test_occupancy_of_one_layer_has_no_other(client: Client, layer: str, layers: set[int]) -> None:
    client.post(SUBMIT, json=intent("A", (0, 4, 1)))
    answer = client.get(OCCUPANCY, params={"layer": layer})
    assert {block[2] for block in blocks(answer)} == layers


def test_occupancy_of_an_idle_hour_is_empty(flown: Client) -> None:
    answer = flown.get(OCCUPANCY, params={"from": "2026-11-22T10:00:00Z"}).json()
    assert (answer["to"], answer["blocks"]) == ("2026-11-22T11:00:00.000Z", [])


def test_a_cancelled_flight_takes_its_occupancy_with_it(flown: Client) -> None:
    flown.delete(f"{SUBMIT}/{the_flight(flown)}")
    assert flown.get(OCCUPANCY).json()["blocks"] == []
