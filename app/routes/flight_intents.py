"""Flight intents: submit, preview, read, list, change, cancel, activate, end."""

import hashlib
import re
from typing import Annotated

import orjson
from anyio import to_thread
from fastapi import APIRouter, Header, Query, Response
from fastapi.exceptions import RequestValidationError

from app import problems
from app.auth import Caller, CallerDep
from app.deconfliction import IdempotencyKey
from app.errors import (
    OperatorMismatch,
    PreconditionRequired,
    UnknownFlightIntent,
)
from app.flight_intents import Refusal, State
from app.labels import Label
from app.routes import ids, paging
from app.routes.answers import (
    PATH,
    ChangedFlightIntentAnswer,
    FlightIntentAnswer,
    FlightIntentPage,
    PreviewAnswer,
    intent_response,
    more_of,
    outcome_body,
    outcome_response,
    planned,
    render,
)
from app.routes.submissions import AnyIntentBody, spoken_for, submitted
from app.service import Service, ServiceDep
from app.times import Timestamp, format_time
from planner.errors import NoPlan

# Entity tags, or any (RFC 9110).
_IF_MATCH = r'^ *(\*|(W/)?"[^",]*"( *, *(W/)?"[^",]*")*) *$'

router = APIRouter(prefix=PATH, tags=["flight intents"])

# The longest flights take most of a megabyte each: a page that has so much ends.
_PAGE_BYTES = 32 * 1024 * 1024


@router.post(
    "",
    status_code=201,
    response_class=Response,
    responses={201: {"model": ChangedFlightIntentAnswer}, **problems.documented(400, 409, 413, 422, 503)},
    summary="Submit a flight intent",
)
async def submit(
    service: ServiceDep,
    caller: CallerDep,
    body: AnyIntentBody,
    idempotency_key: Annotated[str | None, Header(min_length=1, max_length=255)] = None,
) -> Response:
    """Plan the flight against everything reserved before, and reserve it; the answer is sent when that is durable.

    A flight of higher `priority` is planned as if those of lower priority were not there that depart late enough to be
    moved and have not been activated. Those in its way are planned again at once; `displaced` says what became of them.

    With a `trajectory` of the operator's own instead, or `volumes`, that is checked and reserved as it is; where others
    are in its way, a `path-conflicts` problem says where and proposes a plan. Bodies may have up to a mebibyte unless
    the server is set otherwise, which is enough for the longest of them.
    """
    body = spoken_for(caller, body)
    submission = await submitted(service, body)
    key = None
    if idempotency_key is not None:
        digest = hashlib.sha256(orjson.dumps(body.model_dump(), option=orjson.OPT_SORT_KEYS)).hexdigest()
        key = IdempotencyKey(idempotency_key, digest, lambda outcome: outcome_body(service, outcome))
    outcome = await service.deconfliction.submit(submission, key)
    return outcome_response(service, outcome)


@router.post(
    "/preview",
    response_class=Response,
    responses={200: {"model": PreviewAnswer}, **problems.documented(400, 409, 413, 422, 503)},
    summary="Plan a flight without reserving it",
)
async def preview(service: ServiceDep, caller: CallerDep, body: AnyIntentBody) -> Response:
    """Answer what submitting this body would give at this moment; nothing is reserved or recorded."""
    submission = await submitted(service, spoken_for(caller, body))
    plan = await service.deconfliction.preview(submission)
    if isinstance(plan, Refusal):
        content = problems.refusal_body(plan, more=more_of(service.airspace.grid, submission, plan))
        return Response(content, problems.KINDS[NoPlan].status, media_type=problems.MEDIA_TYPE)
    answer = planned(service.airspace.grid, "preview", plan.submission, plan.trajectory, plan.reservations)
    answer["displaces"] = plan.displaces
    return Response(orjson.dumps(answer), media_type="application/json")


@router.get(
    "",
    response_class=Response,
    responses={200: {"model": FlightIntentPage}, **problems.documented(422, 503)},
    summary="List flight intents",
)
def list_flight_intents(
    service: ServiceDep,
    caller: CallerDep,
    operator: Label | None = None,
    state: State | None = None,
    from_: Annotated[
        Timestamp | None, Query(alias="from", description="Flights that arrive at this time or later.")
    ] = None,
    to: Annotated[Timestamp | None, Query(description="Flights that depart before this time.")] = None,
    limit: Annotated[int, Query(ge=1, le=paging.LIMIT)] = 50,
    cursor: str | None = None,
) -> Response:
    """List intents in their order of arrival, an operator's own unless they may see all. Refused ones count with their
    departure window. A page of very long flights ends before its `limit`; `next_cursor` says whether there are more.
    """
    if operator is not None and not caller.may_see(operator):
        raise OperatorMismatch(f"the flight intents of operator {operator!r} are not yours to see")
    if not caller.sees_all:
        operator = caller.operator
    # One more than asked for: whether there is another page.
    found = service.ledger.page(
        after_sequence=paging.decode(cursor), limit=limit + 1, operator=operator, state=state, from_ms=from_, to_ms=to
    )
    items, size = [], 0
    for intent in found[:limit]:
        items.append(orjson.Fragment(text := orjson.dumps(render(service.airspace.grid, intent))))
        size += len(text)
        if size >= _PAGE_BYTES:
            break
    next_cursor = paging.encode(found[len(items) - 1].sequence) if len(found) > len(items) else None
    return Response(orjson.dumps({"items": items, "next_cursor": next_cursor}), media_type="application/json")


@router.get(
    "/{intent_id}",
    response_class=Response,
    responses={200: {"model": FlightIntentAnswer}, **problems.documented(404, 503)},
    summary="Read a flight intent",
)
def read(service: ServiceDep, caller: CallerDep, intent_id: str) -> Response:
    """Return an intent with the reservations it still holds."""
    intent = service.ledger.find(_id(intent_id))
    if intent is None or not caller.may_see(intent.submission.operator):
        removed_ms = service.ledger.removed().before_ms
        hint = "" if removed_ms is None else f"; those that ended before {format_time(removed_ms)} have been removed"
        raise UnknownFlightIntent(f"there is no flight intent {intent_id}{hint}")
    return intent_response(service, intent)


@router.put(
    "/{intent_id}",
    response_class=Response,
    responses={
        200: {"model": ChangedFlightIntentAnswer},
        **problems.documented(400, 404, 409, 412, 413, 422, 428, 503),
    },
    summary="Change a flight intent",
)
async def change(
    service: ServiceDep,
    caller: CallerDep,
    intent_id: str,
    body: AnyIntentBody,
    if_match: Annotated[
        str | None,
        Header(
            max_length=1000,
            description="The `ETag` of what is to be changed, in its quotes; `*` for whichever.",
            json_schema_extra={"pattern": _IF_MATCH},
        ),
    ] = None,
) -> Response:
    """Plan the flight anew with this body, under its old sequence number; where that fails, the old plan stands.

    A flight that is activated and in the air keeps to its plan for some seconds more and goes on from there; only its
    destination, reference and priority can change then.
    """
    versions = _versions(if_match)
    own_id = await _own(service, caller, intent_id)
    submission = await submitted(service, spoken_for(caller, body))
    outcome = await service.deconfliction.change(own_id, submission, versions)
    if isinstance(outcome, Refusal):
        more = more_of(service.airspace.grid, submission, outcome)
        content = problems.refusal_body(outcome, stands=intent_id, more=more)
        return Response(content, problems.KINDS[NoPlan].status, media_type=problems.MEDIA_TYPE)
    headers = {"ETag": f'"{outcome.intent.version}"'}
    return Response(outcome_body(service, outcome), headers=headers, media_type="application/json")


@router.delete(
    "/{intent_id}",
    response_class=Response,
    responses={200: {"model": FlightIntentAnswer}, **problems.documented(404, 409, 503)},
    summary="Cancel a flight intent",
)
async def cancel(service: ServiceDep, caller: CallerDep, intent_id: str) -> Response:
    """Cancel an intent. Before departure its blocks are free at once; a departed flight keeps them until arrival, or
    until it is reported on the ground (a position with `airborne: false`) and this request is repeated.
    """
    return intent_response(service, await service.deconfliction.cancel(await _own(service, caller, intent_id)))


@router.post(
    "/{intent_id}/activate",
    response_class=Response,
    responses={200: {"model": FlightIntentAnswer}, **problems.documented(404, 409, 503)},
    summary="Activate a flight intent",
)
async def activate(service: ServiceDep, caller: CallerDep, intent_id: str) -> Response:
    """Say that an accepted flight is about to depart; who flies without that is nonconforming. A service may refuse it
    earlier than so long before departure: an activated flight makes way for nobody.
    """
    return intent_response(service, await service.deconfliction.activate(await _own(service, caller, intent_id)))


@router.post(
    "/{intent_id}/end",
    response_class=Response,
    responses={200: {"model": FlightIntentAnswer}, **problems.documented(404, 409, 503)},
    summary="End a flight intent",
)
async def end(service: ServiceDep, caller: CallerDep, intent_id: str) -> Response:
    """Say that a flight is over. Its blocks are free at once if it has not departed or was reported on the ground; else
    it keeps them until its arrival, for an aircraft does not vanish because a record did, or until it is reported on
    the ground (a position with `airborne: false`) and this request is repeated.
    """
    return intent_response(service, await service.deconfliction.end(await _own(service, caller, intent_id)))


def _versions(if_match: str | None) -> frozenset[int] | None:
    """Return the versions that a change is about, None for any (RFC 9110, If-Match)."""
    if if_match is None:
        raise PreconditionRequired("a change needs `If-Match` with the `ETag` of the flight intent as it was read")
    if if_match.strip() == "*":
        return None
    tags = [tag.strip() for tag in if_match.split(",")]
    if not re.search(_IF_MATCH, if_match):
        raise RequestValidationError(
            [
                {
                    "loc": ("header", "If-Match"),
                    "msg": f'{if_match[:50]} is no entity tag: send the ETag in its quotes, such as "1", or *',
                    "type": "value_error",
                }
            ]
        )
    # What is no version of ours, weak tags among them, matches nothing.
    return frozenset(int(tag[1:-1]) for tag in tags if re.fullmatch(r'"[0-9]{1,18}"', tag, re.ASCII))


def _id(text: str) -> str:
    return ids.existing(text, UnknownFlightIntent, "flight intent")


async def _own(service: Service, caller: Caller, text: str) -> str:
    """Return the id in a path if it is of an intent that the caller may change; raises `UnknownFlightIntent`."""
    intent_id = _id(text)
    if not caller.may_change_all:
        operator = await to_thread.run_sync(service.ledger.operator_of, intent_id)
        if operator is None or not caller.may_change(operator):
            raise UnknownFlightIntent(f"there is no flight intent {text}")
    return intent_id
