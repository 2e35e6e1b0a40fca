"""`airmatrix simulate`: random flights through the API, as in the paper's scenario (paper 4.2)."""

import math
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from app.client import DEFAULT_URL, Client, ProblemAnswer
from app.commands.random_intents import RandomIntents
from app.commands.terminal import progress_bar, remark, show, spread
from app.commands.token import Token
from app.routes.answers import FlightIntentAnswer
from app.routes.submissions import FlightIntentBody
from app.times import now_ms, parse_time
from planner.experiments.traffic import Od

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
    operator: Annotated[
        str | None, typer.Option(help="The operator's name.  [default: the token's, simulator without one]")
    ] = None,
    url: Annotated[str, typer.Option(help="The service.")] = DEFAULT_URL,
    token: Token = None,
) -> None:
    """Submit random flights one after another and sum up what became of them."""
    try:
        start_ms = now_ms() + 60_000 if start is None else parse_time(start)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--start") from error
    if not math.isfinite(window):
        raise typer.BadParameter("expected a number of seconds", param_hint="--window")
    if operator is None and token is None:
        operator = "simulator"
    tally = Tally()
    with Client(url, token=token) as client:
        demand = RandomIntents.served_by(client, od)
        began = time.perf_counter()
        interrupted = False
        try:
            with progress_bar("flight intents", flights) as advance_to:
                for number, body in enumerate(demand.bodies(flights, start_ms, window, seed, operator), start=1):
                    _submit(client, FlightIntentBody.model_validate(body), tally)
                    advance_to(number)
        except KeyboardInterrupt:
            interrupted = True
            remark("interrupted", "yellow", "what was accepted stays reserved")
        finally:
            if tally.latency_ms:
                seconds = time.perf_counter() - began
                _print(tally, seconds, demand.title)
    if interrupted:
        raise typer.Exit(_INTERRUPTED)


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
    table.add_row("latency", spread(tally.latency_ms))
    show(table)
