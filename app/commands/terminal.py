"""What commands show: results on stdout, everything else on stderr, all text as it is."""

import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from app.errors import StartupError


class Advance(Protocol):
    """Moves a progress bar to how much is done, with an aside to show beside it."""

    def __call__(self, done: float, aside: str = "") -> None:
        """Show the progress."""


def show(table: Table) -> None:
    """Print a result."""
    _console(stderr=False).print(table)


def remark(label: str, style: str, message: str) -> None:
    """Print a labelled line on stderr."""
    _console(stderr=True).print(Text.assemble((f"{label}:", style), " ", message), soft_wrap=True)


@contextmanager
def progress_bar(what: str, total: float) -> Iterator[Advance]:
    """Show a bar while the block runs; call what it yields with how much is done."""
    aside = TextColumn("{task.fields[aside]}")
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), aside)
    console = _console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(what, total=total, aside="")
        yield lambda done, aside="": progress.update(task, completed=done, aside=aside)


@contextmanager
def interrupt_held() -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C back while the block runs; what it yields raises the `KeyboardInterrupt` where that is safe.

    Kernels build named tuples, in Python: an exception raised there ends the process with a segmentation fault, or
    is lost (numba issue 2324). A second Ctrl-C raises at once.
    """
    received = False
    before = signal.getsignal(signal.SIGINT)

    def receive(_number: int, _frame: FrameType | None) -> None:
        nonlocal received
        received = True
        signal.signal(signal.SIGINT, before)

    def check() -> None:
        if received:
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, receive)
    try:
        yield check
        check()
    finally:
        signal.signal(signal.SIGINT, before)


def spread(values_ms: Sequence[float] | NDArray[np.float64]) -> str:
    """Return how at least one duration, in ms, is distributed."""
    median, p95, p99, longest = np.percentile(values_ms, [50, 95, 99, 100])
    return f"median {median:.1f} ms, p95 {p95:.1f} ms, p99 {p99:.1f} ms, max {longest:.1f} ms"


def write(path: Path, content: bytes) -> None:
    """Write a result to a file; raises `StartupError` where that is not possible."""
    try:
        path.write_bytes(content)
    except (OSError, ValueError) as error:
        raise StartupError(f"cannot write {path}: {error}") from error


def _console(*, stderr: bool) -> Console:
    # Names come from files and requests: neither markup nor emoji codes in them are meant.
    return Console(stderr=stderr, markup=False, emoji=False, highlight=False)
