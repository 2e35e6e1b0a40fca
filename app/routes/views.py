"""What several answers about the air have in common."""

from typing import Any

from pydantic import BaseModel

from app.routes.answers import BlockIndices
from app.service import Service
from app.surveillance import Sighting
from app.times import Moment, format_time
from planner.airmatrix import AirMatrix


class ClockAnswer(BaseModel):
    """The service's clock: `rate` seconds pass in a second; simulated in demonstrations and tests only."""

    now: Moment
    rate: float
    simulated: bool


class VelocityAnswer(BaseModel):
    """Metres a second."""

    east: float
    north: float
    up: float


class SightingAnswer(BaseModel):
    """Where an aircraft was last seen. `block` is null outside the grid, `airborne` where nobody said."""

    time: Moment
    lon: float
    lat: float
    alt_m: float
    airborne: bool | None
    block: BlockIndices | None
    age_s: float
    flagged: bool


def clock(service: Service, now_ms: int) -> dict[str, Any]:
    """Return what a `ClockAnswer` has."""
    settings = service.settings
    simulated = settings.clock_start is not None or settings.clock_rate != 1
    return {"now": format_time(now_ms), "rate": settings.clock_rate, "simulated": simulated}


def sighting(grid: AirMatrix, seen: Sighting, at_ms: int) -> dict[str, Any]:
    """Return what a `SightingAnswer` has."""
    return {
        "time": format_time(seen.time_ms),
        "lon": seen.lon,
        "lat": seen.lat,
        "alt_m": seen.alt_m,
        "airborne": seen.airborne,
        "block": None if seen.block is None else grid.block(seen.block),
        "age_s": (at_ms - seen.time_ms) / 1000,
        "flagged": seen.is_implausible,
    }
