"""Telemetry: positions of flights, and of tracks that surveillance sees."""

from typing import Annotated, Any, Literal
from uuid import UUID

import orjson
from anyio import to_thread
from fastapi import APIRouter, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator
from pydantic.config import JsonDict
from pydantic_core import ErrorDetails, from_json

from app import problems
from app.auth import PLAN, SURVEILLANCE, CallerDep
from app.errors import (
    InvalidPosition,
    MalformedRequest,
    PositionNotAllowed,
    PositionNotFinite,
    PositionRefused,
    TooManyPositions,
)
from app.labels import Label
from app.problems import StrictBody
from app.service import ServiceDep
from app.surveillance import Sighting
from app.telemetry import Report
from app.times import Timestamp

router = APIRouter(prefix="/v1/telemetry", tags=["telemetry"])

MAX_POSITIONS = 5_000
# What counts as a request: the writer works for all of them.
_POSITIONS_A_REQUEST = 500

_EXAMPLE: JsonDict = {
    "track_id": "radar-17",
    "time": "2026-11-22T08:00:00Z",
    "lon": 71.4210,
    "lat": 51.1165,
    "alt_m": 61.5,
    "airborne": True,
}

_Coordinate = Annotated[float, Field(strict=True, allow_inf_nan=False)]


class PositionReport(StrictBody):
    """Where an aircraft was: of a flight intent, or of a track where only surveillance sees it."""

    model_config = ConfigDict(json_schema_extra={"examples": [_EXAMPLE]})

    flight_intent_id: UUID | None = None
    track_id: Label | None = None
    time: Timestamp
    lon: Annotated[_Coordinate, Field(ge=-180, le=180)]
    lat: Annotated[_Coordinate, Field(ge=-90, le=90)]
    alt_m: _Coordinate
    airborne: Annotated[bool | None, Field(strict=True)] = None

    @model_validator(mode="after")
    def _names_one(self) -> "PositionReport":
        if (self.flight_intent_id is None) == (self.track_id is None):
            raise ValueError("name either a flight_intent_id or a track_id")
        return self


class PositionProblem(BaseModel):
    """Why one position was refused."""

    index: int
    type: str
    title: str
    status: int
    detail: str


class Flag(BaseModel):
    """What is odd about a position that was taken."""

    index: int
    flag: Literal["implausible-jump"]
    detail: str


class TelemetryAnswer(BaseModel):
    """How many positions were taken, how many refused, and what is to be said of single ones."""

    accepted: int
    problem_count: int
    problems: list[PositionProblem]
    flagged: list[Flag]


class _Envelope(StrictBody):
    """The body: positions, those of one aircraft in their order. Each is read, and taken or refused, for itself."""

    positions: list[Any]


_BODY_SCHEMA = {
    "type": "object",
    "required": ["positions"],
    "additionalProperties": False,
    "properties": {
        "positions": {
            "type": "array",
            "maxItems": MAX_POSITIONS,
            "description": "Those of one aircraft in their order.",
            "items": PositionReport.model_json_schema(),
        }
    },
}


_SCOPE_FOR = {"flights": PLAN, "tracks": SURVEILLANCE}

_POSITIONS = TypeAdapter(list[PositionReport])

_JUMP = {"flag": "implausible-jump", "detail": "further from the last position than aircraft fly"}


@router.post(
    "",
    status_code=202,
    response_class=Response,
    responses={202: {"model": TelemetryAnswer}, **problems.documented(400, 413, 422, 429, 503)},
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {"application/json": {"schema": _BODY_SCHEMA, "example": {"positions": [_EXAMPLE]}}},
        }
    },
    summary="Report positions",
)
async def report(service: ServiceDep, caller: CallerDep, request: Request) -> Response:
    """Record where aircraft were. The answer is sent when that is durable; what is repeated is not recorded twice.

    Positions of the future, of another part of the world, of unknown flights or older than what is known are refused
    one by one. One that no aircraft can have reached from the last is taken, and flagged.

    Each refused position has its problem, by `index`, but of those that are no positions at all only the first hundred.
    `problem_count` is how many were refused. Against an operator's rate every 500 positions, begun or full, count as a
    request.
    """
    telemetry = service.telemetry
    read, unreadable = await to_thread.run_sync(_read, await request.body())
    # One has been counted already.
    service.access.overdraw(caller, max(0, len(read) + len(unreadable) - 1) // _POSITIONS_A_REQUEST)
    allowed = {kind: scope in caller.scopes for kind, scope in _SCOPE_FOR.items()}
    positions = [(index, position) for index, position in read if allowed[_kind(position)]]
    refused: dict[int, PositionRefused] = {
        index: PositionNotAllowed(f"positions of {_kind(position)} need the scope {_SCOPE_FOR[_kind(position)]}")
        for index, position in read
        if not allowed[_kind(position)]
    }
    receipt = await telemetry.report([position for _, position in positions], caller.operator)
    flagged = []
    for (index, _), entry in zip(positions, receipt.entries, strict=True):
        if isinstance(entry, PositionRefused):
            refused[index] = entry
        elif entry:
            flagged.append(index)
    accepted = sum(index not in refused for index, _ in positions)
    service.metrics.positions([*unreadable.values(), *refused.values()], accepted)
    # Thousands of refusals take a while to write down.
    content = await to_thread.run_sync(_answer, accepted, unreadable, refused, flagged)
    return Response(content, 202, media_type="application/json")


def _read(body: bytes) -> tuple[list[tuple[int, Report]], dict[int, PositionRefused]]:
    """Return the positions that can be read, with their indices, and what is wrong with the others."""
    try:
        items = _Envelope.model_validate(from_json(body)).positions
    except ValidationError as error:
        raise RequestValidationError([{**item, "loc": ("body", *item["loc"])} for item in error.errors()]) from error
    except ValueError as error:
        raise MalformedRequest(f"the body is not valid JSON: {error}") from error
    if len(items) > MAX_POSITIONS:
        raise TooManyPositions(f"{len(items)} positions; a report may have up to {MAX_POSITIONS}")
    refused: dict[int, PositionRefused] = {}
    try:
        read = _POSITIONS.validate_python(items)
    except ValidationError as error:
        for item in error.errors(include_url=False, include_context=False, include_input=False):
            refused.setdefault(int(item["loc"][0]), _refusal(item))
        read = _POSITIONS.validate_python([item for index, item in enumerate(items) if index not in refused])
    indices = [index for index in range(len(items)) if index not in refused]
    return [(index, _report(position)) for index, position in zip(indices, read, strict=True)], refused


def _refusal(item: ErrorDetails) -> PositionRefused:
    field = ".".join(str(part) for part in item["loc"][1:])
    message = item["msg"].removeprefix("Value error, ")
    kind = PositionNotFinite if item["type"] == "finite_number" else InvalidPosition
    return kind(f"{field}: {message}" if field else message)


def _report(position: PositionReport) -> Report:
    return Report(
        Sighting(position.time, position.lon, position.lat, position.alt_m, position.airborne),
        None if position.flight_intent_id is None else str(position.flight_intent_id),
        position.track_id,
    )


def _kind(position: Report) -> str:
    return "flights" if position.track_id is None else "tracks"


def _answer(
    accepted: int, unreadable: dict[int, PositionRefused], refused: dict[int, PositionRefused], flagged: list[int]
) -> bytes:
    told = dict(problems.told([*unreadable.items()])) | refused
    return orjson.dumps(
        {
            "accepted": accepted,
            "problem_count": len(unreadable) + len(refused),
            "problems": [
                {"index": index, **problems.document(problems.kind_of(told[index]), str(told[index]))}
                for index in sorted(told)
            ],
            "flagged": [{"index": index, **_JUMP} for index in flagged],
        }
    )
