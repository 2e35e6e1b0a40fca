"""The airspace: what it is, what buildings take of it, who uses it when."""

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
import orjson
from fastapi import APIRouter, Header, Path, Query, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field

from app import problems
from app.block_status import BlockStatus, Status, statuses
from app.errors import UnknownBlock
from app.routes.flight_intents import BlockIndices
from app.service import Service, ServiceDep
from app.times import LATEST_MS, Moment, Timestamp, format_time
from planner.airmatrix import AirMatrix
from planner.airspace import building_feature

router = APIRouter(prefix="/v1/airspace", tags=["airspace"])

GEOJSON = "application/geo+json"
_DEFAULT_SPAN_MS = 3_600_000

Layer = Annotated[int | None, Query(ge=0, description="Layer k, zero-based; all layers by default.")]
Index = Annotated[int, Path(ge=0)]
RemovedBefore = Annotated[
    Moment | None, Field(description="Flights that ended before this may have been removed; null: none has been.")
]


class Origin(BaseModel):
    """The grid's lower south-west corner, projected (metres) and geodetic."""

    x: float
    y: float
    lon: float
    lat: float


class AirspaceSettings(BaseModel):
    """Settings that bear on plans."""

    terminal_dwell_s: float
    default_ground_hold_s: float
    greedy_hover_limit_s: float
    horizon_days: float


class AirspaceAnswer(BaseModel):
    """The airspace."""

    id: str
    name: str
    crs: str
    bounds: Annotated[list[float], Field(min_length=4, max_length=4)]
    origin: Origin
    block_side_m: float
    block_height_m: float
    dimensions: BlockIndices
    ceiling_m: float
    ground_w84_m: float | None
    occupancy_rule: str
    search: str
    statically_occupied: list[int]
    attribution: str
    licence: str
    fingerprint: str
    settings: AirspaceSettings


class FeatureCollection(BaseModel):
    """GeoJSON (RFC 7946)."""

    type: Literal["FeatureCollection"]
    features: list[dict[str, Any]]


_FEATURES = FeatureCollection.model_json_schema()


class StaticAnswer(BaseModel):
    """Statically occupied blocks."""

    blocks: list[BlockIndices]


class BlockStatusAnswer(BaseModel):
    """A block in use."""

    block: BlockIndices
    status: Status
    reasons: list[str]
    flight_intents: list[str]


class StatusAnswer(BaseModel):
    """The blocks in use at one time; blocks that are not listed are idle."""

    at: Moment
    removed_before: RemovedBefore
    counts: dict[Status, int]
    blocks: list[BlockStatusAnswer]


class BlockBounds(BaseModel):
    """A block's extent: degrees, and metres above the ground datum."""

    west: float
    south: float
    east: float
    north: float
    base_m: float
    top_m: float


class ScheduleEntry(BaseModel):
    """A reservation of the block."""

    flight_intent_id: str
    enter: Moment
    exit: Moment


class BlockAnswer(BaseModel):
    """One block: where it is, its status now, and its reservations in a time span."""

    block: BlockIndices
    bounds: BlockBounds
    statically_occupied: bool
    status: Literal["idle"] | Status
    reasons: list[str]
    removed_before: RemovedBefore
    schedule: list[ScheduleEntry]


class BlockUse(BaseModel):
    """How long a block is reserved within a time span."""

    block: BlockIndices
    seconds: float


class OccupancyAnswer(BaseModel):
    """Seconds of reserved time of each block in use."""

    from_: Annotated[Moment, Field(alias="from")]
    to: Moment
    removed_before: RemovedBefore
    blocks: list[BlockUse]


@router.get("", responses=problems.documented(), summary="Read the airspace")
def read(service: ServiceDep) -> AirspaceAnswer:
    """Return the grid, its rules and what buildings take of it."""
    airspace, settings = service.airspace, service.settings
    grid = airspace.grid
    lon, lat = grid.unproject(grid.origin_x_m, grid.origin_y_m)
    return AirspaceAnswer(
        id=airspace.id,
        name=airspace.name,
        crs=f"EPSG:{grid.epsg}",
        bounds=list(grid.bounds),
        origin=Origin(x=grid.origin_x_m, y=grid.origin_y_m, lon=float(lon), lat=float(lat)),
        block_side_m=grid.block_side_m,
        block_height_m=grid.block_height_m,
        dimensions=grid.dimensions,
        ceiling_m=airspace.ceiling_m,
        ground_w84_m=airspace.ground_w84_m,
        occupancy_rule=airspace.rule.value,
        search=settings.search.value,
        statically_occupied=airspace.occupied_per_layer,
        attribution=airspace.attribution,
        licence=airspace.licence,
        fingerprint=airspace.fingerprint,
        settings=AirspaceSettings(
            terminal_dwell_s=airspace.terminal_dwell_ms / 1000,
            default_ground_hold_s=settings.ground_hold_s,
            greedy_hover_limit_s=settings.hover_limit_s,
            horizon_days=settings.horizon_days,
        ),
    )


@router.get(
    "/buildings",
    response_class=Response,
    responses={200: {"content": {GEOJSON: {"schema": _FEATURES}}}, **problems.documented()},
    summary="Read the buildings",
)
def read_buildings(service: ServiceDep) -> Response:
    """Return footprints with `height` in metres, as GeoJSON."""
    features = [building_feature(building) for building in service.airspace.buildings]
    return _geojson(features, attribution=service.airspace.attribution, licence=service.airspace.licence)


@router.get(
    "/static",
    response_class=Response,
    responses={200: {"model": StaticAnswer}, **problems.documented(422)},
    summary="List statically occupied blocks",
)
def list_static(service: ServiceDep, layer: Layer = None) -> Response:
    """Return the blocks that buildings occupy."""
    blocks = service.airspace.grid.ijk(np.flatnonzero(service.airspace.occupied))
    if layer is not None:
        _check_layer(service, layer)
        blocks = blocks[blocks[:, 2] == layer]
    content = orjson.dumps({"blocks": np.ascontiguousarray(blocks)}, option=orjson.OPT_SERIALIZE_NUMPY)
    return Response(content, media_type="application/json")


@router.get(
    "/status",
    response_class=Response,
    responses={
        200: {"model": StatusAnswer, "content": {GEOJSON: {"schema": _FEATURES}}},
        **problems.documented(422, 503),
    },
    summary="Status of the blocks in use",
)
def read_status(
    service: ServiceDep,
    at: Annotated[Timestamp | None, Query(description="Default: now. Past and future come from reservations.")] = None,
    layer: Layer = None,
    bbox: Annotated[str | None, Query(description="west,south,east,north in degrees")] = None,
    status: Status | None = None,
    f: Annotated[Literal["json", "geojson"] | None, Query(description="Answer format.")] = None,
    accept: Annotated[str | None, Header()] = None,
) -> Response:
    """Return green, yellow and red blocks. Without telemetry, which comes later, every reserved block is green."""
    grid = service.airspace.grid
    at_ms = service.clock() if at is None else at
    held, ids = service.ledger.held_between(at_ms, at_ms + 1)
    in_use = statuses(held)
    keep = _within(grid, np.array([entry.block for entry in in_use], dtype=np.int64), bbox)
    if layer is not None:
        _check_layer(service, layer)
    shown = [
        entry
        for entry, inside in zip(in_use, keep.tolist(), strict=True)
        if inside and status in (None, entry.status) and layer in (None, grid.block(entry.block)[2])
    ]
    blocks = [_block_status(grid, entry, ids) for entry in shown]
    if f == "geojson" or (f is None and GEOJSON in (accept or "")):
        return _geojson(
            [
                {
                    "type": "Feature",
                    "geometry": _footprint(grid, entry.block),
                    "properties": {**block, **_height(grid, entry)},
                }
                for entry, block in zip(shown, blocks, strict=True)
            ],
            at=format_time(at_ms),
            removed_before=_removed_before(service),
        )
    counts = {color.value: sum(entry.status is color for entry in shown) for color in Status}
    content = {
        "at": format_time(at_ms),
        "removed_before": _removed_before(service),
        "counts": counts,
        "blocks": blocks,
    }
    return Response(orjson.dumps(content), media_type="application/json")


@router.get(
    "/blocks/{i}/{j}/{k}",
    responses=problems.documented(404, 422, 503),
    summary="Read one block and its schedule",
)
def read_block(
    service: ServiceDep,
    i: Index,
    j: Index,
    k: Index,
    from_: Annotated[Timestamp | None, Query(alias="from", description="Default: now.")] = None,
    to: Annotated[Timestamp | None, Query(description="Default: all that is reserved.")] = None,
) -> BlockAnswer:
    """Return a block's bounds, its status now, and the reservations that overlap [from, to)."""
    grid = service.airspace.grid
    if not grid.contains((i, j, k)):
        raise UnknownBlock(f"there is no block {[i, j, k]}; the airspace has {list(grid.dimensions)} blocks")
    block = grid.index((i, j, k))
    now_ms = service.clock()
    from_ms, to_ms = _span(now_ms if from_ is None else from_, LATEST_MS if to is None else to)
    held, ids = service.ledger.held_between(from_ms, to_ms, block)
    present = statuses(service.ledger.held_between(now_ms, now_ms + 1, block)[0])
    x, y, base_m = (
        grid.centres(np.array([block]))[0] - np.array([grid.block_side_m, grid.block_side_m, grid.block_height_m]) / 2
    )
    lon, lat = grid.unproject([x, x + grid.block_side_m] * 2, [y, y, y + grid.block_side_m, y + grid.block_side_m])
    return BlockAnswer(
        block=(i, j, k),
        bounds=BlockBounds(
            west=float(lon.min()),
            south=float(lat.min()),
            east=float(lon.max()),
            north=float(lat.max()),
            base_m=float(base_m),
            top_m=float(base_m) + grid.block_height_m,
        ),
        statically_occupied=bool(service.airspace.occupied[block]),
        status=present[0].status if present else "idle",
        reasons=list(present[0].reasons) if present else [],
        removed_before=service.ledger.removed().before_ms,
        schedule=[
            ScheduleEntry(flight_intent_id=ids[sequence], enter=enter, exit=leave)
            for sequence, enter, leave in zip(
                held.sequence.tolist(), held.enter_ms.tolist(), held.exit_ms.tolist(), strict=True
            )
        ],
    )


@router.get(
    "/occupancy",
    response_class=Response,
    responses={200: {"model": OccupancyAnswer}, **problems.documented(422, 503)},
    summary="Seconds of use of each block",
)
def read_occupancy(
    service: ServiceDep,
    from_: Annotated[Timestamp | None, Query(alias="from", description="Default: now.")] = None,
    to: Annotated[Timestamp | None, Query(description="Default: an hour after `from`.")] = None,
    layer: Layer = None,
) -> Response:
    """Return how long each block is reserved within [from, to): the paper's heat map."""
    grid = service.airspace.grid
    start = service.clock() if from_ is None else from_
    from_ms, to_ms = _span(start, start + _DEFAULT_SPAN_MS if to is None else to)
    block, use_ms = service.ledger.use_between(from_ms, to_ms)
    indices, seconds = grid.ijk(block), use_ms / 1000
    if layer is not None:
        _check_layer(service, layer)
        indices, seconds = indices[indices[:, 2] == layer], seconds[indices[:, 2] == layer]
    content = {
        "from": format_time(from_ms),
        "to": format_time(to_ms),
        "removed_before": _removed_before(service),
        "blocks": [{"block": ijk, "seconds": use} for ijk, use in zip(indices.tolist(), seconds.tolist(), strict=True)],
    }
    return Response(orjson.dumps(content), media_type="application/json")


def _invalid(parameter: str, message: str) -> RequestValidationError:
    return RequestValidationError([{"loc": ("query", parameter), "msg": message, "type": "value_error"}])


def _check_layer(service: Service, layer: int) -> None:
    layers = service.airspace.grid.dimensions[2]
    if layer >= layers:
        raise _invalid("layer", f"the airspace has layers 0 to {layers - 1}")


def _span(from_ms: int, to_ms: int) -> tuple[int, int]:
    if to_ms <= from_ms:
        raise _invalid("to", "must be later than `from`")
    return from_ms, to_ms


def _within(grid: AirMatrix, blocks: Any, bbox: str | None) -> Any:
    """Tell for each block whether its footprint's bounds meet a bounding box, shape (n,)."""
    if bbox is None:
        return np.ones(len(blocks), dtype=np.bool_)
    try:
        west, south, east, north = (float(part) for part in bbox.split(","))
    except ValueError:
        raise _invalid("bbox", "expected west,south,east,north in degrees") from None
    if not (-math.inf < west <= east < math.inf and -math.inf < south <= north < math.inf):
        raise _invalid("bbox", "west must not exceed east, nor south north, and all must be finite")
    lon, lat = grid.corners
    i, j, _ = grid.ijk(blocks).T
    corners = ((j, i), (j, i + 1), (j + 1, i), (j + 1, i + 1))
    lons = np.array([lon[corner] for corner in corners])
    lats = np.array([lat[corner] for corner in corners])
    return (
        (lons.max(axis=0, initial=-np.inf) >= west)
        & (lons.min(axis=0, initial=np.inf) <= east)
        & (lats.max(axis=0, initial=-np.inf) >= south)
        & (lats.min(axis=0, initial=np.inf) <= north)
    )


def _block_status(grid: AirMatrix, entry: BlockStatus, ids: dict[int, str]) -> dict[str, Any]:
    return {
        "block": grid.block(entry.block),
        "status": entry.status.value,
        "reasons": entry.reasons,
        "flight_intents": [ids[sequence] for sequence in entry.sequences],
    }


def _footprint(grid: AirMatrix, block: int) -> dict[str, Any]:
    lon, lat = grid.corners
    i, j, _ = grid.block(block)
    ring = [(j, i), (j, i + 1), (j + 1, i + 1), (j + 1, i), (j, i)]
    return {
        "type": "Polygon",
        "coordinates": [[[round(float(lon[corner]), 10), round(float(lat[corner]), 10)] for corner in ring]],
    }


def _height(grid: AirMatrix, entry: BlockStatus) -> dict[str, float]:
    return {"base_m": grid.block(entry.block)[2] * grid.block_height_m, "height_m": grid.block_height_m}


def _removed_before(service: Service) -> str | None:
    before_ms = service.ledger.removed().before_ms
    return None if before_ms is None else format_time(before_ms)


def _geojson(features: Sequence[dict[str, Any]], **members: str | None) -> Response:
    return Response(orjson.dumps({"type": "FeatureCollection", **members, "features": features}), media_type=GEOJSON)
