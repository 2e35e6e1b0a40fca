"""Part "peers": graph libraries without reservations, and a plain safe-interval planner, beside ours with reservations.

Building graphs is not measured. Every flight time of a library must be `Planner.unconstrained`, every arrival of the
plain planner that of ours, or the benchmark fails.
"""

from dataclasses import dataclass, field, replace
from importlib.metadata import version

from rich.progress import Progress

from planner.airspace import OccupancyRule
from planner.cfa_star import Planner
from planner.path import Plan
from tests.benchmark import graph_libraries, measuring, workloads
from tests.benchmark.graph_libraries import LIBRARIES, FindPath, Network
from tests.benchmark.measuring import Run
from tests.benchmark.workloads import Workload
from tests.reference.planning import Hold
from tests.reference.safe_interval import SafeIntervalPlanner

FILES = ("uniform_300", "lowest_300")
TARGET = 4.0
OURS, OURS_STATIC, PLAIN = "AirMatrix", "AirMatrix, A* alone", "plain Python safe-interval"
_INSTALL = "pip install --require-hashes --no-deps -r tests/benchmark/requirements.lock"


@dataclass
class Contest:
    """One file under one rule, and the runs of everybody who planned it."""

    name: str
    workload: Workload
    runs: dict[str, list[Run]] = field(default_factory=dict)

    def run(self, contestant: str) -> Run:
        """Return a new run of a contestant."""
        run = Run()
        self.runs.setdefault(contestant, []).append(run)
        return run


def measure(repeat: int) -> None:
    """Let everybody plan the same requests, and print."""
    installed = [name for name in LIBRARIES if graph_libraries.is_installed(name)]
    for name in LIBRARIES:
        if name not in installed:
            measuring.show(f"peers: {name} is left out, as it is not installed: {_INSTALL}")
    contests = [
        Contest(f"{file}, {rule}", replace(workload, airspace=replace(workload.airspace, rule=rule)))
        for file in FILES
        for workload in [workloads.from_file(file)]
        for rule in OccupancyRule
    ]
    total = sum(len(contest.workload.requests) for contest in contests) * repeat * (3 + len(installed))
    with measuring.steps("peers: requests", total) as progress:
        for contest in contests:
            _measure(contest, installed, repeat, progress)
    _print(contests)


def _measure(contest: Contest, libraries: list[str], repeat: int, progress: Progress) -> None:
    airspace, requests = contest.workload.airspace, contest.workload.requests
    aircraft = list({id(request.performance.times): request.performance.times for request in requests}.values())
    network = graph_libraries.network_of(airspace)
    finders = {name: LIBRARIES[name](network, aircraft) for name in libraries}
    for _ in range(repeat):
        planner = Planner(airspace)
        with measuring.undisturbed():
            plans = _ours(contest, planner, progress)
            alone_ms = _ours_static(contest, planner, progress)
        for name in libraries:
            with measuring.undisturbed():
                of_aircraft = dict(zip(map(id, aircraft), finders[name], strict=True))
                _library(name, contest, network, of_aircraft, alone_ms, progress)
        plain = SafeIntervalPlanner(airspace)
        # Unmeasured, for its heuristic's table of each aircraft.
        for request in {id(request.performance.times): request for request in requests}.values():
            plain.earliest_path(request)
        with measuring.undisturbed():
            _plain(contest, plain, plans, progress)


def _ours(contest: Contest, planner: Planner, progress: Progress) -> list[Plan | None]:
    run = contest.run(OURS)
    plans = []
    for owner, request in enumerate(contest.workload.requests):
        plans.append(run.plan(planner, request, owner))
        measuring.step(progress)
    return plans


def _ours_static(contest: Contest, planner: Planner, progress: Progress) -> list[int]:
    run = contest.run(OURS_STATIC)
    times_ms = []
    for request in contest.workload.requests:
        times_ms.append(run.time(planner.unconstrained, request))
        measuring.step(progress)
    return times_ms


def _library(
    name: str,
    contest: Contest,
    network: Network,
    finders: dict[int, FindPath],
    alone_ms: list[int],
    progress: Progress,
) -> None:
    run = contest.run(f"{name} {version(name)}, A* alone")
    for request, due_ms in zip(contest.workload.requests, alone_ms, strict=True):
        times = request.performance.times
        path = run.time(finders[id(times)], request.origin, request.destination)
        assert network.time_along(path, times) == due_ms, f"{name} found another flight time than the planner"
        measuring.step(progress)


def _plain(contest: Contest, plain: SafeIntervalPlanner, plans: list[Plan | None], progress: Progress) -> None:
    run = contest.run(PLAIN)
    for request, plan in zip(contest.workload.requests, plans, strict=True):
        path = run.time(plain.earliest_path, request)
        arrival_ms = None if path is None else path[-1].depart_ms
        assert arrival_ms == (None if plan is None else plan.arrival_ms), "the plain planner arrives at another time"
        if plan is not None:
            columns = (plan.hold_block.tolist(), plan.hold_enter_ms.tolist(), plan.hold_exit_ms.tolist())
            plain.reserve(Hold(*hold) for hold in zip(*columns, strict=True))
        measuring.step(progress)


def _print(contests: list[Contest]) -> None:
    table = measuring.table(
        f"peers: each on all requests of a file; target: {OURS}, with reservations, {TARGET:g} x faster than any peer",
        "requests", "planner", "reservations", "sum s", "median ms", "p95", "p99", "sum: x ours", "median", "target",
    )  # fmt: skip
    for contest in contests:
        ours_s = measuring.sum_s(contest.runs[OURS])
        (ours_ms,) = measuring.percentiles_ms(contest.runs[OURS], 50)
        peers = {name: measuring.sum_s(runs) for name, runs in contest.runs.items() if name not in (OURS, OURS_STATIC)}
        fastest = min(peers, key=lambda name: peers[name])
        for name, runs in contest.runs.items():
            median, p95, p99 = measuring.percentiles_ms(runs, 50, 95, 99)
            times = measuring.sum_s(runs) / ours_s
            table.add_row(
                contest.name,
                name,
                "with" if name in (OURS, PLAIN) else "without",
                f"{measuring.sum_s(runs):.3f}",
                *(f"{value:.3f}" for value in (median, p95, p99)),
                f"{times:.1f}",
                f"{median / ours_ms:.1f}",
                ("met" if times >= TARGET else "MISSED") if name == fastest else "",
            )
        table.add_section()
    measuring.show(table)
