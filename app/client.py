"""A small typed client of the HTTP API.

ClientError
├── ServiceUnreachable   no answer
├── UnexpectedAnswer     an answer that is not AirMatrix's
├── MalformedToken       what was given as a token is none
└── ProblemAnswer        the service answered with a problem document
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeVar
from urllib.parse import quote

import httpx
import orjson
from pydantic import BaseModel, ValidationError

from app.flight_intents import State
from app.routes.aircraft_types import AircraftTypeAnswer, AircraftTypeList
from app.routes.airspace import AirspaceAnswer, StaticAnswer
from app.routes.answers import FlightIntentAnswer, FlightIntentPage, PlannedFlightBody
from app.routes.events import EventPage
from app.routes.flights import AlertList, FlightList
from app.routes.health import Readiness
from app.routes.status import StatusAnswer
from app.routes.submissions import FlightIntentBody
from app.routes.telemetry import TelemetryAnswer
from app.times import format_time
from planner.airmatrix import AirMatrix

DEFAULT_URL = "http://127.0.0.1:8000"

# RFC 6750: what follows `Bearer`.
_TOKEN = re.compile(r"[A-Za-z0-9._~+/-]+=*")

Answer = TypeVar("Answer", bound=BaseModel)


class ClientError(Exception):
    """The service did not do what was asked."""


class ServiceUnreachable(ClientError):
    """The service did not answer."""


class UnexpectedAnswer(ClientError):
    """Something answered, but not like AirMatrix."""


class MalformedToken(ClientError):
    """What was given as a token is none."""


class ProblemAnswer(ClientError):
    """The service answered with a problem; `members` is the whole document."""

    def __init__(self, status: int, members: dict[str, Any]) -> None:
        kind = f"{status} {members.get('title', '')}".strip()
        super().__init__(": ".join(filter(None, (kind, members.get("detail") or members.get("reason")))))
        self.status = status
        self.members = members

    @property
    def reason(self) -> str:
        """The machine-readable reason, or the problem's slug where it has none."""
        return str(self.members.get("reason") or str(self.members.get("type", "unknown")).rpartition("/")[2])


class Client:
    """One connection pool to one service; use it as a context manager. Methods raise `ClientError`."""

    def __init__(
        self,
        url: str = DEFAULT_URL,
        timeout_s: float = 30.0,
        transport: httpx.BaseTransport | None = None,
        token: str | None = None,
    ) -> None:
        headers = authorization(token)
        try:
            self._http = httpx.Client(base_url=url, timeout=timeout_s, transport=transport, headers=headers)
        except httpx.InvalidURL as error:
            raise ServiceUnreachable(f"{url!r} is not an address: {error}") from error

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self._http.close()

    def submit(self, body: FlightIntentBody, idempotency_key: str | None = None) -> FlightIntentAnswer:
        """Submit a flight intent; a refusal is a `ProblemAnswer` with status 409 or 422."""
        headers = {} if idempotency_key is None else {"Idempotency-Key": idempotency_key}
        return self._send(FlightIntentAnswer, "POST", "/v1/flight-intents", json=_json(body), headers=headers)

    def preview(self, body: FlightIntentBody) -> PlannedFlightBody:
        """Plan a flight without reserving it."""
        return self._send(PlannedFlightBody, "POST", "/v1/flight-intents/preview", json=_json(body))

    def flight_intent(self, intent_id: str) -> FlightIntentAnswer:
        """Read a flight intent."""
        return self._send(FlightIntentAnswer, "GET", f"/v1/flight-intents/{quote(intent_id, safe='')}")

    def flight_intents(
        self, operator: str | None = None, state: State | None = None, from_ms: int | None = None
    ) -> Iterator[FlightIntentAnswer]:
        """Yield all flight intents by sequence, page by page; `from_ms`: only those that arrive then or later."""
        wanted = {
            "operator": operator,
            "state": None if state is None else state.value,
            "from": None if from_ms is None else format_time(from_ms),
        }
        parameters = {name: value for name, value in wanted.items() if value is not None}
        while True:
            page = self._send(FlightIntentPage, "GET", "/v1/flight-intents", params=parameters)
            yield from page.items
            if page.next_cursor is None:
                return
            parameters["cursor"] = page.next_cursor

    def cancel(self, intent_id: str) -> FlightIntentAnswer:
        """Cancel a flight intent."""
        return self._send(FlightIntentAnswer, "DELETE", f"/v1/flight-intents/{quote(intent_id, safe='')}")

    def activate(self, intent_id: str) -> FlightIntentAnswer:
        """Say that the flight begins."""
        return self._send(FlightIntentAnswer, "POST", f"/v1/flight-intents/{quote(intent_id, safe='')}/activate")

    def end(self, intent_id: str) -> FlightIntentAnswer:
        """Say that the flight is over."""
        return self._send(FlightIntentAnswer, "POST", f"/v1/flight-intents/{quote(intent_id, safe='')}/end")

    def telemetry(self, positions: Sequence[Mapping[str, object]]) -> TelemetryAnswer:
        """Report positions; each that is refused has a problem in the answer."""
        return self._send(
            TelemetryAnswer,
            "POST",
            "/v1/telemetry",
            content=orjson.dumps({"positions": positions}),
            headers={"Content-Type": "application/json"},
        )

    def flights(self) -> FlightList:
        """List the flights and tracks that fly or should, with their newest positions."""
        return self._send(FlightList, "GET", "/v1/flights")

    def alerts(self) -> AlertList:
        """List what deviates, newest first."""
        return self._send(AlertList, "GET", "/v1/airspace/alerts")

    def airspace(self) -> AirspaceAnswer:
        """Read the airspace."""
        return self._send(AirspaceAnswer, "GET", "/v1/airspace")

    def static_blocks(self) -> StaticAnswer:
        """List the statically occupied blocks."""
        return self._send(StaticAnswer, "GET", "/v1/airspace/static")

    def aircraft_types(self) -> list[AircraftTypeAnswer]:
        """List the aircraft types."""
        return self._send(AircraftTypeList, "GET", "/v1/aircraft-types").items

    def status(self, at_ms: int | None = None) -> StatusAnswer:
        """Read the blocks in use, now by default."""
        parameters = {} if at_ms is None else {"at": format_time(at_ms)}
        return self._send(StatusAnswer, "GET", "/v1/airspace/status", params=parameters)

    def events(self, after: int = 0) -> EventPage:
        """Read a page of the journal."""
        return self._send(EventPage, "GET", "/v1/events", params={"after": str(after)})

    def readiness(self) -> Readiness:
        """Ask whether the service is ready; `ProblemAnswer` with status 503 if not."""
        return self._send(Readiness, "GET", "/health/ready")

    def _send(self, answer: type[Answer], method: str, path: str, **arguments: Any) -> Answer:
        try:
            response = self._http.request(method, path, **arguments)
        except httpx.TransportError as error:
            cause = str(error) or type(error).__name__
            raise ServiceUnreachable(f"no answer from {self._http.base_url}: {cause}") from error
        if response.is_error:
            raise ProblemAnswer(response.status_code, _members(response))
        try:
            return answer.model_validate_json(response.content)
        except ValidationError as error:
            raise UnexpectedAnswer(
                f"{self._http.base_url} does not answer like AirMatrix: {method} {path}: {error.errors()[0]['msg']}"
            ) from error


def authorization(token: str | None) -> dict[str, str]:
    """Return the headers that a bearer token is sent in, none without one; raises `MalformedToken`."""
    if token is None:
        return {}
    if not _TOKEN.fullmatch(token.strip()):
        raise MalformedToken("the token has characters that no token has; give what `airmatrix token` prints")
    return {"Authorization": f"Bearer {token.strip()}"}


def grid_of(answer: AirspaceAnswer) -> AirMatrix:
    """Return the grid that an airspace's answer describes."""
    return AirMatrix(
        epsg=int(answer.crs.removeprefix("EPSG:")),
        origin_x_m=answer.origin.x,
        origin_y_m=answer.origin.y,
        block_side_m=answer.block_side_m,
        block_height_m=answer.block_height_m,
        dimensions=answer.dimensions,
    )


def _json(body: FlightIntentBody) -> dict[str, Any]:
    return body.model_dump(mode="json", exclude_none=True)


def _members(response: httpx.Response) -> dict[str, Any]:
    try:
        members = response.json()
    except ValueError:
        members = None
    return members if isinstance(members, dict) else {"title": response.reason_phrase, "detail": response.text[:500]}
