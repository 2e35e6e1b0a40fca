"""`airmatrix load`: how many flight intents a service accepts a second, and how fast it answers."""

from collections.abc import Iterator
from contextlib import closing
from itertools import chain, islice
from typing import Annotated

import numpy as np
import orjson
import typer
from rich.table import Table

from app.client import DEFAULT_URL, Client
from app.commands.closed_loop import ClosedLoop, Measurement
from app.commands.random_intents import RandomIntents
from app.commands.terminal import progress_bar, remark, show, spread
from app.commands.token import Token
from app.routes.submissions import FlightIntentBody
from app.times import now_ms
from planner.experiments.traffic import Od

_LONGEST_S = 3_600.0
_LONGEST_WINDOW_H = 366 * 24.0
_MOST_REQUESTS = 10_000_000
# Requests are made before the clock starts, as many as a fast service takes; any more are made while it runs.
_PREPARED_PER_S = 1_000
_MOST_PREPARED = 200_000
_SLICES = 10


def load(
    clients: Annotated[int, typer.Option(min=1, max=1_000, help="Clients at a time.")] = 32,
    duration: Annotated[float, typer.Option(min=0.1, max=_LONGEST_S, help="Seconds to measure.")] = 60.0,
    limit: Annotated[int, typer.Option(min=1, max=_MOST_REQUESTS, help="Most requests to measure.")] = _MOST_REQUESTS,
    warm_up: Annotated[
        float, typer.Option(min=0, max=_LONGEST_S, help="Seconds of the same before, which do not count.")
    ] = 5.0,
    window: Annotated[
        float, typer.Option(min=0, max=_LONGEST_WINDOW_H, help="Hours, from in 60 s, to spread departures over.")
    ] = 24.0,
    seed: Annotated[int, typer.Option(min=0, help="The same seed asks for the same flights.")] = 1,
    od: Annotated[Od, typer.Option(help="Origins and destinations.")] = Od.UNIFORM,
    operator: Annotated[
        str | None, typer.Option(help="The operator's name.  [default: the token's, load without one]")
    ] = None,
    url: Annotated[str, typer.Option(help="The service.")] = DEFAULT_URL,
    token: Token = None,
) -> None:
    """Submit random flights from many clients at a time, and measure how many are accepted and how fast.

    What is accepted STAYS RESERVED: load a service that has a ledger of its own, never one in use.

    Each client waits for its answer before it sends the next request. After the duration, or the limit, nothing more is
    sent; what is under way is waited for, 30 seconds at most. Ctrl-C ends it at once, with the figures so far.
    Exit status 1 if nothing was accepted.
    """
    if operator is None and token is None:
        operator = "load"
    with Client(url, token=token) as client:
        demand = RandomIntents.served_by(client, od)
    wanted = demand.bodies(limit + _MOST_REQUESTS, now_ms() + 60_000, window * 3600, seed, operator)
    first = next(wanted)
    FlightIntentBody.model_validate(first)
    bodies = map(orjson.dumps, chain([first], wanted))
    ahead = min(_MOST_PREPARED, int(warm_up * _PREPARED_PER_S) + min(limit, int(duration * _PREPARED_PER_S)))
    with closing(ClosedLoop(url, clients, chain(_prepared(bodies, ahead), bodies), token)) as loop:
        if warm_up and _measured(loop, "warm-up", warm_up).interrupted:
            remark("interrupted", "yellow", "in the warm-up; what was accepted stays reserved")
            raise typer.Exit(1)
        measured = _measured(loop, "measuring", duration, limit)
    if measured.interrupted:
        lost = f"{measured.unanswered} requests were not waited for"
        remark("interrupted", "yellow", f"{lost}; what was accepted stays reserved")
    _print(measured, clients, demand.title)
    if measured.accepted == 0:
        raise typer.Exit(1)


def _prepared(bodies: Iterator[bytes], count: int) -> list[bytes]:
    with progress_bar("preparing", count) as advance_to:
        made: list[bytes] = []
        while len(made) < count:
            made += islice(bodies, min(1000, count - len(made)))
            advance_to(len(made))
        return made


def _measured(loop: ClosedLoop, what: str, seconds: float, limit: int = _MOST_REQUESTS) -> Measurement:
    """Run the clients with a progress bar, beside it the present rate."""
    last_s, last = 0.0, 0
    with progress_bar(what, seconds) as advance_to:

        def watch(elapsed_s: float, accepted: int) -> None:
            nonlocal last_s, last
            advance_to(elapsed_s, f"{(accepted - last) / (elapsed_s - last_s):.0f} accepted/s")
            last_s, last = elapsed_s, accepted

        return loop.run(seconds, limit, watch)


def _print(measured: Measurement, clients: int, title: str) -> None:
    seconds = measured.seconds
    table = Table(title=title, show_header=False, title_justify="left")
    table.add_row("requests", f"{measured.requests} in {seconds:.2f} s, {clients} clients")
    table.add_row("accepted", f"{measured.accepted}, {measured.accepted / seconds:.1f}/s")
    if measured.accepted:
        table.add_row("latency", spread(measured.latency_ms))
    for part, values_ms in measured.server_ms.items():
        table.add_row(f"of it {part}", spread(values_ms))
    for reason, count in measured.refused.most_common():
        table.add_row(f"refused: {reason}", str(count))
    for problem, latencies_ms in measured.problems_ms.items():
        table.add_row(f"problem: {problem}", f"{len(latencies_ms)}, {spread(latencies_ms)}")
    if measured.lost:
        causes = ", ".join(f"{count} {cause}" for cause, count in measured.lost.most_common())
        table.add_row("connection errors", causes)
    if measured.requests:
        each_ms, share = 1000 * measured.cpu_s / measured.requests, measured.cpu_s / seconds
        table.add_row("this command", f"{each_ms:.3f} ms of CPU a request, {share:.0%} of a core")
    edges = np.linspace(0.0, seconds, _SLICES + 1)
    slice_of = np.searchsorted(edges, measured.answered_s, side="right") - 1
    for number in range(_SLICES):
        latencies_ms = measured.latency_ms[slice_of == number]
        rate = len(latencies_ms) / (seconds / _SLICES)
        p99 = f", p99 {np.percentile(latencies_ms, 99):.1f} ms" if len(latencies_ms) else ""
        table.add_row(f"from {edges[number]:.1f} s", f"{rate:.1f}/s{p99}")
    show(table)
