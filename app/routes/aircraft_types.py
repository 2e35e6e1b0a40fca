"""Aircraft types that flights can be planned for."""

from typing import Annotated

from fastapi import APIRouter
from pydantic import BaseModel, Field

from app import problems
from app.service import ServiceDep
from planner.aircraft import LinkSpeeds

router = APIRouter(prefix="/v1/aircraft-types", tags=["aircraft types"])


class LinkSpeedsAnswer(BaseModel):
    """Speeds along the links of this airspace's blocks, in m/s; `alpha` is the steeper tilt."""

    horizontal: float
    vertical: float
    alpha: float
    beta: float

    @classmethod
    def of(cls, speeds: LinkSpeeds, factor: float = 1.0) -> "LinkSpeedsAnswer":
        """Return speeds times a factor."""
        return cls(
            horizontal=speeds.horizontal * factor,
            vertical=speeds.vertical * factor,
            alpha=speeds.alpha * factor,
            beta=speeds.beta * factor,
        )


class AircraftTypeAnswer(BaseModel):
    """An aircraft's profile."""

    id: str
    name: str
    mass_kg: float
    max_vertical_speed_mps: float
    max_horizontal_speed_mps: float
    speed_factor: Annotated[float, Field(description="Flights are planned at this part of the speed.")]
    endurance_s: float | None
    link_speeds_mps: Annotated[LinkSpeedsAnswer, Field(description="At full power.")]
    planned_link_speeds_mps: Annotated[LinkSpeedsAnswer, Field(description="At full power times `speed_factor`.")]


class AircraftTypeList(BaseModel):
    """All aircraft types."""

    items: list[AircraftTypeAnswer]
    next_cursor: None = None


@router.get("", responses=problems.documented(), summary="List aircraft types")
def list_aircraft_types(service: ServiceDep) -> AircraftTypeList:
    """Return the shipped profiles and those of the operator of this service."""
    grid = service.airspace.grid
    items = []
    for aircraft in service.aircraft_types.values():
        speeds = aircraft.link_speeds(grid.block_side_m, grid.block_height_m)
        items.append(
            AircraftTypeAnswer(
                id=aircraft.id,
                name=aircraft.name,
                mass_kg=aircraft.mass_kg,
                max_vertical_speed_mps=aircraft.max_vertical_speed_mps,
                max_horizontal_speed_mps=aircraft.max_horizontal_speed_mps,
                speed_factor=aircraft.speed_factor,
                endurance_s=aircraft.endurance_s,
                link_speeds_mps=LinkSpeedsAnswer.of(speeds),
                planned_link_speeds_mps=LinkSpeedsAnswer.of(speeds, aircraft.speed_factor),
            )
        )
    return AircraftTypeList(items=items)
