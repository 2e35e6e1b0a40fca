"""`airmatrix simulate`: random flights through the API, as in the paper's scenario (paper 4.2)."""

import math
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from app.client import DEFAULT_URL, Client, ProblemAnswer, grid_of
from app.commands.terminal import progress_bar, remark, show
from app.errors import StartupError
from app.routes.flight_intents import FlightIntentAnswer, FlightIntentBody
from app.times import format_time, now_ms, parse_time
from planner.airmatrix import AirMatrix, IntArray
from planner.airspace import BoolArray

# The paper's table of aircraft; the others that a service offers do not take part.
PAPER_AIRCRAFT = ("dji-mavic-air", "self-built-drone", "dji-phantom-4", "dji-matrice-600-pro")


_LONGEST_WINDOW_S = 366 * 86_400.0
_INTERRUPTED = 130


class Od(StrEnum):
    """Where flights begin and end: anywhere free, as in the paper, or on the ground, as real pads lie."""

    UNIFORM = "uniform"
    LOWEST = "lowest"


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
        bodies = random_flights(grid, places, aircraft, flights, start_ms, window, seed, operator)
        began = time.perf_counter()
        interrupted = False
        try:
            with progress_bar("flight intents", flights) as advance_to:
                for number, body in enumerate(bodies, start=1):
                    _submit(client, body, tally)
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


def terminals(grid: AirMatrix, occupied: BoolArray, od: Od) -> IntArray:
    """Return the blocks where flights may begin and end."""
    if od is Od.UNIFORM:
        return np.flatnonzero(~occupied)
    columns = grid.dimensions[0] * grid.dimensions[1]
    free = ~occupied.reshape(-1, columns)
    lowest: IntArray = np.argmax(free, axis=0) * columns + np.arange(columns)
    return lowest[free.any(axis=0)]


def random_flights(
    grid: AirMatrix,
    places: IntArray,
    aircraft: list[str],
    flights: int,
    start_ms: int,
    window_s: float,
    seed: int,
    operator: str,
) -> Iterator[FlightIntentBody]:
    """Yield flights in filing order: endpoints, aircraft and departures uniform, all from one seed."""
    random = np.random.default_rng(seed)
    for number in range(flights):
        ends = random.choice(places, size=2, replace=False)
        x, y, alt_m = grid.centres(ends).T
        lon, lat = grid.unproject(x, y)
        origin, destination = (
            {"lon": float(lon[end]), "lat": float(lat[end]), "alt_m": float(alt_m[end])} for end in (0, 1)
        )
        departure_ms = start_ms + int(random.uniform(0, window_s * 1000))
        yield FlightIntentBody.model_validate(
            {
                "operator": operator,
                "reference": f"seed {seed}, flight {number + 1}",
                "aircraft_type": aircraft[int(random.integers(len(aircraft)))],
                "origin": origin,
                "destination": destination,
                "earliest_departure": format_time(departure_ms),
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
