"""Part "committed": what a plan takes with thousands of flights in the index already."""

from dataclasses import replace
from itertools import islice

import numpy as np

from planner.cfa_star import Planner, PlanRequest
from planner.errors import NoPlan
from planner.experiments.traffic import Od
from tests.benchmark import measuring, workloads
from tests.benchmark.measuring import Run

LEVELS = (0, 1000, 10_000, 50_000)
REQUESTS = 500
HOUR_S, DAY_S = 3600.0, 86_400.0
_COMMITTED_SEED, _WARM_UP_SEED, _REQUESTED_SEED = 1, 2, 3
_NOON_MS, _HOUR_MS = 43_200_000, 3_600_000
# No flight takes an hour: what departs within three hours around an hour is all that its flights can meet.
_AROUND_NOON_MS = (_NOON_MS - _HOUR_MS, _NOON_MS + 2 * _HOUR_MS)


def measure(repeat: int) -> None:
    """Commit flights over 24 hours, then plan further requests at each level without reserving; print.

    More flights in a day are also more traffic around a request. So requests of one hour are planned once more with all
    flights, and with only those of the hours around: what differs is what the number of reservations costs.
    """
    planners, around_noon = _committed()
    most = planners[max(LEVELS)]
    within_a_day = [_requests(most, DAY_S, 0, repetition) for repetition in range(repeat)]
    _print(
        f"committed: a plan of {REQUESTS} with flights committed over 24 h, Astana 2 km, containment, safe-interval",
        {f"{level:,}": planner for level, planner in planners.items()},
        within_a_day,
    )
    after_noon = [_requests(most, HOUR_S, _NOON_MS, repetition) for repetition in range(repeat)]
    _print(
        f"committed: a plan of {REQUESTS} within one hour, with the same traffic around it",
        {"of 3 hours": around_noon, f"all {max(LEVELS):,}": most},
        after_noon,
    )


def _requests(planner: Planner, window_s: float, start_ms: int, repetition: int) -> list[PlanRequest]:
    """Return new requests for each repetition, lest a planner know them."""
    source = workloads.random_requests(planner, Od.UNIFORM, window_s, _REQUESTED_SEED + repetition)
    return [
        replace(
            request,
            earliest_departure_ms=request.earliest_departure_ms + start_ms,
            latest_departure_ms=request.latest_departure_ms + start_ms,
        )
        for request in islice(source, REQUESTS)
    ]


def _committed() -> tuple[dict[int, Planner], Planner]:
    """Return planners with flights planned in filing order: one for each level's first so many, one of around noon."""
    planners = {level: Planner(workloads.astana()) for level in LEVELS}
    around_noon = Planner(workloads.astana())
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
            if _AROUND_NOON_MS[0] <= plan.departure_ms < _AROUND_NOON_MS[1]:
                around_noon.index.reserve(plan.hold_block, plan.hold_enter_ms, plan.hold_exit_ms, owner)
            measuring.step(progress)
            owner += 1
            if owner == max(LEVELS):
                break
    return planners, around_noon


def _print(title: str, planners: dict[str, Planner], repetitions: list[list[PlanRequest]]) -> None:
    runs = _plan(title.partition(":")[0], planners, repetitions)
    table = measuring.table(
        title,
        "committed", "reservations", "median ms", "p95", "p99", "median: x first", "p95", "p99",
        "expansions, all runs", "delay s", "refused",
    )  # fmt: skip
    first = np.array(measuring.percentiles_ms(next(iter(runs.values())), 50, 95, 99))
    for name, planner in planners.items():
        times = np.array(measuring.percentiles_ms(runs[name], 50, 95, 99))
        table.add_row(
            name,
            f"{len(planner.index):,}",
            *(f"{time:.3f}" for time in times),
            *(f"{ratio:.2f}" for ratio in times / first),
            f"{sum(run.expansions for run in runs[name]):,}",
            f"{sum(run.delay_ms for run in runs[name]) / 1000:.1f}",
            str(sum(run.refused for run in runs[name])),
        )
    measuring.show(table)


def _plan(what: str, planners: dict[str, Planner], repetitions: list[list[PlanRequest]]) -> dict[str, list[Run]]:
    """Plan all requests by all planners, side by side."""
    names = list(planners)
    for planner in planners.values():
        for request in islice(workloads.random_requests(planner, Od.UNIFORM, DAY_S, _WARM_UP_SEED), 50):
            planner.plan(request)
    runs: dict[str, list[Run]] = {name: [] for name in names}
    with measuring.steps(f"{what}: further requests", sum(len(requests) for requests in repetitions)) as progress:
        for requests in repetitions:
            for name in names:
                runs[name].append(Run())
            with measuring.undisturbed():
                for number, request in enumerate(requests):
                    # Request by request through the planners, each first in turn: noise hits all alike.
                    for turn in range(len(names)):
                        name = names[(number + turn) % len(names)]
                        runs[name][-1].plan(planners[name], request)
                    measuring.step(progress)
    return runs
