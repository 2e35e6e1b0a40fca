"""Domain error -> RFC 9457 problem: the only table of HTTP statuses."""

import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import orjson
import structlog
from fastapi import APIRouter, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, model_validator
from starlette.exceptions import HTTPException
from starlette.responses import Response

from app import auth, errors
from app.flight_intents import FlightIntent, Refusal
from app.times import format_time
from planner.errors import AircraftProfileError, NoPlan, NotPlannable, PathRefused, VolumeError
from planner.submitted import PathConflicts

log = structlog.get_logger()

MEDIA_TYPE = "application/problem+json"

_Found = TypeVar("_Found")


@dataclass(frozen=True)
class Kind:
    """One kind of problem: its slug in ``/problems/``, status, title, and what its reader can do."""

    slug: str
    status: int
    title: str
    advice: str


KINDS: dict[type[Exception], Kind] = {
    NotPlannable: Kind(
        "not-plannable", 422, "No plan can exist for this request",
        "Change origin or destination; `reason` says which, `nearest_free_block` where to.",
    ),
    PathRefused: Kind(
        "path-refused", 422, "This path cannot be flown",
        "Change the entry whose index is `entry`; `reason` says what is wrong with it.",
    ),
    NoPlan: Kind(
        "no-conflict-free-plan", 409, "Traffic or closed airspace leaves no plan",
        "Submit again with a later departure; `earliest_feasible_departure` is one that works now, where known.",
    ),
    AircraftProfileError: Kind(
        "aircraft-too-slow", 422, "The aircraft is too slow for this airspace", "Choose a faster aircraft type."
    ),
    PathConflicts: Kind(
        "path-conflicts", 409, "Others are in the way of this path",
        "Submit a path around `conflicts`, or what `proposal` flies, where there is one.",
    ),
    errors.UnknownAircraftType: Kind(
        "unknown-aircraft-type", 422, "Unknown aircraft type", "Choose one from /v1/aircraft-types."
    ),
    errors.DepartureInThePast: Kind(
        "departure-in-the-past", 422, "The departure window has passed", "Choose a later departure."
    ),
    errors.BeyondHorizon: Kind(
        "beyond-horizon", 422, "The departure is too far ahead", "Submit the flight intent nearer to its departure."
    ),
    errors.UnknownFlightIntent: Kind(
        "unknown-flight-intent", 404, "Unknown flight intent", "Check the id; /v1/flight-intents lists all."
    ),
    errors.UnknownBlock: Kind(
        "unknown-block", 404, "Unknown block", "Blocks are zero-based; `dimensions` in /v1/airspace bounds them."
    ),
    errors.UnknownConstraint: Kind(
        "unknown-constraint", 404, "Unknown constraint", "Check the id; /v1/constraints lists those in force."
    ),
    errors.TooManyConstraints: Kind(
        "too-many-constraints", 409, "Too many constraints", "Remove some, or close one larger volume instead."
    ),
    VolumeError: Kind(
        "invalid-volume", 422, "Not a volume of this airspace",
        "Send a valid polygon in degrees, and altitudes, that reach into the airspace.",
    ),
    errors.UnknownWebhook: Kind("unknown-webhook", 404, "Unknown webhook", "Check the id; /v1/webhooks lists yours."),
    errors.WebhookRefused: Kind(
        "webhook-refused", 422, "Nothing is delivered to this address", "Give an https url of a public host."
    ),
    errors.TooManyWebhooks: Kind("too-many-webhooks", 409, "Too many webhooks", "Remove one that is not needed."),
    errors.ItemRefused: Kind(
        "item-refused", 422, "An item of the batch is refused, and the batch with it",
        "Nothing was recorded. `cause` says what is wrong with the item at `index`; correct or leave it out.",
    ),
    errors.ItemNotAllowed: Kind(
        "item-not-allowed", 403, "An item of the batch is not allowed, and so the batch is refused",
        "Nothing was recorded. `cause` says what the token does not allow in the item at `index`.",
    ),
    errors.BatchNotPlanned: Kind(
        "batch-not-planned", 503, "There was not enough time to plan the batch",
        "Nothing was recorded. Send fewer flight intents at once, or the same later.",
    ),
    errors.IllegalTransition: Kind(
        "illegal-transition", 409, "The flight intent's state does not allow this",
        "Read the intent's state first; one that is displaced can be changed, which plans it again, or cancelled.",
    ),
    errors.NotChangeable: Kind(
        "not-changeable", 422, "This cannot be changed", "Leave it as it is, or cancel the intent and submit another."
    ),
    errors.PreconditionRequired: Kind(
        "precondition-required", 428, "Which version is to be changed?",
        "Send the `ETag` of the flight intent that you read as `If-Match`.",
    ),
    errors.PreconditionFailed: Kind(
        "precondition-failed", 412, "The flight intent has changed since", "Read it again, and change what it is now."
    ),
    errors.IdempotencyKeyReused: Kind(
        "idempotency-key-reused", 422, "Idempotency key used with another body", "Use a new key for a new request."
    ),
    errors.PositionRefused: Kind(
        "invalid-position", 422, "Not a position", "Send what /docs shows; the other positions of the report are kept."
    ),
    errors.UnknownFlight: Kind(
        "unknown-flight", 404, "Unknown flight", "Check `flight_intent_id`; report others under a `track_id`."
    ),
    errors.PositionInTheFuture: Kind(
        "position-in-the-future", 422, "Position from the future", "Check the reporting system's clock."
    ),
    errors.PositionTooOld: Kind(
        "position-too-old", 422, "Position too old to be kept", "Report positions within seconds."
    ),
    errors.PositionOutOfOrder: Kind(
        "position-out-of-order", 409, "Not newer than what is known", "Drop it; report newer positions."
    ),
    errors.PositionNotFinite: Kind(
        "position-not-finite", 422, "Position not finite", "Send finite numbers, or nothing."
    ),
    errors.PositionRemote: Kind(
        "position-remote", 422, "Position nowhere near the airspace", "Report positions of this airspace only."
    ),
    errors.PositionNotAllowed: Kind(
        "position-not-allowed", 403, "Not yours to report",
        "Flights need the scope airmatrix.plan, tracks airmatrix.surveillance.",
    ),
    errors.TooManyPositions: Kind(
        "too-many-positions", 413, "Too many positions", "Split the report."
    ),
    errors.InvalidCursor: Kind(
        "invalid-cursor", 422, "Invalid cursor", "Pass `next_cursor` as it came, or leave it out to start again."
    ),
    errors.BodyTooLarge: Kind("body-too-large", 413, "The body is too large", "Send fewer bytes."),
    errors.HeadTooLarge: Kind(
        "head-too-large", 431, "The request's head is too large", "Send fewer and shorter headers."
    ),
    errors.RequestTimedOut: Kind(
        "request-timeout", 408, "The request did not arrive in time", "Send it again, the whole of it at once."
    ),
    errors.TooManyConnections: Kind(
        "too-many-connections", 503, "Too many connections are open",
        "Wait `Retry-After` seconds; use fewer connections.",
    ),
    errors.TooManyStreams: Kind(
        "too-many-streams", 503, "Too many streams are open", "Read /v1/airspace/status, or ask another server."
    ),
    errors.UnsupportedMediaType: Kind(
        "unsupported-media-type", 415, "The body is not said to be JSON", "Send `Content-Type: application/json`."
    ),
    errors.MalformedRequest: Kind("malformed-request", 400, "Malformed request", "Send a JSON document."),
    errors.Unauthenticated: Kind(
        "unauthenticated", 401, "No valid token", "Send `Authorization: Bearer <token>` with a token that is valid now."
    ),
    errors.InsufficientScope: Kind(
        "insufficient-scope", 403, "The token lacks a scope", "Ask for a token with one of `needed_scopes`."
    ),
    errors.OperatorMismatch: Kind(
        "operator-mismatch", 403, "Another operator than the token's", "Leave `operator` out, or name the token's."
    ),
    errors.PriorityNotAllowed: Kind(
        "priority-not-allowed", 403, "The token does not allow this priority",
        "Ask for a lower priority, or for a token with a higher `airmatrix_max_priority`.",
    ),
    errors.TooManyRequests: Kind("too-many-requests", 429, "Too many requests", "Wait `Retry-After` seconds."),
    errors.TooManyOpenIntents: Kind(
        "too-many-open-intents", 429, "Too many flight intents that are not over",
        "Wait until flights have ended, or cancel some.",
    ),
    errors.HostNotAllowed: Kind(
        "host-not-allowed", 421, "Host not served here",
        "Without authentication only loopback hosts are answered; use 127.0.0.1 or localhost.",
    ),
    errors.CrossSiteRequest: Kind(
        "cross-site-request", 403, "Asked for by another site's page",
        "Without authentication only this service's own pages, and programs, may change anything.",
    ),
    errors.QueueFull: Kind("queue-full", 503, "Too many requests are waiting", "Wait `Retry-After` seconds."),
    errors.LedgerUnavailable: Kind(
        "ledger-unavailable", 503, "The ledger is unavailable", "Nothing was recorded. Try again later."
    ),
    errors.OutcomeUnknown: Kind(
        "outcome-unknown", 503, "It is not known whether this was recorded",
        "Repeat the request with the same Idempotency-Key if it had one; else read first what there is.",
    ),
    errors.ReadOnlyServer: Kind(
        "read-only", 421, "This server only answers reads", "Send the request to a server that writes."
    ),
    errors.NotReady: Kind("not-ready", 503, "The service is not ready", "`reason` says why. Ask again in a second."),
}  # fmt: skip

VALIDATION = Kind("validation-error", 422, "Invalid request", "Correct what `errors` lists.")
HTTP_ERRORS = {
    404: Kind("not-found", 404, "Not found", "Check the path against /docs."),
    405: Kind("method-not-allowed", 405, "Method not allowed", "Check the method against /docs; `Allow` names others."),
}
INTERNAL = Kind("internal-error", 500, "Internal error", "Report `error_id`; the log has the details.")


# Who sends more that is wrong than this has hardly read as much.
_MOST_TOLD = 100

# What a body of several forms is told apart by stands in the place of an error like a member; it is none.
FORMS = (":planned", ":trajectory", ":volumes")


class Problem(BaseModel):
    """An RFC 9457 problem document; kinds of problems add members."""

    model_config = ConfigDict(extra="allow")

    type: str
    title: str
    status: int
    detail: str


class KindAnswer(BaseModel):
    """What a problem's `type` leads to."""

    type: str
    title: str
    status: int
    advice: str


def documented(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return what OpenAPI says of a route's problems."""
    return {status: {"model": Problem, "description": "A problem (RFC 9457)"} for status in (*statuses, 500)}


router = APIRouter(prefix="/problems", tags=["running it"])


@router.get("/{slug}", responses=documented(404), summary="Explain a kind of problem")
async def explain(slug: str) -> KindAnswer:
    """Say what a problem of this type means and what to do about it."""
    for kind in (*KINDS.values(), *HTTP_ERRORS.values(), VALIDATION, INTERNAL):
        if kind.slug == slug:
            return KindAnswer(type=f"/problems/{slug}", title=kind.title, status=kind.status, advice=kind.advice)
    raise HTTPException(404)


def kind_of(error: Exception) -> Kind:
    """Return the kind of problem an error is; `KeyError` if the table lacks it, which is a bug."""
    for cls in type(error).__mro__:
        if cls in KINDS:
            return KINDS[cls]
    raise KeyError(type(error))


def document(kind: Kind, detail: str) -> dict[str, Any]:
    """Return the members that all problems have."""
    return {"type": f"/problems/{kind.slug}", "title": kind.title, "status": kind.status, "detail": detail}


def body(kind: Kind, detail: str, members: Mapping[str, Any] | None = None) -> bytes:
    """Return a problem document."""
    return orjson.dumps(document(kind, detail) | dict(members or {}))


def response(
    kind: Kind, detail: str, members: Mapping[str, Any] | None = None, headers: Mapping[str, str] | None = None
) -> Response:
    """Return a problem as an HTTP response."""
    return Response(body(kind, detail, members), kind.status, headers, MEDIA_TYPE)


def response_to(error: Exception) -> Response:
    """Return the response to a domain error."""
    members: dict[str, Any] = {}
    if isinstance(error, NotPlannable):
        members["reason"] = error.reason
        if error.nearest_free_block is not None:
            members["nearest_free_block"] = error.nearest_free_block
    if isinstance(error, PathRefused):
        members |= {"reason": error.reason, "entry": error.entry}
    if isinstance(error, NoPlan):
        members["reason"] = error.reason
        if error.earliest_feasible_departure_ms is not None:
            members["earliest_feasible_departure"] = format_time(error.earliest_feasible_departure_ms)
    if isinstance(error, errors.NotReady):
        members |= {"reason": error.reason, "waiting": error.waiting, "revision": error.revision}
    if isinstance(error, errors.InsufficientScope):
        members["needed_scopes"] = error.needed
    if isinstance(error, errors.ItemRefused):
        members |= {"index": error.index, "cause": orjson.Fragment(response_to(error.cause).body)}
    return response(kind_of(error), str(error), members, _headers(error))


def _headers(error: Exception) -> dict[str, str]:
    if isinstance(error, errors.Unauthenticated):
        return {"WWW-Authenticate": 'Bearer error="invalid_token"' if error.is_invalid else "Bearer"}
    if isinstance(error, errors.InsufficientScope):
        return {"WWW-Authenticate": f'Bearer error="insufficient_scope", scope="{" ".join(error.needed)}"'}
    if isinstance(error, errors.TooManyRequests):
        return {"Retry-After": str(error.retry_after_s)}
    return {"Retry-After": "1"} if kind_of(error).status == 503 else {}


def refusal_body(
    refusal: Refusal,
    intent: FlightIntent | None = None,
    stands: str | None = None,
    more: Mapping[str, Any] | None = None,
) -> bytes:
    """Return the problem document of a refusal, with the intent under which it is recorded, if it is, or the id of the
    one whose old plan stands; `more` are members that only its kind has.
    """
    members: dict[str, Any] = {"reason": refusal.reason, "conflicting_intents": refusal.conflicting_intents}
    if refusal.conflicting_constraints:
        members["conflicting_constraints"] = refusal.conflicting_constraints
    if intent is not None:
        members |= {"flight_intent_id": intent.id, "sequence": intent.sequence}
    if stands is not None:
        members["flight_intent_id"] = stands
    if refusal.earliest_feasible_departure_ms is not None:
        members["earliest_feasible_departure"] = format_time(refusal.earliest_feasible_departure_ms)
    kind = PathConflicts if refusal.reason == PathConflicts.reason else NoPlan
    return body(KINDS[kind], refusal.detail, members | dict(more or {}))


class StrictBody(BaseModel):
    """A body, or a part of one, that is refused for the first member that it does not know: naming each of a hundred
    thousand would keep everybody waiting.
    """

    model_config = ConfigDict(extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _with_one_unknown(cls, given: object) -> object:
        known = {field.alias or name for name, field in cls.model_fields.items()}
        if not isinstance(given, dict) or given.keys() <= known:
            return given
        unknown = next(name for name in given if name not in known)
        return {name: value for name, value in given.items() if name == unknown or name in known}


def told(found: Sequence[_Found]) -> Sequence[_Found]:
    """Return so much of what is wrong with a body as is told; how much there is in all is said beside it."""
    return found[:_MOST_TOLD]


def install(app: FastAPI) -> None:
    """Answer every error with a problem."""

    async def domain_error(_: Request, error: Exception) -> Response:
        return response_to(error)

    async def validation_error(_: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        all_errors = error.errors()
        found = [
            {
                "loc": [part for part in item["loc"] if part not in FORMS],
                "msg": item["msg"].removeprefix("Value error, "),
                "type": item["type"],
            }
            for item in told(all_errors)
        ]
        members = {"errors": found, "error_count": len(all_errors)}
        if any(item["type"] == "json_invalid" for item in found):
            return response(KINDS[errors.MalformedRequest], "the body is not valid JSON", members)
        first = f"{'.'.join(str(part) for part in found[0]['loc'])}: {found[0]['msg']}"
        more = f" (and {len(all_errors) - 1} more)" if len(all_errors) > 1 else ""
        return response(VALIDATION, first + more, members)

    async def http_error(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        if error.status_code == 400:
            return response(KINDS[errors.MalformedRequest], "the body cannot be parsed")
        known = HTTP_ERRORS.get(error.status_code)
        if known is not None:
            headers = dict(error.headers or {})
            if known.status == 405:
                # The framework names those of one route that has the path: not all, or those of another's pattern.
                head = {"HEAD"}.intersection(headers.get("Allow", "").split(", "))
                headers["Allow"] = ", ".join(sorted(auth.methods_at(request.url.path) | head))
            return response(known, known.advice, headers=headers)
        # What the framework refuses for reasons of its own is malformed to us, under the framework's status.
        malformed = replace(KINDS[errors.MalformedRequest], status=error.status_code)
        return response(malformed, str(error.detail), headers=error.headers)

    async def unexpected_error(request: Request, error: Exception) -> Response:
        error_id = str(uuid.uuid4())
        log.error("unexpected error", error_id=error_id, path=request.url.path, exc_info=error)
        return response(INTERNAL, INTERNAL.advice, {"error_id": error_id})

    for kind in KINDS:
        app.add_exception_handler(kind, domain_error)
    app.add_exception_handler(RequestValidationError, validation_error)
    app.add_exception_handler(HTTPException, http_error)
    app.add_exception_handler(Exception, unexpected_error)
