"""`airmatrix verify`: the independent checker over a whole ledger."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from app.commands.terminal import progress_bar, remark, show
from app.flight_intents import FlightIntent, State
from app.ledger import Ledger, open_ledger
from app.service import load_airspace
from app.settings import Settings
from app.times import format_time
from planner.airmatrix import AirMatrix
from planner.airspace import OccupancyRule
from planner.separation import CheckedFlight, Report, Violation
from planner.separation import verify as judge

_SHOWN = 20


def verify(
    ledger: Annotated[str | None, typer.Option(help="Ledger file or URL.")] = None,
    airspace: Annotated[Path | None, typer.Option(help="Airspace file. Default: the shipped one.")] = None,
) -> None:
    """Check every reservation and trajectory of a ledger with none of the planner's code; exit 1 on a violation."""
    settings = Settings.given(ledger=ledger, airspace=airspace)
    field = load_airspace(settings)
    book = open_ledger(settings.ledger, field)
    try:
        flights, states = _flights(book)
    finally:
        book.close()
    with progress_bar("checking", 1.0) as advance_to:
        report = judge(field, flights, lambda _, fraction: advance_to(fraction))
    _print(report, states, f"{settings.ledger}: {field.name}", field.grid)
    if not report.ok:
        raise typer.Exit(1)


def checked(intent: FlightIntent) -> CheckedFlight:
    """Return an intent as the checker sees it: its trajectory where it still holds reservations for it."""
    trajectory, held = intent.trajectory, intent.reservations
    if trajectory is None or len(held) == 0:
        none = np.empty(0, dtype=np.int64)
        return CheckedFlight(intent.id, none, none, none, held.block, held.enter_ms, held.exit_ms)
    return CheckedFlight(
        intent.id,
        trajectory.block,
        trajectory.arrive_ms,
        trajectory.depart_ms,
        held.block,
        held.enter_ms,
        held.exit_ms,
    )


def _flights(book: Ledger) -> tuple[list[CheckedFlight], dict[State, int]]:
    flights = []
    states = dict.fromkeys(State, 0)
    with progress_bar("reading", book.count()) as advance_to:
        for number, intent in enumerate(book.all_intents(), start=1):
            states[intent.state] += 1
            if intent.trajectory is not None:
                flights.append(checked(intent))
            advance_to(number)
    return flights, states


def _print(report: Report, states: dict[State, int], title: str, grid: AirMatrix) -> None:
    table = Table(title=title, show_header=False, title_justify="left")
    table.add_row("flight intents", ", ".join(f"{count} {state}" for state, count in states.items() if count) or "none")
    judged = f"{report.flights - report.released} flights, {report.reservations} reservations"
    table.add_row("judged", judged + (f" ({report.released} released)" if report.released else ""))
    for kind, count in _counts(report).items():
        table.add_row(kind, str(count))
    promise = "" if report.rule is OccupancyRule.CONTAINMENT else " (not promised under the midpoint rule)"
    closest, vertical, clearance = report.closest, report.closest_vertical, report.clearance
    table.add_row(
        "closest approach",
        f"no two flights within {grid.block_height_m:g} m vertically"
        if closest is None
        else f"{closest.horizontal_m:.3f} m horizontally, {closest.vertical_m:.3f} m vertically, "
        f"at {format_time(closest.time_ms)}{promise}",
    )
    if vertical is not None:
        table.add_row("closest vertically", f"{vertical.vertical_m:.3f} m, {vertical.horizontal_m:.3f} m horizontally")
    if clearance is not None:
        table.add_row("closest building", f"{clearance.distance_m:.3f} m, {clearance.building}{promise}")
    show(table)
    for violation in report.violations[:_SHOWN]:
        remark("violation", "red", _sentence(violation))
    if len(report.violations) > _SHOWN:
        remark("violation", "red", f"… and {len(report.violations) - _SHOWN} more")


def _counts(report: Report) -> dict[str, int]:
    """Return what the summary always states, and every other kind of violation that occurs."""
    always = {
        "overlaps": "overlapping reservations of a block",
        "separation violations": "flights nearer than a block",
        "building violations": "building nearer than half a block",
        "containment violations": "trajectory without a reservation",
    }
    found: dict[str, int] = dict.fromkeys(always, 0)
    labels = {kind: label for label, kind in always.items()}
    for violation in report.violations:
        label = labels.get(violation.kind.value, violation.kind.value)
        found[label] = found.get(label, 0) + 1
    return found


def _sentence(violation: Violation) -> str:
    detail = f": {violation.detail}" if violation.detail else ""
    span = f"{format_time(violation.from_ms)} to {format_time(violation.to_ms)}"
    return f"{violation.kind} ({', '.join(violation.flights)}), block {list(violation.block)}, {span}{detail}"
