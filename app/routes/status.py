"""The status of the blocks in use: green, yellow, red."""

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
import orjson
from fastapi import APIRouter, Header, Query, Response
from pydantic import BaseModel

from app import problems
from app.block_status import BlockStatus, Status
from app.monitor import View
from app.routes.airspace import (
    FEATURES,
    GEOJSON,
    Layer,
    RemovedBefore,
    check_layer,
    geojson,
    invalid,
)
from app.routes.answers import BlockIndices
from app.routes.views import ClockAnswer, clock
from app.service import Service, ServiceDep
from app.times import Moment, Timestamp, format_time
from planner.airmatrix import AirMatrix

router = APIRouter(prefix="/v1/airspace", tags=["airspace"])


class BlockStatusAnswer(BaseModel):
    """A block in use: whose it is, or who is in it, why it is not green, and which constraints close it, if any."""

    block: BlockIndices
    status: Status
    reasons: list[str]
    flight_intents: list[str]
    track_ids: list[str]
    constraints: list[str] | None = None


class StatusAnswer(BaseModel):
    """The blocks in use at one time; blocks that are not listed are idle."""

    at: Moment
    clock: ClockAnswer
    removed_before: RemovedBefore
    positions_removed_before: RemovedBefore
    counts: dict[Status, int]
    blocks: list[BlockStatusAnswer]


@router.get(
    "/status",
    response_class=Response,
    responses={
        200: {"model": StatusAnswer, "content": {GEOJSON: {"schema": FEATURES}}},
        **problems.documented(422, 503),
    },
    summary="Status of the blocks in use",
)
def read_status(
    service: ServiceDep,
    at: Annotated[
        Timestamp | None,
        Query(description="Default: now. The past comes from recorded positions, the future from reservations."),
    ] = None,
    layer: Layer = None,
    bbox: Annotated[str | None, Query(description="west,south,east,north in degrees")] = None,
    status: Status | None = None,
    f: Annotated[Literal["json", "geojson"] | None, Query(description="Answer format.")] = None,
    accept: Annotated[str | None, Header()] = None,
) -> Response:
    """Return green, yellow and red blocks: the paper's comparison of reservations with where aircraft are.

    Red: several aircraft, an aircraft in a block that another flight holds, in a building's, or in closed airspace.
    Yellow: an aircraft where nothing is reserved, or a reservation whose flight is off track, early, late, lost,
    contingent or missing.
    """
    grid = service.airspace.grid
    if layer is not None:
        check_layer(service, layer)
    view = service.monitor.view(at)
    keep = _within(grid, np.array([entry.block for entry in view.blocks], dtype=np.int64), bbox)
    shown = [
        entry
        for entry, inside in zip(view.blocks, keep.tolist(), strict=True)
        if inside and status in (None, entry.status) and layer in (None, grid.block(entry.block)[2])
    ]
    rendered = blocks(service, view, shown)
    members = {**described(service, view), "counts": counts(shown)}
    if f == "geojson" or (f is None and GEOJSON in (accept or "")):
        features = [
            {
                "type": "Feature",
                "geometry": _footprint(grid, entry.block),
                "properties": {**block, **_height(grid, entry)},
            }
            for entry, block in zip(shown, rendered, strict=True)
        ]
        return geojson(features, **members)
    return Response(orjson.dumps({**members, "blocks": rendered}), media_type="application/json")


def blocks(service: Service, view: View, entries: Sequence[BlockStatus]) -> list[dict[str, Any]]:
    """Return what `BlockStatusAnswer`s have."""
    grid, flights = service.airspace.grid, view.picture.flights
    return [
        {
            "block": grid.block(entry.block),
            "status": entry.status.value,
            "reasons": entry.reasons,
            "flight_intents": [flights[each.sequence].id for each in entry.aircraft if not each.track_id],
            "track_ids": [each.track_id for each in entry.aircraft if each.track_id],
            **({"constraints": entry.constraints} if entry.constraints else {}),
        }
        for entry in entries
    ]


def counts(entries: Sequence[BlockStatus]) -> dict[str, int]:
    """Return how many blocks have each status."""
    return {color.value: sum(entry.status is color for entry in entries) for color in Status}


def described(service: Service, view: View) -> dict[str, Any]:
    """Return what a `StatusAnswer` has beside its blocks."""
    removed = service.ledger.removed()
    return {
        "at": format_time(view.at_ms),
        "clock": clock(service, view.now_ms),
        "removed_before": _time(removed.before_ms),
        "positions_removed_before": _time(removed.positions_before_ms),
    }


def _time(time_ms: int | None) -> str | None:
    return None if time_ms is None else format_time(time_ms)


def _within(grid: AirMatrix, blocks: Any, bbox: str | None) -> Any:
    """Tell for each block whether its footprint's bounds meet a bounding box, shape (n,)."""
    if bbox is None:
        return np.ones(len(blocks), dtype=np.bool_)
    try:
        west, south, east, north = (float(part) for part in bbox.split(","))
    except ValueError:
        raise invalid("bbox", "expected west,south,east,north in degrees") from None
    if not (-math.inf < west <= east < math.inf and -math.inf < south <= north < math.inf):
        raise invalid("bbox", "west must not exceed east, nor south north, and all must be finite")
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
