"""Request ids and the log line of every request."""

import asyncio
import json
import logging
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Never

import httpx
import pytest
import structlog
from sqlalchemy import Connection, Engine, event
from sqlalchemy.exc import OperationalError
from starlette.responses import PlainTextResponse
from starlette.types import Receive, Scope, Send
from structlog.contextvars import get_contextvars, merge_contextvars
from structlog.testing import capture_logs

from app import logs
from app.main import create_app
from app.settings import Settings
from app.tracing import Tracing
from tests.api.bodies import SUBMIT, intent
from tests.api.serving import Client, served, serving
from tests.ledger.locations import Ledgers, SqliteLedgers, write_lock
from tests.ledger.process import FakeClock, until

ID = {"X-Request-ID": "ORD-7781:retry.2_a"}
MADE = re.compile(r"[0-9a-f]{8}-[0-9a-f]{4}-7[0-9a-f]{3}-[0-9a-f]{4}-[0-9a-f]{12}")

Line = dict[str, Any]


@pytest.fixture
def ledgers(tmp_path: Path) -> Ledgers:
    """Keep to one kind of database: nothing here has to do with that."""
    return SqliteLedgers(tmp_path)


@pytest.fixture
def lines() -> Iterator[list[Line]]:
    """Return what is logged during a test, as it is."""
    with capture_logs(processors=[merge_contextvars]) as captured:
        yield captured  # type: ignore[misc]


def requests(lines: list[Line]) -> list[Line]:
    return [line for line in lines if line["event"] == "request"]


def answer_id(response: httpx.Response) -> str:
    """Return the id that an answer names; it names one only."""
    (found,) = response.headers.get_list("x-request-id")
    return str(found)


# The header


@pytest.mark.parametrize("given", ["a", "7", "ORD-7781", "a.b:c_d-e", "x" * 100])
def test_a_fit_request_id_is_taken(client: Client, given: str) -> None:
    assert answer_id(client.get("/health/live", headers={"X-Request-ID": given})) == given


@pytest.mark.parametrize("given", ["", " ", "x" * 101, "a b", "a/b", 'a"b', "a\tb", "né", "a,b", "<script>"])
def test_an_unfit_request_id_is_replaced(client: Client, given: str) -> None:
    response = client.get("/health/live", headers=[(b"X-Request-ID", given.encode())])
    assert MADE.fullmatch(answer_id(response))


def test_every_request_without_an_id_gets_one_of_its_own(client: Client) -> None:
    made = [answer_id(client.get("/health/live")) for _ in range(3)]
    assert all(MADE.fullmatch(each) for each in made)
    assert len(set(made)) == 3


@pytest.mark.parametrize(
    ("method", "path", "options", "status"),
    [
        ("POST", SUBMIT, {"json": intent()}, 201),
        ("GET", "/", {}, 200),
        ("POST", SUBMIT, {"content": b"{", "headers": {"Content-Type": "application/json"}}, 400),
        ("GET", "/nowhere", {}, 404),
        ("PUT", SUBMIT, {}, 405),
        ("POST", SUBMIT, {"content": b"x" * 1_048_577}, 413),
        ("GET", "/health/live", {"headers": {"Host": "airmatrix.example"}}, 421),
        ("POST", SUBMIT, {"json": intent("A", "A")}, 422),
    ],
)
def test_whatever_the_answer_it_names_the_request(
    client: Client, method: str, path: str, options: dict[str, Any], status: int
) -> None:
    headers = {**ID, **options.get("headers", {})}
    response = client.request(method, path, **{**options, "headers": headers})
    assert (response.status_code, answer_id(response)) == (status, ID["X-Request-ID"])


def test_a_refusal_of_a_stopped_writer_names_the_request(client: Client) -> None:
    client.service.writer.stop()
    response = client.post(SUBMIT, json=intent(), headers=ID)
    assert (response.status_code, answer_id(response)) == (503, ID["X-Request-ID"])


@pytest.fixture
def buggy(settings: Settings, clock: FakeClock) -> Iterator[Client]:
    """Return a client of a service with a bug."""
    app = create_app(settings, clock)

    @app.get("/bug")
    async def bug() -> None:
        raise ZeroDivisionError

    with served(app) as client:
        yield client


def test_the_answer_to_an_unexpected_error_names_the_request(buggy: Client) -> None:
    response = buggy.get("/bug", headers=ID)
    assert (response.status_code, answer_id(response)) == (500, ID["X-Request-ID"])


# The log


def test_a_request_is_one_line_of_the_debug_log(client: Client, lines: list[Line]) -> None:
    client.get(f"{SUBMIT}?limit=3", headers=ID)
    (line,) = lines
    assert 0 < line.pop("ms") < 60_000
    assert line == {
        "event": "request",
        "log_level": "debug",
        "method": "GET",
        "route": SUBMIT,
        "status": 200,
        "request_id": ID["X-Request-ID"],
    }


def test_a_problem_is_logged_with_its_type_and_no_path(client: Client, lines: list[Line]) -> None:
    client.get(f"{SUBMIT}/swordfish", headers=ID)
    (line,) = lines
    del line["ms"]
    assert line == {
        "event": "request",
        "log_level": "debug",
        "method": "GET",
        "route": f"{SUBMIT}/{{intent_id}}",
        "status": 404,
        "problem": "unknown-flight-intent",
        "request_id": ID["X-Request-ID"],
    }


def test_an_id_that_was_made_is_the_one_that_is_logged(client: Client, lines: list[Line]) -> None:
    response = client.get("/health/live")
    assert [line["request_id"] for line in lines] == [answer_id(response)]


def test_an_unfit_request_id_is_not_logged(client: Client, lines: list[Line]) -> None:
    client.get("/health/live", headers={"X-Request-ID": "a b"})
    assert "a b" not in str(lines)


def test_a_problem_of_the_service_is_a_warning_with_the_id(client: Client, lines: list[Line]) -> None:
    def fail(_: Connection) -> Never:
        raise OperationalError("BEGIN", {}, Exception("disk I/O error"))

    event.listen(Engine, "begin", fail)
    try:
        assert client.get(SUBMIT, headers=ID).status_code == 503
    finally:
        event.remove(Engine, "begin", fail)
    (line,) = requests(lines)
    assert (line["log_level"], line["status"], line["problem"]) == ("warning", 503, "ledger-unavailable")
    assert line["request_id"] == ID["X-Request-ID"]


def test_an_unexpected_error_is_logged_with_the_id(buggy: Client, lines: list[Line]) -> None:
    buggy.get("/bug", headers=ID)
    (unexpected,) = [line for line in lines if line["event"] == "unexpected error"]
    (line,) = requests(lines)
    assert (line["log_level"], line["problem"]) == ("warning", "internal-error")
    assert unexpected["request_id"] == line["request_id"] == ID["X-Request-ID"]


def test_requests_that_a_full_queue_refuses_do_not_fill_the_log(
    settings: Settings, clock: FakeClock, lines: list[Line]
) -> None:
    async def overfill() -> None:
        full = Settings.model_validate({**settings.model_dump(), "queue_limit": 1})
        async with serving(create_app(full, clock)) as (http, service):
            with write_lock(full.ledger):
                first = asyncio.create_task(http.post(SUBMIT, json=intent()))
                # The writer has taken the first request once there is room for a second beside it.
                await asyncio.sleep(0.1)
                await until(lambda: service.writer.waiting == 0)
                second = asyncio.create_task(http.post(SUBMIT, json=intent()))
                await until(lambda: service.writer.is_full)
                await http.post(SUBMIT, json=intent())
            await asyncio.gather(first, second)

    asyncio.run(overfill())
    assert [(line["status"], line["log_level"]) for line in requests(lines)] == [
        (503, "debug"),
        (201, "debug"),
        (201, "debug"),
    ]


def test_what_the_writer_logs_of_a_request_has_its_id(client: Client, lines: list[Line]) -> None:
    client.post(SUBMIT, json=intent(), headers=ID)
    client.service.writer.stop()
    (line,) = [line for line in lines if line["event"] == "flight intent accepted"]
    assert line["request_id"] == ID["X-Request-ID"]


def test_requests_at_the_same_time_keep_their_ids_apart(client: Client, lines: list[Line]) -> None:
    async def together() -> None:
        given = [f"id-{n}" for n in range(20)]
        answers = [client.http.get(SUBMIT, headers={"X-Request-ID": each}) for each in given]
        assert [answer_id(answer) for answer in await asyncio.gather(*answers)] == given

    client.portal.call(together)
    assert sorted(line["request_id"] for line in requests(lines)) == sorted(f"id-{n}" for n in range(20))


def test_no_id_outlives_its_request(settings: Settings, clock: FakeClock) -> None:
    async def ask() -> list[dict[str, Any]]:
        async with serving(create_app(settings, clock)) as (http, _):
            before = get_contextvars()
            await http.get("/health/live", headers=ID)
            return [before, get_contextvars()]

    assert asyncio.run(ask()) == [{}, {}]


def test_a_log_that_cannot_be_written_breaks_nothing(client: Client) -> None:
    def fail_to_log(*_: object) -> Never:
        raise OSError("no space left on device")

    async def ask() -> httpx.Response:
        tracing = Tracing(PlainTextResponse("well"))

        async def with_state(scope: Scope, receive: Receive, send: Send) -> None:
            await tracing({**scope, "state": {"service": client.service}}, receive, send)

        # Unlike a server, it does not hide what an application raises after its answer.
        async with httpx.AsyncClient(transport=httpx.ASGITransport(with_state), base_url="http://127.0.0.1") as http:
            return await http.get("/", headers=ID)

    before = structlog.get_config()
    structlog.configure(processors=[fail_to_log])
    try:
        response = asyncio.run(ask())
    finally:
        structlog.configure(**before)
    assert (response.status_code, answer_id(response)) == (200, ID["X-Request-ID"])


@pytest.mark.parametrize(("level", "logged"), [("debug", ["request"]), ("info", [])])
def test_lines_are_json_for_machines_with_the_id(
    client: Client, capsys: pytest.CaptureFixture[str], level: str, logged: list[str]
) -> None:
    before, handlers = structlog.get_config(), logging.root.handlers[:]
    logs.configure(Settings.model_validate({"log_format": "json", "log_level": level}))
    try:
        client.get("/health/live", headers=ID)
    finally:
        structlog.configure(**before)
        logging.root.handlers[:] = handlers
    written = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [line["event"] for line in written] == logged
    assert [line["request_id"] for line in written] == [ID["X-Request-ID"]] * len(logged)
