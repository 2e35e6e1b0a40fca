"""Health: alive, and ready or not, with the reason; within its time, whatever the ledger does."""

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread, current_thread
from threading import enumerate as all_threads
from typing import Any

import httpx
import pytest
from sqlalchemy import Connection, Engine, event
from sqlalchemy.exc import OperationalError
from structlog.testing import capture_logs

from app.ledger_probe import LedgerProbe
from app.main import create_app
from app.service import Service, running
from app.settings import Settings
from tests.api.bodies import PROBLEM, SUBMIT, intent, problem
from tests.api.serving import Client, served, serving, settings_for
from tests.ledger.district import OLD_TOWN
from tests.ledger.locations import SqliteLedgers, write_lock
from tests.ledger.process import FakeClock, until

NOT_READY = PROBLEM | {"reason", "waiting", "revision"}
# More readers than there are threads for them.
READERS = 50


def not_ready(response: httpx.Response) -> tuple[str, int, int | None]:
    """Return reason, waiting and revision of a service that is not ready."""
    answer = problem(response, 503, "not-ready")
    assert set(answer) == NOT_READY
    assert response.headers["retry-after"] == "1"
    return answer["reason"], answer["waiting"], answer["revision"]


def settings_with(settings: Settings, **options: object) -> Settings:
    return Settings.model_validate({**settings.model_dump(), **options})


@contextmanager
def failing(thread: str) -> Iterator[None]:
    """Let the transactions of a thread fail as they begin."""

    def fail(_: Connection) -> None:
        if current_thread().name == thread:
            raise OperationalError("BEGIN", {}, Exception("disk I/O error"))

    event.listen(Engine, "begin", fail)
    try:
        yield
    finally:
        event.remove(Engine, "begin", fail)


def test_a_process_is_live(client: Client) -> None:
    response = client.get("/health/live")
    assert (response.status_code, response.json()) == (200, {"status": "live"})


def test_a_service_is_ready_with_the_ledger_s_revision(client: Client) -> None:
    client.post(SUBMIT, json=intent())
    response = client.get("/health/ready")
    assert response.status_code == 200
    assert response.json() == {"status": "ready", "mode": "read-write", "revision": 1, "waiting": 0}


def test_a_service_that_only_reads_is_ready_and_says_so(client: Client, settings: Settings, clock: FakeClock) -> None:
    client.post(SUBMIT, json=intent())
    with served(create_app(settings_with(settings, read_only=True), clock)) as reader:
        response = reader.get("/health/ready")
        mode = reader.get("/version").json()["mode"]
    assert response.status_code == 200
    assert response.json() == {"status": "ready", "mode": "read-only", "revision": 1, "waiting": 0}
    assert mode == "read-only"


def test_a_service_whose_writer_has_stopped_is_not_ready(client: Client) -> None:
    client.service.writer.stop()
    assert not_ready(client.get("/health/ready")) == ("the ledger writer has stopped", 0, 0)


def test_a_service_whose_writer_has_crashed_is_not_ready(client: Client) -> None:
    # Not a request, so that the writer fails where it does not expect to.
    client.service.writer._queue.put(object())  # type: ignore[arg-type]
    client.service.writer._thread.join()
    assert not_ready(client.get("/health/ready")) == ("the ledger writer has stopped", 0, 0)


def test_a_service_whose_ledger_cannot_be_read_is_not_ready_and_says_how(client: Client) -> None:
    with failing("ledger-probe"):
        reason = not_ready(client.get("/health/ready"))
    assert reason == ("the ledger cannot be read", 0, None)
    assert client.get("/health/ready").status_code == 200


def test_a_service_that_only_reads_is_not_ready_when_it_cannot(
    client: Client, settings: Settings, clock: FakeClock
) -> None:
    del client  # It has made the ledger this airspace's.
    with served(create_app(settings_with(settings, read_only=True), clock)) as reader, failing("ledger-probe"):
        reason = not_ready(reader.get("/health/ready"))
    assert reason == ("the ledger cannot be read", 0, None)


def test_a_service_whose_last_write_failed_is_not_ready_until_writes_work_again(client: Client) -> None:
    client.post(SUBMIT, json=intent())
    with failing("ledger-writer"):
        problem(client.post(SUBMIT, json=intent()), 503, "ledger-unavailable")
        reason, _, revision = not_ready(client.get("/health/ready"))
    assert reason == "the last write failed"
    assert revision == 1
    assert client.post(SUBMIT, json=intent()).status_code == 201
    assert client.get("/health/ready").status_code == 200


def test_a_service_that_was_not_ready_becomes_so_without_being_written_to(client: Client) -> None:
    with failing("ledger-writer"):
        client.post(SUBMIT, json=intent())
    client.portal.call(until, lambda: client.service.writer.trouble is None)
    assert client.get("/health/ready").status_code == 200


def test_every_reason_is_told(client: Client) -> None:
    with failing("ledger-writer"):
        client.post(SUBMIT, json=intent())
        client.service.writer.stop()
        with failing("ledger-probe"):
            reason, _, _ = not_ready(client.get("/health/ready"))
    assert reason == "the ledger writer has stopped; the last write failed; the ledger cannot be read"


def test_where_the_ledger_is_is_for_the_log_and_not_for_everybody(tmp_path: Path, clock: FakeClock) -> None:
    ledger = SqliteLedgers(tmp_path).migrated()
    path = Path(ledger)
    with served(create_app(settings_for(OLD_TOWN, ledger, tmp_path), clock)) as client, capture_logs() as logged:
        path.rename(path.with_suffix(".moved"))
        problem(client.post(SUBMIT, json=intent()), 503, "ledger-unavailable")
        response = client.get("/health/ready")
    assert not_ready(response)[0] == "the last write failed; the ledger cannot be read"
    assert str(tmp_path) not in response.text
    assert any(str(path) in str(entry) for entry in logged if "health" in entry["event"])


@asynccontextmanager
async def waiting(settings: Settings, clock: FakeClock, requests: int) -> AsyncIterator[tuple[Any, Service]]:
    """Run a service that has requests in its queue and one in hand, which waits for the write lock."""
    async with serving(create_app(settings, clock)) as (http, service):
        with write_lock(settings.ledger):
            tasks = [asyncio.create_task(http.post(SUBMIT, json=intent()))]
            # Put into the queue, and taken out of it.
            await until(lambda: service.writer._queue.unfinished_tasks == 1 and service.writer.waiting == 0)
            tasks += [asyncio.create_task(http.post(SUBMIT, json=intent())) for _ in range(requests)]
            await until(lambda: service.writer.waiting == requests)
            yield http, service
        await asyncio.gather(*tasks)
        assert (await http.get("/health/ready")).status_code == 200


@pytest.mark.parametrize("limit", [2, 3])
def test_a_service_is_ready_as_long_as_there_is_room_in_its_queue(
    settings: Settings, clock: FakeClock, limit: int
) -> None:
    async def ask() -> httpx.Response:
        async with waiting(settings_with(settings, queue_limit=limit), clock, requests=2) as (http, _):
            return await http.get("/health/ready")  # type: ignore[no-any-return]

    response = asyncio.run(ask())
    if limit == 3:
        assert response.json() == {"status": "ready", "mode": "read-write", "revision": 0, "waiting": 2}
    else:
        assert not_ready(response) == ("the queue is full: 2 requests are waiting", 2, 0)


@pytest.mark.parametrize(("seconds", "status"), [(9.0, 200), (11.0, 503)])
def test_a_service_whose_requests_wait_for_too_long_is_not_ready(
    settings: Settings, clock: FakeClock, seconds: float, status: int
) -> None:
    async def ask() -> httpx.Response:
        async with waiting(settings, clock, requests=2) as (http, service):
            first, _ = service.writer._queue.queue
            assert first is not None
            first.arrived -= seconds
            return await http.get("/health/ready")  # type: ignore[no-any-return]

    response = asyncio.run(ask())
    assert response.status_code == status
    if status == 503:
        assert not_ready(response) == ("the first request in the queue has waited for 11 s", 2, 0)


# A ledger that does not answer


@contextmanager
def hanging() -> Iterator[Event]:
    """Let all reads hang until the event is set."""
    answers = Event()

    def hang(_: Connection) -> None:
        if current_thread().name != "ledger-writer":
            answers.wait(30)

    event.listen(Engine, "begin", hang)
    try:
        yield answers
    finally:
        answers.set()
        event.remove(Engine, "begin", hang)


def probing_threads() -> list[Thread]:
    return [thread for thread in all_threads() if thread.name == "ledger-probe"]


def test_a_ledger_that_hangs_holds_no_health_check_and_no_more_than_one_thread_of_them(
    settings: Settings, clock: FakeClock
) -> None:
    async def ask(service: Service) -> None:
        async with serving(create_app(settings, running=service)) as (http, _):
            with hanging() as answers:
                # All threads of reading routes hang, and more requests for them wait.
                reads = [asyncio.create_task(http.get(SUBMIT)) for _ in range(READERS)]
                await asyncio.sleep(0)
                checks = [http.get("/health/ready") for _ in range(5)]
                for response in await asyncio.gather(*checks):
                    assert not_ready(response) == (
                        "the ledger cannot be read: it has not answered within 0.05 s", 0, None
                    )  # fmt: skip
                assert not_ready(await http.get("/health/ready"))
                (probing,) = probing_threads()
                # Not even the end of the process waits for it.
                assert probing.daemon
                for path in ("/health/live", "/version", "/metrics"):
                    assert (await http.get(path)).status_code == 200
                assert not any(read.done() for read in reads)
                answers.set()
                assert {(await read).status_code for read in reads} == {200}
            await until(lambda: not probing_threads())
            assert (await http.get("/health/ready")).status_code == 200

    with running(settings, clock) as service:
        asyncio.run(ask(replace(service, probe=LedgerProbe(service.ledger, patience_s=0.05))))


def test_a_late_answer_of_the_ledger_is_one(settings: Settings, clock: FakeClock) -> None:
    async def ask(service: Service) -> httpx.Response:
        async with serving(create_app(settings, running=service)) as (http, _):
            with hanging() as answers:
                check = asyncio.create_task(http.get("/health/ready"))
                await until(lambda: len(probing_threads()) == 1)
                assert not check.done()
                answers.set()
                return await check

    with running(settings, clock) as service:
        assert asyncio.run(ask(service)).status_code == 200
