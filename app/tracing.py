"""What every request leaves behind: its id in the answer and the logs, a line in the log, counts in the metrics."""

import re
from contextlib import suppress
from time import perf_counter
from typing import NamedTuple

import structlog
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uuid_utils import uuid7

from app.errors import QueueFull, TooManyConnections, TooManyStreams
from app.metrics import OTHER
from app.problems import KINDS, MEDIA_TYPE
from app.service import Service

log = structlog.get_logger()

_HEADER = b"x-request-id"
_ID = re.compile(rb"[A-Za-z0-9._:-]{1,100}")
# How `app.problems` begins every document. What comes after may be long.
_TEXT = rb'"(?:[^"\\]|\\.)*+"'
_PROBLEM = re.compile(
    rb'\{"type":"/problems/([^"]+)","title":%b,"status":\d+,"detail":%b(?:,"reason":"([^"]*)")?' % (_TEXT, _TEXT)
)
_IS_PROBLEM = (b"content-type", MEDIA_TYPE.encode())
# Shedding load must not fill a disk with lines about it; the metrics count it.
_SHED = {KINDS[error].slug for error in (QueueFull, TooManyConnections, TooManyStreams)}


class _Problem(NamedTuple):
    """What kind of problem an answer was, and its reason if it has one."""

    slug: str
    reason: str | None


class _Answer:
    """Sends an answer on with its request's id, and remembers what it was."""

    def __init__(self, send: Send, request_id: bytes) -> None:
        self._send = send
        self._request_id = request_id
        self._is_problem = False
        self.status: int | None = None
        self.problem: _Problem | None = None

    async def send(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.status = message["status"]
            self._is_problem = _IS_PROBLEM in message["headers"]
            message["headers"] = [*message["headers"], (_HEADER, self._request_id)]
        elif self._is_problem:
            # Whoever made it, it is counted as its reader sees it.
            self.problem = _problem_in(message["body"])
        await self._send(message)


class Tracing:
    """ASGI middleware around everything, the answer to an unexpected error included."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and take down how it was answered."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        began = perf_counter()
        service: Service = scope["state"]["service"]
        request_id = _id_of(scope)
        answer = _Answer(send, request_id)
        bound = structlog.contextvars.bind_contextvars(request_id=request_id.decode())
        _note_waiting(service)
        try:
            await self._app(scope, receive, answer.send)
        finally:
            _note_waiting(service)
            _note_answer(service, scope, answer, perf_counter() - began)
            structlog.contextvars.reset_contextvars(**bound)


def _id_of(scope: Scope) -> bytes:
    """Return the id that a request came with, if it is a fit one, otherwise a new one."""
    for name, value in scope["headers"]:
        if name == _HEADER and _ID.fullmatch(value):
            return bytes(value)
    return str(uuid7()).encode()


def _problem_in(body: bytes) -> _Problem | None:
    begun = _PROBLEM.match(body)
    if begun is None:
        return None
    slug, reason = begun.groups()
    return _Problem(slug.decode(), None if reason is None else reason.decode())


def _note_waiting(service: Service) -> None:
    if not service.is_read_only:
        service.metrics.waiting(service.writer.waiting)


def _note_answer(service: Service, scope: Scope, answer: _Answer, seconds: float) -> None:
    """Count and log an answer; one that never began has no status, and nothing to be counted under."""
    if answer.status is None:
        return
    method, route = scope["method"], getattr(scope.get("route"), "path", OTHER)
    service.metrics.answered(method, route, answer.status, seconds)
    details = {}
    if answer.problem is not None:
        details["problem"] = answer.problem.slug
        service.metrics.problem(*answer.problem)
    write = log.warning if answer.status >= 500 and details.get("problem") not in _SHED else log.debug
    # A log that cannot be written is no reason to break off an answer.
    with suppress(OSError, ValueError):
        write("request", method=method, route=route, status=answer.status, ms=round(seconds * 1000, 3), **details)
