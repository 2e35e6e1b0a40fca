"""Connections that keep to limits: how long and large a head may be, how slowly an answer is read, how many there are.

uvicorn bounds the time between requests and how much of a body waits in memory, and no more.
"""

import asyncio
import socket
from typing import Any

from uvicorn.config import Config
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol
from uvicorn.server import ServerState

from app import problems
from app.errors import HeadTooLarge, MalformedRequest, RequestError, RequestTimedOut
from app.gate import SURPLUS
from app.security_headers import headers_of
from app.service import Service

# A token of some thousand characters and what browsers and proxies add fit in.
MAX_HEAD_BYTES = 32 * 1024
MAX_HEADERS = 100
# So much of an answer must be read within the time that is set, or all that is left of it.
_LEAST_READ_BYTES = 16 * 1024
# So much the system takes ahead of what it can send. It would take megabytes, and then no more until a third of them is
# read, which looks the same as a client that does not read.
_AHEAD_BYTES = 64 * 1024
# How long a connection beyond the limit may take to be told so.
_SURPLUS_S = 1.0


class Connection(HttpToolsProtocol):
    """One connection of a client."""

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._service: Service = app_state["service"]
        self._settings = self._service.settings
        self._is_surplus = False
        self._is_in_head = True
        # Since the parser last passed on a head or some of a body: of a head that does not end, or of trailers.
        self._unparsed_bytes = 0
        self._refusal: RequestError | None = None
        self._head_timer: asyncio.TimerHandle | None = None
        self._reading_timer: asyncio.TimerHandle | None = None
        self._unread_bytes = 0

    # ---- what comes

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for a head."""
        super().connection_made(transport)
        accepted: socket.socket = transport.get_extra_info("socket")
        accepted.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, _AHEAD_BYTES)
        limit = self._settings.max_connections
        if len(self.connections) > 2 * limit:
            # Not even told why: descriptors are needed for the ledger.
            transport.abort()
        if len(self.connections) > limit:
            self._is_surplus = True
            self.app_state = {**self.app_state, SURPLUS: True}
        self._await_head()

    def data_received(self, data: bytes) -> None:
        """Take more of a request; one that makes no progress is refused."""
        self._unparsed_bytes += len(data)
        super().data_received(data)
        if self.transport.is_closing():
            return
        if self._unparsed_bytes > MAX_HEAD_BYTES:
            self._refuse(HeadTooLarge(f"the request's head has more than {MAX_HEAD_BYTES} bytes"))
        elif self._head_timer is None and (self.cycle is None or self.cycle.response_complete):
            self._await_head()

    def on_message_begin(self) -> None:
        """Begin a request."""
        super().on_message_begin()
        self._is_in_head = True

    def on_header(self, name: bytes, value: bytes) -> None:
        """Take a header. Those behind a body are dropped: what they say was decided without them."""
        if self._is_in_head:
            super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """Answer a request whose head has arrived, unless there is too much of it."""
        self._unparsed_bytes = 0
        self._is_in_head = False
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None
        size = len(self.url) + sum(len(name) + len(value) for name, value in self.headers)
        if size > MAX_HEAD_BYTES:
            self._refusal = HeadTooLarge(f"the request's head has more than {MAX_HEAD_BYTES} bytes")
        elif len(self.headers) > MAX_HEADERS:
            self._refusal = HeadTooLarge(f"the request has more than {MAX_HEADERS} headers")
        if self._refusal is not None:
            # The parser ends, and says so to `send_400_response`.
            raise self._refusal
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """Take some of a body."""
        self._unparsed_bytes = 0
        super().on_body(body)

    def on_message_complete(self) -> None:
        """End a request."""
        self._unparsed_bytes = 0
        super().on_message_complete()

    def _await_head(self) -> None:
        within_s = _SURPLUS_S if self._is_surplus else self._settings.head_timeout_s
        self._head_timer = self.loop.call_later(within_s, self._give_up_head, within_s)

    def _give_up_head(self, within_s: float) -> None:
        if self._unparsed_bytes == 0:
            self._close()
        else:
            self._refuse(RequestTimedOut(f"the request's head did not arrive within {within_s:g} s"))

    # ---- what goes

    def send_400_response(self, msg: str) -> None:  # noqa: ARG002
        """Refuse what cannot be parsed."""
        self._refuse(self._refusal or MalformedRequest("this is not HTTP as it should be"))

    def _refuse(self, error: RequestError) -> None:
        """Answer the request that is arriving with a problem, and close the connection.

        If an answer to an earlier one is due, there is none to this one: it would be taken for that.
        """
        cycle = self.cycle
        owes_another = (
            cycle is not None
            and not cycle.response_complete
            and (cycle.response_started or not cycle.more_body or bool(self.pipeline))
        )
        if not owes_another:
            kind = problems.kind_of(error)
            body = problems.body(kind, str(error))
            head = [
                *self.server_state.default_headers,
                *headers_of("", self.scheme or "http").items(),
                (b"content-type", problems.MEDIA_TYPE.encode()),
                (b"content-length", b"%d" % len(body)),
                (b"connection", b"close"),
            ]
            lines = [b"%s: %s\r\n" % header for header in head]
            self.transport.write(b"".join([STATUS_LINE[kind.status], *lines, b"\r\n", body]))
            self._service.metrics.problem(kind.slug, None)
        self._close()

    def on_response_complete(self) -> None:
        """Go on to the next request, or see that the connection ends."""
        super().on_response_complete()
        if self.transport.is_closing():
            self._watch_reading()

    def timeout_keep_alive_handler(self) -> None:
        """Close a connection on which nothing has come for some seconds."""
        super().timeout_keep_alive_handler()
        self._watch_reading()

    def pause_writing(self) -> None:
        """See that an answer which the client is slow to read is read at all: it takes memory meanwhile."""
        super().pause_writing()
        self._watch_reading()

    def resume_writing(self) -> None:
        """Go on writing."""
        super().resume_writing()
        if not self.transport.is_closing():
            self._cancel_watch()

    def _close(self) -> None:
        """Close when all is sent, but do not wait for a client that does not read it."""
        self.transport.close()
        self._watch_reading()

    def _watch_reading(self) -> None:
        if self._reading_timer is None:
            self._unread_bytes = self.transport.get_write_buffer_size()
            self._reading_timer = self.loop.call_later(self._settings.send_timeout_s, self._check_reading)

    def _check_reading(self) -> None:
        self._reading_timer = None
        read = self._unread_bytes - self.transport.get_write_buffer_size()
        if read < min(_LEAST_READ_BYTES, self._unread_bytes):
            self.transport.abort()
        else:
            self._watch_reading()

    def _cancel_watch(self) -> None:
        if self._reading_timer is not None:
            self._reading_timer.cancel()
            self._reading_timer = None

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        if self._head_timer is not None:
            self._head_timer.cancel()
        self._cancel_watch()
        super().connection_lost(exc)
