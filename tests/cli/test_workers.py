"""`airmatrix serve --workers N`: one port, one ledger, several processes that come and go."""

import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from threading import Thread
from urllib.parse import urlsplit

import httpx
import pytest

from app.client import Client
from app.errors import StartupError
from app.times import now_ms
from app.workers import Workers
from tests.cli.conftest import Run
from tests.cli.serving import Server, serving
from tests.cli.test_serve import foreign_database, names, serve
from tests.cli.town import along_row
from tests.ledger.locations import write_lock
from tests.ledger.process import assert_gapless, assert_no_overlaps

SUBMIT = "/v1/flight-intents"
# From an empty kernel cache, or with the JIT off, on a busy machine.
PATIENCE_S = 60.0


def until(reached: Callable[[], object]) -> None:
    """Wait for another process."""
    deadline = time.monotonic() + PATIENCE_S
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def submitted(server: Server, number: int, operator: str = "acme-air") -> httpx.Response:
    """Submit a flight over a connection of its own, so that any worker may take it."""
    body = along_row(number % 4, 2, now_ms() + 600_000 + 60_000 * number, operator=operator)
    return httpx.post(server.url + SUBMIT, json=body.model_dump(mode="json", exclude_none=True), timeout=30)


def listened_to(server: Server) -> bool:
    """Tell whether any process still listens on a server's port."""
    try:
        socket.create_connection(("127.0.0.1", urlsplit(server.url).port or 0), timeout=1).close()
    except ConnectionRefusedError:
        return False
    return True


@pytest.fixture
def town_options(town_file: Path) -> tuple[str, ...]:
    return "--airspace", str(town_file)


JSON = {"AIRMATRIX_LOG_FORMAT": "json"}


# Together


def test_workers_share_a_port_and_a_ledger(tmp_path: Path, town_options: tuple[str, ...]) -> None:
    with serving(tmp_path, *town_options, "--workers", "3", **JSON) as server:
        assert len(server.workers()) == 3
        with ThreadPoolExecutor(8) as clients:
            answers = list(clients.map(lambda number: submitted(server, number), range(60)))
        assert {answer.status_code for answer in answers} == {201}
        assert sorted(answer.json()["sequence"] for answer in answers) == list(range(1, 61))
        assert len({line["worker"] for line in server.entries("flight intent accepted")}) >= 2
        assert server.stop() == 0
    assert_gapless(server.ledger)
    assert_no_overlaps(server.ledger)


def test_the_log_says_ready_and_listening_once_and_after_all_workers(
    tmp_path: Path, town_options: tuple[str, ...]
) -> None:
    with serving(tmp_path, *town_options, AIRMATRIX_WORKERS="2", **JSON) as server:
        told = [line["event"] for line in server.entries("worker is ready", "ready", "listening", "airspace")]
    assert told == ["airspace", "worker is ready", "worker is ready", "ready", "listening"]


def test_any_worker_answers_for_the_metrics_of_all(tmp_path: Path, town_options: tuple[str, ...]) -> None:
    with serving(tmp_path, *town_options, "--workers", "2", TMPDIR=str(tmp_path), **JSON) as server:
        for number in range(20):
            assert submitted(server, number).status_code == 201
        for _ in range(5):
            metrics = httpx.get(f"{server.url}/metrics").text.splitlines()
            assert 'airmatrix_flight_intents_total{outcome="accepted"} 20.0' in metrics
        assert [name for name in names(tmp_path) if name.startswith("airmatrix-metrics-")] != []
        assert server.stop() == 0
    assert [name for name in names(tmp_path) if name.startswith("airmatrix-metrics-")] == []


@pytest.mark.parametrize("workers", ["0", "65", "many"])
def test_no_workers_and_too_many_are_refused(airmatrix: Run, workers: str) -> None:
    airmatrix("serve", "--workers", workers).assert_misused("--workers")


def test_too_many_workers_are_refused_from_the_environment_too(airmatrix: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AIRMATRIX_WORKERS", "65")
    airmatrix("serve").assert_refused("workers")


def test_what_is_refused_is_refused_once_and_before_any_worker_starts(tmp_path: Path) -> None:
    foreign_database(tmp_path / "recipes.sqlite")
    refused = serve(tmp_path, "--port", 0, "--workers", 3, "--ledger", "recipes.sqlite")
    refused.assert_refused("recipes.sqlite is a SQLite database, but not an AirMatrix ledger")
    assert names(tmp_path) == ["recipes.sqlite"]


# Dying and stopping


def test_a_killed_worker_is_replaced_and_what_it_answered_is_there(
    tmp_path: Path, town_options: tuple[str, ...]
) -> None:
    with serving(tmp_path, *town_options, "--workers", "2", **JSON) as server:
        before = server.workers()
        answered = [submitted(server, number).json()["id"] for number in range(10)]
        victim = min(before)
        os.kill(victim, signal.SIGKILL)
        until(lambda: len(server.workers() - before) == 1)
        (died,) = server.entries("worker died, another one is started")
        assert (died["level"], died["worker"], died["status"]) == ("critical", victim, -signal.SIGKILL)
        answered += [submitted(server, number).json()["id"] for number in range(10, 20)]
        with Client(server.url) as client:
            assert [intent.id for intent in client.flight_intents()] == answered
        assert server.stop() == 0
    assert_gapless(server.ledger)


def test_a_stopped_service_finishes_what_its_workers_took(tmp_path: Path, town_options: tuple[str, ...]) -> None:
    with serving(tmp_path, *town_options, "--workers", "2", **JSON) as server, ThreadPoolExecutor(6) as clients:
        with write_lock(server.ledger):
            answers = [clients.submit(submitted, server, number) for number in range(6)]
            until(lambda: waiting(server) >= 4)
            time.sleep(0.5)
            server.process.send_signal(signal.SIGTERM)
            until(lambda: not listened_to(server))
        assert [answer.result().status_code for answer in answers] == [201] * 6
        assert server.process.wait(15) == 0
    assert "Traceback" not in server.log.read_text()


def waiting(server: Server) -> int:
    """Return how many requests wait for the writers of all workers."""
    lines = httpx.get(f"{server.url}/metrics").text.splitlines()
    (length,) = (line.split()[-1] for line in lines if line.startswith("airmatrix_queue_length "))
    return int(float(length))


def test_interrupting_from_a_terminal_ends_all_processes_quietly(tmp_path: Path, town_options: tuple[str, ...]) -> None:
    with serving(tmp_path, *town_options, "--workers", "2") as server:
        os.killpg(server.process.pid, signal.SIGINT)
        assert server.process.wait(15) == 130
    assert not listened_to(server)
    log = server.log.read_text()
    assert "Traceback" not in log
    assert "Aborted" not in log
    assert "critical" not in log


def test_workers_end_when_their_parent_is_killed(tmp_path: Path, town_options: tuple[str, ...]) -> None:
    with serving(tmp_path, *town_options, "--workers", "2", **JSON) as server:
        answered = submitted(server, 0)
        server.stop(signal.SIGKILL)
        until(lambda: not listened_to(server))
    assert len(server.entries("the parent process is gone, so this worker ends")) == 2
    with serving(tmp_path, *town_options, "--workers", "2") as server, Client(server.url) as client:
        assert [intent.id for intent in client.flight_intents()] == [answered.json()["id"]]


def test_a_worker_that_would_differ_from_the_others_does_not_start_until_it_would_not(
    tmp_path: Path, town_file: Path
) -> None:
    airspace = tmp_path / "town.geojson"
    airspace.write_bytes(town_file.read_bytes())
    with serving(tmp_path, "--airspace", str(airspace), "--workers", "2", **JSON) as server:
        before = server.workers()
        airspace.rename(tmp_path / "mislaid")
        os.kill(min(before), signal.SIGKILL)
        until(lambda: server.entries("worker cannot start"))
        assert submitted(server, 0).status_code == 201
        (tmp_path / "mislaid").rename(airspace)
        until(lambda: len(server.workers()) == 2)
        assert server.stop() == 0


FAULTY = """
from app import deconfliction, service
from app.cli import main

planned = deconfliction.Deconfliction._submit

def submit(self, transaction, now, intent_id, submission, key):
    if submission.operator == "mallory":
        raise SystemExit("mallory was here")
    return planned(self, transaction, now, intent_id, submission, key)

deconfliction.Deconfliction._submit = submit
if __name__ == "__main__":
    main()
"""


@pytest.fixture
def faulty(tmp_path: Path) -> tuple[str | Path, ...]:
    """Return a program whose writer dies of what `mallory` submits."""
    program = tmp_path / "faulty.py"
    program.write_text(FAULTY)
    return sys.executable, program


def test_a_service_whose_writer_died_ends(
    tmp_path: Path, town_options: tuple[str, ...], faulty: tuple[str | Path, ...]
) -> None:
    with serving(tmp_path, *town_options, program=faulty, **JSON) as server:
        assert submitted(server, 0).status_code == 201
        mallory = Thread(target=partial(attempted, server), daemon=True)
        mallory.start()
        assert server.process.wait(15) == 70
        mallory.join()
    (died,) = server.entries("the ledger writer has died")
    assert died["level"] == "critical"


def attempted(server: Server) -> None:
    """Let mallory submit, whatever comes of it."""
    try:
        submitted(server, 1, operator="mallory")
    except httpx.TransportError:
        return


def test_a_worker_whose_writer_died_is_replaced(
    tmp_path: Path, town_options: tuple[str, ...], faulty: tuple[str | Path, ...]
) -> None:
    with serving(tmp_path, *town_options, "--workers", "2", program=faulty, **JSON) as server:
        before = server.workers()
        attempted(server)
        until(lambda: len(server.workers() - before) == 1)
        (died,) = server.entries("worker died, another one is started")
        assert (died["worker"] in before, died["status"]) == (True, 70)
        assert [submitted(server, number).status_code for number in range(10)] == [201] * 10
        assert server.stop() == 0
    assert_gapless(server.ledger)


# Without a service


def waits(folder: Path, ready: Callable[[], None]) -> None:
    """Be a worker that leaves a file as its trace."""
    (folder / str(os.getpid())).touch()
    ready()
    time.sleep(PATIENCE_S)


def cannot_start(folder: Path, _ready: Callable[[], None]) -> None:
    """Be a worker that dies before it is ready."""
    (folder / str(os.getpid())).touch()
    sys.exit(2)


def freezes(folder: Path, ready: Callable[[], None]) -> None:
    """Be a worker that freezes, but only the first."""
    first = names(folder) == []
    (folder / str(os.getpid())).touch()
    ready()
    # Not before it was heard of.
    time.sleep(0.5)
    if first:
        os.kill(os.getpid(), signal.SIGSTOP)
    time.sleep(PATIENCE_S)


def starts_badly_the_second_time(folder: Path, ready: Callable[[], None]) -> None:
    """Be a worker that dies after it was ready, then before, and then not any more."""
    times = len(names(folder))
    (folder / str(os.getpid())).touch()
    if times == 1:
        sys.exit(3)
    ready()
    if times == 0:
        time.sleep(0.2)
        sys.exit(4)
    os.kill(os.getppid(), signal.SIGTERM)
    time.sleep(PATIENCE_S)


def ignores_signals(folder: Path, ready: Callable[[], None]) -> None:
    """Be a worker that does not end when it is told to."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    waits(folder, ready)


def stop_here(number: signal.Signals = signal.SIGTERM) -> None:
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_workers_run_until_a_signal_and_say_which(tmp_path: Path, number: signal.Signals) -> None:
    workers = Workers(2, partial(waits, tmp_path))
    assert workers.run(partial(stop_here, number)) is number
    assert len(names(tmp_path)) == 2
    assert all(ended(int(pid)) for pid in names(tmp_path))


def ended(pid: int) -> bool:
    """Tell whether a process has ended and was waited for."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def test_workers_that_cannot_start_are_not_tried_again(tmp_path: Path) -> None:
    with pytest.raises(StartupError, match=r"worker \d+ could not start; it ended with status 2"):
        Workers(1, partial(cannot_start, tmp_path)).run(stop_here)
    assert len(names(tmp_path)) == 1


def test_a_worker_that_froze_is_killed_and_replaced(tmp_path: Path) -> None:
    died: list[int] = []

    def on_death(pid: int) -> None:
        died.append(pid)
        stop_here()

    Workers(1, partial(freezes, tmp_path), silence_s=2.0).run(lambda: None, on_death)
    assert [str(pid) for pid in died] == names(tmp_path)[:1]


def test_a_worker_that_dies_is_replaced_even_if_that_fails_at_first(tmp_path: Path) -> None:
    died: list[int] = []
    assert Workers(1, partial(starts_badly_the_second_time, tmp_path)).run(lambda: None, died.append) is signal.SIGTERM
    assert len(died) == 2
    assert len(names(tmp_path)) == 3


def test_a_worker_that_does_not_stop_is_killed(tmp_path: Path) -> None:
    Workers(1, partial(ignores_signals, tmp_path), stop_s=0.5).run(stop_here)
    assert all(ended(int(pid)) for pid in names(tmp_path))
