"""What operators send: bodies of flight intents, and what they become."""

from collections.abc import Iterable
from typing import Annotated, NamedTuple, TypeVar

import numpy as np
from anyio import CapacityLimiter, to_thread
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Discriminator, FailFast, Field, Tag, WithJsonSchema, model_validator

from app import problems
from app.auth import Caller
from app.errors import (
    OperatorMismatch,
    PriorityNotAllowed,
    UnknownAircraftType,
)
from app.flight_intents import Position, Submission
from app.labels import Label
from app.problems import StrictBody
from app.routes.answers import BlockIndices, centres
from app.service import Service
from app.times import Timestamp
from planner.airmatrix import IntArray
from planner.cfa_star import Performance
from planner.errors import DestinationBlocked, OriginBlocked
from planner.submitted import MAX_ENTRIES, SubmittedPath, trajectory_path, volumes_path

Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]

_Index = Annotated[int, Field(strict=True, ge=-(2**31), lt=2**31)]

BlockBody = Annotated[
    tuple[_Index, _Index, _Index],
    WithJsonSchema(
        {
            "type": "array",
            "items": {"type": "integer", "minimum": -(2**31), "maximum": 2**31 - 1},
            "minItems": 3,
            "maxItems": 3,
        }
    ),
]

# In a large airspace a search inside volumes takes a second and its memory.
_CHECKS_AT_ONCE = CapacityLimiter(2)


class PositionBody(StrictBody):
    """A position: WGS84 degrees, metres above the airspace's ground datum."""

    lon: Annotated[Finite, Field(ge=-180, le=180)]
    lat: Annotated[Finite, Field(ge=-90, le=90)]
    alt_m: Finite


class IntentBody(StrictBody):
    """What all forms of a flight intent have in common."""

    operator: Annotated[Label | None, Field(description="Required without authentication; else the token's.")] = None
    reference: Label | None = None
    aircraft_type: Label
    latest_departure: Annotated[
        Timestamp | None, Field(description="Default: the earliest departure and the airspace's ground hold.")
    ] = None
    priority: Annotated[int, Field(strict=True, ge=-1000, le=1000)] = 0

    def _check_latest(self, departure_ms: int, departure: str) -> None:
        if self.latest_departure is not None and self.latest_departure < departure_ms:
            raise ValueError(f"latest_departure lies before {departure}")


class FlightIntentBody(IntentBody):
    """What an operator asks for: a plan from an origin to a destination."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "operator": "acme-air",
                    "reference": "ORD-7781",
                    "aircraft_type": "dji-matrice-600-pro",
                    "origin": {"lon": 71.4202, "lat": 51.1160, "alt_m": 20},
                    "destination": {"lon": 71.4205, "lat": 51.1164, "alt_m": 20},
                    "earliest_departure": "2026-11-22T08:00:00Z",
                    "latest_departure": "2026-11-22T08:05:00Z",
                    "priority": 0,
                }
            ]
        },
    )

    origin: PositionBody
    destination: PositionBody
    earliest_departure: Timestamp

    @model_validator(mode="after")
    def _window(self) -> "FlightIntentBody":
        self._check_latest(self.earliest_departure, "earliest_departure")
        return self


class TrajectoryEntryBody(BaseModel):
    """A block whose centre the aircraft is in from `arrive` to `depart`; what else answers say of it is ignored."""

    block: BlockBody
    arrive: Timestamp
    depart: Timestamp


class TrajectoryBody(IntentBody):
    """A trajectory of the operator's own, as answers give it, to be reserved as it is.

    It departs at its first `arrive`, and lasts an hour at most unless the server is set otherwise. Were it displaced
    later, it would be planned again until `latest_departure`.
    """

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "operator": "acme-air",
                    "reference": "ORD-7784",
                    "aircraft_type": "dji-matrice-600-pro",
                    "trajectory": [
                        {"block": [23, 14, 0], "arrive": "2026-11-22T08:20:00Z", "depart": "2026-11-22T08:20:00Z"},
                        {"block": [24, 14, 0], "arrive": "2026-11-22T08:20:03Z", "depart": "2026-11-22T08:20:03Z"},
                        {"block": [24, 15, 0], "arrive": "2026-11-22T08:20:06Z", "depart": "2026-11-22T08:20:10Z"},
                        {"block": [24, 16, 0], "arrive": "2026-11-22T08:20:13Z", "depart": "2026-11-22T08:20:13Z"},
                    ],
                }
            ]
        },
    )

    # Of entries that are none the first is told: thousands would take as long to look at as all that is right.
    trajectory: Annotated[list[TrajectoryEntryBody], Field(min_length=2, max_length=MAX_ENTRIES), FailFast()]

    @model_validator(mode="after")
    def _window(self) -> "TrajectoryBody":
        self._check_latest(self.trajectory[0].arrive, "the departure")
        return self


class VolumeBody(StrictBody):
    """A block, to be held from `enter` until before `exit`."""

    block: BlockBody
    enter: Timestamp
    exit: Timestamp


class VolumesBody(IntentBody):
    """4D volumes of the operator's own, as answers give `reservations`, to be reserved as they are.

    They must leave the aircraft a way from the origin to the destination. The flight departs when the first of them
    begins, which is one of the origin's block, and arrives when the last ends, one of the destination's: within an hour
    unless the server is set otherwise. They hang together: each is reached from the origin's by way of others, every
    one of them beside the one before (also across an edge or a corner) and overlapping it in time.
    """

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "operator": "acme-air",
                    "reference": "ORD-7785",
                    "aircraft_type": "dji-matrice-600-pro",
                    "origin": {"lon": 71.4202, "lat": 51.1160, "alt_m": 20},
                    "destination": {"lon": 71.4205, "lat": 51.1162, "alt_m": 20},
                    "volumes": [
                        {"block": [23, 14, 0], "enter": "2026-11-22T08:40:00Z", "exit": "2026-11-22T08:40:20Z"},
                        {"block": [24, 14, 0], "enter": "2026-11-22T08:40:00Z", "exit": "2026-11-22T08:40:20Z"},
                        {"block": [24, 15, 0], "enter": "2026-11-22T08:40:00Z", "exit": "2026-11-22T08:40:20Z"},
                    ],
                }
            ]
        },
    )

    origin: PositionBody
    destination: PositionBody
    volumes: Annotated[list[VolumeBody], Field(min_length=1, max_length=MAX_ENTRIES), FailFast()]

    @model_validator(mode="after")
    def _window(self) -> "VolumesBody":
        self._check_latest(min(volume.enter for volume in self.volumes), "the departure")
        return self


def _form(body: object) -> str:
    """Return which form of a flight intent a body is meant to be."""
    planned, *others = problems.FORMS
    names = body if isinstance(body, dict) else ()
    return next((form for form in others if form.removeprefix(":") in names), planned)


AnyIntentBody = Annotated[
    Annotated[FlightIntentBody, Tag(":planned")]
    | Annotated[TrajectoryBody, Tag(":trajectory")]
    | Annotated[VolumesBody, Tag(":volumes")],
    Discriminator(_form),
]

_Body = TypeVar("_Body", bound=IntentBody)


def spoken_for(caller: Caller, body: _Body) -> _Body:
    """Return a body that names its operator, and nothing that its sender may not ask for.

    Raises
    ------
    RequestValidationError, OperatorMismatch, PriorityNotAllowed
    """
    operator = caller.operator if body.operator is None else body.operator
    if operator is None:
        item = {"type": "missing", "loc": ("body", "operator"), "msg": "Field required"}
        raise RequestValidationError([item])
    if not caller.may_change(operator):
        raise OperatorMismatch(f"the token is operator {caller.operator!r}'s, not {operator!r}'s")
    if body.priority > caller.max_priority:
        raise PriorityNotAllowed(f"priority {body.priority} is above {caller.max_priority}, the highest of this token")
    return body.model_copy(update={"operator": operator})


class _Ends(NamedTuple):
    """Where a flight begins and ends; blocks are flat indices."""

    origin: Position
    destination: Position
    origin_block: int
    destination_block: int


def located(service: Service, body: FlightIntentBody) -> Submission:
    """Return a body that names its operator as a submission; raises what is wrong with it whatever the traffic."""
    _check_aircraft_type(service, body)
    return _submission(service, body, _ends(service, body.origin, body.destination), body.earliest_departure)


async def submitted(service: Service, body: IntentBody) -> Submission:
    """Return a body of any form as a submission; raises as `located`, and `PathRefused`."""
    if isinstance(body, FlightIntentBody):
        return located(service, body)
    return await to_thread.run_sync(_checked, service, body, limiter=_CHECKS_AT_ONCE)


def _checked(service: Service, body: IntentBody) -> Submission:
    """Return a body with a path of the operator's own as a submission."""
    _check_aircraft_type(service, body)
    airspace = service.airspace
    performance = Performance.of(service.aircraft_types[body.aircraft_type], airspace.grid)
    longest_ms = int(service.settings.path_limit_s * 1000)
    if isinstance(body, VolumesBody):
        ends = _ends(service, body.origin, body.destination)
        volumes = _columns((volume.block, volume.enter, volume.exit) for volume in body.volumes)
        ends_at = ends.origin_block, ends.destination_block
        path = volumes_path(airspace, performance, *ends_at, *volumes, longest_ms=longest_ms)
    else:
        assert isinstance(body, TrajectoryBody)
        entries = _columns((entry.block, entry.arrive, entry.depart) for entry in body.trajectory)
        path = trajectory_path(airspace, performance, *entries, longest_ms=longest_ms)
        origin, destination = centres(airspace.grid, path.block[[0, -1]])
        ends = _Ends(origin, destination, int(path.block[0]), int(path.block[-1]))
        service.deconfliction.check(ends.origin_block, ends.destination_block)
    return _submission(service, body, ends, path.departure_ms, path)


def _check_aircraft_type(service: Service, body: IntentBody) -> None:
    if body.aircraft_type not in service.aircraft_types:
        known = ", ".join(sorted(service.aircraft_types))
        raise UnknownAircraftType(f"unknown aircraft type {body.aircraft_type!r}; known: {known}")


def _ends(service: Service, origin: PositionBody, destination: PositionBody) -> _Ends:
    airspace = service.airspace
    origin_block = airspace.free_block_at(origin.lon, origin.lat, origin.alt_m, OriginBlocked)
    destination_block = airspace.free_block_at(destination.lon, destination.lat, destination.alt_m, DestinationBlocked)
    service.deconfliction.check(origin_block, destination_block)
    return _Ends(Position(**origin.model_dump()), Position(**destination.model_dump()), origin_block, destination_block)


def _columns(rows: Iterable[tuple[BlockIndices, int, int]]) -> tuple[IntArray, IntArray, IntArray]:
    blocks, begins_ms, ends_ms = (np.array(column, dtype=np.int64) for column in zip(*rows, strict=True))
    return blocks, begins_ms, ends_ms


def _submission(
    service: Service, body: IntentBody, ends: _Ends, departure_ms: int, path: SubmittedPath | None = None
) -> Submission:
    assert body.operator is not None
    latest_ms = body.latest_departure
    if latest_ms is None:
        latest_ms = departure_ms + int(service.settings.ground_hold_s * 1000)
    return Submission(
        operator=body.operator,
        reference=body.reference,
        aircraft_type=body.aircraft_type,
        priority=body.priority,
        **ends._asdict(),
        earliest_departure_ms=departure_ms,
        latest_departure_ms=latest_ms,
        path=path,
    )
