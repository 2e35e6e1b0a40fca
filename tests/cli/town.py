"""A small town to fly in: ten by ten blocks in three layers, with two buildings, and flights along its rows.

The `hall` (50 m) fills the middle of block (4, 4) in the layers 0 and 1, the `shed` (10 m) that of (0, 9) in layer 0.
"""

import json
from pathlib import Path
from typing import Any

from app.routes.submissions import FlightIntentBody
from app.times import format_time
from planner.airmatrix import AirMatrix
from planner.buildings import build_airspace, read_buildings
from planner.errors import Block

GRID = AirMatrix(32642, 668_920.0, 5_665_220.0, 20.0, 40.0, (10, 10, 3))
WINDOW: dict[str, Any] = {"epsg": 32642, "x0": GRID.origin_x_m, "y0": GRID.origin_y_m, "size_m": 200}
HALL, SHED = (4, 4), (0, 9)
OCCUPIED: list[Block] = [(4, 4, 0), (0, 9, 0), (4, 4, 1)]

AIRCRAFT = "dji-matrice-600-pro"
# 20 m at 0.6 x 18 m/s, rounded up to an even millisecond.
LINK_MS = 1852


def building(id_: str, column: tuple[int, int], **properties: Any) -> dict[str, Any]:
    """Return a building that leaves 2 m free on all sides of one column's cell."""
    i, j = column
    west, south = GRID.origin_x_m + 20 * i + 2, GRID.origin_y_m + 20 * j + 2
    east, north = west + 16, south + 16
    lon, lat = GRID.unproject([west, east, east, west, west], [south, south, north, north, south])
    return {
        "type": "Feature",
        "properties": {"id": id_, **properties},
        "geometry": {"type": "Polygon", "coordinates": [[list(corner) for corner in zip(lon, lat, strict=True)]]},
    }


def building_file(path: Path, *features: dict[str, Any], window: dict[str, Any] | None, **members: Any) -> Path:
    """Write a building file and return its path."""
    metadata = {"attribution": "nobody", "licence": "CC0"} | ({} if window is None else {"window": window})
    document = {"type": "FeatureCollection", "metadata": metadata, "features": list(features), **members}
    path.write_text(json.dumps(document), encoding="utf-8")
    return path


def town_buildings(path: Path) -> Path:
    """Write the town's building file and return its path."""
    hall, shed = building("hall", HALL, height=50), building("shed", SHED, height=10)
    return building_file(path, hall, shed, window=WINDOW, name="town")


def town_airspace(folder: Path) -> Path:
    """Write the town's airspace file into a folder and return its path."""
    data = read_buildings(town_buildings(folder / "buildings.geojson"))
    path = folder / "town.geojson"
    build_airspace(data, id="town", name=data.name, grid=GRID, ceiling_m=120.0).write(path)
    return path


def place(block: Block) -> tuple[float, float, float]:
    """Return longitude, latitude and altitude of a block's centre."""
    i, j, k = block
    lon, lat = GRID.unproject(GRID.origin_x_m + 20 * i + 10, GRID.origin_y_m + 20 * j + 10)
    return float(lon), float(lat), 40.0 * k + 20


def flight(
    origin: Block, destination: Block, earliest_ms: int, latest_ms: int | None = None, **changes: Any
) -> FlightIntentBody:
    """Return the body of a flight between the centres of two blocks."""
    names = ("lon", "lat", "alt_m")
    body = {
        "operator": "acme-air",
        "aircraft_type": AIRCRAFT,
        "origin": dict(zip(names, place(origin), strict=True)),
        "destination": dict(zip(names, place(destination), strict=True)),
        "earliest_departure": format_time(earliest_ms),
        "latest_departure": None if latest_ms is None else format_time(latest_ms),
    }
    return FlightIntentBody.model_validate(body | changes)


def along_row(row: int, layer: int, earliest_ms: int, latest_ms: int | None = None, **changes: Any) -> FlightIntentBody:
    """Return the body of a flight along a whole row, from west to east: nine links, ten reservations."""
    return flight((0, row, layer), (9, row, layer), earliest_ms, latest_ms, **changes)
