"""Part "city": 24 km x 24 km in blocks of 20 m x 40 m, 1,200 x 1,200 x 3 of them."""

import gc
import time
from itertools import islice

from rich.progress import Progress

from planner.cfa_star import Planner
from planner.experiments.traffic import Od
from tests.benchmark import measuring, workloads
from tests.benchmark.measuring import Run

REQUESTS = 300
WINDOW_S = 300.0
TARGET_MEDIAN_MS, TARGET_P99_MS = 3.0, 40.0
_SEED = 1


def measure(repeat: int) -> None:
    """Plan requests cold, one after another, each against all before it, and print times and memory."""
    airspace = workloads.city()
    dimensions = " x ".join(f"{count:,}" for count in airspace.grid.dimensions)
    times = measuring.table(
        f"city: {REQUESTS} requests in {WINDOW_S:g} s, {dimensions} blocks, containment, safe-interval; "
        f"targets: median {TARGET_MEDIAN_MS:g} ms, p99 {TARGET_P99_MS:g} ms",
        "traffic", "sum s", "median ms", "p95", "p99", "max", "expansions", "delay s", "refused", "targets",
    )  # fmt: skip
    memory = measuring.table(
        "city: memory of a planner",
        "traffic", "built in s", "MB before", "MB built", "MB after planning", "bytes a block: built", "after planning",
    )  # fmt: skip
    with measuring.steps("city: requests", len(Od) * repeat * REQUESTS) as progress:
        for od in Od:
            runs = []
            for repetition in range(repeat):
                gc.collect()
                before = measuring.resident_bytes()
                began = time.perf_counter()
                planner = Planner(airspace)
                built_s = time.perf_counter() - began
                built = measuring.resident_bytes()
                runs.append(_plan_all(planner, od, progress))
                after = measuring.resident_bytes()
                if repetition == 0 and before and built and after:
                    blocks = airspace.grid.block_count
                    memory.add_row(
                        od.value,
                        f"{built_s:.2f}",
                        *(f"{resident / 1e6:.0f}" for resident in (before, built, after)),
                        *(f"{(resident - before) / blocks:.0f}" for resident in (built, after)),
                    )
                del planner
            median, p95, p99, longest = measuring.percentiles_ms(runs, 50, 95, 99, 100)
            met = median <= TARGET_MEDIAN_MS and p99 <= TARGET_P99_MS
            times.add_row(
                od.value,
                f"{measuring.sum_s(runs):.2f}",
                *(f"{value:.2f}" for value in (median, p95, p99, longest)),
                f"{runs[0].expansions:,}",
                f"{runs[0].delay_ms / 1000:.1f}",
                str(runs[0].refused),
                "met" if met else "MISSED",
            )
    measuring.show(times)
    if memory.row_count:
        measuring.show(memory)


def _plan_all(planner: Planner, od: Od, progress: Progress) -> Run:
    requests = [*islice(workloads.random_requests(planner, od, WINDOW_S, _SEED), REQUESTS)]
    run = Run()
    with measuring.undisturbed():
        for owner, request in enumerate(requests):
            run.plan(planner, request, owner)
            measuring.step(progress)
    return run
