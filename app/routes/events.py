"""The append-only journal, paged."""

from typing import Annotated, Any

from fastapi import APIRouter, Query
from pydantic import BaseModel

from app import problems
from app.ledger import JournalEntry
from app.routes import paging
from app.service import ServiceDep
from app.times import Moment

router = APIRouter(prefix="/v1/events", tags=["events"])


class Event(BaseModel):
    """One change of the ledger, in the order of the changes.

    `kind` is a flight intent's new state; `unmoved` where it keeps its state and its plan although a constraint closes
    some of that; or how the aircraft of a flight intent or of a track conforms now, with the reasons; or what became of
    a constraint. Events of one revision happened at once. Where a flight was planned again, `details` tell the `cause`,
    by how much departure and arrival moved, and the reason if it was displaced; where it is unmoved, the `cause`.
    """

    revision: int
    time: Moment
    kind: str
    flight_intent_id: str | None
    sequence: int | None
    track_id: str | None
    reasons: list[str]
    details: dict[str, Any]


class EventPage(BaseModel):
    """A page of events; `next_cursor` is the `after` of the next, null when there is nothing more yet.

    Events up to the revision `removed_through` have been removed; 0: none has been.
    """

    items: list[Event]
    next_cursor: str | None
    removed_through: int


@router.get("", responses=problems.documented(422, 503), summary="Read the journal")
def list_events(
    service: ServiceDep,
    after: Annotated[int, Query(ge=0, le=2**62, description="A revision; 0 for the beginning.")] = 0,
    limit: Annotated[int, Query(ge=1, le=paging.LIMIT)] = 100,
) -> EventPage:
    """Return the changes after a revision, oldest first. Revisions have no gaps; those of one revision come together,
    also beyond the limit.
    """
    entries = service.ledger.journal_after(after, limit)
    last = entries[-1].revision if entries else after
    return EventPage(
        items=[event(entry) for entry in entries],
        next_cursor=str(last) if last < service.ledger.revision() else None,
        removed_through=service.ledger.removed().journal_through,
    )


def event(entry: JournalEntry) -> Event:
    """Return a journal entry as an event."""
    return Event(
        revision=entry.revision,
        time=entry.time_ms,
        kind=entry.kind,
        flight_intent_id=entry.intent_id or None,
        sequence=entry.sequence or None,
        track_id=entry.track_id,
        reasons=list(entry.reasons),
        details=dict(entry.details),
    )
