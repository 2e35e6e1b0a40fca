"""`airmatrix fly`: aircraft for the accepted flights of a service, some of which do not do as planned."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn
from rich.table import Table

from app.client import DEFAULT_URL, Client, grid_of
from app.commands.deviations import Deviations, Kind
from app.commands.pilots import Dispatch, Pilots, Report, ServiceTime
from app.commands.terminal import remark, show, spread
from app.commands.token import Token

_LONGEST_S = 366 * 86_400.0
_INTERRUPTED = 130
# A service that is slower than this is no use for telemetry.
_TIMEOUT_S = 10.0
ALL_KINDS = ",".join(Kind)


def fly(
    deviations: Annotated[
        str, typer.Option(help="Which flights deviate: a share such as 0.1 or 10%, or a number, the first so many.")
    ] = "0",
    kinds: Annotated[str, typer.Option(help="How they do.")] = ALL_KINDS,
    seed: Annotated[int, typer.Option(min=0, help="The same seed makes the same flights deviate, and as much.")] = 1,
    operator: Annotated[str | None, typer.Option(help="Fly this operator's flights only.")] = None,
    interval: Annotated[
        float, typer.Option(min=0.05, max=3_600, help="Seconds of the service's time between two reports.")
    ] = 1.0,
    duration: Annotated[float | None, typer.Option(min=0.1, max=_LONGEST_S, help="Seconds to fly.")] = None,
    until_idle: Annotated[bool, typer.Option("--until-idle", help="Stop when no flight is left.")] = False,
    url: Annotated[str, typer.Option(help="The service.")] = DEFAULT_URL,
    token: Token = None,
) -> None:
    """Fly the accepted flights of a service: activate each, and report where its aircraft is, until Ctrl-C.

    Flights that are accepted meanwhile fly too; those that are planned again fly as they are planned then.
    The service's clock says what time it is, also where it runs fast.

    Of the flights that deviate, each does so in one way: `late` departs late; `drift` goes sideways and returns;
    `layer` flies a layer too high or too low; `hover` stops in mid-air; `lost` falls silent; with `intruder`, somebody
    without a flight intent crosses its way, reported as a track.

    A token needs the scopes airmatrix.plan and airmatrix.monitor and, for intruders, airmatrix.surveillance. Name its
    operator too: other operators' flights it sees, but cannot fly.

    All positions of a tick go in one request. While one is not answered none is sent, and the ticks missed are counted.
    """
    wish = parse_deviations(deviations, kinds, seed)
    with Client(url, _TIMEOUT_S, token=token) as client:
        grid = grid_of(client.airspace())
        clock = ServiceTime(client)
        dispatch = Dispatch(client, clock, grid, wish, operator)
        pilots = Pilots(client, clock, grid, dispatch, interval)
        end_s = math.inf if duration is None else time.monotonic() + duration
        interrupted = False
        try:
            with live_line() as say:
                pilots.fly(
                    lambda: time.monotonic() >= end_s or (until_idle and pilots.unfinished == 0),
                    lambda report: say(summary(report)),
                )
        except KeyboardInterrupt:
            interrupted = True
            remark("interrupted", "yellow", "aircraft that are still in the air are heard of no more")
    print_report(pilots.report, clock.rate)
    if interrupted:
        raise typer.Exit(_INTERRUPTED)


def parse_deviations(text: str, kinds: str, seed: int) -> Deviations:
    """Return which flights deviate, as the options say it; raises `typer.BadParameter`."""
    names = [name.strip() for name in kinds.split(",")]
    unknown = [name for name in names if name not in list(Kind)]
    if unknown:
        raise typer.BadParameter(f"{unknown[0]!r} is none of {', '.join(Kind)}", param_hint="--kinds")
    chosen = tuple(Kind(name) for name in names)
    if text.isascii() and text.isdecimal() and len(text) < 10:
        return Deviations(seed, chosen, first=int(text))
    try:
        share = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        share = -1.0
    if not 0 <= share <= 1:
        raise typer.BadParameter(
            "expected a number of flights, or a share of them such as 0.1 or 10%", param_hint="--deviations"
        )
    return Deviations(seed, chosen, share=share)


def summary(report: Report) -> str:
    """Return how it goes, in one line."""
    latest = sorted(report.latency_ms[-60:])
    parts = [f"{report.in_air} in the air", f"{report.arrived} arrived", f"{_rate(report):.0f} positions/s"]
    if latest:
        parts.append(f"{latest[len(latest) // 2]:.0f} ms")
    if report.deviating:
        parts.append("deviating: " + ", ".join(f"{number} {kind}" for kind, number in sorted(report.deviating.items())))
    parts += [f"refused: {number} {reason}" for reason, number in report.refused.most_common(2)]
    if report.skipped:
        parts.append(f"{report.skipped} ticks skipped: the service is slow")
    if report.unanswered:
        parts.append(f"{report.unanswered.total()} requests unanswered")
    return " · ".join(parts)


def print_report(report: Report, rate: float) -> None:
    """Print what was measured."""
    table = Table(title=f"flown at {rate:g} s a second", show_header=False, title_justify="left")
    sent = f"{report.accepted} in {report.seconds:.1f} s, {_rate(report):.1f}/s, at most {report.most_at_once} at once"
    table.add_row("positions accepted", sent)
    table.add_row("aircraft", f"{report.arrived} arrived, at most {report.most_in_air} in the air at a time")
    for kind, number in sorted(report.deviating.items()):
        table.add_row(f"deviating: {kind}", str(number))
    for reason, number in report.refused.most_common():
        table.add_row(f"refused: {reason}", str(number))
    for flag, number in report.flagged.most_common():
        table.add_row(f"flagged: {flag}", str(number))
    for error, number in report.unanswered.most_common():
        table.add_row("unanswered", f"{number}: {error}")
    table.add_row("ticks skipped", str(report.skipped))
    if report.latency_ms:
        table.add_row("latency", spread(report.latency_ms))
    show(table)


@contextmanager
def live_line() -> Iterator[Callable[[str], None]]:
    """Show a line while the block runs, where somebody looks; call what it yields with what to say."""
    console = Console(stderr=True, markup=False, emoji=False, highlight=False)
    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False))
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=None)
        yield lambda line: progress.update(task, description=line)


def _rate(report: Report) -> float:
    return report.accepted / report.seconds if report.seconds else 0.0
