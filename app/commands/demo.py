"""`airmatrix demo`: a service, traffic, and aircraft of which some deviate; nothing is left of it afterwards."""

import heapq
import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer
from rich.table import Table

from app.client import Client, ProblemAnswer, ServiceUnreachable, grid_of
from app.commands.fly import ALL_KINDS, live_line, parse_deviations, summary
from app.commands.pilots import Dispatch, Pilots, Report, ServiceTime, at_work
from app.commands.random_intents import Body, RandomIntents
from app.commands.terminal import remark, show
from app.errors import StartupError
from app.routes.submissions import FlightIntentBody
from planner.experiments.traffic import Od

_LONGEST_S = 366 * 86_400.0
_INTERRUPTED = 130
_STOP_S = 10.0
_GLANCE_S = 0.1
# What the user may have set and the demonstration respects; it is alone with everything else.
_RESPECTED = ("AIRMATRIX_AIRSPACE", "AIRMATRIX_AIRCRAFT_TYPES")
# As `airmatrix` is called; from nowhere else, wherever this is run.
_SERVE = (sys.executable, "-P", "-c", "from app.cli import main; main()", "serve")

_OPERATORS = ("blue-kite", "medlift", "steppe-express")
# Departures lie so far ahead, and within so long; in the service's time, the first in addition to a poll of the pilots.
_LEAD_S, _SPREAD_S = 15.0, 60.0
_LOOK_S = 1.0


def demo(
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 for any.")] = 8000,
    flights: Annotated[int, typer.Option(min=1, max=1_000, help="Flights that fly or soon will, at any time.")] = 80,
    rate: Annotated[float, typer.Option(min=0.1, max=100, help="Seconds of the service's clock a second.")] = 4.0,
    deviations: Annotated[str, typer.Option(help="Which flights deviate, as `airmatrix fly` takes it.")] = "15%",
    seed: Annotated[int, typer.Option(min=0, help="The same seed asks for the same flights.")] = 1,
    duration: Annotated[float | None, typer.Option(min=0.1, max=_LONGEST_S, help="Seconds; else until Ctrl-C.")] = None,
) -> None:
    """Show everything at once: a service with traffic, aircraft that fly it, and the console to watch them.

    The service's clock is simulated and runs fast. Its ledger lies in a temporary folder and is gone afterwards.
    """
    wish = parse_deviations(deviations, ALL_KINDS, seed)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: sys.exit(0))
    report = Report()
    try:
        with ExitStack() as stack:
            say = stack.enter_context(live_line())
            say("starting the service; the first time, kernels are compiled for half a minute")
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="airmatrix-demo-")))
            service = stack.enter_context(_serving(folder, port, rate))
            client = stack.enter_context(Client(service.url))
            demand = RandomIntents.served_by(client, Od.LOWEST)
            clock = ServiceTime(client)
            grid = grid_of(client.airspace())
            pilots = Pilots(client, clock, grid, Dispatch(client, clock, grid, wish, None), 1.0)
            report = pilots.report
            # From here on the loss of the service is told as what it is.
            _introduce(service.url, demand.title, flights, rate, deviations)
            traffic = stack.enter_context(at_work(Traffic(client, clock, demand, flights, seed)))
            end_s = math.inf if duration is None else time.monotonic() + duration

            def is_over() -> bool:
                service.check()
                if traffic.done():
                    traffic.result()
                return time.monotonic() >= end_s

            pilots.fly(is_over, lambda report: say(summary(report)))
    except KeyboardInterrupt:
        raise typer.Exit(_INTERRUPTED) from None
    finally:
        if report.accepted:
            remark("demo", "green", f"stopped, nothing is left; {report.arrived} flights arrived")


@dataclass(frozen=True, eq=False)
class _Service:
    """`airmatrix serve` as a process of this one's."""

    url: str
    process: "subprocess.Popen[bytes]"
    log: Path

    def check(self) -> None:
        """Raise `StartupError` if it has ended."""
        if self.process.poll() is not None:
            raise StartupError(f"the service has ended: {_last_line(self.log)}")


@contextmanager
def _serving(folder: Path, port: int, rate: float) -> Iterator[_Service]:
    """Run a service with a ledger of its own; raises `StartupError` where it does not start."""
    log = folder / "serve.log"
    options = ("--port", str(port), "--ledger", str(folder / "demo.sqlite"), "--clock-rate", str(rate))
    own = {name: value for name, value in os.environ.items() if not name.startswith("AIRMATRIX_") or name in _RESPECTED}
    with log.open("wb") as stderr:
        process = subprocess.Popen(  # noqa: S603
            [*_SERVE, *options], env=own | {"AIRMATRIX_LOG_FORMAT": "json"},
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=stderr,
        )  # fmt: skip
    try:
        while (url := _url_in(log)) is None:
            if process.poll() is not None:
                raise StartupError(_last_line(log))
            time.sleep(_GLANCE_S)
        yield _Service(url, process, log)
    finally:
        _stop(process)


def _stop(process: "subprocess.Popen[bytes]") -> None:
    """End a process, whatever the user does meanwhile. Ctrl-C in a terminal has reached it already."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        process.terminate()
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    finally:
        signal.signal(signal.SIGINT, before)


def _url_in(log: Path) -> str | None:
    """Return where a service listens, as its log says."""
    for line in log.read_text(encoding="utf-8").splitlines():
        if line.startswith("{") and line.endswith("}"):
            entry = json.loads(line)
            if entry.get("event") == "listening":
                return str(entry["url"])
    return None


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8").split("\n")
    return next((line.removeprefix("error: ") for line in reversed(lines) if line), "it said nothing")


def _introduce(url: str, title: str, flights: int, rate: float, deviations: str) -> None:
    table = Table(title=f"AirMatrix: {title}", show_header=False, title_justify="left")
    table.add_row("console", url)
    table.add_row("API", f"{url}/docs")
    table.add_row("clock", f"simulated, {rate:g} s a second")
    table.add_row("traffic", f"{flights} flights at a time; of all, these deviate: {deviations}")
    table.add_row("stop", "Ctrl-C; the ledger is temporary")
    show(table)


class Traffic:
    """Random flights from the lowest free blocks, so many at a time; one that ends makes room for another."""

    def __init__(self, client: Client, clock: ServiceTime, demand: RandomIntents, flights: int, seed: int) -> None:
        self._client = client
        self._clock = clock
        self._demand = demand
        self._flights = flights
        self._seeds = count(seed * 1_000_000)
        self._numbers = count(1)
        self._arrivals_ms: list[int] = []
        self._over = threading.Event()

    def work(self) -> None:
        """Submit flights until told to stop."""
        with suppress(ServiceUnreachable):
            while not self._over.is_set():
                self.top_up()
                self._over.wait(_LOOK_S)

    def stop(self) -> None:
        """Let `work` return."""
        self._over.set()

    def top_up(self) -> None:
        """Ask for as many flights as are missing; in place of those that are refused, others the next time."""
        now = self._clock.now()
        while self._arrivals_ms and self._arrivals_ms[0] <= now:
            heapq.heappop(self._arrivals_ms)
        missing = self._flights - len(self._arrivals_ms)
        start_ms = now + int((_LEAD_S + 2 * self._clock.rate) * 1000)
        for wish in self._demand.bodies(missing, start_ms, _SPREAD_S, next(self._seeds), _OPERATORS[0]):
            if self._over.is_set():
                return
            with suppress(ProblemAnswer):
                accepted = self._client.submit(FlightIntentBody.model_validate(self._named(wish)))
                assert accepted.arrival is not None
                heapq.heappush(self._arrivals_ms, accepted.arrival)

    def _named(self, wish: Body) -> Body:
        number = next(self._numbers)
        operator = _OPERATORS[number % len(_OPERATORS)]
        return wish | {"operator": operator, "reference": f"{operator[0].upper()}{number:04d}"}
