"""The airspace: what it is, what buildings take of it, who uses it when."""

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
import orjson
from fastapi import APIRouter, Path, Query, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field

from app import problems
from app.block_status import Status
from app.errors import UnknownBlock
from app.routes.answers import BlockIndices
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
    lattice: Annotated[
        list[list[tuple[float, float]]],
        Field(
            description="Longitude and latitude of 3 x 3 points of the grid: south edge, middle and north edge, each "
            "from west to east. A biquadratic through them places every block."
        ),
    ]
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


FEATURES = FeatureCollection.model_json_schema()


class StaticAnswer(BaseModel):
    """Statically occupied blocks."""

    blocks: list[BlockIndices]


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
    constraints: Annotated[list[str], Field(description="Those that close the block now.")]
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
        lattice=_lattice(grid),
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
    responses={200: {"content": {GEOJSON: {"schema": FEATURES}}}, **problems.documented()},
    summary="Read the buildings",
)
def read_buildings(service: ServiceDep) -> Response:
    """Return footprints with `height` in metres, as GeoJSON."""
    features = [building_feature(building) for building in service.airspace.buildings]
    return geojson(features, attribution=service.airspace.attribution, licence=service.airspace.licence)


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
        check_layer(service, layer)
        blocks = blocks[blocks[:, 2] == layer]
    content = orjson.dumps({"blocks": np.ascontiguousarray(blocks)}, option=orjson.OPT_SERIALIZE_NUMPY)
    return Response(content, media_type="application/json")


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
    present = service.monitor.status_of(block)
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
        status="idle" if present is None else present.status,
        reasons=[] if present is None else list(present.reasons),
        constraints=[each.id for each in service.ledger.constraints_at(now_ms) if each.covers(np.array([block]))[0]],
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
    from_ms, to_ms = _span(start, min(start + _DEFAULT_SPAN_MS, LATEST_MS) if to is None else to)
    block, use_ms = service.ledger.use_between(from_ms, to_ms)
    indices, seconds = grid.ijk(block), use_ms / 1000
    if layer is not None:
        check_layer(service, layer)
        indices, seconds = indices[indices[:, 2] == layer], seconds[indices[:, 2] == layer]
    content = {
        "from": format_time(from_ms),
        "to": format_time(to_ms),
        "removed_before": removed_before(service),
        "blocks": [{"block": ijk, "seconds": use} for ijk, use in zip(indices.tolist(), seconds.tolist(), strict=True)],
    }
    return Response(orjson.dumps(content), media_type="application/json")


def _lattice(grid: AirMatrix) -> list[list[tuple[float, float]]]:
    """Return points by which others can place blocks without the projection, to some decimetres in a grid of 50 km."""
    west, south, east, north = grid.extent_m
    x, y = np.meshgrid(np.linspace(west, east, 3), np.linspace(south, north, 3))
    lon, lat = (np.round(degrees, 10).tolist() for degrees in grid.unproject(x, y))
    return [list(zip(*row, strict=True)) for row in zip(lon, lat, strict=True)]


def invalid(parameter: str, message: str) -> RequestValidationError:
    """Return the error that a query parameter is wrong."""
    return RequestValidationError([{"loc": ("query", parameter), "msg": message, "type": "value_error"}])


def check_layer(service: Service, layer: int) -> None:
    """Refuse a layer that the airspace has not."""
    layers = service.airspace.grid.dimensions[2]
    if layer >= layers:
        raise invalid("layer", f"the airspace has layers 0 to {layers - 1}")


def _span(from_ms: int, to_ms: int) -> tuple[int, int]:
    if to_ms <= from_ms:
        raise invalid("to", "must be later than `from`")
    return from_ms, to_ms


def removed_before(service: Service) -> str | None:
    """Return the time before which flights may have been removed."""
    before_ms = service.ledger.removed().before_ms
    return None if before_ms is None else format_time(before_ms)


def geojson(features: Sequence[dict[str, Any]], **members: object) -> Response:
    """Return features, and what is to be said of all of them."""
    return Response(orjson.dumps({"type": "FeatureCollection", **members, "features": features}), media_type=GEOJSON)
