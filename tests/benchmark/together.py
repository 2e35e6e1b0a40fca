"""Part "together": what planning flights of equal standing together wins over first come, first served."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from planner.cfa_star import Planner
from planner.together import Schedule, Together
from tests.benchmark import measuring, workloads

FILES = ("uniform_300", "lowest_300", "uniform_1000", "lowest_1000")
BUDGETS_S = (1.0, 10.0)


@dataclass(frozen=True, eq=False)
class Improved:
    """A schedule after so many iterations, and the one that it started from."""

    iterations: int
    first_come: Schedule
    schedule: Schedule


def measure(repeat: int) -> None:
    """Improve the schedule of each file for as long as each budget, once for each of `repeat` seeds, and print.

    A budget is processor time: what else the machine does must not count.
    """
    table = measuring.table(
        "together: planned in filing order, and improved; containment, safe-interval",
        "flights", "improved for", "iterations", "refused", "delay s", "of first come", "spread s", "p95 s", "worst s",
        "fairness", "later than first come", "by s at most",
    )  # fmt: skip
    with measuring.steps("together: runs", repeat * len(FILES)) as progress:
        for name in FILES:
            runs = []
            for seed in range(repeat):
                with measuring.undisturbed():
                    runs.append(_improved(name, seed))
                measuring.step(progress)
            for number, budget_s in enumerate((0.0, *BUDGETS_S)):
                table.add_row(name, f"{budget_s:g} s", *_cells([run[number] for run in runs]))
    measuring.show(table)
    measuring.show("fairness: Jain's index of what each flight gets of what it would have without traffic.")


def _improved(name: str, seed: int) -> list[Improved]:
    """Return what there is at first and after each budget of one run."""
    workload = workloads.from_file(name)
    together = Together(Planner(workload.airspace), workload.requests, seed=seed)
    found = [Improved(0, together.first_come, together.best)]
    began = time.process_time()
    for budget_s in BUDGETS_S:
        together.improve(_passed(began + budget_s))
        found.append(Improved(together.iterations, together.first_come, together.best))
    return found


def _passed(until: float) -> Callable[[], bool]:
    return lambda: time.process_time() > until


def _cells(runs: Sequence[Improved]) -> list[str]:
    figures = [run.schedule.figures for run in runs]
    of_first_come = [run.schedule.figures.total_ms / run.first_come.figures.total_ms for run in runs]
    later_ms = [run.schedule.delay_ms - run.first_come.delay_ms for run in runs]
    return [
        f"{np.median([run.iterations for run in runs]):,.0f}",
        f"{np.median([each.refused for each in figures]):.0f}",
        f"{np.median([each.total_ms for each in figures]) / 1000:.1f}",
        f"{np.median(of_first_come):.0%}",
        f"{np.median([each.spread_ms for each in figures]) / 1000:.3f}",
        f"{np.median([each.p95_ms for each in figures]) / 1000:.2f}",
        f"{np.median([each.worst_ms for each in figures]) / 1000:.1f}",
        f"{np.median([each.fairness for each in figures]):.5f}",
        f"{np.median([np.count_nonzero(moved_ms > 0) for moved_ms in later_ms]):.0f}",
        f"{np.median([max(moved_ms.max(), 0) for moved_ms in later_ms]) / 1000:.1f}",
    ]
