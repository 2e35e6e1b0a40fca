"""`airmatrix serve --workers N`: one port, one ledger, several processes that come and go."""

import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from itertools import count
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest

from app.client import Client
from app.errors import StartupError
from app.times import now_ms
from app.workers import Workers
from tests.cli import working
from tests.cli.conftest import Run
from tests.cli.serving import Server, serving
from tests.cli.test_serve import foreign_database, names, serve
from tests.cli.town import along_row
from tests.ledger.locations import write_lock
from tests.ledger.process import assert_gapless, assert_no_overlaps

# From an empty kernel cache, or with the JIT off, on a busy machine.
PATIENCE_S = 60.0
JSON = {"AIRMATRIX_LOG_FORMAT": "json"}
DIED = "worker died, another one is started"

# No two flights of this module meet.
departures = count(now_ms() + 600_000, 60_000)

# A service whose writer dies of what `mallory` submits.
FAULTY = """
from app.cli import main
from app.deconfliction import Deconfliction

sound = Deconfliction._submit

def submit(self, transaction, now, intent_id, submission, key):
    if submission.operator == "mallory":
        raise SystemExit("mallory was here")
    return sound(self, transaction, now, intent_id, submission, key)

Deconfliction._submit = submit
if __name__ == "__main__":
    main()
"""


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> tuple[str | Path, ...]:
    program = tmp_path_factory.mktemp("faulty") / "airmatrix.py"
    program.write_text(FAULTY)
    return sys.executable, program


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory, town_file: Path, faulty: tuple[str | Path, ...]) -> Iterator[Server]:
    """Two workers with an airspace file of their own. Each test leaves two that are ready."""
    folder = tmp_path_factory.mktemp("pair")
    (folder / "town.geojson").write_bytes(town_file.read_bytes())
    options = ("--airspace", "town.geojson", "--workers", "2")
    with serving(folder, *options, program=faulty, TMPDIR=str(folder), **JSON) as server:
        yield server


def until(reached: Callable[[], object]) -> None:
    """Wait for another process."""
    deadline = time.monotonic() + PATIENCE_S
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def submitted(server: Server, operator: str = "acme-air") -> httpx.Response:
    """Submit a flight over a connection of its own, so that any worker may take it."""
    body = along_row(0, 2, next(departures), operator=operator)
    url = f"{server.url}/v1/flight-intents"
    return httpx.post(url, json=body.model_dump(mode="json", exclude_none=True), timeout=30)


def attempted(server: Server, operator: str) -> None:
    """Submit a flight, whatever comes of it."""
    with suppress(httpx.TransportError):
        submitted(server, operator)


def recorded(server: Server) -> list[str]:
    """Return the ids of all flight intents."""
    with Client(server.url) as client:
        return [intent.id for intent in client.flight_intents()]


def waiting(server: Server) -> int:
    """Return how many requests wait for the writers of all workers."""
    metrics = httpx.get(f"{server.url}/metrics").text.splitlines()
    (length,) = (line.split()[-1] for line in metrics if line.startswith("airmatrix_queue_length "))
    return int(float(length))


def listened_to(server: Server) -> bool:
    """Tell whether any process still listens on a server's port."""
    try:
        socket.create_connection(("127.0.0.1", urlsplit(server.url).port or 0), timeout=1).close()
    except ConnectionRefusedError:
        return False
    return True


def ended(pid: int) -> bool:
    """Tell whether a process has ended and was waited for."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


# Serving together


def test_the_log_says_ready_and_listening_once_and_after_all_workers(pair: Server) -> None:
    told = [line["event"] for line in pair.entries("airspace", "worker is ready", "ready", "listening")]
    assert told[:5] == ["airspace", "worker is ready", "worker is ready", "ready", "listening"]
    assert told.count("ready") == 1


def test_workers_share_a_port_and_a_ledger(pair: Server) -> None:
    before = len(recorded(pair))
    with ThreadPoolExecutor(8) as clients:
        answers = list(clients.map(lambda _: submitted(pair), range(60)))
    assert sorted(answer.json()["sequence"] for answer in answers) == list(range(before + 1, before + 61))
    assert {line["worker"] for line in pair.entries("flight intent accepted")} >= pair.workers()
    assert_gapless(pair.ledger)
    assert_no_overlaps(pair.ledger)


def test_any_worker_answers_for_the_metrics_of_all(pair: Server) -> None:
    def accepted() -> float:
        metrics = httpx.get(f"{pair.url}/metrics").text.splitlines()
        named = 'airmatrix_flight_intents_total{outcome="accepted"} '
        (value,) = (line.removeprefix(named) for line in metrics if line.startswith(named))
        return float(value)

    before = accepted()
    for _ in range(10):
        submitted(pair)
    assert [accepted() for _ in range(5)] == [before + 10] * 5


# Dying


def test_a_killed_worker_is_replaced_and_what_it_answered_is_there(pair: Server) -> None:
    before = pair.workers()
    answered = [submitted(pair).json()["id"] for _ in range(10)]
    victim = min(before)
    os.kill(victim, signal.SIGKILL)
    until(lambda: len(pair.workers() - before) == 1)
    (died,) = (line for line in pair.entries(DIED) if line["worker"] == victim)
    assert (died["level"], died["status"]) == ("critical", -signal.SIGKILL)
    answered += [submitted(pair).json()["id"] for _ in range(10)]
    assert recorded(pair)[-20:] == answered
    assert_gapless(pair.ledger)


def test_a_worker_whose_writer_died_is_replaced(pair: Server) -> None:
    before = pair.workers()
    attempted(pair, "mallory")
    until(lambda: len(pair.workers() - before) == 1)
    died = pair.entries(DIED)[-1]
    assert died["worker"] in before
    assert died["status"] == 70
    assert submitted(pair).status_code == 201


def test_a_worker_that_would_differ_from_the_others_does_not_start_until_it_would_not(pair: Server) -> None:
    airspace, mislaid = pair.folder / "town.geojson", pair.folder / "mislaid"
    airspace.rename(mislaid)
    before = pair.workers()
    os.kill(min(before), signal.SIGKILL)
    until(lambda: pair.entries("worker cannot start"))
    assert submitted(pair).status_code == 201
    mislaid.rename(airspace)
    until(lambda: len(pair.workers() - before) == 1)


def test_a_service_of_one_process_whose_writer_died_ends(
    tmp_path: Path, town_file: Path, faulty: tuple[str | Path, ...]
) -> None:
    with serving(tmp_path, "--airspace", str(town_file), program=faulty, **JSON) as server:
        assert submitted(server).status_code == 201
        attempted(server, "mallory")
        assert server.process.wait(15) == 70
    (died,) = server.entries("the ledger writer has died")
    assert died["level"] == "critical"


# Starting and stopping


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


def test_a_stopped_service_finishes_what_its_workers_took(tmp_path: Path, town_file: Path) -> None:
    options = ("--airspace", str(town_file), "--workers", "2")
    with serving(tmp_path, *options, TMPDIR=str(tmp_path), **JSON) as server, ThreadPoolExecutor(6) as clients:
        metrics = [name for name in names(tmp_path) if name.startswith("airmatrix-metrics-")]
        with write_lock(server.ledger):
            answers = [clients.submit(submitted, server) for _ in range(6)]
            # The others are with the writers already.
            until(lambda: waiting(server) >= 4)
            time.sleep(0.2)
            server.process.send_signal(signal.SIGTERM)
            until(lambda: not listened_to(server))
        assert [answer.result().status_code for answer in answers] == [201] * 6
        assert server.process.wait(15) == 0
    assert "Traceback" not in server.log.read_text()
    assert len(metrics) == 1
    assert metrics[0] not in names(tmp_path)


def test_interrupting_from_a_terminal_ends_all_processes_quietly(tmp_path: Path, town_file: Path) -> None:
    with serving(tmp_path, "--airspace", str(town_file), AIRMATRIX_WORKERS="2", **JSON) as server:
        pids = server.workers()
        assert len(pids) == 2
        os.killpg(server.process.pid, signal.SIGINT)
        assert server.process.wait(15) == 130
    assert all(ended(pid) for pid in pids)
    log = server.log.read_text()
    assert [word for word in ("Traceback", "Aborted", "critical") if word in log] == []


def test_workers_end_when_their_parent_is_killed(tmp_path: Path, town_file: Path) -> None:
    with serving(tmp_path, "--airspace", str(town_file), "--workers", "2", **JSON) as server:
        server.stop(signal.SIGKILL)
        until(lambda: not listened_to(server))
    assert len(server.entries("the parent process is gone, so this worker ends")) == 2


# Workers of any kind


def stop_here(number: signal.Signals = signal.SIGTERM) -> None:
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_workers_run_until_a_signal_and_say_which(tmp_path: Path, number: signal.Signals) -> None:
    workers = Workers(2, partial(working.works, tmp_path))
    assert workers.run(partial(stop_here, number)) is number
    assert len(names(tmp_path)) == 2
    assert all(ended(int(pid)) for pid in names(tmp_path))


def test_workers_that_cannot_start_are_not_tried_again(tmp_path: Path) -> None:
    with pytest.raises(StartupError, match=r"worker \d+ could not start; it ended with status 2"):
        Workers(1, partial(working.cannot_start, tmp_path)).run(stop_here)
    assert len(names(tmp_path)) == 1


def test_a_worker_that_froze_is_killed_and_replaced(tmp_path: Path) -> None:
    died: list[int] = []

    def on_death(pid: int) -> None:
        died.append(pid)
        stop_here()

    Workers(1, partial(working.freezes, tmp_path), silence_s=2.0).run(lambda: None, on_death)
    assert len(died) == 1
    assert ended(died[0])


def test_a_worker_that_dies_is_replaced_even_if_that_fails_at_first(tmp_path: Path) -> None:
    died: list[int] = []
    workers = Workers(1, partial(working.dies_and_starts_badly, tmp_path))
    assert workers.run(lambda: None, died.append) is signal.SIGTERM
    assert len(died) == 2
    assert len(names(tmp_path)) == 3


def test_a_worker_that_does_not_stop_is_killed(tmp_path: Path) -> None:
    Workers(1, partial(working.does_not_stop, tmp_path), stop_s=0.5).run(stop_here)
    assert all(ended(int(pid)) for pid in names(tmp_path))
