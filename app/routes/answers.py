"""Flight intents as they are answered."""

import time
from collections.abc import Iterable
from typing import Annotated, Any

import numpy as np
import orjson
from fastapi import Response
from pydantic import BaseModel, Field, WithJsonSchema

from app import problems, scheduling
from app.deconfliction import Outcome
from app.flight_intents import Displacement, FlightIntent, Position, Refusal, Reservations, State, Submission
from app.service import Service
from app.submitted_paths import PathRefusal
from app.times import Moment, format_time, format_times
from planner.airmatrix import AirMatrix, IntArray
from planner.errors import NoPlan
from planner.path import Trajectory

PATH = "/v1/flight-intents"

BlockIndices = Annotated[
    tuple[int, int, int],
    WithJsonSchema({"type": "array", "items": {"type": "integer"}, "minItems": 3, "maxItems": 3}),
]


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
    conflicting_constraints: list[str]
    earliest_feasible_departure: Moment | None


class DisplacementBody(BaseModel):
    """A flight that had to make way: how much later it departs and arrives now, or why it is `displaced`."""

    flight_intent_id: str
    sequence: int
    state: State
    reason: str | None
    departure_moved_s: float | None
    arrival_moved_s: float | None


class PlannedFlightBody(BaseModel):
    """A planned flight: what was asked for and, unless it was refused, its path and reservations."""

    state: str
    operator: str
    reference: str | None
    aircraft_type: str
    priority: int
    submitted: Annotated[bool, Field(description="Whether the path is the operator's own, reserved as it came.")]
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


class PreviewAnswer(PlannedFlightBody):
    """A plan that nobody has reserved, and the flights of lower priority that would have to make way for it."""

    displaces: list[str]


class ChangedFlightIntentAnswer(FlightIntentAnswer):
    """A flight intent as it was just recorded or changed, and the flights of lower priority that made way for it."""

    displaced: list[DisplacementBody]


class FlightIntentPage(BaseModel):
    """A page of flight intents by sequence."""

    items: list[FlightIntentAnswer]
    next_cursor: str | None


def render(grid: AirMatrix, intent: FlightIntent) -> dict[str, Any]:
    """Return an intent as JSON-ready values."""
    refusal = intent.refusal
    answer = {
        "id": intent.id,
        "sequence": intent.sequence,
        "version": str(intent.version),
        **planned(grid, intent.state.value, intent.submission, intent.trajectory, intent.reservations),
    }
    if refusal is not None:
        feasible_ms = refusal.earliest_feasible_departure_ms
        answer["refusal"] = {
            "reason": refusal.reason,
            "detail": refusal.detail,
            "conflicting_intents": refusal.conflicting_intents,
            "conflicting_constraints": refusal.conflicting_constraints,
            "earliest_feasible_departure": None if feasible_ms is None else format_time(feasible_ms),
        }
    return answer


def displacements(displaced: Iterable[Displacement]) -> list[dict[str, Any]]:
    """Return what `DisplacementBody`s have."""
    return [
        {
            "flight_intent_id": flight.id,
            "sequence": flight.sequence,
            "state": flight.state.value,
            "reason": flight.reason,
            "departure_moved_s": _seconds(flight.departure_moved_ms),
            "arrival_moved_s": _seconds(flight.arrival_moved_ms),
        }
        for flight in displaced
    ]


def _seconds(ms: int | None) -> float | None:
    return None if ms is None else ms / 1000


def planned(
    grid: AirMatrix,
    state: str,
    submission: Submission,
    trajectory: Trajectory | None,
    reservations: Reservations,
) -> dict[str, Any]:
    """Return what a `PlannedFlightBody` has."""
    answer: dict[str, Any] = {
        "state": state,
        "operator": submission.operator,
        "reference": submission.reference,
        "aircraft_type": submission.aircraft_type,
        "priority": submission.priority,
        "submitted": trajectory is not None and trajectory.is_submitted,
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


def centres(grid: AirMatrix, blocks: IntArray) -> list[Position]:
    """Return the centres of blocks."""
    x, y, alt_m = grid.centres(blocks).T
    lon, lat = grid.unproject(x, y)
    columns = zip(np.round(lon, 10).tolist(), np.round(lat, 10).tolist(), alt_m.tolist(), strict=True)
    return [Position(*column) for column in columns]


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


def more_of(grid: AirMatrix, submission: Submission, refusal: Refusal) -> dict[str, Any]:
    """Return what the refusal of an operator's own path says beyond others."""
    if not isinstance(refusal, PathRefusal):
        return {}
    proposal = None
    if refusal.proposal is not None:
        held = scheduling.reservations(refusal.proposal)
        proposal = planned(grid, "preview", submission, refusal.proposal, held) | {"displaces": refusal.displaces}
    return {
        "conflicts": [
            {
                "block": grid.block(conflict.block),
                "enter": format_time(conflict.enter_ms),
                "exit": format_time(conflict.exit_ms),
            }
            | ({} if conflict.flight_intent_id is None else {"flight_intent_id": conflict.flight_intent_id})
            | ({} if conflict.constraint_id is None else {"constraint_id": conflict.constraint_id})
            for conflict in refusal.conflicts
        ],
        "conflict_count": refusal.conflict_count,
        "proposal": proposal,
    }


def outcome_body(service: Service, outcome: Outcome) -> bytes:
    """Return the body of the answer to a submission or a change."""
    intent = outcome.intent
    # A displaced flight has a refusal too, but was accepted.
    if intent.state is State.REJECTED:
        assert intent.refusal is not None
        more = more_of(service.airspace.grid, intent.submission, intent.refusal)
        return problems.refusal_body(intent.refusal, intent, more=more)
    answer = render(service.airspace.grid, intent)
    return orjson.dumps({**answer, "displaced": displacements(outcome.displaced)})


def outcome_response(service: Service, outcome: Outcome) -> Response:
    """Return the answer to a submission: 201, or the refusal."""
    intent, timing = outcome.intent, outcome.timing
    began = time.perf_counter()
    content = outcome.replayed or outcome.rendered or outcome_body(service, outcome)
    spans = {
        "queue": timing.queue_s,
        "plan": timing.plan_s,
        "commit": timing.commit_s,
        "serialise": time.perf_counter() - began,
    }
    headers = {"Server-Timing": ", ".join(f"{name};dur={seconds * 1000:.3f}" for name, seconds in spans.items())}
    if outcome.replayed is not None:
        headers["Idempotent-Replayed"] = "true"
    if intent.state is State.REJECTED:
        return Response(content, problems.KINDS[NoPlan].status, headers, problems.MEDIA_TYPE)
    version = intent.version if outcome.replayed is None else orjson.loads(outcome.replayed)["version"]
    headers |= {"Location": f"{PATH}/{intent.id}", "ETag": f'"{version}"'}
    return Response(content, 201, headers, "application/json")


def intent_response(service: Service, intent: FlightIntent) -> Response:
    """Return the answer to a question for an intent, or to a change of its state."""
    content = orjson.dumps(render(service.airspace.grid, intent))
    return Response(content, headers={"ETag": f'"{intent.version}"'}, media_type="application/json")
