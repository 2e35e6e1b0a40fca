"""A quarter of a city to watch: eleven by eleven blocks in three layers, a tower in the middle, and a slow clock.

A second of the service takes ten of ours, so that flights stay where a test has put them.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx

from app.times import format_time, parse_time
from planner.airmatrix import AirMatrix
from planner.buildings import build_airspace, read_buildings
from planner.errors import Block
from tests.cli.serving import Server, serving
from tests.cli.town import GRID as TOWN
from tests.cli.town import building, building_file

GRID = AirMatrix(TOWN.epsg, TOWN.origin_x_m, TOWN.origin_y_m, 20.0, 40.0, (11, 11, 3))
TOWER = (5, 5)
ATTRIBUTION = "© the surveyors of <b>nowhere</b>"
SLOW = {"AIRMATRIX_CLOCK_START": "2026-11-22T08:00:00Z", "AIRMATRIX_CLOCK_RATE": "0.1"}


@contextmanager
def quarter(folder: Path, **variables: str) -> Iterator["Quarter"]:
    """Serve the quarter from a folder."""
    with (
        serving(folder, "--airspace", str(airspace(folder)), **variables) as server,
        httpx.Client(base_url=server.url, timeout=20.0) as http,
    ):
        yield Quarter(server, http)


def airspace(folder: Path) -> Path:
    """Write the quarter's airspace file into a folder and return its path."""
    window = {"epsg": GRID.epsg, "x0": GRID.origin_x_m, "y0": GRID.origin_y_m, "size_m": 220}
    buildings = building_file(folder / "buildings.geojson", building("tower", TOWER, height=100), window=window)
    path = folder / "quarter.geojson"
    data = replace(read_buildings(buildings), attribution=ATTRIBUTION)
    build_airspace(data, id="quarter", name="The Quarter", grid=GRID, ceiling_m=120.0).write(path)
    return path


class Quarter:
    """A client of the service that is watched."""

    def __init__(self, server: Server, http: httpx.Client) -> None:
        self.server = server
        self.url = server.url
        self._http = http

    def get(self, path: str, **parameters: str | int) -> Any:
        """Return the JSON of an answer."""
        answer = self._http.get(path, params=parameters)
        answer.raise_for_status()
        return answer.json()

    def now_ms(self) -> int:
        """Return the service's time."""
        return parse_time(self.get("/v1/airspace/status")["clock"]["now"])

    def fly(self, origin: Block, destination: Block, **changes: Any) -> dict[str, Any]:
        """Submit a flight that departs at once, and return it."""
        names = ("lon", "lat", "alt_m")
        body = {
            "operator": "acme-air",
            "aircraft_type": "dji-matrice-600-pro",
            "origin": dict(zip(names, place(origin), strict=True)),
            "destination": dict(zip(names, place(destination), strict=True)),
            "earliest_departure": format_time(self.now_ms()),
        }
        answer = self._http.post("/v1/flight-intents", json=body | changes)
        assert answer.status_code == 201, answer.text
        intent: dict[str, Any] = answer.json()
        return intent

    def activate(self, intent: dict[str, Any]) -> None:
        """Say that a flight is about to depart."""
        self._http.post(f"/v1/flight-intents/{intent['id']}/activate").raise_for_status()

    def post(self, path: str, body: object) -> Any:
        """Return the JSON of the answer to a POST that makes something."""
        answer = self._http.post(path, json=body)
        assert answer.status_code == 201, answer.text
        return answer.json()

    def delete(self, path: str) -> None:
        """Delete something."""
        self._http.delete(path).raise_for_status()

    def report(self, block: Block, **who: str) -> None:
        """Report an aircraft in the middle of a block."""
        lon, lat, alt_m = place(block)
        position = {"time": format_time(self.now_ms()), "lon": lon, "lat": lat, "alt_m": alt_m, "airborne": True}
        answer = self._http.post("/v1/telemetry", json={"positions": [who | position]})
        assert answer.json()["accepted"] == 1, answer.text


def place(block: Block) -> tuple[float, float, float]:
    """Return longitude, latitude and altitude of a block's centre."""
    i, j, k = block
    lon, lat = GRID.unproject(GRID.origin_x_m + 20 * i + 10, GRID.origin_y_m + 20 * j + 10)
    return float(lon), float(lat), 40.0 * k + 20
