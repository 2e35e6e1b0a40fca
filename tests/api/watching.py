"""Two lanes 40 m apart, one between them that nobody has reserved: who flies there, and what is told of it."""

from typing import Any

from app.routes.flights import AlertList, FlightList
from app.routes.status import StatusAnswer
from tests.api.bodies import SUBMIT, TELEMETRY, intent, position, report
from tests.api.serving import Client
from tests.ledger.district import DEPARTURE_MS, LANES

STATUS, FLIGHTS, ALERTS = "/v1/airspace/status", "/v1/flights", "/v1/airspace/alerts"
LINK_MS = 1668
ARRIVAL_MS = DEPARTURE_MS + 7 * LINK_MS
TOLERANCE_MS, FRESHNESS_MS = 2000, 5000
NONE = {"green": 0, "yellow": 0, "red": 0}


def submit(client: Client, origin: str = "W", destination: str = "E", **members: Any) -> str:
    body = intent(origin, destination, district=LANES, **members)
    return str(client.post(SUBMIT, json=body).json()["id"])


def activated(client: Client, origin: str = "W", destination: str = "E") -> str:
    flight = submit(client, origin, destination)
    assert client.post(f"{SUBMIT}/{flight}/activate").status_code == 200
    return flight


def see(client: Client, who: str, i: float, j: float, **members: Any) -> None:
    """Report where an aircraft is now, in blocks from the south-west corner; what is called radar is a track."""
    name = "track_id" if who.startswith("radar") else "flight_intent_id"
    where = LANES.point(i, j, members.pop("alt_m", 20.0))
    seen = position(where, client.service.clock(), **{name: who, "airborne": True, **members})
    assert client.post(TELEMETRY, json=report(seen)).json()["accepted"] == 1


def fly(client: Client, who: str, *, lane: int = 2) -> None:
    """Report a flight where it should be now."""
    see(client, who, 0.5 + (client.service.clock() - DEPARTURE_MS) / LINK_MS, lane + 0.5)


def look(client: Client) -> None:
    client.service.monitor.look()


def state_of(client: Client, flight: str) -> str:
    return str(client.get(f"{SUBMIT}/{flight}").json()["state"])


def colours(client: Client, **parameters: str) -> dict[tuple[int, ...], tuple[str, list[str]]]:
    """Return status and reasons of each block in use."""
    answer = client.get(STATUS, params=parameters).json()
    StatusAnswer.model_validate(answer)
    return {tuple(entry["block"]): (entry["status"], entry["reasons"]) for entry in answer["blocks"]}


def flights(client: Client) -> dict[str, dict[str, Any]]:
    """Return who flies now, by flight intent or track."""
    answer = client.get(FLIGHTS).json()
    FlightList.model_validate(answer)
    return {item["flight_intent_id"] or item["track_id"]: item for item in answer["items"]}


def alerts(client: Client) -> list[dict[str, Any]]:
    answer = client.get(ALERTS).json()
    AlertList.model_validate(answer)
    items: list[dict[str, Any]] = answer["items"]
    return items


def told(client: Client) -> list[tuple[str, str | None, list[str]]]:
    """Return what the journal tells: kind, whose, and why."""
    items = client.get("/v1/events").json()["items"]
    return [(item["kind"], item["flight_intent_id"] or item["track_id"], item["reasons"]) for item in items]
