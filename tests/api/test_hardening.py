"""Clients that are slow, greedy or malicious cost little, get a problem where one can be sent, and harm nobody else."""

import json
import resource
import socket
import threading
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from http.client import HTTPResponse
from itertools import islice, repeat
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from starlette.responses import Response, StreamingResponse

from app import problems
from app.commands.serve import allow_files
from app.connections import MAX_HEAD_BYTES, MAX_HEADERS
from app.main import create_app
from app.settings import Settings
from tests.api.listening import listening
from tests.api.serving import Client, served, settings_for
from tests.ledger.district import OLD_TOWN
from tests.ledger.process import FakeClock

_PATIENCE_S = 20.0
_STREAM = "/v1/airspace/stream"
_PLAIN = b"GET /version HTTP/1.1\r\nHost: localhost\r\n"
_POST = b"POST /v1/flight-intents HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
_BIG = 8 * 1024 * 1024


@dataclass(frozen=True)
class Answer:
    """What came back: status (None if nothing did), headers by lower-case name, body, and whether that was the end."""

    status: int | None
    headers: dict[str, str] = field(default_factory=dict)
    body: bytes = b""
    is_last: bool = True

    @property
    def slug(self) -> str | None:
        """Which problem it is."""
        if self.headers.get("content-type") != problems.MEDIA_TYPE:
            return None
        document = json.loads(self.body)
        assert document["status"] == self.status
        return str(document["type"]).removeprefix("/problems/")


@dataclass(frozen=True)
class Service:
    """A service behind a socket."""

    port: int

    @contextmanager
    def connected(self, *, receive_buffer: int | None = None) -> Iterator[socket.socket]:
        """Connect to it."""
        with closing(socket.socket()) as connection:
            connection.settimeout(_PATIENCE_S)
            if receive_buffer is not None:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
            connection.connect(("127.0.0.1", self.port))
            yield connection

    def send(self, content: bytes) -> Answer:
        """Return the answer to what is sent on a connection of its own."""
        with self.connected() as connection:
            connection.sendall(content)
            return answered(connection)

    def get(self, path: str, headers: dict[str, str] | None = None) -> httpx.Response:
        """Return the answer to a proper request."""
        return httpx.get(f"http://127.0.0.1:{self.port}{path}", headers=headers, timeout=_PATIENCE_S)


def answered(connection: socket.socket) -> Answer:
    """Read one answer, and tell whether the connection was then closed within the time there is for that."""
    with closing(HTTPResponse(connection)) as response:
        try:
            response.begin()
        except ConnectionError:
            return Answer(None)
        headers = {name.lower(): value for name, value in response.getheaders()}
        assert len(headers) == len(response.getheaders()), "a header came twice"
        body = response.read()
        return Answer(response.status, headers, body, is_last=headers.get("connection") == "close")


def rest_of(connection: socket.socket) -> bytes:
    """Return what still comes until a connection ends; raises `TimeoutError` if it does not."""
    parts = []
    with suppress(ConnectionError):
        while part := connection.recv(65_536):
            parts.append(part)
    return b"".join(parts)


def drip(connection: socket.socket, pieces: Iterable[bytes]) -> bool:
    """Send pieces with pauses between them, and tell whether the other end went before the last, or in ten seconds."""
    pause = threading.Event()
    try:
        for piece in islice(pieces, 200):
            connection.send(piece)
            pause.wait(0.05)
    except ConnectionError:
        return True
    return False


def hasty(folder: Path, **options: Any) -> Settings:
    """Return settings of a service that waits for nobody."""
    times = {"head_timeout_s": 0.3, "body_timeout_s": 0.3, "send_timeout_s": 0.6}
    return settings_for(OLD_TOWN, str(folder / "ledger.sqlite"), folder, **{**times, **options})


def application(settings: Settings) -> FastAPI:
    """Return the application, with a big answer, one that never ends, and one that fails."""
    app = create_app(settings, FakeClock())

    @app.get("/v1/big", include_in_schema=False)
    def big() -> Response:
        return Response(b"x" * _BIG, media_type="text/plain")

    @app.get("/v1/endless", include_in_schema=False)
    def endless() -> Response:
        return StreamingResponse(repeat(b"x" * 65_536), media_type="text/plain")

    @app.get("/v1/broken", include_in_schema=False)
    def broken() -> None:
        raise ZeroDivisionError

    return app


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    settings = hasty(tmp_path_factory.mktemp("hasty"), max_streams=2)
    with listening(application(settings), settings) as port:
        running = Service(port)
        yield running
        assert running.get("/health/ready").status_code == 200


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    """Return a client without sockets of a service that reads large bodies."""
    settings = hasty(tmp_path_factory.mktemp("large"), max_body_bytes=2**21)
    with served(application(settings)) as running:
        yield running


# Slow clients


@pytest.mark.parametrize("begun", [b"\r\n", b"G", _PLAIN, _PLAIN + b"X-Slow: 1"], ids=repr)
def test_a_head_that_does_not_end_is_given_up(service: Service, begun: bytes) -> None:
    answer = service.send(begun)
    assert (answer.status, answer.slug, answer.is_last) == (408, "request-timeout", True)


def test_a_head_that_comes_byte_by_byte_is_given_up_at_the_same_time(service: Service) -> None:
    with service.connected() as connection:
        # Each within the time that there is for the whole.
        dripping = threading.Thread(target=drip, args=(connection, (bytes([byte]) for byte in _PLAIN * 10)))
        dripping.start()
        answer = answered(connection)
        dripping.join()
    assert (answer.status, answer.slug) == (408, "request-timeout")


def test_who_connects_and_says_nothing_is_hung_up(service: Service) -> None:
    with service.connected() as connection:
        assert rest_of(connection) == b""


def test_a_second_head_that_does_not_end_is_given_up(service: Service) -> None:
    with service.connected() as connection:
        connection.sendall(_PLAIN + b"\r\n")
        assert answered(connection).status == 200
        connection.sendall(_PLAIN)
        assert answered(connection).slug == "request-timeout"


@pytest.mark.parametrize("body", [b"Content-Length: 100\r\n\r\n{", b"Transfer-Encoding: chunked\r\n\r\n5\r\n{    \r\n"])
def test_a_body_that_does_not_arrive_is_given_up(service: Service, body: bytes) -> None:
    with service.connected() as connection:
        connection.sendall(_POST + body)
        answer = answered(connection)
        assert (answer.status, answer.slug, answer.is_last) == (408, "request-timeout", True)
        assert rest_of(connection) == b""


def test_a_body_that_goes_on_after_its_refusal_is_not_read_for_ever(service: Service) -> None:
    with service.connected() as connection:
        connection.sendall(_POST + b"Content-Length: 1000000000\r\n\r\n")
        assert answered(connection).slug == "body-too-large"
        assert drip(connection, repeat(b"x" * 1_000))


@pytest.mark.parametrize("path", [b"/v1/big", b"/v1/endless"])
@pytest.mark.parametrize("close", [b"", b"Connection: close\r\n"])
def test_an_answer_that_nobody_reads_is_given_up(service: Service, path: bytes, close: bytes) -> None:
    with service.connected(receive_buffer=4_096) as connection:
        connection.sendall(b"GET " + path + b" HTTP/1.1\r\nHost: localhost\r\n" + close + b"\r\n")
        assert connection.recv(15) == b"HTTP/1.1 200 OK"
        # The system tells that the other end is gone when something is sent there.
        assert drip(connection, repeat(b"\r\n"))


def test_an_answer_that_is_read_slowly_but_steadily_is_sent_whole(service: Service) -> None:
    with service.connected(receive_buffer=16_384) as connection:
        connection.sendall(b"GET /v1/big HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        received, pause = 0, threading.Event()
        while chunk := connection.recv(16_384):
            received += len(chunk)
            # For two seconds, longer than a client that does not read is waited for; the test has the rest at once.
            if received < 100 * 16_384:
                pause.wait(0.02)
    assert received > _BIG


# Many clients


def test_one_connection_too_many_is_told_so_and_the_others_go_on(tmp_path: Path) -> None:
    settings = hasty(tmp_path, max_connections=3, head_timeout_s=_PATIENCE_S)
    with listening(application(settings), settings) as port, ExitStack() as others:
        service = Service(port)
        held = [others.enter_context(service.connected()) for _ in range(3)]
        for connection in held:
            connection.sendall(_PLAIN + b"\r\n")
            assert answered(connection).status == 200
        answer = service.send(_PLAIN + b"\r\n")
        assert (answer.status, answer.slug, answer.is_last) == (503, "too-many-connections", True)
        assert answer.headers["retry-after"] == "1"
        # Nor may it stay and say nothing, as those within the limit may.
        with ExitStack() as more:
            silent = [more.enter_context(service.connected()) for _ in range(3)]
            # Twice as many as there may be: now nobody is told anything.
            assert service.send(_PLAIN + b"\r\n").status is None
            assert [rest_of(connection) for connection in silent] == [b"", b"", b""]
        held[0].sendall(_PLAIN + b"\r\n")
        assert answered(held[0]).status == 200
        held[1].close()
        held[2].close()
        assert service.get("/version").status_code == 200


def test_one_stream_too_many_is_told_so_until_one_ends(service: Service) -> None:
    watch = b"GET /v1/airspace/stream HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with service.connected() as first, service.connected() as second:
        for connection in (first, second):
            connection.sendall(watch)
            assert connection.recv(15) == b"HTTP/1.1 200 OK"
        with service.connected() as third:
            third.sendall(watch)
            assert third.recv(12, socket.MSG_PEEK) == b"HTTP/1.1 503"
            answer = answered(third)
        assert (answer.status, answer.slug, answer.headers["retry-after"]) == (503, "too-many-streams", "1")
    for _ in range(200):
        with service.connected() as next_one:
            next_one.sendall(watch)
            if next_one.recv(15) == b"HTTP/1.1 200 OK":
                return
    pytest.fail("the places of streams that have ended are not free again")


def test_a_process_may_open_as_many_files_as_its_connections_need() -> None:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (512, before[1]))
        allow_files(1_000)
        assert resource.getrlimit(resource.RLIMIT_NOFILE) == (2_256, before[1])
        allow_files(10)
        assert resource.getrlimit(resource.RLIMIT_NOFILE) == (2_256, before[1])
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


# Heads


_LONG = b"x" * (MAX_HEAD_BYTES + 1)


@pytest.mark.parametrize(
    "head",
    [
        _PLAIN + b"X-Long: " + _LONG + b"\r\n\r\n",
        _PLAIN + b"X-Endless: " + _LONG * 20,
        _PLAIN + b"X: 1\r\n" * MAX_HEADERS + b"\r\n",
        b"GET /" + _LONG + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET /version?" + _LONG * 20,
        _POST + b"Transfer-Encoding: chunked\r\n\r\n0\r\nX-Trailer: " + _LONG * 20,
    ],
    ids=["a long header", "an endless header", "many headers", "a long path", "an endless query", "an endless trailer"],
)
def test_too_much_of_a_head_is_refused(service: Service, head: bytes) -> None:
    with service.connected() as connection:
        # It may have answered, and not read the rest.
        with suppress(ConnectionError):
            connection.sendall(head)
        answer = answered(connection)
    assert (answer.status, answer.slug, answer.is_last) == (431, "head-too-large", True)


def test_just_as_many_headers_as_allowed_are_read(service: Service) -> None:
    assert service.send(_PLAIN + b"X: 1\r\n" * (MAX_HEADERS - 1) + b"\r\n").status == 200


def test_what_trails_a_body_is_no_header(service: Service) -> None:
    trailers = b"Transfer-Encoding: chunked\r\n\r\n2\r\n{}\r\n0\r\nX-Request-ID: trailing\r\n\r\n"
    answer = service.send(_POST + trailers)
    assert answer.status == 422
    assert answer.headers["x-request-id"] != "trailing"


_BOTH = b"Content-Length: 4\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n"


@pytest.mark.parametrize(
    "request_",
    [
        _POST + _BOTH,
        _POST + b"Transfer-Encoding: chunked\r\nContent-Length: 4\r\n\r\n0\r\n\r\n",
        _POST + b"Content-Length: 2\r\nContent-Length: 3\r\n\r\n{} ",
        _POST + b"Content-Length: -2\r\n\r\n{}",
        _POST + b"Content-Length: 0x2\r\n\r\n{}",
        _POST + b"Transfer-Encoding: chunked\r\n\r\nnothing\r\n",
        _PLAIN + b"Host: 127.0.0.1\r\n\r\n",
        b"GET /version HTTP/1.1\r\nHost: " + b"h" * 300 + b"\r\n\r\n",
        b"GET /version HTTP/1.1\r\nHost: localhost\r\n folded: 1\r\n\r\n",
        b"GET /version HTTP/1.1\r\nHost : localhost\r\n\r\n",
        b"GET /version HTTP/9.9\r\nHost: localhost\r\n\r\n",
        b"CONNECT localhost:80 HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET /\xff HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
    ],
    ids=repr,
)
def test_what_can_be_read_in_two_ways_or_in_none_is_malformed(service: Service, request_: bytes) -> None:
    answer = service.send(request_)
    assert (answer.status, answer.slug) == (400, "malformed-request")


def test_nonsense_behind_a_request_never_passes_for_its_answer(service: Service) -> None:
    with service.connected() as connection:
        connection.sendall(b"GET /v1/airspace/stream HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert connection.recv(15) == b"HTTP/1.1 200 OK"
        connection.sendall(b"nonsense\r\n\r\n")
        assert b"HTTP/1.1" not in rest_of(connection)


def test_an_upgrade_to_another_protocol_is_not_made(service: Service) -> None:
    websocket = b"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: eA==\r\n"
    assert service.send(_PLAIN + websocket + b"\r\n").status == 200


# Bodies


def _bodies() -> Iterator[tuple[str, bytes]]:
    deep = 100_000
    for place in (b"%s", b'{"operator": %s}', b'{"positions": [%s]}', b'{"polygon": {"coordinates": %s}}'):
        name = place.decode() % "…"
        yield f"deep lists in {name}", place % (b"[" * deep + b"]" * deep)
        yield f"deep objects in {name}", place % (b'{"a":' * deep + b"1" + b"}" * deep)
        yield f"endless lists in {name}", place % (b"[" * deep)
        yield f"a huge integer in {name}", place % (b"9" * deep)
        yield f"a huge exponent in {name}", place % b"1e999999999"
    yield "another media type", b"{}"


_CHANGING = ("POST", "PUT", "PATCH")


def _written(app: FastAPI) -> list[tuple[str, str]]:
    """Return every route that takes a body: method, and a path with something in its place."""
    return [
        (method, "/".join("00000000-0000-7000-8000-000000000000" if "{" in part else part for part in path.split("/")))
        for path, item in app.openapi()["paths"].items()
        for method in (name.upper() for name in item)
        if method in _CHANGING and "requestBody" in item[method.lower()]
    ]


def test_no_body_makes_any_route_fail(client: Client) -> None:
    routes = _written(create_app(client.service.settings))
    assert ("POST", "/v1/flight-intents") in routes
    wrong = []
    for method, path in routes:
        for name, content in _bodies():
            media_type = "text/plain" if name == "another media type" else "application/json"
            headers = {"Content-Type": media_type, "If-Match": '"1"'}
            answer = client.request(method, path, content=content, headers=headers)
            refused = answer.status_code in (400, 404, 413, 415, 422)
            # A telemetry report refuses its positions one by one.
            one_by_one = answer.status_code == 202 and answer.json()["accepted"] == 0
            if not (one_by_one or (refused and answer.headers["content-type"] == problems.MEDIA_TYPE)):
                wrong.append((method, path, name, answer.status_code))
    assert wrong == []


# Answers


_STRICT = {
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
}


@pytest.mark.parametrize(
    ("request_", "status", "caching"),
    [
        (b"GET /version HTTP/1.1\r\nHost: localhost", 200, None),
        (b"GET /console/main.js HTTP/1.1\r\nHost: localhost", 200, "no-cache"),
        (b"GET /docs HTTP/1.1\r\nHost: localhost", 200, None),
        (b"GET /v1/aircraft-types HTTP/1.1\r\nHost: localhost", 200, "no-store"),
        (b"GET /v1/nowhere HTTP/1.1\r\nHost: localhost", 404, "no-store"),
        (b"PATCH /v1/telemetry HTTP/1.1\r\nHost: localhost", 405, "no-store"),
        (b"GET /v1/airspace HTTP/1.1\r\nHost: elsewhere.example", 421, "no-store"),
        (b"GET /v1/broken HTTP/1.1\r\nHost: localhost", 500, "no-store"),
        (b"nonsense", 400, None),
    ],
)
def test_every_answer_has_the_security_headers(
    service: Service, request_: bytes, status: int, caching: str | None
) -> None:
    answer = service.send(request_ + b"\r\n\r\n")
    assert answer.status == status
    assert {name: answer.headers.get(name) for name in _STRICT} == _STRICT
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy
    assert "unsafe" not in policy
    assert answer.headers.get("cache-control") == caching
    assert not {"server", "strict-transport-security"} & set(answer.headers)


def test_data_is_never_a_page_that_does_anything(service: Service) -> None:
    policy = service.get("/v1/aircraft-types").headers["content-security-policy"]
    assert policy == "default-src 'none'; frame-ancestors 'none'"


def test_who_says_that_it_came_by_https_is_not_believed(service: Service) -> None:
    assert "strict-transport-security" not in service.get("/version", {"X-Forwarded-Proto": "https"}).headers


def test_a_trusted_proxy_is_believed(tmp_path: Path) -> None:
    settings = hasty(tmp_path, trusted_proxies="127.0.0.0/8, ::1")
    with listening(application(settings), settings) as port:
        service = Service(port)
        by_https = {"X-Forwarded-Proto": "https"}
        assert service.get("/version", by_https).headers["strict-transport-security"] == "max-age=31536000"
        assert "strict-transport-security" not in service.get("/version").headers


@pytest.mark.parametrize("proxies", ["*", "proxy.example", "127.0.0.1,", "10.0.0.1/8"])
def test_proxies_that_are_no_addresses_are_refused(proxies: str) -> None:
    with pytest.raises(ValueError, match="trusted_proxies"):
        Settings(trusted_proxies=proxies)
