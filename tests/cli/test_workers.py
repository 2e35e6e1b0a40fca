"""`airmatrix serve --workers N`: one port, one ledger, several processes that come and go."""

import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from itertools import count
from pathlib import Path
from threading import Timer
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest

from app.client import Client
from app.errors import StartupError
from app.times import now_ms
from app.workers import Workers
from tests.cli import working
from tests.cli.conftest import AIRCRAFT_TYPES, Run
from tests.cli.serving import AIRMATRIX, Server, environment, serving
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
    """Two workers with an aircraft file of their own. Each test leaves two that are ready."""
    folder = tmp_path_factory.mktemp("pair")
    (folder / "aircraft.toml").write_text(AIRCRAFT_TYPES)
    options = ("--airspace", str(town_file), "--aircraft-types", "aircraft.toml", "--workers", "2")
    with serving(folder, *options, program=faulty, **JSON) as server:
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
    types = pair.folder / "aircraft.toml"
    types.write_text(AIRCRAFT_TYPES.replace("mass_kg = 5.0", "mass_kg = 6.0"))
    before = pair.workers()
    os.kill(min(before), signal.SIGKILL)
    until(lambda: pair.entries("worker cannot start"))
    assert "have changed" in pair.entries("worker cannot start")[0]["error"]
    assert submitted(pair).status_code == 201
    types.write_text(AIRCRAFT_TYPES)
    until(lambda: len(pair.workers() - before) == 1)


def test_workers_are_replaced_although_nobody_reads_the_log(tmp_path: Path, town_file: Path) -> None:
    command = [str(AIRMATRIX), "serve", "--port", "0", "--airspace", str(town_file), "--workers", "2"]
    process = subprocess.Popen(command, cwd=tmp_path, env=environment(**JSON), stderr=subprocess.PIPE)
    assert process.stderr is not None
    lines: list[dict[str, Any]] = []
    try:
        while not lines or lines[-1]["event"] != "listening":
            lines.append(json.loads(process.stderr.readline()))
        process.stderr.close()
        server = Server(lines[-1]["url"], tmp_path, tmp_path / "serve.log", process)
        for line in lines:
            if line["event"] == "worker is ready":
                os.kill(line["worker"], signal.SIGKILL)
        assert submitted(server).status_code == 201
        assert process.poll() is None
    finally:
        process.terminate()
        process.wait(15)


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
    with serving(tmp_path, *options, **JSON) as server, ThreadPoolExecutor(6) as clients:
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


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="the environment of a process cannot be seen here")
def test_what_workers_add_up_their_metrics_in_is_gone_when_they_are(tmp_path: Path, town_file: Path) -> None:
    with serving(tmp_path, "--airspace", str(town_file), "--workers", "2", **JSON) as server:
        variables = Path(f"/proc/{min(server.workers())}/environ").read_text().split("\0")
        (folder,) = (Path(text.partition("=")[2]) for text in variables if text.startswith("PROMETHEUS_MULTIPROC_DIR="))
        assert any(folder.iterdir())
        assert server.stop() == 0
    assert not folder.exists()


def test_interrupting_from_a_terminal_ends_all_processes_quietly(tmp_path: Path, town_file: Path) -> None:
    in_front = (sys.executable, "-c", "import os, sys; os.setpgrp(); os.execv(sys.argv[1], sys.argv[1:])", AIRMATRIX)
    options = ("--airspace", str(town_file))
    with serving(tmp_path, *options, program=in_front, AIRMATRIX_WORKERS="2", **JSON) as server:
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


def test_workers_leave_interrupting_to_their_parent(tmp_path: Path) -> None:
    def interrupt_them() -> None:
        for pid in names(tmp_path):
            os.kill(int(pid), signal.SIGINT)
        time.sleep(0.5)
        stop_here()

    Workers(2, partial(working.works, tmp_path)).run(interrupt_them)
    assert len(names(tmp_path)) == 2
    assert "interrupted" not in names(tmp_path)


def test_a_worker_for_which_there_is_no_room_is_started_later(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)

    def kill_and_take_room() -> None:
        (pid,) = names(tmp_path)
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, before[1]))
        Timer(1.0, give_room).start()
        os.kill(int(pid), signal.SIGKILL)

    def give_room() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
        until(lambda: len(names(tmp_path)) == 2)
        stop_here()

    Workers(1, partial(working.works, tmp_path)).run(kill_and_take_room)
    assert "no worker could be started" in capsys.readouterr().out


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
