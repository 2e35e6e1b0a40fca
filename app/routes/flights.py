"""Flights and tracks in the air, and the alerts that they raise."""

from typing import Any, Literal

import orjson
from fastapi import APIRouter, Response
from pydantic import BaseModel

from app import problems
from app.alerts import Alert
from app.conformance import Assessment, Conformance
from app.flight_intents import OPEN_STATES, State
from app.monitor import View
from app.routes.answers import BlockIndices
from app.routes.views import ClockAnswer, SightingAnswer, VelocityAnswer, clock, sighting
from app.service import Service, ServiceDep
from app.times import Moment, format_time

router = APIRouter(prefix="/v1", tags=["airspace"])


class FlightAnswer(BaseModel):
    """A flight, or a track that surveillance sees: where it is, and how it keeps to its plan."""

    flight_intent_id: str | None
    track_id: str | None
    sequence: int | None
    operator: str | None
    reference: str | None
    aircraft_type: str | None
    state: State | None
    conformance: Conformance
    reasons: list[str]
    since: Moment | None
    departure: Moment | None
    arrival: Moment | None
    position: SightingAnswer | None
    velocity_mps: VelocityAnswer | None


class FlightList(BaseModel):
    """All that fly or should fly now."""

    at: Moment
    clock: ClockAnswer
    items: list[FlightAnswer]
    next_cursor: Literal[None]


class ThreatAnswer(BaseModel):
    """A reservation that an aircraft would enter, and in how many seconds."""

    flight_intent_id: str
    block: BlockIndices
    enter: Moment
    exit: Moment
    reach_s: float


class AlertAnswer(BaseModel):
    """An aircraft that does not conform."""

    id: str
    raised: Moment
    severity: Literal["yellow", "red"]
    flight_intent_id: str | None
    track_id: str | None
    conformance: Conformance
    reasons: list[str]
    message: str
    position: SightingAnswer | None
    threatens: list[ThreatAnswer]


class AlertList(BaseModel):
    """Who does not conform, newest first."""

    at: Moment
    clock: ClockAnswer
    items: list[AlertAnswer]


_WORDS = {
    "off_track": "is off its reserved blocks",
    "wrong_layer": "flies in the wrong layer",
    "early": "is ahead of its reservations",
    "late": "is behind its reservations",
    "lost": "has sent no position for a while",
    "not_seen": "should be in the air and was not seen",
    "not_activated": "flies without having been activated",
    "not_accepted": "flies without an accepted plan",
    "no_flight_intent": "has no flight intent",
    "several_aircraft": "shares a block with another aircraft",
    "reserved_by_another": "is in a block that another flight has reserved",
    "in_building": "is in a block that a building occupies",
    "in_constraint": "is in closed airspace",
}


@router.get(
    "/flights",
    response_class=Response,
    responses={200: {"model": FlightList}, **problems.documented(503)},
    summary="List flights in the air",
)
def list_flights(service: ServiceDep) -> Response:
    """Return who flies or should fly now or within a minute, with newest position and conformance."""
    return _json(flights(service, service.monitor.view()))


@router.get(
    "/airspace/alerts",
    response_class=Response,
    responses={200: {"model": AlertList}, **problems.documented(503)},
    summary="List alerts",
)
def list_alerts(service: ServiceDep) -> Response:
    """Return who does not conform, newest first, and which reservations of others it would enter within a minute if it
    went on like that. Red is who violates, or will; yellow any other.
    """
    view = service.monitor.view()
    return _json(alerts(service, view, service.monitor.alerts(view)))


def flights(service: Service, view: View) -> dict[str, Any]:
    """Return what a `FlightList` has."""
    shown = [_flight(service, view, assessment) for assessment in view.assessed.values() if _is_shown(assessment)]
    return {
        "at": format_time(view.at_ms), "clock": clock(service, view.at_ms), "items": shown, "next_cursor": None,
    }  # fmt: skip


def alerts(service: Service, view: View, found: list[Alert]) -> dict[str, Any]:
    """Return what an `AlertList` has."""
    ids = {sequence: flight.id for sequence, flight in view.picture.flights.items()}
    missing = {threat.sequence for alert in found for threat in alert.threats} - ids.keys()
    ids |= service.ledger.ids(missing)
    return {
        "at": format_time(view.at_ms),
        "clock": clock(service, view.at_ms),
        "items": [_alert(service, view, alert, ids) for alert in found],
    }


def _is_shown(assessment: Assessment) -> bool:
    """Tell whether an aircraft flies or should, rather than being known from before."""
    flight = assessment.flight
    if flight is None or assessment.reasons:
        return True
    if flight.state in OPEN_STATES:
        return True
    return assessment.is_airborne and assessment.is_fresh


def _flight(service: Service, view: View, assessment: Assessment) -> dict[str, Any]:
    flight, seen = assessment.flight, assessment.sighting
    remark = view.picture.remarks.get(assessment.aircraft)
    is_since = remark is not None and remark.conformance == assessment.conformance
    return {
        "flight_intent_id": None if flight is None else flight.id,
        "track_id": assessment.aircraft.track_id or None,
        "sequence": None if flight is None else flight.sequence,
        "operator": None if flight is None else flight.operator,
        "reference": None if flight is None else flight.reference,
        "aircraft_type": None if flight is None else flight.aircraft_type,
        "state": None if flight is None else flight.state.value,
        "conformance": assessment.conformance.value,
        "reasons": assessment.all_reasons,
        "since": format_time(remark.since_ms) if remark is not None and is_since else None,
        "departure": _time(None if flight is None else flight.departure_ms),
        "arrival": _time(None if flight is None else flight.arrival_ms),
        "position": None if seen is None else sighting(service.airspace.grid, seen, view.at_ms),
        "velocity_mps": None if seen is None or seen.velocity is None else seen.velocity._asdict(),
    }


def _alert(service: Service, view: View, alert: Alert, ids: dict[int, str]) -> dict[str, Any]:
    assessment, grid = alert.assessment, service.airspace.grid
    flight, seen, track_id = assessment.flight, assessment.sighting, assessment.aircraft.track_id
    who = f"Track {track_id}" if flight is None else f"{flight.operator} {flight.reference or f'no. {flight.sequence}'}"
    what = " and ".join(_WORDS.get(reason, reason) for reason in assessment.all_reasons)
    return {
        "id": f"{track_id if flight is None else flight.id}@{alert.raised_ms}",
        "raised": format_time(alert.raised_ms),
        "severity": alert.severity.value,
        "flight_intent_id": None if flight is None else flight.id,
        "track_id": track_id or None,
        "conformance": assessment.conformance.value,
        "reasons": assessment.all_reasons,
        "message": f"{who} {what}.",
        "position": None if seen is None else sighting(grid, seen, view.at_ms),
        "threatens": [
            {
                "flight_intent_id": ids[threat.sequence],
                "block": grid.block(threat.block),
                "enter": format_time(threat.enter_ms),
                "exit": format_time(threat.exit_ms),
                "reach_s": (threat.reach_ms - view.at_ms) / 1000,
            }
            for threat in alert.threats
        ],
    }


def _time(time_ms: int | None) -> str | None:
    return None if time_ms is None else format_time(time_ms)


def _json(content: dict[str, Any]) -> Response:
    return Response(orjson.dumps(content), media_type="application/json")
