"""Running it: without a ledger or a writer, version, events, the Host header, documentation, every kind of problem."""

import asyncio
import platform
import re
import sqlite3
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI, HTTPException
from sqlalchemy import Connection, Engine, event
from sqlalchemy.exc import OperationalError

from app import problems
from app.errors import RequestError, UnsafeListening
from app.main import create_app
from app.routes.events import EventPage
from app.settings import Settings
from planner.errors import AircraftProfileError, NoPlan, NotPlannable
from tests.api.bodies import PREVIEW, PROBLEM, SUBMIT, intent, problem
from tests.api.serving import Client, served, serving
from tests.ledger.locations import Ledgers, SqliteLedgers, write_lock
from tests.ledger.process import FakeClock, until


def settings_with(settings: Settings, **options: object) -> Settings:
    return Settings.model_validate({**settings.model_dump(), **options})


@pytest.fixture
def ledgers(tmp_path: Path) -> Ledgers:
    """Keep to one kind of database: nothing here has to do with that."""
    return SqliteLedgers(tmp_path)


# Without a writer, or without a ledger


def test_a_service_whose_writer_has_stopped_still_reads(client: Client) -> None:
    client.post(SUBMIT, json=intent())
    client.service.writer.stop()
    assert len(client.get(SUBMIT).json()["items"]) == 1


@pytest.mark.parametrize("path", [SUBMIT, PREVIEW])
def test_a_service_whose_writer_has_stopped_refuses_to_plan(client: Client, path: str) -> None:
    client.service.writer.stop()
    response = client.post(path, json=intent())
    problem(response, 503, "ledger-unavailable")
    assert response.headers["retry-after"] == "1"


@pytest.fixture
def unreadable(client: Client) -> Iterator[Client]:
    """Return a client of a service whose ledger cannot be read."""

    def fail(_: Connection) -> None:
        raise OperationalError("BEGIN", {}, sqlite3.OperationalError("disk I/O error"))

    event.listen(Engine, "begin", fail)
    yield client
    event.remove(Engine, "begin", fail)


@pytest.mark.parametrize(
    "path",
    [
        SUBMIT,
        f"{SUBMIT}/01a2025d-cf8d-7793-bfd6-fd7be76cdfea",
        "/v1/events",
        "/v1/airspace/status",
        "/v1/airspace/occupancy",
        "/v1/airspace/blocks/0/0/0",
    ],
)
def test_what_needs_the_ledger_says_that_it_cannot_be_read(unreadable: Client, path: str) -> None:
    response = unreadable.get(path)
    problem(response, 503, "ledger-unavailable")
    assert response.headers["retry-after"] == "1"


@pytest.mark.parametrize(
    "path", ["/health/live", "/version", "/metrics", "/v1/airspace", "/v1/airspace/static", "/v1/aircraft-types"]
)
def test_what_needs_no_ledger_is_served_without(unreadable: Client, path: str) -> None:
    assert unreadable.get(path).status_code == 200


def test_a_full_queue_refuses_and_records_nothing(settings: Settings, clock: FakeClock) -> None:
    async def overfill() -> httpx.Response:
        async with serving(create_app(settings_with(settings, queue_limit=1), clock)) as (http, service):
            with write_lock(settings.ledger):
                first = asyncio.create_task(http.post(SUBMIT, json=intent()))
                # The writer has taken the first request once there is room for a second beside it.
                await asyncio.sleep(0.1)
                await until(lambda: service.writer.waiting == 0)
                second = asyncio.create_task(http.post(SUBMIT, json=intent()))
                await until(lambda: service.writer.waiting == 1)
                third = await http.post(SUBMIT, json=intent())
            assert [(await first).json()["sequence"], (await second).json()["sequence"]] == [1, 2]
            assert len((await http.get(SUBMIT)).json()["items"]) == 2
            return third

    response = asyncio.run(overfill())
    problem(response, 503, "queue-full")
    assert response.headers["retry-after"] == "1"


# Version


def test_the_version_says_what_runs(client: Client) -> None:
    assert client.get("/version").json() == {
        "airmatrix": version("airmatrix"),
        "python": platform.python_version(),
        "airspace": "district",
        "ledger": "sqlite",
        "mode": "read-write",
        "authentication": "none",
        "allow_unauthenticated": False,
    }


def test_the_version_says_loudly_that_anybody_may_do_anything(settings: Settings, clock: FakeClock) -> None:
    with served(create_app(settings_with(settings, allow_unauthenticated=True), clock)) as client:
        assert client.get("/version").json()["allow_unauthenticated"] is True


# Who may ask


@pytest.mark.parametrize(
    "host",
    ["127.0.0.1", "127.0.0.1:8000", "localhost", "LOCALHOST:8000", "127.8.9.1", "[::1]", "[::1]:8000"],
)
def test_a_loopback_host_is_served(client: Client, host: str) -> None:
    assert client.get("/health/live", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize(
    "host",
    [
        "airmatrix.example",
        "127.0.0.1.example.com",
        "localhost.example.com",
        "10.0.0.1",
        "0.0.0.0",  # noqa: S104 -- refused here
        "[::]",
        "[2001:db8::1]:8000",
        "",
        "::1",
    ],
)
def test_another_host_is_refused_on_every_path(client: Client, host: str) -> None:
    for path in ("/health/live", SUBMIT, "/docs", "/openapi.json", "/nowhere"):
        problem(client.get(path, headers={"Host": host}), 421, "host-not-allowed")


@pytest.mark.parametrize(
    "headers",
    [
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site", "Origin": "http://127.0.0.1:3000"},
        {"Origin": "https://airmatrix.example"},
        {"Origin": "http://127.0.0.1.example"},
        {"Origin": "null"},
    ],
)
def test_a_page_of_another_site_changes_nothing(client: Client, headers: dict[str, str]) -> None:
    flight = client.post(SUBMIT, json=intent()).headers["location"]
    problem(client.post(f"{flight}/activate", headers=headers), 403, "cross-site-request")
    problem(client.delete(flight, headers=headers), 403, "cross-site-request")
    assert client.get(flight, headers=headers).json()["version"] == "1"


@pytest.mark.parametrize(
    "headers",
    [
        {"Sec-Fetch-Site": "same-origin", "Origin": "http://127.0.0.1"},
        {"Sec-Fetch-Site": "none"},
        {"Origin": "http://localhost:8000"},
        {"Origin": "http://[::1]:8000"},
    ],
)
def test_the_service_s_own_pages_change_what_they_like(client: Client, headers: dict[str, str]) -> None:
    flight = client.post(SUBMIT, json=intent()).headers["location"]
    assert client.post(f"{flight}/activate", headers=headers).status_code == 200


def test_a_page_from_the_host_that_is_asked_is_the_service_s_own(settings: Settings, clock: FakeClock) -> None:
    with served(create_app(settings.model_copy(update={"allow_unauthenticated": True}), clock)) as client:
        own, other = (
            {"Host": "uss.example:8000", "Origin": f"http://{origin}"} for origin in ("uss.example:8000", "uss.example")
        )
        assert client.post(SUBMIT, json=intent(), headers=own).status_code == 201
        problem(client.post(SUBMIT, json=intent(), headers=other), 403, "cross-site-request")


def test_nobody_is_sent_elsewhere_for_a_slash_too_many(client: Client) -> None:
    for method in ("GET", "POST"):
        problem(client.request(method, f"{SUBMIT}/"), 404, "not-found")


def test_any_host_is_served_where_that_was_asked_for(settings: Settings, clock: FakeClock) -> None:
    with served(create_app(settings_with(settings, allow_unauthenticated=True), clock)) as client:
        assert client.get("/health/live", headers={"Host": "airmatrix.example"}).status_code == 200


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.0.1", "airmatrix.example"])  # noqa: S104
def test_a_service_refuses_to_start_beyond_loopback(settings: Settings, host: str, ledger_path: Path) -> None:
    with (
        pytest.raises(UnsafeListening, match="there is no authentication"),
        served(create_app(settings_with(settings, host=host, ledger=str(ledger_path)))),
    ):
        pass
    assert not ledger_path.exists()


def test_building_the_application_opens_nothing(settings: Settings, ledger_path: Path) -> None:
    create_app(settings_with(settings, ledger=str(ledger_path)))
    create_app(Settings(ledger="/nowhere/ledger.sqlite", airspace=Path("/nowhere/airspace.json"), host="10.0.0.1"))
    assert not ledger_path.exists()


# Events


@pytest.fixture
def eventful(client: Client, clock: FakeClock) -> Client:
    """Return a client of a service with three events: accepted, accepted, cancelled."""
    first = client.post(SUBMIT, json=intent()).json()
    clock.advance(ms=1)
    client.post(SUBMIT, json=intent("C", "A"))
    client.delete(f"{SUBMIT}/{first['id']}")
    return client


def test_events_tell_what_happened_in_its_order(eventful: Client) -> None:
    page = eventful.get("/v1/events").json()
    first, second = (item["id"] for item in eventful.get(SUBMIT).json()["items"])
    times = ["2026-11-22T08:00:00.000Z", "2026-11-22T08:00:00.001Z", "2026-11-22T08:00:00.001Z"]
    told = [("accepted", first, 1), ("accepted", second, 2), ("cancelled", first, 1)]
    assert page == {
        "items": [
            {
                "revision": revision, "time": time, "kind": kind, "flight_intent_id": flight, "sequence": sequence,
                "track_id": None, "reasons": [], "details": {},
            }
            for revision, (time, (kind, flight, sequence)) in enumerate(zip(times, told, strict=True), start=1)
        ],
        "next_cursor": None,
        "removed_through": 0,
    }  # fmt: skip
    EventPage.model_validate(page)


def test_a_refusal_is_an_event(client: Client) -> None:
    client.post(SUBMIT, json=intent())
    client.post(SUBMIT, json=intent(window_ms=0))
    assert [item["kind"] for item in client.get("/v1/events").json()["items"]] == ["accepted", "rejected"]


@pytest.mark.parametrize(("after", "revisions"), [("0", [1, 2, 3]), ("1", [2, 3]), ("3", []), (str(2**62), [])])
def test_events_after_a_revision_leave_the_earlier_ones_out(eventful: Client, after: str, revisions: list[int]) -> None:
    page = eventful.get("/v1/events", params={"after": after}).json()
    assert [item["revision"] for item in page["items"]] == revisions


@pytest.mark.parametrize(("limit", "pages"), [(1, 3), (2, 2), (3, 1), (500, 1)])
def test_pages_of_events_together_are_the_journal(eventful: Client, limit: int, pages: int) -> None:
    revisions, after, seen = [], "0", 0
    while after is not None:
        page = eventful.get("/v1/events", params={"after": after, "limit": str(limit)}).json()
        revisions += [item["revision"] for item in page["items"]]
        after = page["next_cursor"]
        seen += 1
    assert revisions == [1, 2, 3]
    assert seen == pages


@pytest.mark.parametrize(
    "parameters",
    [{"after": "-1"}, {"after": str(2**62 + 1)}, {"after": "9" * 40}, {"after": "x"}, {"limit": "0"}, {"limit": "501"}],
)
def test_events_that_cannot_be_paged_so_are_refused(client: Client, parameters: dict[str, str]) -> None:
    answer = problem(client.get("/v1/events", params=parameters), 422, "validation-error")
    assert [error["loc"] for error in answer["errors"]] == [["query", next(iter(parameters))]]


# Problems


def all_subclasses(cls: type[Exception]) -> list[type[Exception]]:
    return [found for sub in cls.__subclasses__() for found in (sub, *all_subclasses(sub))]


@pytest.mark.parametrize(
    "error",
    [AircraftProfileError, *(sub for base in (RequestError, NotPlannable, NoPlan) for sub in all_subclasses(base))],
)
def test_every_error_a_request_can_meet_has_its_kind_of_problem(error: type[Exception]) -> None:
    assert problems.kind_of(error.__new__(error)).status in range(400, 504)


def test_every_kind_of_problem_has_a_slug_of_its_own() -> None:
    kinds = [*problems.KINDS.values(), problems.VALIDATION, problems.INTERNAL]
    assert len({kind.slug for kind in kinds}) == len(kinds)


@pytest.mark.parametrize(
    "kind", [*problems.KINDS.values(), problems.VALIDATION, problems.INTERNAL], ids=lambda kind: kind.slug
)
def test_every_type_of_problem_leads_to_its_explanation(client: Client, kind: problems.Kind) -> None:
    response = client.get(f"/problems/{kind.slug}")
    assert response.status_code == 200
    assert response.json() == {
        "type": f"/problems/{kind.slug}",
        "title": kind.title,
        "status": kind.status,
        "advice": kind.advice,
    }


@pytest.mark.parametrize(
    ("method", "path", "status", "slug"),
    [
        ("GET", "/nowhere", 404, "not-found"),
        ("GET", "/v1", 404, "not-found"),
        ("GET", "/problems/no-such-kind", 404, "not-found"),
        ("PATCH", SUBMIT, 405, "method-not-allowed"),
        ("DELETE", "/v1/airspace", 405, "method-not-allowed"),
    ],
)
def test_an_unknown_path_or_method_is_a_problem_whose_type_is_explained(
    client: Client, method: str, path: str, status: int, slug: str
) -> None:
    answer = problem(client.request(method, path), status, slug)
    assert set(answer) == PROBLEM
    assert client.get(answer["type"]).status_code == 200


def test_a_method_that_is_not_allowed_says_which_are(client: Client) -> None:
    assert client.request("PATCH", "/v1/airspace").headers["allow"] == "GET"


def with_a_bug(settings: Settings, clock: FakeClock) -> FastAPI:
    app = create_app(settings, clock)

    @app.get("/bug")
    async def bug() -> None:
        raise ZeroDivisionError("the password is swordfish")

    return app


def test_an_unexpected_error_is_answered_with_its_id_and_nothing_of_its_text(
    settings: Settings, clock: FakeClock
) -> None:
    with served(with_a_bug(settings, clock)) as client:
        first, second = client.get("/bug"), client.get("/bug")
    answer = problem(first, 500, "internal-error")
    assert set(answer) == PROBLEM | {"error_id"}
    assert re.fullmatch(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}", answer["error_id"])
    assert answer["error_id"] != second.json()["error_id"]
    assert {**answer, "error_id": ""} == {**second.json(), "error_id": ""}
    assert "swordfish" not in first.text


def test_an_unexpected_error_is_logged_with_its_id(
    settings: Settings, clock: FakeClock, capsys: pytest.CaptureFixture[str]
) -> None:
    with served(with_a_bug(settings, clock)) as client:
        error_id = client.get("/bug").json()["error_id"]
    (line,) = [line for line in capsys.readouterr().out.splitlines() if error_id in line]
    assert "swordfish" in line


def test_what_the_framework_alone_refuses_is_a_problem_with_its_status(settings: Settings, clock: FakeClock) -> None:
    app = create_app(settings, clock)

    @app.get("/teapot")
    def teapot() -> None:
        raise HTTPException(418, "short and stout")

    with served(app) as client:
        assert problem(client.get("/teapot"), 418, "malformed-request")["detail"] == "short and stout"


# Documentation


def test_the_documentation_is_served(client: Client) -> None:
    response = client.get("/docs")
    assert (response.status_code, response.headers["content-type"]) == (200, "text/html; charset=utf-8")


def test_the_documented_openapi_is_the_application_s(client: Client, settings: Settings) -> None:
    assert client.get("/openapi.json").json() == create_app(settings).openapi()
