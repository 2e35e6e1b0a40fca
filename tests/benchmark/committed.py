"""Part "committed": what a plan takes with thousands of flights in the index already."""

from itertools import islice

import numpy as np

from planner.cfa_star import Planner
from planner.errors import NoPlan
from planner.experiments.traffic import Od
from tests.benchmark import measuring, workloads
from tests.benchmark.measuring import Run

LEVELS = (0, 1000, 10_000, 50_000)
REQUESTS = 500
DAY_S = 86_400.0
_COMMITTED_SEED, _WARM_UP_SEED, _REQUESTED_SEED = 1, 2, 3


def measure(repeat: int) -> None:
    """Commit flights over 24 hours, then plan the same further requests at each level without reserving; print."""
    planners = _committed()
    for planner in planners.values():
        for request in islice(workloads.random_requests(planner, Od.UNIFORM, DAY_S, _WARM_UP_SEED), 50):
            planner.plan(request)
    runs: dict[int, list[Run]] = {level: [] for level in LEVELS}
    with measuring.steps("committed: further requests", repeat * REQUESTS) as progress:
        for repetition in range(repeat):
            # New requests each time, lest a planner know them.
            source = workloads.random_requests(planners[0], Od.UNIFORM, DAY_S, _REQUESTED_SEED + repetition)
            requests = [*islice(source, REQUESTS)]
            for level in LEVELS:
                runs[level].append(Run())
            with measuring.undisturbed():
                for number, request in enumerate(requests):
                    # Request by request through the levels, each first in turn: noise hits all alike.
                    for turn in range(len(LEVELS)):
                        level = LEVELS[(number + turn) % len(LEVELS)]
                        runs[level][-1].plan(planners[level], request)
                    measuring.step(progress)
    _print(planners, runs)


def _committed() -> dict[int, Planner]:
    """Return a planner for each level, which holds the first so many of the same flights, planned in filing order."""
    planners = {level: Planner(workloads.astana()) for level in LEVELS}
    largest = planners[max(LEVELS)]
    owner = 0
    with measuring.steps("committed: flights", max(LEVELS)) as progress:
        for request in workloads.random_requests(largest, Od.UNIFORM, DAY_S, _COMMITTED_SEED):
            try:
                plan = largest.plan(request)
            except NoPlan:
                continue
            for level, planner in planners.items():
                if owner < level:
                    planner.index.reserve(plan.hold_block, plan.hold_enter_ms, plan.hold_exit_ms, owner)
            measuring.step(progress)
            owner += 1
            if owner == max(LEVELS):
                break
    return planners


def _print(planners: dict[int, Planner], runs: dict[int, list[Run]]) -> None:
    table = measuring.table(
        f"committed: a plan of {REQUESTS} with flights committed over 24 h, Astana 2 km, containment, safe-interval",
        "committed", "reservations", "median ms", "p95", "p99", "median: x none", "p95", "p99",
        "expansions, all runs", "delay s", "refused",
    )  # fmt: skip
    none = np.array(measuring.percentiles_ms(runs[0], 50, 95, 99))
    for level, planner in planners.items():
        of_level = runs[level]
        times = np.array(measuring.percentiles_ms(of_level, 50, 95, 99))
        table.add_row(
            f"{level:,}",
            f"{len(planner.index):,}",
            *(f"{time:.3f}" for time in times),
            *(f"{ratio:.2f}" for ratio in times / none),
            f"{sum(run.expansions for run in of_level):,}",
            f"{sum(run.delay_ms for run in of_level) / 1000:.1f}",
            str(sum(run.refused for run in of_level)),
        )
    measuring.show(table)
