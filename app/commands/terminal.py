"""What commands show: results on stdout, everything else on stderr, all text as it is."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from app.errors import StartupError


def show(table: Table) -> None:
    """Print a result."""
    _console(stderr=False).print(table)


def remark(label: str, style: str, message: str) -> None:
    """Print a labelled line on stderr."""
    _console(stderr=True).print(Text.assemble((f"{label}:", style), " ", message), soft_wrap=True)


@contextmanager
def progress_bar(what: str, total: float) -> Iterator[Callable[[float], None]]:
    """Show a bar while the block runs; call what it yields with how much is done."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    console = _console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(what, total=total)
        yield lambda done: progress.update(task, completed=done)


def write(path: Path, content: bytes) -> None:
    """Write a result to a file; raises `StartupError` where that is not possible."""
    try:
        path.write_bytes(content)
    except (OSError, ValueError) as error:
        raise StartupError(f"cannot write {path}: {error}") from error


def _console(*, stderr: bool) -> Console:
    # Names come from files and requests: neither markup nor emoji codes in them are meant.
    return Console(stderr=stderr, markup=False, emoji=False, highlight=False)
