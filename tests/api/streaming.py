"""A stream of Server-Sent Events without sockets, read as it comes."""

import json
import queue
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import anyio
from starlette.types import Message

from app.main import create_app
from app.routes.stream import Board
from tests.api.serving import Client

STREAM = "/v1/airspace/stream"
# Longer than any stream of a test is silent.
_WAIT_S = 10.0


@dataclass(frozen=True)
class Event:
    """One event, or a comment that stands where an event might."""

    name: str | None
    data: Any = None
    id: int | None = None
    comment: str | None = None


class Stream:
    """What a server sends, event by event."""

    def __init__(self) -> None:
        self.status = 0
        self.headers: dict[str, str] = {}
        self._chunks: queue.Queue[bytes | None] = queue.Queue()
        self._text = ""
        self._events: list[Event] = []

    async def receive(self, message: Message) -> None:
        """Take what the application sends."""
        if message["type"] == "http.response.start":
            self.status = message["status"]
            self.headers = {name.decode(): value.decode() for name, value in message["headers"]}
            return
        if message.get("body"):
            self._chunks.put(message["body"])
        if not message.get("more_body", False):
            self._chunks.put(None)

    def next(self) -> Event:
        """Return the next event; fail where the stream has ended, or is silent for long."""
        while not self._events:
            chunk = self._chunks.get(timeout=_WAIT_S)
            assert chunk is not None, "the stream has ended"
            self._text += chunk.decode()
            *whole, self._text = self._text.split("\n\n")
            self._events += [_parsed(part) for part in whole]
        return self._events.pop(0)

    def news(self) -> list[Event]:
        """Return the next events up to the flights that each look brings, and the alerts behind them if there are."""
        events = [self.next()]
        while events[-1].name != "flights":
            events.append(self.next())
        # What one look brings comes in one piece.
        events += self._events
        self._events = []
        return events

    def is_quiet(self, seconds: float) -> bool:
        """Tell whether nothing comes for so long."""
        try:
            self._chunks.get(timeout=seconds)
        except queue.Empty:
            return not self._events
        return False

    def has_ended(self) -> bool:
        """Wait for the next chunk, and tell whether it is the end."""
        return self._chunks.get(timeout=_WAIT_S) is None and not self._events


@contextmanager
def streaming(client: Client, headers: dict[str, str] | None = None, board: Board | None = None) -> Iterator[Stream]:
    """Watch the airspace of a running service, and go away at the end."""
    # Another application on the same service: httpx would wait for the end of the answer.
    app = create_app(client.service.settings, client.service.clock, running=client.service)
    stream = Stream()
    gone = client.portal.call(anyio.Event)
    requested: list[Message] = [{"type": "http.request", "body": b"", "more_body": False}]
    fields = [(b"host", b"127.0.0.1"), *((name.encode(), value.encode()) for name, value in (headers or {}).items())]
    scope = {
        "type": "http", "asgi": {"version": "3.0", "spec_version": "2.0"}, "http_version": "1.1", "method": "GET",
        "scheme": "http", "path": STREAM, "raw_path": STREAM.encode(), "query_string": b"", "headers": fields,
        "server": ("127.0.0.1", 80), "client": ("127.0.0.1", 50_000),
        "state": {"service": client.service, "board": board or Board()},
    }  # fmt: skip

    async def receive() -> Message:
        if requested:
            return requested.pop()
        await gone.wait()
        return {"type": "http.disconnect"}

    async def answer() -> None:
        await app(scope, receive, stream.receive)

    answering: Future[None] = client.portal.start_task_soon(answer)
    try:
        yield stream
    finally:
        client.portal.call(gone.set)
        answering.result(timeout=_WAIT_S)


def _parsed(part: str) -> Event:
    lines = part.split("\n")
    comments = [line.removeprefix(":").strip() for line in lines if line.startswith(":")]
    if comments:
        return Event(None, comment=" ".join(comments))
    fields = dict(line.split(": ", 1) for line in lines)
    assert set(fields) <= {"event", "data", "id"}
    return Event(fields["event"], json.loads(fields["data"]), int(fields["id"]) if "id" in fields else None)
