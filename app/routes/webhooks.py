"""Webhooks: subscribe to events, see how their delivery goes, unsubscribe."""

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Field

from app import problems
from app.auth import Caller, CallerDep
from app.errors import OperatorMismatch, UnknownWebhook
from app.labels import Label
from app.ledger.webhooks import Webhook
from app.routes import ids, paging
from app.service import ServiceDep
from app.times import Moment

router = APIRouter(prefix="/v1/webhooks", tags=["webhooks"])

Kind = Literal["intent", "conformance"]


class WebhookBody(problems.StrictBody):
    """Where events of an operator's flight intents are to go: their new states, and that they are unmoved by a
    constraint (`intent`); and how their aircraft conform (`conformance`).
    """

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "operator": "acme-air",
                    "url": "https://flights.acme-air.example/airmatrix",
                    "secret": "a-secret-of-your-own-choice",
                    "kinds": ["intent", "conformance"],
                }
            ]
        },
    )

    operator: Annotated[Label | None, Field(description="Required without authentication; else the token's.")] = None
    url: Annotated[str, Field(min_length=1, max_length=2000, pattern=r"^[\x21-\x7e]+$")]
    secret: Annotated[
        str | None,
        Field(
            min_length=16,
            max_length=200,
            pattern=r"^[\x21-\x7e]+$",
            description="The key of signatures; made if absent.",
        ),
    ] = None
    kinds: Annotated[list[Kind], Field(min_length=1, max_length=10)]


class WebhookAnswer(BaseModel):
    """A webhook, and how delivery goes. `pending` events wait; `given_up` were tried for a day in vain.

    `failing_since` is null unless an event has to be sent again. Events up to the revision `missed_through` may have
    been removed before they could be sent; null: none were.
    """

    id: str
    operator: str
    url: str
    kinds: list[Kind]
    created: Moment
    pending: int
    given_up: int
    last_delivery: Moment | None
    last_error: str | None
    failing_since: Moment | None
    missed_through: int | None


class NewWebhookAnswer(WebhookAnswer):
    """A webhook as it was just added, with its secret, which no other answer has."""

    secret: str


class WebhookPage(BaseModel):
    """A page of webhooks; `next_cursor` is the `cursor` of the next, null on the last."""

    items: list[WebhookAnswer]
    next_cursor: str | None


@router.post("", status_code=201, responses=problems.documented(400, 409, 413, 422, 503), summary="Subscribe to events")
async def subscribe(service: ServiceDep, caller: CallerDep, body: WebhookBody, response: Response) -> NewWebhookAnswer:
    """Have the events of an operator's flight intents sent to a url from now on, each as a signed POST.

    The body is `{"id", "event", "sent"}`: the event as in `/v1/events`, and the intent's `reference`. The header
    `AirMatrix-Signature` is `t=<unix seconds>,v1=<hex>`, where `<hex>` is the HMAC-SHA256 of `<unix seconds>.<body>`
    under the secret. Whatever is not answered 2xx within 5 s is sent again, later and later, for a day. Events of one
    flight intent come in their order. One may come more than once: then with the same `id`.
    """
    webhook = await service.webhooks.subscribe(_operator(caller, body), body.url, sorted(set(body.kinds)), body.secret)
    response.headers["Location"] = f"{router.prefix}/{webhook.id}"
    return NewWebhookAnswer(**_members(webhook, 0), secret=webhook.secret)


@router.get("", responses=problems.documented(422, 503), summary="List webhooks")
def list_webhooks(
    service: ServiceDep,
    caller: CallerDep,
    operator: Label | None = None,
    limit: Annotated[int, Query(ge=1, le=paging.LIMIT)] = 100,
    cursor: str | None = None,
) -> WebhookPage:
    """List webhooks in the order in which they were added, an operator's own where there is authentication."""
    if operator is not None and not caller.may_change(operator):
        raise OperatorMismatch(f"the webhooks of operator {operator!r} are not yours to see")
    whose = operator if caller.may_change_all else caller.operator
    with service.ledger.webhooks() as rows:
        # One more than asked for: whether there is another page.
        found = rows.page(operator=whose, after=paging.decode(cursor), limit=limit + 1)
        shown = found[:limit]
        waiting = rows.waiting(webhook.number for webhook in shown)
    return WebhookPage(
        items=[WebhookAnswer(**_members(webhook, waiting.get(webhook.number, 0))) for webhook in shown],
        next_cursor=paging.encode(shown[-1].number) if len(found) > limit else None,
    )


@router.delete("/{webhook_id}", responses=problems.documented(404, 503), summary="Unsubscribe")
async def unsubscribe(service: ServiceDep, caller: CallerDep, webhook_id: str) -> WebhookAnswer:
    """Remove a webhook, and return it; what waits for it is not sent any more."""
    own_id = ids.existing(webhook_id, UnknownWebhook, "webhook")
    return WebhookAnswer(**_members(await service.webhooks.unsubscribe(own_id, caller.may_change), 0))


def _operator(caller: Caller, body: WebhookBody) -> str:
    """Return whose events are asked for; raises `RequestValidationError`, `OperatorMismatch`."""
    operator = caller.operator if body.operator is None else body.operator
    if operator is None:
        item = {"type": "missing", "loc": ("body", "operator"), "msg": "Field required without authentication"}
        raise RequestValidationError([item])
    if not caller.may_change(operator):
        raise OperatorMismatch(f"the token is operator {caller.operator!r}'s, not {operator!r}'s")
    return operator


def _members(webhook: Webhook, pending: int) -> dict[str, Any]:
    return {
        "id": webhook.id,
        "operator": webhook.operator,
        "url": webhook.url,
        "kinds": webhook.kinds,
        "created": webhook.created_ms,
        "pending": pending,
        "given_up": webhook.given_up,
        "last_delivery": webhook.last_delivery_ms,
        "last_error": webhook.last_error,
        "failing_since": webhook.failing_since_ms,
        "missed_through": webhook.missed_through,
    }
