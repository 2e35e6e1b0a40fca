"""Measured times, and how they are shown: progress on stderr, tables on stdout."""

import gc
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import ParamSpec, TypeVar

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from planner.cfa_star import Planner, PlanRequest
from planner.errors import NoPlan
from planner.path import Plan

_WIDTH = 180
_STEPS = 100

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


@dataclass
class Run:
    """Requests measured one by one: seconds each, and what came of them."""

    seconds: list[float] = field(default_factory=list)
    expansions: int = 0
    static_expansions: int = 0
    delay_ms: int = 0
    refused: int = 0

    def plan(self, planner: Planner, request: PlanRequest, owner: int | None = None) -> Plan | None:
        """Plan a request and, for an owner, reserve the plan: both are measured. None if it is refused."""
        try:
            plan = self.time(_plan, planner, request, owner)
        except NoPlan:
            self.refused += 1
            return None
        self.expansions += plan.expansions
        self.static_expansions += plan.static_expansions
        self.delay_ms += plan.delay_ms
        return plan

    def time(
        self, function: Callable[Arguments, Result], *arguments: Arguments.args, **named: Arguments.kwargs
    ) -> Result:
        """Call a function and measure how long it took, also if it fails."""
        began = time.perf_counter()
        try:
            return function(*arguments, **named)
        finally:
            self.seconds.append(time.perf_counter() - began)


def _plan(planner: Planner, request: PlanRequest, owner: int | None) -> Plan:
    plan = planner.plan(request)
    if owner is not None:
        planner.index.reserve(plan.hold_block, plan.hold_enter_ms, plan.hold_exit_ms, owner)
    return plan


def percentiles_ms(runs: Iterable[Run], *ranks: float) -> list[float]:
    """Return percentiles of the times of a request in ms: of each run by itself, then the median of the runs."""
    each = [np.percentile(np.array(run.seconds) * 1000, ranks) for run in runs]
    medians: list[float] = np.median(each, axis=0).tolist()
    return medians


def sum_s(runs: Iterable[Run]) -> float:
    """Return the time of all requests in seconds, the median of the runs."""
    return float(np.median([sum(run.seconds) for run in runs]))


@contextmanager
def undisturbed() -> Iterator[None]:
    """Keep Python's garbage collector out of the measured times."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


@contextmanager
def steps(what: str, total: int) -> Iterator[Progress]:
    """Show progress that is drawn between measurements only, never by a thread of its own; see `step`."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(
        *columns, console=console, transient=True, auto_refresh=False, disable=not console.is_terminal
    ) as progress:
        progress.add_task(what, total=total)
        yield progress


def step(progress: Progress) -> None:
    """Count one step of the only task."""
    task = progress.tasks[0]
    every = max(1, int(task.total or 0) // _STEPS)
    progress.update(task.id, advance=1, refresh=int(task.completed) % every == 0)


def resident_bytes() -> int | None:
    """Return the process's resident memory, None where the system does not tell."""
    status = Path("/proc/self/status")
    if not status.exists():
        return None
    (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmRSS:"))
    return int(line.split()[1]) * 1024


def table(title: str, *columns: str) -> Table:
    """Return an empty table."""
    return Table(*columns, title=title, title_justify="left", title_style="bold")


def show(content: Table | str) -> None:
    """Print a table or a line on stdout."""
    Console(width=_WIDTH, highlight=False, markup=False, emoji=False).print(content)
