"""`make bench`: plan the benchmark's flights in order, each against all before it, and print how long it took.

One process, one core. Times cover everything from request to plan and into the index: the search, the flight time
without traffic, the backward pass and the holds.
"""

import json
import platform
import time
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from planner.aircraft import shipped_aircraft_types
from planner.airmatrix import AirMatrix
from planner.airspace import Airspace, OccupancyRule
from planner.cfa_star import Performance, Planner, PlanRequest, Search
from planner.errors import NoPlan
from planner.warm_up import warm_up

NAMES = [f"{od}_{flights}" for od in ("uniform", "lowest") for flights in (300, 1000, 3000)]
AIRCRAFT = ("dji-mavic-air", "self-built-drone", "dji-phantom-4", "dji-matrice-600-pro")
GROUND_HOLD_MS = 300_000


def plan_all(document: dict[str, Any], rule: OccupancyRule, search: Search) -> list[str]:
    """Plan a file's flights; return a row of figures."""
    grid = AirMatrix(3414, 0.0, 0.0, 20.0, 40.0, tuple(document["dims"]))
    occupied = np.zeros(grid.block_count, dtype=np.bool_)
    occupied[document["blocked"]] = True
    profiles = {profile.id: profile for profile in shipped_aircraft_types()}
    performances = [Performance.of(profiles[name], grid) for name in AIRCRAFT]
    planner = Planner(Airspace("benchmark", "benchmark", grid, 120.0, occupied, rule), search)
    seconds, expansions, delay_ms = [], 0, 0
    refused: Counter[str] = Counter()
    for flight in document["flights"]:
        departure_ms = flight["dep_ms"]
        performance = performances[flight["type"]]
        request = PlanRequest(flight["o"], flight["d"], performance, departure_ms, departure_ms + GROUND_HOLD_MS)
        began = time.perf_counter()
        try:
            plan = planner.plan(request)
            planner.index.reserve(plan.hold_block, plan.hold_enter_ms, plan.hold_exit_ms, flight["id"])
            expansions += plan.expansions
            delay_ms += plan.delay_ms
        except NoPlan as error:
            refused[error.reason] += 1
        seconds.append(time.perf_counter() - began)
    median, p95, p99 = np.percentile(np.array(seconds) * 1000, [50, 95, 99])
    reasons = ", ".join(f"{count} {reason}" for reason, count in refused.items()) or "0"
    return [
        f"{sum(seconds):.3f}", f"{median:.3f}", f"{p95:.2f}", f"{p99:.2f}", f"{expansions:,}",
        f"{delay_ms / 1000:.1f}", reasons,
    ]  # fmt: skip


def main() -> None:
    """Print the table."""
    warm_up()
    now = datetime.now(UTC).date()
    table = Table(title=f"{now}, Python {platform.python_version()}, {platform.machine()}", title_justify="left")
    for column in ("flights", "rule", "search", "sum s", "median ms", "p95", "p99", "expansions", "delay s", "refused"):
        table.add_column(column, no_wrap=True)
    for name in NAMES:
        document = json.loads((Path(__file__).parent / f"{name}.json").read_text())
        for rule in OccupancyRule:
            for search in Search:
                table.add_row(name, rule.value, search.value, *plan_all(document, rule, search))
    Console(width=130).print(table)


if __name__ == "__main__":
    main()
