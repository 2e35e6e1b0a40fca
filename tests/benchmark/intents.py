"""Part "intents": the six files, planned in filing order, each flight against all before it."""

from dataclasses import dataclass, replace

from rich.progress import Progress

from planner.airspace import OccupancyRule
from planner.cfa_star import Planner, Search
from tests.benchmark import measuring, workloads
from tests.benchmark.measuring import Run


@dataclass(frozen=True)
class Printed:
    """What a planner was measured with elsewhere: seconds for a whole file, and its expansions."""

    seconds: float
    expansions: int


# The best public planner there is for this, under the midpoint rule: earliest arrivals, as our safe-interval search.
BEST_PUBLIC = {
    "uniform_300": Printed(0.14, 51_788),
    "uniform_1000": Printed(0.60, 166_193),
    "uniform_3000": Printed(3.0, 638_938),
    "lowest_300": Printed(0.19, 72_263),
    "lowest_1000": Printed(0.90, 271_696),
    "lowest_3000": Printed(4.5, 1_100_011),
}

Row = tuple[str, OccupancyRule, Search]


def measure(repeat: int) -> None:
    """Plan every file under both rules with both searches, and print."""
    rows: list[Row] = [(name, rule, search) for name in workloads.FILES for rule in OccupancyRule for search in Search]
    runs: dict[Row, list[Run]] = {row: [] for row in rows}
    total = repeat * sum(len(workloads.from_file(name).requests) for name, _, _ in rows)
    with measuring.steps("intents: flights", total) as progress:
        # Repetitions outermost, so that a busy minute of the machine spoils one run of a row at most.
        for _ in range(repeat):
            for row in rows:
                runs[row].append(_plan_all(*row, progress))
    _print(runs)


def _plan_all(name: str, rule: OccupancyRule, search: Search, progress: Progress) -> Run:
    workload = workloads.from_file(name)
    planner = Planner(replace(workload.airspace, rule=rule), search)
    run = Run()
    with measuring.undisturbed():
        for owner, request in enumerate(workload.requests):
            run.plan(planner, request, owner)
            measuring.step(progress)
    return run


def _print(runs: dict[Row, list[Run]]) -> None:
    table = measuring.table(
        "intents: planned in filing order, each against all before it",
        "flights", "rule", "search", "sum s", "median ms", "p95", "p99", "expansions", "static", "delay s", "refused",
        "public planner", "of its expansions", "of midpoint",
    )  # fmt: skip
    for (name, rule, search), of_row in runs.items():
        seconds, expansions = measuring.sum_s(of_row), of_row[0].expansions
        public = times = midpoint = ""
        if rule is OccupancyRule.CONTAINMENT:
            midpoint = f"{seconds / measuring.sum_s(runs[name, OccupancyRule.MIDPOINT, search]):.2f} x"
        elif search is Search.SAFE_INTERVAL:
            best = BEST_PUBLIC[name]
            public, times = f"{best.seconds / seconds:.1f} x faster", f"{expansions / best.expansions:.2f}"
        median, p95, p99 = measuring.percentiles_ms(of_row, 50, 95, 99)
        table.add_row(
            name, rule.value, search.value, f"{seconds:.3f}", f"{median:.3f}", f"{p95:.2f}", f"{p99:.2f}",
            f"{expansions:,}", f"{of_row[0].static_expansions:,}", f"{of_row[0].delay_ms / 1000:.1f}",
            str(of_row[0].refused), public, times, midpoint,
        )  # fmt: skip
    measuring.show(table)
    measuring.show("public planner: its times were measured elsewhere, on another machine; take the ratio as a hint.")
    measuring.show(
        "expansions: of the search without traffic (static), which looks at no reservations, and of that with it."
    )
