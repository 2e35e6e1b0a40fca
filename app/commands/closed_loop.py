"""Clients in a closed loop: each sends a flight intent, waits for the answer, and only then sends the next.

The clients share a machine with the service that they measure, so they must cost little. Threads on the standard
library's client need 0.14 ms of CPU a request; httpx needs 0.7 ms in threads, and 2.3 ms with 32 clients in one loop.
"""

import re
import socket
import ssl
import sys
import threading
import time
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from http.client import HTTPConnection, HTTPException, HTTPResponse, HTTPSConnection

import httpx
import numpy as np
import orjson
from numpy.typing import NDArray

from app.client import authorization

FloatArray = NDArray[np.float64]

# What the service says of its own time on an accepted intent, in its Server-Timing header.
SERVER_PARTS = ("queue", "plan", "commit", "serialise")
_PART = re.compile(r"(\w+);dur=([\d.]+)")
_COLUMNS = 2 + len(SERVER_PARTS)

_PATH = "/v1/flight-intents"
_HEADERS = {"Content-Type": "application/json"}
_REFUSED = (HTTPStatus.CONFLICT, HTTPStatus.UNPROCESSABLE_ENTITY)
_WAIT = (HTTPStatus.SERVICE_UNAVAILABLE, HTTPStatus.TOO_MANY_REQUESTS)
_TIMEOUT_S = 30.0
_RECONNECT_S = 0.5
# Servers close connections that idle longer, uvicorn after 5 s; that is no fault of theirs.
_IDLE_S = 4.0
_GLANCE_S = 0.25


@dataclass(frozen=True, eq=False)
class Measurement:
    """What a run came to.

    Attributes
    ----------
    seconds, cpu_s
        How long it took, until the last answer; the CPU time that it cost this process.
    answered_s, latency_ms
        One value for each accepted intent: when it was answered, since the run began, and how long that took.
    server_ms
        For each of `SERVER_PARTS` that any answer told, the values of those that did.
    refused
        Refusals by reason.
    problems_ms
        Latencies of all other answers, by status and problem.
    lost
        Requests without an answer, by what went wrong with the connection.
    interrupted, unanswered
        Whether the run was cut short, and how many requests it did not wait for.
    """

    seconds: float
    cpu_s: float
    answered_s: FloatArray
    latency_ms: FloatArray
    server_ms: dict[str, FloatArray]
    refused: Counter[str]
    problems_ms: dict[str, FloatArray]
    lost: Counter[str]
    interrupted: bool
    unanswered: int

    @property
    def accepted(self) -> int:
        """How many intents were accepted."""
        return len(self.latency_ms)

    @property
    def requests(self) -> int:
        """How many requests were answered or lost."""
        others = sum(len(latencies) for latencies in self.problems_ms.values())
        return self.accepted + self.refused.total() + others + self.lost.total()


class ClosedLoop:
    """So many clients of the service at an address, whose connections outlive their runs; close them at the end."""

    def __init__(self, url: str, clients: int, bodies: Iterator[bytes], token: str | None = None) -> None:
        headers = _HEADERS | authorization(token)
        self._clients = [_Client(url, headers) for _ in range(clients)]
        self._bodies = bodies

    def close(self) -> None:
        """Close all connections."""
        for client in self._clients:
            client.close()

    def run(
        self, seconds: float, limit: int = sys.maxsize, watch: Callable[[float, int], None] = lambda *_: None
    ) -> Measurement:
        """Send until the time is over or `limit` requests were sent, and wait for the answers; Ctrl-C cuts it short.

        `watch` is told every quarter of a second how many seconds have passed and how many intents were accepted.
        """
        run = _Run(self._bodies, seconds, limit)
        tallies = [_Tally() for _ in self._clients]
        began, began_cpu = time.perf_counter(), time.process_time()
        with ThreadPoolExecutor(len(self._clients)) as pool:
            working = [
                pool.submit(client.work, run, tally) for client, tally in zip(self._clients, tallies, strict=True)
            ]
            try:
                while wait(working, _GLANCE_S).not_done:
                    watch(time.perf_counter() - began, sum(tally.accepted for tally in tallies))
            except KeyboardInterrupt:
                run.interrupt()
                for client in self._clients:
                    client.hang_up()
        ended, ended_cpu = time.perf_counter(), time.process_time()
        for work in working:
            work.result()
        return _sum(tallies, began, ended - began, ended_cpu - began_cpu, interrupted=run.interrupted)


class _Run:
    """What the clients of one run share: what to send, and when to stop."""

    def __init__(self, bodies: Iterator[bytes], seconds: float, limit: int) -> None:
        self._bodies = bodies
        self._end = time.perf_counter() + seconds
        self._left = limit
        self._lock = threading.Lock()
        self._over = threading.Event()
        self.interrupted = False

    def next_body(self) -> bytes | None:
        """Return what to send next, None when nothing more is to be sent."""
        with self._lock:
            if self._left == 0 or time.perf_counter() >= self._end:
                self._over.set()
            if self._over.is_set():
                return None
            self._left -= 1
            return next(self._bodies)

    def pause(self, seconds: float) -> None:
        """Wait, but not beyond the end."""
        self._over.wait(min(seconds, self._end - time.perf_counter()))

    def interrupt(self) -> None:
        """End the run now."""
        self.interrupted = True
        self._over.set()


@dataclass(eq=False)
class _Tally:
    """What one client was answered. Each accepted intent is a row: when, latency in s, what the server told in ms."""

    rows: "array[float]" = field(default_factory=lambda: array("d"))
    refused: Counter[str] = field(default_factory=Counter)
    problems_ms: "dict[str, array[float]]" = field(default_factory=dict)
    lost: Counter[str] = field(default_factory=Counter)
    unanswered: int = 0

    @property
    def accepted(self) -> int:
        return len(self.rows) // _COLUMNS

    def note(self, response: HTTPResponse, content: bytes, sent: float, answered: float) -> None:
        """Count an answer."""
        if response.status == HTTPStatus.CREATED:
            told = dict(_PART.findall(response.getheader("Server-Timing", "")))
            parts = (float(told.get(part, "nan")) for part in SERVER_PARTS)
            self.rows.extend((answered, answered - sent, *parts))
            return
        members = _members(content)
        reason = members.get("reason")
        if reason is not None and response.status in _REFUSED:
            self.refused[str(reason)] += 1
            return
        kind = str(members.get("type", response.reason)).rpartition("/")[2]
        latencies = self.problems_ms.setdefault(f"{response.status} {kind}".strip(), array("d"))
        latencies.append((answered - sent) * 1000)


class _Client:
    """One client and its connection."""

    def __init__(self, url: str, headers: dict[str, str]) -> None:
        self._headers = headers
        # Read as `app.client` reads it.
        address = httpx.URL(url)
        host = address.raw_host.decode()
        self._path = address.raw_path.decode().rstrip("/") + _PATH
        self._connection = (
            HTTPSConnection(host, address.port, timeout=_TIMEOUT_S, context=ssl.create_default_context())
            if address.scheme == "https"
            else HTTPConnection(host, address.port, timeout=_TIMEOUT_S)
        )
        self._answered = 0.0

    def work(self, run: _Run, tally: _Tally) -> None:
        """Send one request after another until the run is over."""
        while (body := run.next_body()) is not None:
            sent = time.perf_counter()
            if sent - self._answered > _IDLE_S:
                self._connection.close()
            try:
                self._connection.request("POST", self._path, body, self._headers)
                response = self._connection.getresponse()
                content = response.read()
            except (OSError, HTTPException) as error:
                self._connection.close()
                if run.interrupted:
                    tally.unanswered += 1
                else:
                    tally.lost[getattr(error, "strerror", None) or type(error).__name__] += 1
                    run.pause(_RECONNECT_S)
                continue
            self._answered = time.perf_counter()
            tally.note(response, content, sent, self._answered)
            if response.status in _WAIT:
                run.pause(_retry_after_s(response))

    def hang_up(self) -> None:
        """Break off the request under way, from another thread."""
        connected = self._connection.sock
        if connected is not None:
            with suppress(OSError):
                # Not the method of a TLS socket, which takes the session away from the thread that reads.
                socket.socket.shutdown(connected, socket.SHUT_RDWR)

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()


def _members(content: bytes) -> dict[str, object]:
    try:
        members = orjson.loads(content)
    except orjson.JSONDecodeError:
        return {}
    return members if isinstance(members, dict) else {}


def _retry_after_s(response: HTTPResponse) -> float:
    """Return how long an answer asks to wait; 0 where it names no number of seconds."""
    header = response.getheader("Retry-After", "").strip()
    return float(header) if header.isdecimal() else 0.0


def _sum(tallies: Sequence[_Tally], began: float, seconds: float, cpu_s: float, *, interrupted: bool) -> Measurement:
    rows = np.concatenate([np.frombuffer(tally.rows, dtype=np.float64) for tally in tallies]).reshape(-1, _COLUMNS)
    told = {part: column[~np.isnan(column)] for part, column in zip(SERVER_PARTS, rows.T[2:], strict=True)}
    kinds = sorted({kind for tally in tallies for kind in tally.problems_ms})
    return Measurement(
        seconds=seconds,
        cpu_s=cpu_s,
        answered_s=rows[:, 0] - began,
        latency_ms=rows[:, 1] * 1000,
        server_ms={part: values for part, values in told.items() if len(values)},
        refused=sum((tally.refused for tally in tallies), Counter()),
        problems_ms={
            kind: np.concatenate([np.array(tally.problems_ms.get(kind, ())) for tally in tallies]) for kind in kinds
        },
        lost=sum((tally.lost for tally in tallies), Counter()),
        interrupted=interrupted,
        unanswered=sum(tally.unanswered for tally in tallies),
    )
