"""Flight intents: submit, preview, read, list, cancel."""

import hashlib
import time
from typing import Annotated, Any
from uuid import UUID

import numpy as np
import orjson
from fastapi import APIRouter, Header, Query, Response
from pydantic import BaseModel, ConfigDict, Field, model_validator

from app import problems
from app.deconfliction import IdempotencyKey, Outcome
from app.errors import PriorityNotSupported, UnknownAircraftType, UnknownFlightIntent
from app.flight_intents import FlightIntent, Position, Refusal, Reservations, State, Submission
from app.routes import paging
from app.service import Service, ServiceDep
from app.times import Moment, Timestamp, format_time, format_times
from planner.airmatrix import AirMatrix
from planner.errors import DestinationBlocked, NoPlan, OriginBlocked
from planner.path import Trajectory

router = APIRouter(prefix="/v1/flight-intents", tags=["flight intents"])

Label = Annotated[
    str, Field(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]*[^\x00-\x20\x7f][^\x00-\x1f\x7f]*$")
]
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
BlockIndices = tuple[int, int, int]


class PositionBody(BaseModel):
    """A position: WGS84 degrees, metres above the airspace's ground datum."""

    model_config = ConfigDict(extra="forbid")

    lon: Annotated[Finite, Field(ge=-180, le=180)]
    lat: Annotated[Finite, Field(ge=-90, le=90)]
    alt_m: Finite


class FlightIntentBody(BaseModel):
    """What an operator asks for."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "operator": "acme-air",
                    "reference": "ORD-7781",
                    "aircraft_type": "dji-matrice-600-pro",
                    "origin": {"lon": 71.4200, "lat": 51.1160, "alt_m": 20},
                    "destination": {"lon": 71.4360, "lat": 51.1280, "alt_m": 20},
                    "earliest_departure": "2026-11-22T08:00:00Z",
                    "latest_departure": "2026-11-22T08:05:00Z",
                    "priority": 0,
                }
            ]
        },
    )

    operator: Label
    reference: Label | None = None
    aircraft_type: Label
    origin: PositionBody
    destination: PositionBody
    earliest_departure: Timestamp
    latest_departure: Annotated[
        Timestamp | None, Field(description="Default: the earliest departure and the airspace's ground hold.")
    ] = None
    priority: Annotated[int, Field(strict=True, ge=-1000, le=1000)] = 0

    @model_validator(mode="after")
    def _window(self) -> "FlightIntentBody":
        if self.latest_departure is not None and self.latest_departure < self.earliest_departure:
            raise ValueError("latest_departure lies before earliest_departure")
        return self


class LocatedPosition(BaseModel):
    """A position and the block that contains it."""

    lon: float
    lat: float
    alt_m: float
    block: BlockIndices


class Waypoint(BaseModel):
    """A block centre of a trajectory; from `depart` to the next `arrive` the straight link between the two."""

    block: BlockIndices
    lon: float
    lat: float
    alt_m: float
    arrive: Moment
    depart: Moment


class Reservation(BaseModel):
    """A block, held from `enter` until before `exit`."""

    block: BlockIndices
    enter: Moment
    exit: Moment


class RefusalBody(BaseModel):
    """Why a recorded intent was refused."""

    reason: str
    detail: str
    conflicting_intents: list[str]
    earliest_feasible_departure: Moment | None


class PlannedFlightBody(BaseModel):
    """A planned flight: what was asked for and, unless it was refused, its path and reservations."""

    state: str
    operator: str
    reference: str | None
    aircraft_type: str
    priority: int
    origin: LocatedPosition
    destination: LocatedPosition
    earliest_departure: Moment
    latest_departure: Moment
    departure: Moment | None = None
    arrival: Moment | None = None
    flight_time_s: float | None = None
    ground_hold_s: float | None = None
    hover_s: float | None = None
    delay_s: float | None = None
    trajectory: list[Waypoint]
    reservations: list[Reservation]


class FlightIntentAnswer(PlannedFlightBody):
    """A recorded flight intent."""

    id: str
    sequence: int
    version: str
    refusal: RefusalBody | None = None


class FlightIntentPage(BaseModel):
    """A page of flight intents by sequence."""

    items: list[FlightIntentAnswer]
    next_cursor: str | None


@router.post(
    "",
    status_code=201,
    response_class=Response,
    responses={201: {"model": FlightIntentAnswer}, **problems.documented(400, 409, 413, 422, 503)},
    summary="Submit a flight intent",
)
async def submit(
    service: ServiceDep,
    body: FlightIntentBody,
    idempotency_key: Annotated[str | None, Header(min_length=1, max_length=255)] = None,
) -> Response:
    """Plan the flight against everything reserved before, and reserve it; the answer is sent when that is durable."""
    submission = _located(service, body)
    key = None
    if idempotency_key is not None:
        digest = hashlib.sha256(orjson.dumps(body.model_dump(), option=orjson.OPT_SORT_KEYS)).hexdigest()
        key = IdempotencyKey(idempotency_key, digest, lambda outcome: _outcome_body(service, outcome))
    outcome = await service.deconfliction.submit(submission, key)
    return _outcome_response(service, outcome)


@router.post(
    "/preview",
    response_class=Response,
    responses={200: {"model": PlannedFlightBody}, **problems.documented(400, 409, 413, 422, 503)},
    summary="Plan a flight without reserving it",
)
async def preview(service: ServiceDep, body: FlightIntentBody) -> Response:
    """Answer what submitting this body would give at this moment; nothing is reserved or recorded."""
    plan = await service.deconfliction.preview(_located(service, body))
    if isinstance(plan, Refusal):
        return Response(problems.refusal_body(plan), problems.KINDS[NoPlan].status, media_type=problems.MEDIA_TYPE)
    answer = _planned(service.airspace.grid, "preview", plan.submission, plan.trajectory, plan.reservations)
    return Response(orjson.dumps(answer), media_type="application/json")


@router.get(
    "",
    response_class=Response,
    responses={200: {"model": FlightIntentPage}, **problems.documented(422, 503)},
    summary="List flight intents",
)
def list_flight_intents(
    service: ServiceDep,
    operator: Label | None = None,
    state: State | None = None,
    from_: Annotated[
        Timestamp | None, Query(alias="from", description="Flights that arrive at this time or later.")
    ] = None,
    to: Annotated[Timestamp | None, Query(description="Flights that depart before this time.")] = None,
    limit: Annotated[int, Query(ge=1, le=paging.LIMIT)] = 50,
    cursor: str | None = None,
) -> Response:
    """List intents in their order of arrival. Refused ones count with their departure window."""
    # One more than asked for: whether there is another page.
    found = service.ledger.page(
        after_sequence=paging.decode(cursor), limit=limit + 1, operator=operator, state=state, from_ms=from_, to_ms=to
    )
    intents = found[:limit]
    items = [render(service.airspace.grid, intent) for intent in intents]
    next_cursor = paging.encode(intents[-1].sequence) if len(found) > limit else None
    return Response(orjson.dumps({"items": items, "next_cursor": next_cursor}), media_type="application/json")


@router.get(
    "/{intent_id}",
    response_class=Response,
    responses={200: {"model": FlightIntentAnswer}, **problems.documented(404, 503)},
    summary="Read a flight intent",
)
def read(service: ServiceDep, intent_id: str) -> Response:
    """Return an intent with the reservations it still holds."""
    intent = service.ledger.find(_id(intent_id))
    if intent is None:
        removed_ms = service.ledger.removed().before_ms
        hint = "" if removed_ms is None else f"; those that ended before {format_time(removed_ms)} have been removed"
        raise UnknownFlightIntent(f"there is no flight intent {intent_id}{hint}")
    return _intent_response(service, intent)


@router.delete(
    "/{intent_id}",
    response_class=Response,
    responses={200: {"model": FlightIntentAnswer}, **problems.documented(404, 409, 503)},
    summary="Cancel a flight intent",
)
async def cancel(service: ServiceDep, intent_id: str) -> Response:
    """Cancel an intent. Before departure its blocks are free at once; a departed flight keeps them until arrival."""
    return _intent_response(service, await service.deconfliction.cancel(_id(intent_id)))


@router.post(
    "/{intent_id}/activate",
    response_class=Response,
    responses={200: {"model": FlightIntentAnswer}, **problems.documented(404, 409, 503)},
    summary="Activate a flight intent",
)
async def activate(service: ServiceDep, intent_id: str) -> Response:
    """Say that an accepted flight is about to depart; who flies without that is nonconforming."""
    return _intent_response(service, await service.deconfliction.activate(_id(intent_id)))


@router.post(
    "/{intent_id}/end",
    response_class=Response,
    responses={200: {"model": FlightIntentAnswer}, **problems.documented(404, 409, 503)},
    summary="End a flight intent",
)
async def end(service: ServiceDep, intent_id: str) -> Response:
    """Say that a flight is over. Its blocks are free at once if it has not departed or was reported on the ground; else
    it keeps them until its arrival, for an aircraft does not vanish because a record did.
    """
    return _intent_response(service, await service.deconfliction.end(_id(intent_id)))


def render(grid: AirMatrix, intent: FlightIntent) -> dict[str, Any]:
    """Return an intent as JSON-ready values."""
    refusal = intent.refusal
    answer = {
        "id": intent.id,
        "sequence": intent.sequence,
        "version": str(intent.version),
        **_planned(grid, intent.state.value, intent.submission, intent.trajectory, intent.reservations),
    }
    if refusal is not None:
        feasible_ms = refusal.earliest_feasible_departure_ms
        answer["refusal"] = {
            "reason": refusal.reason,
            "detail": refusal.detail,
            "conflicting_intents": refusal.conflicting_intents,
            "earliest_feasible_departure": None if feasible_ms is None else format_time(feasible_ms),
        }
    return answer


def _id(text: str) -> str:
    """Return the id in a path; what is no UUID is the id of nothing, and no database's business."""
    try:
        UUID(text)
    except ValueError:
        raise UnknownFlightIntent(f"there is no flight intent {text}") from None
    return text


def _located(service: Service, body: FlightIntentBody) -> Submission:
    """Return a body as a submission; raises what is wrong with it whatever the traffic."""
    if body.priority != 0:
        raise PriorityNotSupported("this version plans every flight intent with priority 0; leave `priority` out")
    if body.aircraft_type not in service.aircraft_types:
        known = ", ".join(sorted(service.aircraft_types))
        raise UnknownAircraftType(f"unknown aircraft type {body.aircraft_type!r}; known: {known}")
    origin = Position(**body.origin.model_dump())
    destination = Position(**body.destination.model_dump())
    airspace = service.airspace
    origin_block = airspace.free_block_at(origin.lon, origin.lat, origin.alt_m, OriginBlocked)
    destination_block = airspace.free_block_at(destination.lon, destination.lat, destination.alt_m, DestinationBlocked)
    service.deconfliction.check(origin_block, destination_block)
    latest_ms = body.latest_departure
    if latest_ms is None:
        latest_ms = body.earliest_departure + int(service.settings.ground_hold_s * 1000)
    return Submission(
        operator=body.operator,
        reference=body.reference,
        aircraft_type=body.aircraft_type,
        priority=body.priority,
        origin=origin,
        destination=destination,
        origin_block=origin_block,
        destination_block=destination_block,
        earliest_departure_ms=body.earliest_departure,
        latest_departure_ms=latest_ms,
    )


def _planned(
    grid: AirMatrix,
    state: str,
    submission: Submission,
    trajectory: Trajectory | None,
    reservations: Reservations,
) -> dict[str, Any]:
    answer: dict[str, Any] = {
        "state": state,
        "operator": submission.operator,
        "reference": submission.reference,
        "aircraft_type": submission.aircraft_type,
        "priority": submission.priority,
        "origin": _position(grid, submission.origin, submission.origin_block),
        "destination": _position(grid, submission.destination, submission.destination_block),
        "earliest_departure": format_time(submission.earliest_departure_ms),
        "latest_departure": format_time(submission.latest_departure_ms),
    }
    if trajectory is not None:
        departure_ms, arrival_ms = trajectory.departure_ms, trajectory.arrival_ms
        delay_ms = arrival_ms - submission.earliest_departure_ms - trajectory.unconstrained_ms
        answer |= {
            "departure": format_time(departure_ms),
            "arrival": format_time(arrival_ms),
            "flight_time_s": trajectory.flight_time_ms / 1000,
            "ground_hold_s": (departure_ms - submission.earliest_departure_ms) / 1000,
            "hover_s": trajectory.hover_ms / 1000,
            "delay_s": delay_ms / 1000,
        }
    answer["trajectory"] = [] if trajectory is None else _waypoints(grid, trajectory)
    answer["reservations"] = _reservations(grid, reservations)
    return answer


def _position(grid: AirMatrix, position: Position, block: int) -> dict[str, Any]:
    return {"lon": position.lon, "lat": position.lat, "alt_m": position.alt_m, "block": grid.block(block)}


def _waypoints(grid: AirMatrix, trajectory: Trajectory) -> list[dict[str, Any]]:
    x, y, alt_m = grid.centres(trajectory.block).T
    lon, lat = grid.unproject(x, y)
    columns = zip(
        grid.ijk(trajectory.block).tolist(),
        np.round(lon, 10).tolist(),
        np.round(lat, 10).tolist(),
        alt_m.tolist(),
        format_times(trajectory.arrive_ms),
        format_times(trajectory.depart_ms),
        strict=True,
    )
    names = ("block", "lon", "lat", "alt_m", "arrive", "depart")
    return [dict(zip(names, values, strict=True)) for values in columns]


def _reservations(grid: AirMatrix, held: Reservations) -> list[dict[str, Any]]:
    columns = zip(grid.ijk(held.block).tolist(), format_times(held.enter_ms), format_times(held.exit_ms), strict=True)
    return [{"block": block, "enter": enter, "exit": leave} for block, enter, leave in columns]


def _outcome_body(service: Service, outcome: Outcome) -> bytes:
    if outcome.intent.refusal is not None:
        return problems.refusal_body(outcome.intent.refusal, outcome.intent)
    return orjson.dumps(render(service.airspace.grid, outcome.intent))


def _outcome_response(service: Service, outcome: Outcome) -> Response:
    intent, timing = outcome.intent, outcome.timing
    began = time.perf_counter()
    content = outcome.replayed or outcome.rendered or _outcome_body(service, outcome)
    spans = {
        "queue": timing.queue_s,
        "plan": timing.plan_s,
        "commit": timing.commit_s,
        "serialise": time.perf_counter() - began,
    }
    headers = {"Server-Timing": ", ".join(f"{name};dur={seconds * 1000:.3f}" for name, seconds in spans.items())}
    if outcome.replayed is not None:
        headers["Idempotent-Replayed"] = "true"
    if intent.refusal is not None:
        return Response(content, problems.KINDS[NoPlan].status, headers, problems.MEDIA_TYPE)
    version = intent.version if outcome.replayed is None else orjson.loads(outcome.replayed)["version"]
    headers |= {"Location": f"{router.prefix}/{intent.id}", "ETag": f'"{version}"'}
    return Response(content, 201, headers, "application/json")


def _intent_response(service: Service, intent: FlightIntent) -> Response:
    content = orjson.dumps(render(service.airspace.grid, intent))
    return Response(content, headers={"ETag": f'"{intent.version}"'}, media_type="application/json")
