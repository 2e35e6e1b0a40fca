"""Buildings: GeoJSON footprints and heights -> statically occupied blocks (paper 2.1).

A building is its footprint extruded from the ground to its height. It occupies a block when its footprint
overlaps the block's cell by more than 1e-6 m² and it is higher than the floor of the block's layer.
"""

import itertools
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import shapely

from planner.airmatrix import AirMatrix, IntArray
from planner.airspace import Airspace, BoolArray, Building, OccupancyRule
from planner.errors import BuildingDataError

MIN_OVERLAP_M2 = 1e-6
METRES_PER_LEVEL = 3.0
ROOF_M = 3.0
_MAX_HEIGHT_M = 10_000.0
_MAX_LEVELS = 1_000.0

# Neighbours often overlap by slivers; from this share of the smaller footprint on it is worth a warning.
_OVERLAP_SHARE = 0.01

_WGS84_NAME = re.compile(r"(CRS84|EPSG:+4326|EPSG:[\d.]*:4326)$", re.IGNORECASE)
_NUMBER = re.compile(r"\s*(\d+\.?\d*|\.\d+)\s*m?\s*")
_FLAT_TYPES = ("Point", "MultiPoint", "LineString", "MultiLineString")
_FOOTPRINT_TYPES = ("Polygon", "MultiPolygon")

Geometries = npt.NDArray[np.object_]
Progress = Callable[[int], None]


@dataclass(frozen=True)
class Window:
    """The extent a building file was made for: origin is the south-west corner, size is (east, north)."""

    epsg: int
    origin_m: tuple[float, float]
    size_m: tuple[float, float]


@dataclass(frozen=True)
class BuildingData:
    """What a building file holds. `warnings` counts in plain words what was repaired, assumed or skipped."""

    buildings: tuple[Building, ...]
    name: str = ""
    attribution: str = ""
    licence: str = ""
    window: Window | None = None
    warnings: Mapping[str, int] = field(default_factory=dict)


class _Feature(NamedTuple):
    id: str
    properties: dict[str, Any]
    geometry: dict[str, Any]


def read_buildings(path: Path, default_height_m: float | None = None) -> BuildingData:
    """Read a GeoJSON FeatureCollection of building footprints in WGS84 longitude and latitude.

    Heights are metres above ground: ``height`` (a number, or a text like "12" or "12 m"); else 3 m times
    ``building:levels`` plus 3 m for the roof; else `default_height_m`. Values that are not positive, or more
    than 10 km or 1000 levels, count as missing. Polygons are made valid, keeping all that an outer ring
    encloses; points and lines are skipped. Attribution, licence and window come from the ``metadata`` member.

    Raises
    ------
    BuildingDataError
        The file cannot be read, is not such a collection, is in another CRS, has a malformed footprint, or
        lacks heights while there is no default.
    """
    if default_height_m is not None and not 0 < default_height_m <= _MAX_HEIGHT_M:
        raise BuildingDataError(f"the default height must be a number of metres above 0, not {default_height_m}")
    document = _document(path)
    warnings: Counter[str] = Counter()
    try:
        _check_crs(document.get("crs"))
        features, footprints = _footprints(_features(document["features"], warnings), warnings)
        buildings = _buildings(features, footprints, default_height_m, warnings)
        metadata = document.get("metadata")
        metadata = metadata if isinstance(metadata, dict) else {}
        window = _window(metadata.get("window"))
    except BuildingDataError as error:
        raise BuildingDataError(f"{path}: {error}") from error
    warnings["pairs of footprints that overlap"] = _count_overlapping(footprints)
    return BuildingData(
        buildings=buildings,
        name=str(document.get("name") or path.stem),
        attribution=str(metadata.get("attribution") or ""),
        licence=str(metadata.get("licence") or metadata.get("license") or ""),
        window=window,
        warnings=dict(+warnings),
    )


def statically_occupied(
    grid: AirMatrix, buildings: Sequence[Building], on_progress: Progress | None = None
) -> BoolArray:
    """Return which blocks of the grid buildings occupy: flat over blocks.

    `on_progress` is called with the number of buildings done, after each.

    Raises
    ------
    BuildingDataError
        A footprint cannot be projected to the grid's CRS.
    """
    return _occupied(grid, _local_footprints(grid, buildings), buildings, on_progress)


def build_airspace(
    data: BuildingData,
    *,
    id: str,  # noqa: A002 - the airspace's own word
    name: str,
    grid: AirMatrix,
    ceiling_m: float,
    rule: OccupancyRule = OccupancyRule.CONTAINMENT,
    terminal_dwell_ms: int = 0,
    ground_w84_m: float | None = None,
    on_progress: Progress | None = None,
) -> Airspace:
    """Return the airspace of a grid among these buildings; those farther than a block side away are left out.

    Raises
    ------
    BuildingDataError
        The grid lies outside its CRS's area of use, no building overlaps it though there are some, or a
        footprint cannot be projected.
    AirspaceFileError
        The CRS is unknown or not in metres.
    """
    _check_area_of_use(grid)
    footprints = _local_footprints(grid, data.buildings)
    if data.buildings and not shapely.intersects(footprints, _grid_box(grid, 0.0)).any():
        west, south, east, north = grid.bounds
        raise BuildingDataError(
            f"none of the {len(data.buildings)} buildings overlaps the window (lon {west:.5f} to {east:.5f}, "
            f"lat {south:.5f} to {north:.5f}); check --epsg, --origin and that longitude comes first"
        )
    near = shapely.intersects(footprints, _grid_box(grid, grid.block_side_m))
    return Airspace(
        id=id,
        name=name,
        grid=grid,
        ceiling_m=ceiling_m,
        occupied=_occupied(grid, footprints, data.buildings, on_progress),
        rule=rule,
        terminal_dwell_ms=terminal_dwell_ms,
        ground_w84_m=ground_w84_m,
        attribution=data.attribution,
        licence=data.licence,
        buildings=tuple(building for building, keep in zip(data.buildings, near, strict=True) if keep),
    )


def shipped_airspace() -> Airspace:
    """Return the airspace that comes with AirMatrix: 2 km x 2 km of Astana, blocks of 20 m x 20 m x 40 m."""
    data = read_buildings(Path(str(files("planner") / "airspaces" / "astana_2km.geojson")))
    if data.window is None:
        raise BuildingDataError("the shipped building data has lost its window")
    grid = AirMatrix.covering(
        epsg=data.window.epsg,
        origin_m=data.window.origin_m,
        size_m=data.window.size_m,
        ceiling_m=120.0,
        block_side_m=20.0,
        block_height_m=40.0,
    )
    return build_airspace(data, id="astana-2km", name="Astana, left bank, 2 km", grid=grid, ceiling_m=120.0)


def _document(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"), parse_constant=_refuse_constant)
    except (OSError, ValueError, RecursionError) as error:
        raise BuildingDataError(f"cannot read buildings from {path}: {error}") from error
    if not isinstance(document, dict) or document.get("type") != "FeatureCollection":
        raise BuildingDataError(f"{path} is not a GeoJSON FeatureCollection")
    if not isinstance(document.get("features"), list):
        raise BuildingDataError(f"{path}: a FeatureCollection needs a list of features")
    return document


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")


def _check_crs(crs: Any) -> None:
    """Refuse the ``crs`` member of old GeoJSON unless it names WGS84."""
    if crs is None:
        return
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    if not isinstance(name, str) or not _WGS84_NAME.search(name):
        raise BuildingDataError(f"its CRS is {name or crs!r}; convert it to WGS84 longitude and latitude (EPSG:4326)")


def _features(members: list[Any], warnings: Counter[str]) -> list[_Feature]:
    """Return the polygonal features; those that harmlessly have no polygon are counted."""
    features = []
    for index, member in enumerate(members):
        feature = _feature(member, index)
        kind = feature.geometry.get("type")
        if kind in _FOOTPRINT_TYPES:
            features.append(feature)
        elif kind in _FLAT_TYPES:
            warnings["points and lines skipped"] += 1
        elif not feature.geometry:
            warnings["features without geometry skipped"] += 1
        else:
            raise BuildingDataError(f"feature {feature.id!r}: geometry is {kind!r}, not a Polygon or MultiPolygon")
    return features


def _feature(member: Any, index: int) -> _Feature:
    if isinstance(member, dict):
        properties, geometry = member.get("properties") or {}, member.get("geometry") or {}
        if isinstance(properties, dict) and isinstance(geometry, dict):
            ids = (member.get("id"), properties.get("id"), f"feature-{index}")
            return _Feature(next(str(id_) for id_ in ids if id_ is not None), properties, geometry)
    raise BuildingDataError(f"features[{index}] is not a GeoJSON feature")


def _footprints(features: list[_Feature], warnings: Counter[str]) -> tuple[list[_Feature], Geometries]:
    """Return the features whose polygons enclose an area, and these polygons, valid."""
    footprints = parsed([feature.geometry for feature in features])
    for feature, footprint in zip(features, footprints, strict=True):
        if footprint is None:
            raise BuildingDataError(
                f"feature {feature.id!r}: malformed polygon (positions must be numbers, rings closed)"
            )
    # Empty polygons have NaN bounds, which compare as inside.
    remote = (np.abs(shapely.bounds(footprints)) > (180, 90, 180, 90)).any(axis=1)
    if remote.any():
        raise BuildingDataError(
            f"{remote.sum()} of {len(features)} polygons are not in degrees of longitude and latitude"
            f" (first: {features[np.argmax(remote)].id!r}); convert the file to WGS84 (EPSG:4326)"
        )
    repaired = _repair(footprints)
    solid = shapely.area(footprints) > 0
    warnings["invalid polygons repaired"] += int(np.count_nonzero(repaired & solid))
    warnings["polygons without area skipped"] += int(np.count_nonzero(~solid))
    if not solid.any():
        raise BuildingDataError("no polygon in it could be a building")
    return [feature for feature, keep in zip(features, solid, strict=True) if keep], footprints[solid]


def parsed(geometries: Sequence[Mapping[str, Any]]) -> Geometries:
    """Return two-dimensional shapes of GeoJSON geometries, None where malformed."""
    shapes: Geometries = np.empty(len(geometries), dtype=object)
    with np.errstate(over="ignore"):
        shapes[:] = shapely.from_geojson([json.dumps(geometry) for geometry in geometries], on_invalid="ignore")
    return np.asarray(shapely.force_2d(shapes))


def _repair(footprints: Geometries) -> npt.NDArray[np.bool_]:
    """Make polygons valid in place, keeping every area that a ring encloses; return which were invalid."""
    invalid: npt.NDArray[np.bool_] = ~shapely.is_valid(footprints)
    footprints[invalid] = shapely.make_valid(footprints[invalid], method="structure", keep_collapsed=False)
    return invalid


def _buildings(
    features: list[_Feature], footprints: Geometries, default_height_m: float | None, warnings: Counter[str]
) -> tuple[Building, ...]:
    buildings, without_height = [], []
    taken: set[str] = set()
    for feature, geometry in zip(features, shapely.to_geojson(footprints), strict=True):
        height_m, source = _height(feature.properties, warnings)
        if height_m is None:
            without_height.append(feature.id)
            height_m, source = float(default_height_m or math.nan), "default"
        buildings.append(Building(_unique(feature.id, taken, warnings), height_m, source, json.loads(geometry)))
    if without_height and default_height_m is None:
        raise BuildingDataError(
            f"{len(without_height)} of {len(features)} buildings have neither height nor building:levels "
            f"(first: {without_height[0]!r}); give the height to assume for them with --default-height METRES"
        )
    warnings["heights assumed by default"] += len(without_height)
    return tuple(buildings)


def _height(properties: dict[str, Any], warnings: Counter[str]) -> tuple[float | None, str]:
    """Return height in metres and where it comes from."""
    stated = properties.get("height")
    if (height_m := _positive_number(stated, _MAX_HEIGHT_M)) is not None:
        source = str(properties.get("height_source") or "height")
        warnings["heights assumed in the data"] += source.startswith("assumed")
        return height_m, source
    warnings["unusable heights ignored"] += stated is not None
    if (levels := _positive_number(properties.get("building:levels"), _MAX_LEVELS)) is not None:
        warnings["heights derived from building:levels"] += 1
        return METRES_PER_LEVEL * levels + ROOF_M, "building:levels"
    return None, ""


def _positive_number(value: Any, limit: float) -> float | None:
    """Return a number, or a text like "12" or "12.5 m", if it is above 0 and at most `limit`."""
    if isinstance(value, str) and _NUMBER.fullmatch(value):
        value = float(value.strip().rstrip("m"))
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= limit:
        return None
    return float(value)


def _unique(wanted: str, taken: set[str], warnings: Counter[str]) -> str:
    """Return an id that no building has yet, and take it."""
    copies = (f"{wanted}-{copy}" for copy in itertools.count(2))
    unique = next(id_ for id_ in itertools.chain([wanted], copies) if id_ not in taken)
    warnings["repeated ids made unique"] += unique != wanted
    taken.add(unique)
    return unique


def _window(window: Any) -> Window | None:
    if window is None:
        return None
    try:
        size = window["size_m"]
        east, north = size if isinstance(size, list) else (size, size)
        origin_m = (float(window["x0"]), float(window["y0"]))
        return Window(int(window["epsg"]), origin_m, (float(east), float(north)))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise BuildingDataError(
            "metadata.window needs epsg, x0, y0 (its south-west corner) and size_m (side, or east and north)"
        ) from error


def _count_overlapping(footprints: Geometries) -> int:
    """Count pairs that share more than a sliver of the smaller footprint."""
    first, second = shapely.STRtree(footprints).query(footprints, predicate="intersects")
    first, second = first[first < second], second[first < second]
    shared = shapely.area(shapely.intersection(footprints[first], footprints[second]))
    area = shapely.area(footprints)
    return int(np.count_nonzero(shared > _OVERLAP_SHARE * np.minimum(area[first], area[second])))


def _local_footprints(grid: AirMatrix, buildings: Sequence[Building]) -> Geometries:
    footprints = local_shapes(grid, parsed([building.footprint for building in buildings]))
    lost = shapely.is_missing(footprints)
    if lost.any():
        first = buildings[int(np.argmax(lost))]
        raise BuildingDataError(f"building {first.id!r} lies where EPSG:{grid.epsg} is undefined; check --epsg")
    return footprints


def local_shapes(grid: AirMatrix, shapes: Geometries) -> Geometries:
    """Return valid shapes in projected metres from the grid's origin: vertices projected, edges straight; None for
    those that lie where the projection is undefined.
    """
    degrees, owner = shapely.get_coordinates(shapes, return_index=True)
    x, y = grid.project(degrees[:, 0], degrees[:, 1])
    local = np.column_stack([x - grid.origin_x_m, y - grid.origin_y_m])
    lost = ~np.isfinite(local).all(axis=1)
    local[lost] = 0.0
    projected: Geometries = np.asarray(shapely.set_coordinates(shapes.copy(), local))
    _repair(projected)
    projected[owner[lost]] = None
    return projected


def _check_area_of_use(grid: AirMatrix) -> None:
    west, south, east, north = grid.extent_m
    lon, lat = (float(degrees) for degrees in grid.unproject((west + east) / 2, (south + north) / 2))
    area = grid.crs.area_of_use
    if area is None:
        return
    width = (area.east - area.west) % 360 or 360  # an area may cross the antimeridian
    if not ((lon - area.west) % 360 <= width and area.south <= lat <= area.north):
        raise BuildingDataError(
            f"the window's centre (lon {lon:.5f}, lat {lat:.5f}) lies outside the area of use "
            f"of EPSG:{grid.epsg} ({area.name}); check --epsg and --origin"
        )


def _grid_box(grid: AirMatrix, margin_m: float) -> shapely.Polygon:
    west, south, east, north = grid.extent_m
    return shapely.box(-margin_m, -margin_m, east - west + margin_m, north - south + margin_m)


def _occupied(
    grid: AirMatrix, footprints: Geometries, buildings: Sequence[Building], on_progress: Progress | None
) -> BoolArray:
    count_i, count_j, count_k = grid.dimensions
    highest_m = np.zeros((count_j, count_i))
    for done, (footprint, building) in enumerate(zip(footprints, buildings, strict=True), start=1):
        if not footprint.is_empty:
            cells = overlapped_cells(grid, footprint)
            highest_m[cells] = np.maximum(highest_m[cells], building.height_m)
        if on_progress is not None:
            on_progress(done)
    floor_m = np.arange(count_k) * grid.block_height_m
    occupied: BoolArray = highest_m > floor_m[:, np.newaxis, np.newaxis]
    return occupied.ravel()


def overlapped_cells(grid: AirMatrix, footprint: Any) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the cells that a footprint overlaps by more than `MIN_OVERLAP_M2`."""
    side = grid.block_side_m
    west, south, east, north = np.array(footprint.bounds) / side
    first_i, end_i = max(0, math.floor(west)), min(grid.dimensions[0], math.ceil(east))
    first_j, end_j = max(0, math.floor(south)), min(grid.dimensions[1], math.ceil(north))
    i = np.tile(np.arange(first_i, end_i), max(0, end_j - first_j))
    j = np.repeat(np.arange(first_j, end_j), max(0, end_i - first_i))
    cells = shapely.box(i * side, j * side, (i + 1) * side, (j + 1) * side)
    shapely.prepare(footprint)
    overlapped = shapely.contains_properly(footprint, cells)
    partly = np.flatnonzero(~overlapped & shapely.intersects(footprint, cells))
    overlapped[partly] = shapely.area(shapely.intersection(footprint, cells[partly])) > MIN_OVERLAP_M2
    return j[overlapped], i[overlapped]
