"""The air as it changes: Server-Sent Events for the console and whoever else watches."""

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import orjson
from anyio import to_thread
from fastapi import APIRouter, Header
from fastapi.sse import format_sse_event
from starlette.responses import StreamingResponse

from app import problems
from app.conformance import Conformance
from app.errors import LedgerUnavailable
from app.ledger import JournalEntry
from app.monitor import View
from app.routes import flights, status
from app.routes.events import event
from app.service import Service, ServiceDep
from app.times import format_time

router = APIRouter(prefix="/v1/airspace", tags=["airspace"])

# How often a stream looks whether the monitor has looked, and for how long it says nothing.
_POLL_S, _SILENCE_S = 0.1, 10.0
_ENTRIES = 500
_CONFORMANCE = frozenset(Conformance)


@router.get(
    "/stream",
    response_class=StreamingResponse,
    responses={
        200: {"description": "Server-Sent Events", "content": {"text/event-stream": {"schema": {"type": "string"}}}},
        **problems.documented(422, 503),
    },
    summary="Watch the airspace",
)
async def watch(
    service: ServiceDep,
    last_event_id: Annotated[
        int | None, Header(ge=0, le=2**62, description="The revision after which to go on; default: now.")
    ] = None,
) -> StreamingResponse:
    """Send what changes, about once a second.

    `status`: first all blocks in use (`full`), then those that changed and those that are `idle` again. `flights`: as
    /v1/flights. `alerts`: as /v1/airspace/alerts, when they change. `intent` and `conformance`: the journal, whose
    revisions are the ids that `Last-Event-ID` resumes after; `gap` if retention has removed some of what was missed.
    """
    revision = await to_thread.run_sync(service.ledger.revision)
    after = revision if last_event_id is None else min(last_event_id, revision)
    return StreamingResponse(
        _events(service, after), media_type="text/event-stream", headers={"Cache-Control": "no-cache"}
    )


async def _events(service: Service, revision: int) -> AsyncIterator[bytes]:
    """Yield events until the client goes or the server ends."""
    watcher = _Watcher(service, revision)
    tried: View | None = None
    silent_s = 0.0
    while not service.closing.is_set():
        view = service.monitor.latest
        if view is None or view is tried:
            await asyncio.sleep(_POLL_S)
            silent_s += _POLL_S
            if silent_s >= _SILENCE_S:
                silent_s = 0.0
                yield format_sse_event(comment="nothing new")
            continue
        tried, silent_s = view, 0.0
        after = replace(watcher)
        try:
            content = await to_thread.run_sync(after.news, view)
            watcher = after
        except LedgerUnavailable as error:
            # Nothing of it was told; the next look tells it all.
            content = format_sse_event(comment=str(error))
        yield content


@dataclass
class _Watcher:
    """One stream: what it has told so far."""

    service: Service
    revision: int
    seen: View | None = None
    blocks: dict[tuple[int, int, int], dict[str, Any]] = field(default_factory=dict)
    alerts: list[dict[str, Any]] = field(default_factory=list)

    def news(self, view: View) -> bytes:
        """Return the events that tell what is new in a view, and in the journal."""
        events = [self._journal(), self._status(view), _event("flights", flights.flights(self.service, view))]
        raised = flights.alerts(self.service, view, self.service.monitor.alerts(view))
        if raised["items"] != self.alerts or self.seen is None:
            self.alerts = raised["items"]
            events.append(_event("alerts", raised))
        self.seen = view
        return b"".join(events)

    def _journal(self) -> bytes:
        ledger, events = self.service.ledger, []
        removed = ledger.removed().journal_through
        if self.revision < removed:
            events.append(_event("gap", {"removed_through": removed}))
        while True:
            entries = ledger.journal_after(self.revision, _ENTRIES)
            events += [_journal_event(entry) for entry in entries]
            if entries:
                self.revision = entries[-1].revision
            if len(entries) < _ENTRIES:
                return b"".join(events)

    def _status(self, view: View) -> bytes:
        blocks = {tuple(entry["block"]): entry for entry in status.blocks(self.service, view, view.blocks)}
        before, self.blocks = self.blocks, blocks
        content = {
            **status.described(self.service, view),
            "full": self.seen is None,
            "counts": status.counts(view.blocks),
            "blocks": [entry for block, entry in blocks.items() if before.get(block) != entry],
        }
        if self.seen is None:
            # With an id, so that who loses the stream at once resumes from here.
            return _event("status", content, self.revision)
        return _event("status", {**content, "idle": [block for block in before if block not in blocks]})


def _journal_event(entry: JournalEntry) -> bytes:
    kind = "conformance" if entry.kind in _CONFORMANCE else "intent"
    return _event(kind, {**event(entry).model_dump(mode="json"), "time": format_time(entry.time_ms)}, entry.revision)


def _event(name: str, content: dict[str, Any], revision: int | None = None) -> bytes:
    return format_sse_event(
        event=name, data_str=orjson.dumps(content).decode(), id=None if revision is None else str(revision)
    )
