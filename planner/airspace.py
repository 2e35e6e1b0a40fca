"""An airspace: a grid, its buildings, what they occupy, and the rules that flights keep in it.

An airspace file is a GeoJSON FeatureCollection of the buildings (a GIS opens it) with one foreign member,
``airmatrix``, that holds everything else.
"""

import base64
import hashlib
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from planner.airmatrix import AirMatrix
from planner.errors import AirspaceFileError, Block, DestinationBlocked, OriginBlocked

FORMAT = "airmatrix-airspace/1"

MAX_DWELL_MS = 3_600_000

BoolArray = npt.NDArray[np.bool_]


class OccupancyRule(StrEnum):
    """When a flight occupies a block: the paper's rule, or the one that keeps aircraft a block apart."""

    MIDPOINT = "midpoint"
    CONTAINMENT = "containment"


@dataclass(frozen=True)
class Building:
    """A footprint (GeoJSON Polygon or MultiPolygon geometry, WGS84 degrees) and its height above ground."""

    id: str
    height_m: float
    height_source: str
    footprint: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Airspace:
    """One AirMatrix airspace. `occupied` is flat over blocks; `terminal_dwell_ms` applies at both ends."""

    id: str
    name: str
    grid: AirMatrix
    ceiling_m: float
    occupied: BoolArray
    rule: OccupancyRule = OccupancyRule.CONTAINMENT
    terminal_dwell_ms: int = 0
    ground_w84_m: float | None = None
    attribution: str = ""
    licence: str = ""
    buildings: tuple[Building, ...] = ()

    def __post_init__(self) -> None:
        if self.occupied.shape != (self.grid.block_count,):
            raise AirspaceFileError(
                f"static occupancy has shape {self.occupied.shape}, the grid has {self.grid.block_count} blocks"
            )
        if not 0 <= self.terminal_dwell_ms <= MAX_DWELL_MS:
            raise AirspaceFileError("the terminal dwell must lie between 0 and an hour")
        self.occupied.setflags(write=False)

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 over all that decides whether a reservation is valid here: grid, occupancy, rule, dwell."""
        grid = self.grid
        facts = [
            grid.epsg, grid.origin_x_m, grid.origin_y_m, grid.block_side_m, grid.block_height_m,
            list(grid.dimensions), self.rule.value, self.terminal_dwell_ms,
        ]  # fmt: skip
        digest = hashlib.sha256(json.dumps(facts).encode())
        digest.update(np.packbits(self.occupied).tobytes())
        return digest.hexdigest()

    @property
    def occupied_per_layer(self) -> list[int]:
        """Number of statically occupied blocks in each layer, lowest first."""
        return [int(count) for count in self.occupied.reshape(self.grid.dimensions[2], -1).sum(axis=1)]

    def free_block_at(
        self, lon: float, lat: float, alt_m: float, if_blocked: type[OriginBlocked | DestinationBlocked]
    ) -> int:
        """Return the flat index of the free block that contains a position.

        Raises
        ------
        OutsideAirspace
        OriginBlocked, DestinationBlocked
            The one given as `if_blocked`, with the nearest free block.
        """
        block = self.grid.block_at(lon, lat, alt_m)
        if self.occupied[self.grid.index(block)]:
            nearest = self.nearest_free_block(lon, lat, alt_m)
            hint = "" if nearest is None else f"; the nearest free block is {list(nearest)}"
            raise if_blocked(f"{if_blocked.end} in block {list(block)}, which a building occupies{hint}", nearest)
        return self.grid.index(block)

    def nearest_free_block(self, lon: float, lat: float, alt_m: float) -> Block | None:
        """Return the free block whose centre is nearest to a position, None if there is none."""
        free = np.flatnonzero(~self.occupied)
        if free.size == 0:
            return None
        x, y = self.grid.project(lon, lat)
        offsets = self.grid.centres(free) - np.array([float(x), float(y), alt_m])
        return self.grid.block(int(free[np.argmin((offsets**2).sum(axis=1))]))

    def write(self, path: Path) -> None:
        """Write the airspace file, all of it or nothing."""
        grid = self.grid
        header = {
            "format": FORMAT,
            "id": self.id,
            "name": self.name,
            "epsg": grid.epsg,
            "origin_m": [grid.origin_x_m, grid.origin_y_m],
            "block_side_m": grid.block_side_m,
            "block_height_m": grid.block_height_m,
            "dimensions": list(grid.dimensions),
            "ceiling_m": self.ceiling_m,
            "occupancy_rule": self.rule.value,
            "terminal_dwell_ms": self.terminal_dwell_ms,
            "ground_w84_m": self.ground_w84_m,
            "attribution": self.attribution,
            "licence": self.licence,
            "fingerprint": self.fingerprint,
            "occupied_zlib_base64": base64.b64encode(zlib.compress(np.packbits(self.occupied).tobytes(), 9)).decode(),
        }
        lines = [json.dumps(building_feature(building), ensure_ascii=False) for building in self.buildings]
        text = (
            f'{{"type": "FeatureCollection", "airmatrix": {json.dumps(header, ensure_ascii=False)}, "features": [\n'
            + ",\n".join(lines)
            + "\n]}\n"
        )
        if path.exists() and not path.is_file():
            raise OSError(f"{path} is not a regular file")
        partial = path.with_name(f"{path.name}.partial")
        try:
            partial.write_text(text, encoding="utf-8")
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)


def building_feature(building: Building) -> dict[str, Any]:
    """Return a building as a GeoJSON feature."""
    return {
        "type": "Feature",
        "id": building.id,
        "properties": {
            "id": building.id,
            "height": building.height_m,
            "height_source": building.height_source,
        },
        "geometry": building.footprint,
    }


def read_airspace(path: Path) -> Airspace:
    """Read an airspace file.

    Raises
    ------
    AirspaceFileError
        The file cannot be read, is no airspace file, or its parts contradict each other.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise AirspaceFileError(f"cannot read airspace file {path}: {error}") from error
    header = document.get("airmatrix") if isinstance(document, dict) else None
    if not isinstance(header, dict):
        raise AirspaceFileError(
            f"{path} is not an airspace file; build one with: "
            "airmatrix airspace build --buildings FILE.geojson --out FILE"
        )
    if header.get("format") != FORMAT:
        raise AirspaceFileError(f"{path}: format {header.get('format')!r}, expected {FORMAT!r}")
    try:
        airspace = _airspace(header, document["features"])
    except (LookupError, TypeError, ValueError, OverflowError, zlib.error) as error:
        raise AirspaceFileError(f"{path} is damaged: {type(error).__name__}: {error}") from error
    if airspace.fingerprint != header.get("fingerprint"):
        raise AirspaceFileError(f"{path} is damaged: its content does not match its fingerprint")
    return airspace


def _airspace(header: dict[str, Any], features: list[dict[str, Any]]) -> Airspace:
    count_i, count_j, count_k = (int(count) for count in header["dimensions"])
    grid = AirMatrix(
        epsg=int(header["epsg"]),
        origin_x_m=float(header["origin_m"][0]),
        origin_y_m=float(header["origin_m"][1]),
        block_side_m=float(header["block_side_m"]),
        block_height_m=float(header["block_height_m"]),
        dimensions=(count_i, count_j, count_k),
    )
    packed = np.frombuffer(zlib.decompress(base64.b64decode(header["occupied_zlib_base64"])), dtype=np.uint8)
    ground = header["ground_w84_m"]
    return Airspace(
        id=str(header["id"]),
        name=str(header["name"]),
        grid=grid,
        ceiling_m=float(header["ceiling_m"]),
        occupied=np.unpackbits(packed, count=grid.block_count).astype(np.bool_),
        rule=OccupancyRule(header["occupancy_rule"]),
        terminal_dwell_ms=int(header["terminal_dwell_ms"]),
        ground_w84_m=None if ground is None else float(ground),
        attribution=str(header["attribution"]),
        licence=str(header["licence"]),
        buildings=tuple(
            Building(
                id=str(feature["properties"]["id"]),
                height_m=float(feature["properties"]["height"]),
                height_source=str(feature["properties"]["height_source"]),
                footprint=feature["geometry"],
            )
            for feature in features
        ),
    )
