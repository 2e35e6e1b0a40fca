"""Batches: flight intents of equal standing, planned together."""

import asyncio
import hashlib
from collections.abc import Coroutine, Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import orjson
from anyio import to_thread
from fastapi import APIRouter, Header, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Field, model_validator

from app import problems
from app.auth import CallerDep
from app.batches import BatchKey, BatchOutcome
from app.deconfliction import Outcome
from app.errors import (
    ItemNotAllowed,
    ItemRefused,
    MalformedRequest,
    OperatorMismatch,
    PriorityNotAllowed,
    UnknownAircraftType,
)
from app.routes.answers import ChangedFlightIntentAnswer, outcome_body
from app.routes.submissions import Finite, FlightIntentBody, located, spoken_for
from app.service import Service, ServiceDep
from planner.errors import NotPlannable
from planner.together import Figures

router = APIRouter(prefix="/v1/flight-intents/batch", tags=["flight intents"])

_MOST_INTENTS = 500
_LONGEST_S = 10.0


class BatchBody(problems.StrictBody):
    """Flight intents that nobody needs to be first among."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "flight_intents": [
                        {
                            "operator": "acme-air",
                            "reference": "ORD-7786",
                            "aircraft_type": "dji-matrice-600-pro",
                            "origin": {"lon": 71.4202, "lat": 51.1160, "alt_m": 20},
                            "destination": {"lon": 71.4205, "lat": 51.1160, "alt_m": 20},
                            "earliest_departure": "2026-11-22T09:00:00Z",
                        },
                        {
                            "operator": "acme-air",
                            "reference": "ORD-7787",
                            "aircraft_type": "dji-mavic-air",
                            "origin": {"lon": 71.4205, "lat": 51.1162, "alt_m": 20},
                            "destination": {"lon": 71.4205, "lat": 51.1164, "alt_m": 20},
                            "earliest_departure": "2026-11-22T09:00:00Z",
                        },
                    ],
                    "improve_for_s": 0.5,
                }
            ]
        },
    )

    flight_intents: Annotated[list[FlightIntentBody], Field(min_length=1, max_length=_MOST_INTENTS)]
    improve_for_s: Annotated[
        Finite, Field(ge=0, le=_LONGEST_S, description="How long to look for something better than their order.")
    ] = 1.0

    @model_validator(mode="before")
    @classmethod
    def _few_enough(cls, body: object) -> object:
        """Count flight intents before any of them is looked at."""
        items = body.get("flight_intents") if isinstance(body, dict) else None
        if isinstance(items, list) and len(items) > _MOST_INTENTS:
            raise ValueError(f"{len(items)} flight_intents; a batch may have up to {_MOST_INTENTS}")
        return body

    @model_validator(mode="after")
    def _of_equal_standing(self) -> "BatchBody":
        first = self.flight_intents[0].priority
        for number, body in enumerate(self.flight_intents):
            if body.priority != first:
                raise ValueError(
                    f"flight_intents[{number}] has priority {body.priority} and flight_intents[0] {first}: "
                    "a batch has one"
                )
        return self


class FiguresBody(BaseModel):
    """Delays of the flights that have a plan, in seconds, and how many are `refused`.

    `spread_s` is the standard deviation. `fairness` is Jain's index of what each flight gets of what it would have
    alone: its flight time without traffic, divided by the time from its earliest departure to its arrival, 0 if it is
    refused. It is 1 if all get the same share.
    """

    total_delay_s: float
    mean_delay_s: float
    worst_delay_s: float
    spread_s: float
    fairness: float
    refused: int


class ImprovementBody(BaseModel):
    """How long better schedules were looked for, and why no longer: `time`, `optimal` or `shutdown`."""

    iterations: int
    elapsed_s: float
    stopped_by: str


class RefusedItem(problems.Problem):
    """A flight intent that was refused, and is recorded so."""

    reason: str
    flight_intent_id: str
    sequence: int


class BatchAnswer(BaseModel):
    """What became of each flight intent, in the order of the batch, and what planning them together has won."""

    items: list[ChangedFlightIntentAnswer | RefusedItem]
    first_come: FiguresBody
    improved: FiguresBody
    improvement: ImprovementBody


@router.post(
    "",
    status_code=201,
    response_class=Response,
    responses={201: {"model": BatchAnswer}, **problems.documented(400, 403, 413, 422, 429, 503)},
    summary="Submit flight intents together",
)
async def submit(
    request: Request,
    service: ServiceDep,
    caller: CallerDep,
    body: BatchBody,
    idempotency_key: Annotated[str | None, Header(min_length=1, max_length=255)] = None,
) -> Response:
    """Plan flights of one priority together, and reserve all that have a plan: all of them are recorded, or none.

    First come, first served in the order of the batch is what they would get one by one. Other orders are tried from
    there, for `improve_for_s`, so that delays become fewer and less unequal: whoever would have a plan one by one has
    one, and unless more of them have one, they are not delayed more in all. A single flight may well be. Nobody else's
    flight is moved, whatever the priority. Some batches may wait for each other; more are answered
    503, a second one of the same operator 429. One that cannot be planned in time is answered 503 too: send fewer
    flight intents then.

    The answer to a repetition with the same `Idempotency-Key` has the flight intents as they are by then.
    """
    # One has been counted already.
    service.access.overdraw(caller, len(body.flight_intents) - 1)
    bodies, submissions = [], []
    for number, item in enumerate(body.flight_intents):
        with _item(number):
            bodies.append(spoken_for(caller, item))
            submissions.append(located(service, bodies[number]))
    key = None
    if idempotency_key is not None:
        asked = {"flight_intents": [item.model_dump() for item in bodies], "improve_for_s": body.improve_for_s}
        digest = hashlib.sha256(orjson.dumps(asked, option=orjson.OPT_SORT_KEYS)).hexdigest()
        key = BatchKey(idempotency_key, digest)
    planning = service.batches.submit(submissions, body.improve_for_s, key, service.closing.is_set)
    outcome = await _while_connected(request, planning)
    # Hundreds of trajectories take a while to write down.
    content = await to_thread.run_sync(_answer, service, outcome)
    headers = {"Idempotent-Replayed": "true"} if outcome.is_replayed else None
    return Response(content, 201, headers, "application/json")


async def _while_connected(request: Request, work: Coroutine[Any, Any, BatchOutcome]) -> BatchOutcome:
    """Return what comes of some work, which is cancelled if the client hangs up; raises `MalformedRequest` then."""
    job, hung_up = asyncio.ensure_future(work), asyncio.ensure_future(_hung_up(request))
    try:
        await asyncio.wait((job, hung_up), return_when=asyncio.FIRST_COMPLETED)
    finally:
        hung_up.cancel()
        job.cancel()
    try:
        return await job
    except asyncio.CancelledError:
        if not job.cancelled():
            raise
        raise MalformedRequest("the connection ended before the batch was planned") from None


async def _hung_up(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass


@contextmanager
def _item(number: int) -> Iterator[None]:
    """Say of which item it is that something is wrong."""
    try:
        yield
    except (UnknownAircraftType, NotPlannable) as error:
        raise ItemRefused(number, error) from error
    except (OperatorMismatch, PriorityNotAllowed) as error:
        raise ItemNotAllowed(number, error) from error
    except RequestValidationError as error:
        place = ("body", "flight_intents", number)
        found = [{**item, "loc": (*place, *item["loc"][1:])} for item in error.errors()]
        raise RequestValidationError(found) from error


def _answer(service: Service, outcome: BatchOutcome) -> bytes:
    comparison = outcome.comparison
    improvement = comparison.improvement
    return orjson.dumps(
        {
            "items": [orjson.Fragment(outcome_body(service, Outcome(intent))) for intent in outcome.intents],
            "first_come": _figures(comparison.first_come),
            "improved": _figures(comparison.improved),
            "improvement": {
                "iterations": improvement.iterations,
                "elapsed_s": round(improvement.elapsed_s, 3),
                "stopped_by": improvement.stopped_by,
            },
        }
    )


def _figures(figures: Figures) -> dict[str, Any]:
    return {
        "total_delay_s": figures.total_ms / 1000,
        "mean_delay_s": round(figures.mean_ms / 1000, 3),
        "worst_delay_s": figures.worst_ms / 1000,
        "spread_s": round(figures.spread_ms / 1000, 3),
        "fairness": round(figures.fairness, 6),
        "refused": figures.refused,
    }
