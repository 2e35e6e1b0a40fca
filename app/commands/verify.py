"""`airmatrix verify`: the independent checker over a whole ledger."""

from contextlib import closing
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from app.commands.terminal import progress_bar, remark, show
from app.flight_intents import FlightIntent, Reservations, State
from app.ledger import open_ledger, parse_location
from app.service import load_airspace
from app.settings import Settings
from app.times import format_time
from app.trespasses import Trespass, trespasses
from planner.airmatrix import AirMatrix
from planner.airspace import OccupancyRule
from planner.path import Trajectory
from planner.separation import CheckedFlight, Report, Violation
from planner.separation import verify as judge

_SHOWN = 20


def verify(
    ledger: Annotated[str | None, typer.Option(help="Ledger file or URL.")] = None,
    airspace: Annotated[Path | None, typer.Option(help="Airspace file. Default: the shipped one.")] = None,
) -> None:
    """Check every reservation and trajectory of a ledger, and that nobody holds closed airspace who was planned around
    it or could have made way, with none of the planner's code; exit 1 on a violation.
    """
    settings = Settings.given(ledger=ledger, airspace=airspace)
    field = load_airspace(settings)
    with closing(open_ledger(settings.ledger, field)) as book:
        removed_ms = book.removed().before_ms
        with book.snapshot() as snapshot:
            intents, unknown = snapshot.intents()
            trespassing = trespasses(snapshot, intents)
    flights = [checked(intent) for intent in intents if intent.trajectory is not None or len(intent.reservations)]
    flights += [_flight(f"unknown intent {sequence}", held, None) for sequence, held in unknown.items()]
    with progress_bar("checking", 1.0) as advance_to:
        report = judge(field, flights, lambda _, fraction: advance_to(fraction))
    states = {state: sum(intent.state is state for intent in intents) for state in State}
    strays = [flight.id for flight in flights if len(flight.block) == 0 < len(flight.hold_block)]
    title = f"{parse_location(settings.ledger)}: {field.name}"
    _print(report, states, removed_ms, strays, trespassing, title, field.grid)
    if strays or trespassing or not report.ok:
        raise typer.Exit(1)


def checked(intent: FlightIntent) -> CheckedFlight:
    """Return an intent as the checker sees it: with what it must hold.

    Who gave up all of it must hold nothing; who gave up what lay ahead must hold what lies behind.
    """
    held, trajectory = intent.reservations, intent.trajectory
    if trajectory is None or intent.state not in (State.CANCELLED, State.ENDED):
        return _flight(intent.id, held, trajectory)
    if len(held) == 0:
        return _flight(intent.id, held, None)
    # A reservation's exit lies one millisecond behind what it covers.
    until_ms = int(held.exit_ms.max()) - 1
    span = (trajectory.departure_ms, until_ms) if until_ms < trajectory.arrival_ms else None
    return _flight(intent.id, held, trajectory, span)


def _flight(
    name: str, held: Reservations, trajectory: Trajectory | None, span: tuple[int, int] | None = None
) -> CheckedFlight:
    none = np.empty(0, dtype=np.int64)
    return CheckedFlight(
        name,
        none if trajectory is None else trajectory.block,
        none if trajectory is None else trajectory.arrive_ms,
        none if trajectory is None else trajectory.depart_ms,
        held.block,
        held.enter_ms,
        held.exit_ms,
        span,
    )


def _print(
    report: Report,
    states: dict[State, int],
    removed_ms: int | None,
    strays: list[str],
    trespassing: list[Trespass],
    title: str,
    grid: AirMatrix,
) -> None:
    table = Table(title=title, show_header=False, title_justify="left")
    table.add_row("flight intents", ", ".join(f"{count} {state}" for state, count in states.items() if count) or "none")
    if removed_ms is not None:
        table.add_row("removed by retention", f"flight intents that ended before {format_time(removed_ms)}")
    judged = f"{report.flights - report.released} flights, {report.reservations} reservations"
    table.add_row("judged", judged + (f" ({report.released} released)" if report.released else ""))
    for kind, count in _counts(report).items():
        table.add_row(kind, str(count))
    table.add_row("constraint violations", str(len(trespassing)))
    promise = "" if report.rule is OccupancyRule.CONTAINMENT else " (not promised under the midpoint rule)"
    closest, vertical, clearance = report.closest, report.closest_vertical, report.clearance
    table.add_row(
        "closest approach",
        f"no two flights within {grid.block_height_m:g} m vertically"
        if closest is None and report.motion_judged
        else "not judged, reservations are wrong wholesale"
        if closest is None
        else f"{closest.horizontal_m:.3f} m horizontally, {closest.vertical_m:.3f} m vertically, "
        f"at {format_time(closest.time_ms)}{promise}",
    )
    if vertical is not None:
        table.add_row("closest vertically", f"{vertical.vertical_m:.3f} m, {vertical.horizontal_m:.3f} m horizontally")
    if clearance is not None:
        table.add_row("closest building", f"{clearance.distance_m:.3f} m, {clearance.building}{promise}")
    show(table)
    for stray in strays[:_SHOWN]:
        remark("violation", "red", f"reservations that belong to no flight ({stray})")
    for trespass in trespassing[:_SHOWN]:
        remark("violation", "red", _reproach(trespass, grid))
    if len(trespassing) > _SHOWN:
        remark("violation", "red", f"… and {len(trespassing) - _SHOWN} more in closed airspace")
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


def _reproach(trespass: Trespass, grid: AirMatrix) -> str:
    intent, constraint, block, from_ms, to_ms = trespass.overlap
    span = f"{format_time(from_ms)} to {format_time(to_ms)}"
    why = f"{trespass.reason}, {constraint.id} ({constraint.name})"
    return f"reservation in closed airspace ({intent.id}), block {list(grid.block(block))}, {span}: {why}"
