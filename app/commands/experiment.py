"""`airmatrix experiment paper`: the paper's section 4, repeated and written up as one HTML page."""

import os
import platform
import shlex
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer

from app.commands.terminal import interrupt_held, progress_bar, remark, write
from app.errors import StartupError
from app.service import load_airspace
from app.settings import Settings
from app.times import format_time, now_ms
from planner.experiments.study import Design, conduct
from planner.warm_up import kernels_are_compiled, warm_up

experiment_app = typer.Typer(help="Repeat published experiments.", no_args_is_help=True)

_INTERRUPTED = 130
_LIBRARIES = ("airmatrix", "numpy", "numba")


@experiment_app.command()
def paper(
    out: Annotated[Path, typer.Option(help="Folder to write report.html, tables and figures into.")],
    airspace: Annotated[Path | None, typer.Option(help="Airspace file. Default: the shipped one.")] = None,
    flights: Annotated[int, typer.Option(min=1, max=3_000, help="Flights in the paper's scenario.")] = 300,
    seeds: Annotated[int, typer.Option(min=1, max=1_000, help="Seeds for each density.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="The first seed.")] = 1,
    quick: Annotated[bool, typer.Option("--quick", help="Three seeds at most, one size of traffic.")] = False,
) -> None:
    """Repeat section 4 of the paper in any airspace and write the report."""
    began = time.perf_counter()
    design = Design.of(flights, seeds, seed, quick)
    field = load_airspace(Settings.given(airspace=airspace))
    try:
        with _staging(out) as folder:
            with interrupt_held() as check_interrupt, progress_bar("flights", design.workload(field)) as show_done:
                if not kernels_are_compiled():
                    remark("note", "cyan", "compiling the kernels, once per version; this takes some ten seconds")
                warm_up()

                def advance_to(done: float, aside: str = "") -> None:
                    check_interrupt()
                    show_done(done, aside)

                study = conduct(field, design, advance_to)
            # The figures need matplotlib, which no other command waits for.
            from planner.experiments.report import Provenance, build_report

            provenance = Provenance(
                command=shlex.join(["airmatrix", *sys.argv[1:]]),
                versions={**{name: version(name) for name in _LIBRARIES}, "Python": platform.python_version()},
                machine=_machine(),
                finished=f"{format_time(now_ms())[:16].replace('T', ' ')} UTC",
                duration_s=time.perf_counter() - began,
            )
            for name, content in build_report(study, provenance).items():
                (folder / name).parent.mkdir(exist_ok=True)
                write(folder / name, content)
    except KeyboardInterrupt:
        remark("interrupted", "yellow", "nothing was written")
        raise typer.Exit(_INTERRUPTED) from None
    typer.echo(out / "report.html")


@contextmanager
def _staging(out: Path) -> Iterator[Path]:
    """Yield a new folder inside `out` whose files are moved there when the block ends well; else nothing is left."""
    try:
        existed = out.exists()
        out.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=".report-", dir=out))
    except OSError as error:
        raise StartupError(f"cannot write into {out}: {error.strerror}") from error
    try:
        yield folder
        files = (path for path in folder.rglob("*") if path.is_file())
        # The page last: where it is, all that it speaks of is there too.
        for path in sorted(files, key=lambda path: (path.suffix == ".html", path)):
            place = out / path.relative_to(folder)
            try:
                place.parent.mkdir(exist_ok=True)
                path.replace(place)
            except OSError as error:
                raise StartupError(f"cannot write {place}: {error.strerror}") from error
    finally:
        shutil.rmtree(folder)
        if not existed and not any(out.iterdir()):
            out.rmdir()


def _machine() -> str:
    """Describe processor and system."""
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), model)
    return f"{model}, {os.cpu_count()} cores, {platform.system()} {platform.release()}"
