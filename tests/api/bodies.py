"""What operators and surveillance post, for the districts of the tests."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import httpx

from app.flight_intents import Position
from app.problems import MEDIA_TYPE
from app.times import format_time
from planner.errors import Block
from tests.ledger.district import AIRCRAFT, DEPARTURE_MS, OLD_TOWN, District

SUBMIT = "/v1/flight-intents"
PREVIEW = "/v1/flight-intents/preview"
TELEMETRY = "/v1/telemetry"

FLIGHT_INTENT = {
    "id", "sequence", "version", "state", "operator", "reference", "aircraft_type", "priority", "submitted", "origin",
    "destination", "earliest_departure", "latest_departure", "departure", "arrival", "flight_time_s", "ground_hold_s",
    "hover_s", "delay_s", "trajectory", "reservations",
}  # fmt: skip
# What was just recorded or changed, and who made way for it.
CHANGED = FLIGHT_INTENT | {"displaced"}
PREVIEWED = FLIGHT_INTENT - {"id", "sequence", "version"} | {"displaces"}
PLANNED = {"departure", "arrival", "flight_time_s", "ground_hold_s", "hover_s", "delay_s"}
PROBLEM = {"type", "title", "status", "detail"}


def intent(
    origin: str | Block = "A",
    destination: str | Block = "B",
    /,
    *,
    district: District = OLD_TOWN,
    earliest_ms: int = DEPARTURE_MS,
    window_ms: int | None = None,
    **members: Any,
) -> dict[str, Any]:
    """Return the body of a flight intent; without `window_ms`, without latest departure."""
    body = {
        "operator": "acme-air",
        "aircraft_type": AIRCRAFT,
        "origin": asdict(district.centre(origin)),
        "destination": asdict(district.centre(destination)),
        "earliest_departure": format_time(earliest_ms),
    }
    if window_ms is not None:
        body["latest_departure"] = format_time(earliest_ms + window_ms)
    return {**body, **members}


def recorded(answer: Mapping[str, Any]) -> dict[str, Any]:
    """Return the answer to a submission or a change as it can be read later: without those who made way."""
    assert set(answer) == CHANGED
    return {name: value for name, value in answer.items() if name != "displaced"}


def position(
    place: str | Block | Position, time_ms: int, /, *, district: District = OLD_TOWN, **members: Any
) -> dict[str, Any]:
    """Return one position of a report; `members` name the flight or the track, and whatever else is to be said."""
    where = place if isinstance(place, Position) else district.centre(place)
    return {"time": format_time(time_ms), **asdict(where), **members}


def report(*positions: Any) -> dict[str, Any]:
    """Return the body of a report."""
    return {"positions": positions}


def problem(response: httpx.Response, status: int, slug: str) -> dict[str, Any]:
    """Return a response's problem document, after checking that it is this one."""
    document: dict[str, Any] = response.json()
    assert (response.status_code, document["type"]) == (status, f"/problems/{slug}"), document
    assert response.headers["content-type"] == MEDIA_TYPE
    assert set(document) >= PROBLEM
    assert document["status"] == status
    assert document["title"]
    assert document["detail"]
    return document
