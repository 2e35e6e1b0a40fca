"""The air as it changes: Server-Sent Events for the console and whoever else watches."""

import asyncio
import threading
from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import orjson
from anyio import to_thread
from fastapi import APIRouter, Header, Request
from fastapi.sse import format_sse_event
from starlette.responses import StreamingResponse

from app import problems
from app.auth import Caller, CallerDep
from app.conformance import Conformance
from app.errors import LedgerUnavailable
from app.ledger import JournalEntry
from app.ledger.constraints import CONSTRAINT_KINDS
from app.monitor import View
from app.routes import flights, status
from app.routes.events import event
from app.service import Service, ServiceDep
from app.times import format_time

router = APIRouter(prefix="/v1/airspace", tags=["airspace"])

# How often a stream looks whether the monitor has looked, and for how long it says nothing.
_POLL_S, _SILENCE_S = 0.1, 10.0
# How long it leaves a ledger alone that has failed.
_RETRY_S = 1.0
_EVENTS = dict.fromkeys(Conformance, "conformance") | dict.fromkeys(CONSTRAINT_KINDS, "constraint")


@dataclass(frozen=True, eq=False)
class _Bulletin:
    """What there is to tell of a view: of the blocks in whole, or as the difference to what the view `before` had."""

    view: View
    before: View | None
    blocks: Mapping[tuple[int, int, int], dict[str, Any]]
    alerts: Sequence[dict[str, Any]]
    whole: bytes
    difference: bytes
    flights: bytes
    raised: bytes
    raised_if_new: bytes

    @classmethod
    def of(cls, service: Service, view: View, last: "_Bulletin | None") -> "_Bulletin":
        """Render a view after the last one."""
        blocks = {tuple(entry["block"]): entry for entry in status.blocks(service, view, view.blocks)}
        described = {**status.described(service, view), "counts": status.counts(view.blocks)}
        before = {} if last is None else last.blocks
        changed = [entry for block, entry in blocks.items() if before.get(block) != entry]
        idle = [block for block in before if block not in blocks]
        raised = flights.alerts(service, view, service.monitor.alerts(view))
        alerts = _event("alerts", raised)
        is_new = last is None or raised["items"] != last.alerts
        return cls(
            view=view,
            before=None if last is None else last.view,
            blocks=blocks,
            alerts=raised["items"],
            whole=_event("status", {**described, "full": True, "blocks": list(blocks.values())}),
            difference=_event("status", {**described, "full": False, "blocks": changed, "idle": idle}),
            flights=_event("flights", flights.flights(service, view)),
            raised=alerts,
            raised_if_new=alerts if is_new else b"",
        )


class Board:
    """The newest bulletin, rendered once for all who watch; of the journal each is sent so many entries at once."""

    def __init__(self, entries_at_once: int = 2_000) -> None:
        self.entries_at_once = entries_at_once
        self._lock = threading.Lock()
        self._latest: _Bulletin | None = None

    def bulletin(self, service: Service, view: View) -> _Bulletin:
        """Return what there is to tell of a view; raises `LedgerUnavailable`."""
        with self._lock:
            if self._latest is None or self._latest.view is not view:
                self._latest = _Bulletin.of(service, view, self._latest)
            return self._latest


@dataclass
class _Watcher:
    """One stream: what it has told so far, and whether the journal has more than was told at once."""

    service: Service
    board: Board
    revision: int
    told: View | None = None
    is_behind: bool = False

    def news(self, view: View) -> bytes:
        """Return the events that tell what is new in the journal and in a view."""
        journal = self._journal()
        if view is self.told:
            return journal
        bulletin = self.board.bulletin(self.service, view)
        is_next = self.told is not None and bulletin.before is self.told
        blocks = bulletin.difference if is_next else _with_id(bulletin.whole, self.revision)
        self.told = bulletin.view
        return b"".join([journal, blocks, bulletin.flights, bulletin.raised_if_new if is_next else bulletin.raised])

    def _journal(self) -> bytes:
        ledger, events = self.service.ledger, []
        removed = ledger.removed().journal_through
        if self.revision < removed:
            events.append(_event("gap", {"removed_through": removed}))
        entries = ledger.journal_after(self.revision, self.board.entries_at_once)
        # Only the last of a revision has its id: who resumes after it has had all of them.
        last = {entry.revision: entry.place for entry in entries}
        events += [_journal_event(entry, is_last=entry.place == last[entry.revision]) for entry in entries]
        if entries:
            self.revision = entries[-1].revision
        self.is_behind = len(entries) >= self.board.entries_at_once
        return b"".join(events)


def _with_id(event: bytes, revision: int) -> bytes:
    """Return an event with an id, so that who loses the stream at once resumes from there."""
    return b"%sid: %d\n\n" % (event.removesuffix(b"\n"), revision)


def _journal_event(entry: JournalEntry, *, is_last: bool) -> bytes:
    return _event(
        _EVENTS.get(entry.kind, "intent"),
        {**event(entry).model_dump(mode="json"), "time": format_time(entry.time_ms)},
        entry.revision if is_last else None,
    )


def _event(name: str, content: dict[str, Any], revision: int | None = None) -> bytes:
    return format_sse_event(
        event=name, data_str=orjson.dumps(content).decode(), id=None if revision is None else str(revision)
    )


@router.get(
    "/stream",
    response_class=StreamingResponse,
    responses={
        200: {"description": "Server-Sent Events", "content": {"text/event-stream": {}}},
        **problems.documented(422, 503),
    },
    summary="Watch the airspace",
)
async def watch(
    request: Request,
    service: ServiceDep,
    caller: CallerDep,
    last_event_id: Annotated[
        int | None, Header(ge=0, le=2**62, description="The revision after which to go on; default: now.")
    ] = None,
) -> StreamingResponse:
    """Send what changes, about once a second.

    `status`: first all blocks in use (`full`), then those that changed and those that are `idle` again. `flights`: as
    /v1/flights. `alerts`: as /v1/airspace/alerts, when they change. `intent`, `conformance` and `constraint`: the
    journal, whose revisions are the ids that `Last-Event-ID` resumes after; `gap` if retention has removed some of
    what was missed.
    """
    board: Board = request.state.board
    revision = await to_thread.run_sync(service.ledger.revision)
    after = revision if last_event_id is None else min(last_event_id, revision)
    return StreamingResponse(
        _events(service, caller, board, after),
        media_type="text/event-stream",
        headers={"Cache-Control": "no-cache", "X-Accel-Buffering": "no"},
    )


async def _events(service: Service, caller: Caller, board: Board, revision: int) -> AsyncIterator[bytes]:
    """Yield events until the client goes, its token expires or the server ends."""
    watcher = _Watcher(service, board, revision)
    tried: View | None = None
    silent_s = 0.0
    while not service.closing.is_set() and not caller.is_expired():
        view = service.monitor.latest
        if view is None or (view is tried and not watcher.is_behind):
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
        except LedgerUnavailable as error:
            # Nothing of it was told. Who is behind in the journal asks again, but not at once.
            yield format_sse_event(comment=str(error))
            await asyncio.sleep(_RETRY_S)
            continue
        watcher = after
        yield content
