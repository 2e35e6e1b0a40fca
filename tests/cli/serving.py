"""`airmatrix serve` as a process of its own, on loopback and a port that the system chooses."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

AIRMATRIX = Path(sys.executable).with_name("airmatrix")

# From an empty kernel cache, or with the JIT off, on a busy machine.
_READY_WITHIN_S = 90.0
_STOPPED_WITHIN_S = 10.0
_URL = re.compile(r"url\W+(http://127\.0\.0\.1:\d+)")


@dataclass(frozen=True)
class Server:
    """A running service and the folder it runs in; its log is in `log`."""

    url: str
    folder: Path
    log: Path
    process: "subprocess.Popen[bytes]"

    @property
    def ledger(self) -> Path:
        """The ledger that `serve` makes where none is named."""
        return self.folder / "airmatrix.sqlite"

    def entries(self, *events: str) -> list[dict[str, Any]]:
        """Return what was logged, all or these events, by a server that logs in JSON."""
        lines = [json.loads(line) for line in self.log.read_text().splitlines() if line.startswith("{")]
        return [line for line in lines if not events or line["event"] in events]

    def workers(self) -> set[int]:
        """Return the process ids of the workers that are ready and have not died."""
        dead = {line["worker"] for line in self.entries("worker died, another one is started")}
        return {line["worker"] for line in self.entries("worker is ready")} - dead

    def stop(self, number: signal.Signals = signal.SIGTERM) -> int:
        """Send a signal, wait for the end, and return the exit status."""
        self.process.send_signal(number)
        return self.process.wait(_STOPPED_WITHIN_S)


def environment(**variables: str) -> dict[str, str]:
    """Return this process's environment without settings of ours, wide enough for tables, and `variables`."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("AIRMATRIX_")}
    return own | {"COLUMNS": "300"} | variables


@contextmanager
def started(
    folder: Path,
    *options: str,
    log: str = "serve.log",
    program: Sequence[str | Path] = (AIRMATRIX,),
    **variables: str,
) -> Iterator["subprocess.Popen[bytes]"]:
    """Start `airmatrix serve` in a folder; it is ended afterwards if it still runs."""
    with (folder / log).open("wb") as stderr:
        process = subprocess.Popen(
            [*program, "serve", *options],
            cwd=folder, env=environment(**variables), stderr=stderr,
        )  # fmt: skip
    try:
        yield process
    finally:
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(_STOPPED_WITHIN_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@contextmanager
def serving(
    folder: Path,
    *options: str,
    log: str = "serve.log",
    program: Sequence[str | Path] = (AIRMATRIX,),
    **variables: str,
) -> Iterator[Server]:
    """Serve on any free port, and wait until the service is ready."""
    with started(folder, "--port", "0", *options, log=log, program=program, **variables) as process:
        until = time.monotonic() + _READY_WITHIN_S
        while not (url := ready_url(folder / log)):
            if process.poll() is not None or time.monotonic() > until:
                raise AssertionError(f"the service did not become ready:\n{(folder / log).read_text()}")
            time.sleep(0.02)
        yield Server(url, folder, folder / log, process)


def ready_url(log: Path) -> str | None:
    """Return the address that a log names, once the service there is ready."""
    named = _URL.search(log.read_text())
    if named is None:
        return None
    try:
        answer = httpx.get(f"{named[1]}/health/ready", timeout=5.0)
    except httpx.TransportError:
        return None
    return named[1] if answer.status_code == 200 else None
