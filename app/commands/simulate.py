"""`airmatrix simulate`: random flights through the API, as in the paper's scenario (paper 4.2)."""

import math
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from app.client import DEFAULT_URL, Client, ProblemAnswer, grid_of
from app.commands.terminal import progress_bar, remark, show
from app.errors import StartupError
from app.routes.flight_intents import FlightIntentAnswer, FlightIntentBody
from app.times import format_time, now_ms, parse_time
from planner.airmatrix import AirMatrix
from planner.experiments.traffic import PAPER_AIRCRAFT, Flight, Od, random_flights, terminals

_LONGEST_WINDOW_S = 366 * 86_400.0
_INTERRUPTED = 130


@dataclass
class Tally:
    """What became of the flights. Times in seconds, latencies in milliseconds."""

    accepted: list[FlightIntentAnswer] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)
    latency_ms: list[float] = field(default_factory=list)


def simulate(
    flights: Annotated[int, typer.Option(min=1, max=100_000, help="Number of flights.")] = 300,
    window: Annotated[
        float, typer.Option(min=0, max=_LONGEST_WINDOW_S, help="Seconds within which they want to depart.")
    ] = 300.0,
    seed: Annotated[int, typer.Option(min=0, help="The same seed asks for the same flights.")] = 1,
    od: Annotated[Od, typer.Option(help="Origins and destinations.")] = Od.UNIFORM,
    start: Annotated[str | None, typer.Option(help="Begin of the window, RFC 3339. Default: in 60 s.")] = None,
    operator: Annotated[str, typer.Option(help="The operator's name.")] = "simulator",
    url: Annotated[str, typer.Option(help="The service.")] = DEFAULT_URL,
) -> None:
    """Submit random flights one after another and sum up what became of them."""
    try:
        start_ms = now_ms() + 60_000 if start is None else parse_time(start)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--start") from error
    if not math.isfinite(window):
        raise typer.BadParameter("expected a number of seconds", param_hint="--window")
    tally = Tally()
    with Client(url) as client:
        answer = client.airspace()
        grid = grid_of(answer)
        occupied = np.zeros(grid.block_count, dtype=np.bool_)
        occupied[[grid.index(block) for block in client.static_blocks().blocks]] = True
        places = terminals(grid, occupied, od)
        if len(places) < 2:
            raise StartupError("the airspace has fewer than two free blocks to fly between")
        aircraft = [item.id for item in client.aircraft_types()]
        aircraft = [id_ for id_ in PAPER_AIRCRAFT if id_ in aircraft] or aircraft
        wishes = random_flights(places, aircraft, flights, window, seed)
        began = time.perf_counter()
        interrupted = False
        try:
            with progress_bar("flight intents", flights) as advance_to:
                for number, wish in enumerate(wishes, start=1):
                    _submit(client, _body(grid, wish, start_ms, operator, f"seed {seed}, flight {number}"), tally)
                    advance_to(number)
        except KeyboardInterrupt:
            interrupted = True
            remark("interrupted", "yellow", "what was accepted stays reserved")
        finally:
            if tally.latency_ms:
                seconds = time.perf_counter() - began
                _print(tally, seconds, f"{answer.name}, {answer.occupancy_rule}, {answer.search}")
    if interrupted:
        raise typer.Exit(_INTERRUPTED)


def _body(grid: AirMatrix, flight: Flight, start_ms: int, operator: str, reference: str) -> FlightIntentBody:
    """Return the request for a flight between the centres of its blocks."""
    x, y, alt_m = grid.centres(np.array([flight.origin, flight.destination])).T
    lon, lat = grid.unproject(x, y)
    origin, destination = (
        {"lon": float(lon[end]), "lat": float(lat[end]), "alt_m": float(alt_m[end])} for end in (0, 1)
    )
    return FlightIntentBody.model_validate(
        {
            "operator": operator,
            "reference": reference,
            "aircraft_type": flight.aircraft,
            "origin": origin,
            "destination": destination,
            "earliest_departure": format_time(start_ms + flight.departure_ms),
        }
    )


def _submit(client: Client, body: FlightIntentBody, tally: Tally) -> None:
    began = time.perf_counter()
    try:
        tally.accepted.append(client.submit(body))
    except ProblemAnswer as problem:
        tally.refused[problem.reason] += 1
    tally.latency_ms.append((time.perf_counter() - began) * 1000)


def _print(tally: Tally, seconds: float, title: str) -> None:
    submitted = len(tally.latency_ms)
    table = Table(title=title, show_header=False, title_justify="left")
    table.add_row("flight intents", f"{submitted} in {seconds:.2f} s, one after another")
    table.add_row("accepted", str(len(tally.accepted)))
    for reason, count in tally.refused.most_common():
        table.add_row(f"refused: {reason}", str(count))
    for label, values in (
        ("delay", [intent.delay_s for intent in tally.accepted]),
        ("ground hold", [intent.ground_hold_s for intent in tally.accepted]),
        ("hover", [intent.hover_s for intent in tally.accepted]),
    ):
        if values:
            column = np.array(values, dtype=np.float64)
            more = f"{np.count_nonzero(column)} flights, sum {column.sum():.1f} s, max {column.max():.1f} s"
            table.add_row(label, f"mean {column.mean():.3f} s, {more}")
    median, p95, p99 = np.percentile(tally.latency_ms, [50, 95, 99])
    latency = f"median {median:.1f} ms, p95 {p95:.1f} ms, p99 {p99:.1f} ms, max {max(tally.latency_ms):.1f} ms"
    table.add_row("latency", latency)
    show(table)
