"""A soak: does a service that runs for long, with everything passing and being removed, stay as small and as quick?

    python -m tests.soak.soak [SECONDS]

One service, its clock some hundred times as fast as time, flights kept for an hour of that clock; clients submit
flights within the next half hour of it, one after another. Every tenth of the run is a line. Exit status 1 if memory,
files or latency have grown in the second half of the run, or `airmatrix verify` finds a violation.
"""

import random
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
import numpy as np
from rich.console import Console
from rich.table import Table

from app.times import format_time, parse_time
from planner.airspace import Airspace
from planner.buildings import shipped_airspace
from planner.experiments.traffic import Od, terminals
from tests.cli.serving import AIRMATRIX

RATE = 300.0
CLIENTS = 8
SLICES = 10
READY_WITHIN_S = 90.0
# What the second half of the run may have more than the first after its first fifth.
TOLERANCE = 1.10


@dataclass
class Slice:
    """What a tenth of the run was like; lists of milliseconds, sizes at its end."""

    latency_ms: list[float] = field(default_factory=list)
    refused: int = 0
    rss_mib: float = 0.0
    file_mib: float = 0.0
    index: int = 0

    @property
    def p50(self) -> float:
        """Median latency of a request."""
        return float(np.median(self.latency_ms))

    @property
    def p99(self) -> float:
        """The 99th percentile."""
        return float(np.percentile(self.latency_ms, 99))


class Clients:
    """Threads that each submit one flight after another until told to stop."""

    def __init__(self, url: str, airspace: Airspace) -> None:
        self._url = url
        self._grid = airspace.grid
        self._places = terminals(airspace.grid, airspace.occupied, Od.UNIFORM)
        self._stopping = threading.Event()
        self.slice = Slice()
        self.failures: list[str] = []
        self._threads = [threading.Thread(target=self._submit, args=[seed]) for seed in range(CLIENTS)]

    def __enter__(self) -> "Clients":
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        for thread in self._threads:
            thread.join()

    def _submit(self, seed: int) -> None:
        chance = random.Random(seed)
        with httpx.Client(base_url=self._url, timeout=30) as http:
            while not self._stopping.is_set():
                now_ms = parse_time(http.get("/v1/airspace/status", params={"bbox": "0,0,0,0"}).json()["at"])
                for _ in range(20):
                    began = time.perf_counter()
                    answer = http.post("/v1/flight-intents", json=self._body(chance, now_ms))
                    self.slice.latency_ms.append((time.perf_counter() - began) * 1000)
                    if answer.status_code == 409:
                        self.slice.refused += 1
                    elif answer.status_code != 201:
                        self.failures.append(answer.text)
                        return

    def _body(self, chance: random.Random, now_ms: int) -> dict[str, Any]:
        ends = np.array(chance.sample(self._places.tolist(), 2))
        x, y, alt_m = self._grid.centres(ends).T
        lon, lat = self._grid.unproject(x, y)
        origin, destination = (
            {"lon": float(lon[end]), "lat": float(lat[end]), "alt_m": float(alt_m[end])} for end in (0, 1)
        )
        return {
            "operator": "soak",
            "aircraft_type": "dji-matrice-600-pro",
            "origin": origin,
            "destination": destination,
            "earliest_departure": format_time(now_ms + chance.randrange(60_000, 1_800_000)),
        }


def main() -> None:
    """Run the soak; print what it was like."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 300.0
    console = Console()
    with TemporaryDirectory() as folder, socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        free.close()
        server = subprocess.Popen([sys.executable, "-m", "tests.soak.server", folder, str(port), str(RATE)])
        try:
            slices, failures = soak(f"http://127.0.0.1:{port}", server.pid, Path(folder) / "soak.sqlite", seconds)
        finally:
            server.send_signal(signal.SIGTERM)
            server.wait(30)
        verified = subprocess.run(
            [AIRMATRIX, "verify", "--ledger", "soak.sqlite"], cwd=folder, capture_output=True, text=True, check=False
        )
    table = Table(title=f"{seconds:g} s, the clock {RATE:g} times as fast, {CLIENTS} clients", title_justify="left")
    for name in ("until", "requests/s", "refused", "p50 ms", "p99 ms", "memory MiB", "files MiB", "index"):
        table.add_column(name, justify="right")
    for number, part in enumerate(slices, start=1):
        table.add_row(
            f"{number * seconds / SLICES:.0f} s", f"{len(part.latency_ms) / (seconds / SLICES):.0f}", str(part.refused),
            f"{part.p50:.1f}", f"{part.p99:.1f}", f"{part.rss_mib:.0f}", f"{part.file_mib:.0f}", str(part.index),
        )  # fmt: skip
    console.print(table)
    console.print(verified.stdout or verified.stderr, highlight=False)
    grown = growth(slices)
    for name, ratio in grown.items():
        console.print(f"{name}: second half {ratio:.2f} of the first (after its first fifth)")
    for failure in failures:
        console.print(f"not answered as expected: {failure}")
    if failures or verified.returncode or any(ratio > TOLERANCE for ratio in grown.values()):
        sys.exit(1)


def soak(url: str, pid: int, ledger: Path, seconds: float) -> tuple[list[Slice], list[str]]:
    """Wait for the service, let the clients run, and return what each part of the run was like."""
    ready_by = time.monotonic() + READY_WITHIN_S
    while not _ready(url):
        if time.monotonic() > ready_by:
            raise RuntimeError("the service did not become ready")
        time.sleep(0.1)
    slices = []
    with Clients(url, shipped_airspace()) as clients:
        for _ in range(SLICES):
            time.sleep(seconds / SLICES)
            done, clients.slice = clients.slice, Slice()
            done.rss_mib = _rss_mib(pid)
            done.file_mib = sum(file.stat().st_size for file in ledger.parent.glob("soak.sqlite*")) / 2**20
            done.index = _index_size(url)
            slices.append(done)
            if clients.failures:
                break
    return slices, clients.failures


def growth(slices: list[Slice]) -> dict[str, float]:
    """Return the second half's medians as multiples of the first half's, whose first fifth only fills everything."""
    early, late = slices[len(slices) // 5 : len(slices) // 2], slices[len(slices) // 2 :]
    figures = {
        "memory": [[part.rss_mib for part in half] for half in (early, late)],
        "files": [[part.file_mib for part in half] for half in (early, late)],
        "median latency": [[part.p50 for part in half] for half in (early, late)],
    }
    return {name: float(np.median(second) / np.median(first)) for name, (first, second) in figures.items()}


def _ready(url: str) -> bool:
    try:
        return httpx.get(f"{url}/health/ready", timeout=5).status_code == 200
    except httpx.TransportError:
        return False


def _rss_mib(pid: int) -> float:
    match = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    assert match is not None
    return int(match[1]) / 1024


def _index_size(url: str) -> int:
    match = re.search(r"^airmatrix_index_reservations (\S+)$", httpx.get(f"{url}/metrics").text, re.MULTILINE)
    assert match is not None
    return int(float(match[1]))


if __name__ == "__main__":
    main()
