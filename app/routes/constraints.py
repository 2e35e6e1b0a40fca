"""Constraints: airspace that is closed for a while, or for good."""

from typing import Annotated, Any, Literal

import orjson
from anyio import to_thread
from fastapi import APIRouter, Header, Query, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Field
from uuid_utils import uuid7

from app import problems
from app.constraints import Constraint
from app.errors import UnknownConstraint
from app.labels import Label
from app.routes import ids, paging
from app.routes.airspace import FEATURES, GEOJSON, geojson
from app.routes.answers import DisplacementBody, displacements
from app.routes.submissions import Finite
from app.service import ServiceDep
from app.times import Moment, Timestamp, format_time
from planner.volumes import volume_blocks

router = APIRouter(prefix="/v1/constraints", tags=["constraints"])

# A constraint may say that it has been in force already, but not for longer than this.
_BEGUN_FOR_MS = 86_400_000

Vertex = Annotated[list[Finite], Field(min_length=2, max_length=3, description="Longitude and latitude in degrees.")]
Rings = list[Annotated[list[Vertex], Field(min_length=4)]]


class PolygonBody(problems.StrictBody):
    """A GeoJSON Polygon (RFC 7946): its outer ring, then its holes."""

    type: Literal["Polygon"]
    coordinates: Annotated[Rings, Field(min_length=1)]


class MultiPolygonBody(problems.StrictBody):
    """A GeoJSON MultiPolygon (RFC 7946)."""

    type: Literal["MultiPolygon"]
    coordinates: Annotated[list[Annotated[Rings, Field(min_length=1)]], Field(min_length=1)]


Geometry = Annotated[PolygonBody | MultiPolygonBody, Field(discriminator="type")]


class ConstraintBody(problems.StrictBody):
    """A volume to be closed: a polygon, altitudes above the airspace's ground datum, and times."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "name": "Parade",
                    "polygon": {
                        "type": "Polygon",
                        "coordinates": [
                            [[71.426, 51.121], [71.43, 51.121], [71.43, 51.123], [71.426, 51.123], [71.426, 51.121]]
                        ],
                    },
                    "base_m": 0,
                    "top_m": 80,
                    "until": "2026-11-22T10:00:00Z",
                }
            ]
        },
    )

    name: Label
    polygon: Geometry
    base_m: Finite = 0.0
    top_m: Annotated[Finite | None, Field(description="Null: no upper end.")] = None
    from_: Annotated[Timestamp | None, Field(alias="from", description="Default: now; at most a day ago.")] = None
    until: Annotated[Timestamp | None, Field(description="Null: for good.")] = None


class ConstraintAnswer(BaseModel):
    """A constraint; `blocks` is how many it closes."""

    id: str
    name: str
    polygon: Geometry
    base_m: float
    top_m: float | None
    from_: Annotated[Moment, Field(alias="from")]
    until: Moment | None
    created: Moment
    removed: Moment | None
    blocks: int


class NewConstraintAnswer(ConstraintAnswer):
    """A constraint that was made now, what became of those who had to make way, and who no longer could."""

    displaced: list[DisplacementBody]
    unmoved: list[str]


class ConstraintPage(BaseModel):
    """A page of constraints, in the order in which they were made."""

    items: list[ConstraintAnswer]
    next_cursor: str | None


@router.post(
    "",
    status_code=201,
    response_class=Response,
    responses={201: {"model": NewConstraintAnswer}, **problems.documented(400, 409, 413, 422, 503)},
    summary="Close airspace",
)
async def close(service: ServiceDep, body: ConstraintBody) -> Response:
    """Close all blocks that the volume overlaps: no flight is planned through them while it is in force.

    Accepted flights that hold some of them then are planned again at once, by priority and in order of arrival; what
    became of them is in `displaced`. Flights that have been activated, or depart within the notice, stay as they are:
    `unmoved`, which the journal says of each too. An aircraft in closed airspace makes its block red.
    """
    now_ms = service.clock()
    from_ms = now_ms if body.from_ is None else body.from_
    if from_ms < now_ms - _BEGUN_FOR_MS:
        raise _invalid("from", "must not be more than a day ago")
    if body.until is not None and body.until <= max(from_ms, now_ms):
        raise _invalid("until", "must be later than `from`, and than now")
    polygon = body.polygon.model_dump()
    # A jagged polygon over a large airspace takes a while.
    blocks = await to_thread.run_sync(volume_blocks, service.airspace.grid, polygon, body.base_m, body.top_m)
    closed = await service.airspace_closing.close(
        Constraint(
            number=0,
            id=str(uuid7()),
            name=body.name,
            polygon=polygon,
            base_m=body.base_m,
            top_m=body.top_m,
            from_ms=from_ms,
            until_ms=body.until,
            blocks=blocks,
            created_ms=now_ms,
        )
    )
    answer = {
        **render(closed.constraint),
        "displaced": displacements(closed.displaced),
        "unmoved": closed.unmoved,
    }
    headers = {"Location": f"{router.prefix}/{closed.constraint.id}"}
    return Response(orjson.dumps(answer), 201, headers, "application/json")


@router.get(
    "",
    response_class=Response,
    responses={
        200: {"model": ConstraintPage, "content": {GEOJSON: {"schema": FEATURES}}},
        **problems.documented(422, 503),
    },
    summary="List constraints",
)
def list_constraints(
    service: ServiceDep,
    at: Annotated[
        Timestamp | None,
        Query(description="Those in force at this time, also if removed since. Default: those in force, and to come."),
    ] = None,
    limit: Annotated[int, Query(ge=1, le=paging.LIMIT)] = 100,
    cursor: str | None = None,
    f: Annotated[Literal["json", "geojson"] | None, Query(description="Answer format.")] = None,
    accept: Annotated[str | None, Header()] = None,
) -> Response:
    """List constraints in the order in which they were made."""
    number = paging.decode(cursor)
    # One more than asked for: whether there is another page.
    if at is None:
        found = service.ledger.constraints_after(service.clock(), number=number, limit=limit + 1)
    else:
        found = [each for each in service.ledger.constraints_at(at) if each.number > number][: limit + 1]
    shown = found[:limit]
    items = [render(constraint) for constraint in shown]
    next_cursor = paging.encode(shown[-1].number) if len(found) > limit else None
    if f == "geojson" or (f is None and GEOJSON in (accept or "")):
        features = [
            {"type": "Feature", "id": item["id"], "geometry": item.pop("polygon"), "properties": item} for item in items
        ]
        return geojson(features, next_cursor=next_cursor)
    return Response(orjson.dumps({"items": items, "next_cursor": next_cursor}), media_type="application/json")


@router.get(
    "/{constraint_id}",
    response_class=Response,
    responses={200: {"model": ConstraintAnswer}, **problems.documented(404, 422, 503)},
    summary="Read a constraint",
)
def read(service: ServiceDep, constraint_id: str) -> Response:
    """Return a constraint, also one that has ended or was removed."""
    constraint = service.ledger.constraint(_id(constraint_id))
    if constraint is None:
        raise UnknownConstraint(f"there is no constraint {constraint_id}")
    return Response(orjson.dumps(render(constraint)), media_type="application/json")


@router.delete(
    "/{constraint_id}",
    response_class=Response,
    responses={200: {"model": ConstraintAnswer}, **problems.documented(404, 422, 503)},
    summary="Open closed airspace again",
)
async def reopen(service: ServiceDep, constraint_id: str) -> Response:
    """Remove a constraint. Flights that made way for it stay where they are planned now."""
    constraint = await service.airspace_closing.reopen(_id(constraint_id))
    return Response(orjson.dumps(render(constraint)), media_type="application/json")


def render(constraint: Constraint) -> dict[str, Any]:
    """Return a constraint as JSON-ready values."""
    until_ms, removed_ms = constraint.until_ms, constraint.removed_ms
    return {
        "id": constraint.id,
        "name": constraint.name,
        "polygon": constraint.polygon,
        "base_m": constraint.base_m,
        "top_m": constraint.top_m,
        "from": format_time(constraint.from_ms),
        "until": None if until_ms is None else format_time(until_ms),
        "created": format_time(constraint.created_ms),
        "removed": None if removed_ms is None else format_time(removed_ms),
        "blocks": len(constraint.blocks),
    }


def _id(text: str) -> str:
    return ids.existing(text, UnknownConstraint, "constraint")


def _invalid(member: str, message: str) -> RequestValidationError:
    return RequestValidationError([{"loc": ("body", member), "msg": message, "type": "value_error"}])
