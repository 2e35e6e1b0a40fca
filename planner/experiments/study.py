"""The paper's section 4 as a study: what is simulated, and what of each run is kept."""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from planner.aircraft import AircraftType, shipped_aircraft_types
from planner.airmatrix import FloatArray, IntArray
from planner.airspace import Airspace, OccupancyRule
from planner.cfa_star import Search
from planner.experiments import altitude, cases, paper
from planner.experiments.metrics import CornerCuts, Encounter, conflicts_added, corner_cuts, encounter, seconds_in_use
from planner.experiments.simulation import NothingToStudy, Run, Simulator, Verdict
from planner.experiments.traffic import Demand, Flight, Od

T = TypeVar("T")


@dataclass(frozen=True)
class Design:
    """How much is simulated.

    Traffic is `flights` within `windows_min` for each of `seeds`, of which the first within the paper's window is the
    reference; `sizes` flights within the paper's window compare searches and rules. Computing times are medians of
    `timings` passes.
    """

    flights: int
    seeds: tuple[int, ...]
    sizes: tuple[int, ...]
    timings: int
    windows_min: tuple[int, ...] = paper.WINDOWS_MIN

    @classmethod
    def of(cls, flights: int, seeds: int, first_seed: int, quick: bool = False) -> "Design":
        """Return the whole design, or the quick one: three seeds at most, one size, each time measured once."""
        sizes = (flights,) if quick else (flights, round(flights * 10 / 3), flights * 10)
        count = min(seeds, 3) if quick else seeds
        return cls(flights, tuple(range(first_seed, first_seed + count)), sizes, timings=1 if quick else 5)

    def workload(self, airspace: Airspace) -> int:
        """Return how many flights are planned in all."""
        reference = 5 * (self.timings + 1) + len(_types_compared())
        density = 3 * len(self.windows_min) * len(self.seeds)
        balancing = len(altitude.WEIGHTS_MS) if altitude.lets_flights_choose(airspace) else 0
        scenarios = reference + density + balancing
        return self.flights * scenarios + sum(self.sizes) * len(Od) * len(OccupancyRule) * len(Search)


@dataclass(frozen=True)
class NearMiss:
    """Two flights (their numbers) that come too near."""

    flights: tuple[int, int]
    encounter: Encounter


@dataclass(frozen=True, eq=False)
class Reference:
    """The paper's scenario once: A* and both searches under the midpoint rule, and safe-interval under containment.

    `astar` is the paper's: the greedy search with nothing reserved. `safe_interval_alone` is the other search with
    nothing reserved. Every plan begins with a search without traffic, which by itself takes `without_traffic_s`
    (flights,).

    `conflicts` (flights,) is what each A* trajectory adds to the paper's metric, `whole_second_conflicts` the same with
    occupations widened to whole seconds, and `conflicts_left` the metric over the trajectories of greedy CFA*.
    `comparisons` has the flights that both A* and greedy CFA* planned. `near_misses` are those of the greedy run, the
    least separated first.
    """

    astar: Run
    greedy: Run
    safe_interval_alone: Run
    safe_interval: Run
    containment: Run
    without_traffic_s: FloatArray
    conflicts: IntArray
    whole_second_conflicts: IntArray
    conflicts_left: int
    comparisons: tuple[cases.Comparison, ...]
    greedy_verdict: Verdict
    containment_verdict: Verdict
    near_misses: tuple[NearMiss, ...]
    corner_cuts: CornerCuts
    in_use_s: FloatArray


@dataclass(frozen=True)
class Trial:
    """One seed's traffic within one window: A* and greedy CFA* by midpoint, safe-interval CFA* by containment."""

    window_min: int
    seed: int
    conflicts: int
    whole_second_conflicts: int
    delay_s: float
    refused: int
    too_near: int
    corner_cuts: CornerCuts
    containment_delay_s: float
    containment_refused: int
    containment_too_near: int
    violations: int


@dataclass(frozen=True, eq=False)
class UseByType:
    """The reference traffic, all of one type of aircraft, by greedy CFA*: seconds for which each block is held."""

    aircraft: AircraftType
    refused: int
    in_use_s: FloatArray

    @property
    def speed_ratio(self) -> float:
        """The ratio of horizontal to vertical speed."""
        return self.aircraft.max_horizontal_speed_mps / self.aircraft.max_vertical_speed_mps


@dataclass(frozen=True, eq=False)
class Balance:
    """The reference traffic by safe-interval CFA*, midpoint, with surcharges on links into crowded layers.

    Before each flight a layer's surcharge is `weight_ms` times its crowding by that of the most crowded layer.
    `in_use_s` (blocks,): seconds for which each block is held.
    """

    weight_ms: int
    run: Run
    in_use_s: FloatArray
    verdict: Verdict


@dataclass(frozen=True)
class Trade:
    """One rule and search on one size of traffic. `delay_s` is the sum over flights that were not refused."""

    od: Od
    flights: int
    rule: OccupancyRule
    search: Search
    accepted: int
    refused: Counter[str]
    delay_s: float
    longest_delay_s: float
    computing_s: float
    expansions: int
    verdict: Verdict

    @property
    def mean_delay_s(self) -> float:
        """Delay a flight that was not refused."""
        return self.delay_s / self.accepted if self.accepted else 0.0


@dataclass(frozen=True, eq=False)
class Study:
    """All that was measured. There are no `balances` where flights have one layer to fly in."""

    airspace: Airspace
    design: Design
    reference: Reference
    trials: tuple[Trial, ...]
    use_by_type: tuple[UseByType, ...]
    balances: tuple[Balance, ...]
    trades: tuple[Trade, ...]


def conduct(airspace: Airspace, design: Design, on_progress: Callable[[int], None] | None = None) -> Study:
    """Run the whole study; `on_progress` is told how many flights of the `workload` have been planned.

    The airspace's own rule and terminal dwell do not count: the paper has no dwell.

    Raises
    ------
    NothingToStudy
        There are fewer than two columns with a free block, or buildings part the ends of every flight of the reference.
    AircraftProfileError
    """
    simulator = Simulator(airspace, on_progress)
    reference = simulate_reference(simulator, design)
    return Study(
        airspace,
        design,
        reference,
        trials=tuple(
            simulate_trial(simulator, design.flights, window_min, seed)
            for window_min in design.windows_min
            for seed in design.seeds
        ),
        use_by_type=use_by_type(simulator, reference.astar.flights),
        balances=altitude_balance(simulator, reference.safe_interval) if altitude.lets_flights_choose(airspace) else (),
        trades=tuple(
            trade(simulator, Demand(od, flights, paper.WINDOW_MIN, design.seeds[0]), rule, search)
            for od in Od
            for flights in design.sizes
            for rule in OccupancyRule
            for search in Search
        ),
    )


def simulate_reference(simulator: Simulator, design: Design) -> Reference:
    """Simulate the paper's scenario with the design's first seed."""
    flights = simulator.flights(Demand(Od.UNIFORM, design.flights, paper.WINDOW_MIN, design.seeds[0]))
    midpoint = OccupancyRule.MIDPOINT
    astar = _timed(design.timings, lambda: simulator.fly_alone(flights, midpoint, Search.GREEDY))
    if not astar.accepted:
        raise NothingToStudy(f"buildings part the ends of all {len(flights)} flights of the paper's scenario")
    greedy = _timed(design.timings, lambda: simulator.fly(flights, midpoint, Search.GREEDY))
    safe_interval_alone = _timed(design.timings, lambda: simulator.fly_alone(flights, midpoint, Search.SAFE_INTERVAL))
    safe_interval = _timed(design.timings, lambda: simulator.fly(flights, midpoint, Search.SAFE_INTERVAL))
    containment = _timed(
        design.timings, lambda: simulator.fly(flights, OccupancyRule.CONTAINMENT, Search.SAFE_INTERVAL)
    )
    without_traffic_s = _passes(design.timings, lambda: simulator.time_without_traffic(flights, midpoint))
    verdict = simulator.judge(greedy)
    airspace = simulator.airspaces[midpoint]
    return Reference(
        astar=astar,
        greedy=greedy,
        safe_interval_alone=safe_interval_alone,
        safe_interval=safe_interval,
        containment=containment,
        without_traffic_s=np.median(without_traffic_s, axis=0),
        conflicts=_conflicts(astar),
        whole_second_conflicts=_conflicts(astar, in_whole_seconds=True),
        conflicts_left=int(conflicts_added(greedy.accepted).sum()),
        comparisons=tuple(
            cases.compare(airspace.grid, number, alone, among)
            for number, (alone, among) in enumerate(zip(astar.plans, greedy.plans, strict=True))
            if alone is not None and among is not None
        ),
        greedy_verdict=verdict,
        containment_verdict=simulator.judge(containment),
        near_misses=near_misses(greedy, verdict, airspace),
        corner_cuts=corner_cuts(airspace, greedy.accepted),
        in_use_s=seconds_in_use(greedy.accepted, airspace.grid.block_count),
    )


def _conflicts(run: Run, *, in_whole_seconds: bool = False) -> IntArray:
    """Return what each flight of a run adds to the conflict metric, nothing where it was refused: (flights,)."""
    added = np.zeros(len(run.plans), dtype=np.int64)
    planned = [plan is not None for plan in run.plans]
    added[planned] = conflicts_added(run.accepted, in_whole_seconds=in_whole_seconds)
    return added


def near_misses(run: Run, verdict: Verdict, airspace: Airspace) -> tuple[NearMiss, ...]:
    """Return when and how near each pair that came too near was, the least separated first."""
    found = []
    for pair in verdict.too_near:
        first, second = (run.plans[number] for number in pair)
        if first is not None and second is not None and (met := encounter(airspace.grid, first, second)) is not None:
            found.append(NearMiss(pair, met))
    return tuple(sorted(found, key=lambda miss: (miss.encounter.separation, miss.flights)))


def simulate_trial(simulator: Simulator, flights: int, window_min: int, seed: int) -> Trial:
    """Simulate one seed's traffic within one window."""
    drawn = simulator.flights(Demand(Od.UNIFORM, flights, window_min, seed))
    midpoint = OccupancyRule.MIDPOINT
    astar = simulator.fly_alone(drawn, midpoint, Search.GREEDY)
    greedy = simulator.fly(drawn, midpoint, Search.GREEDY)
    containment = simulator.fly(drawn, OccupancyRule.CONTAINMENT, Search.SAFE_INTERVAL)
    verdict, containment_verdict = simulator.judge(greedy), simulator.judge(containment)
    return Trial(
        window_min=window_min,
        seed=seed,
        conflicts=int(_conflicts(astar).sum()),
        whole_second_conflicts=int(_conflicts(astar, in_whole_seconds=True).sum()),
        delay_s=_sum(greedy.delay_s),
        refused=greedy.refused.total(),
        too_near=len(verdict.too_near),
        corner_cuts=corner_cuts(simulator.airspaces[midpoint], greedy.accepted),
        containment_delay_s=_sum(containment.delay_s),
        containment_refused=containment.refused.total(),
        containment_too_near=len(containment_verdict.too_near),
        violations=verdict.violations + containment_verdict.violations,
    )


def use_by_type(simulator: Simulator, flights: Iterable[Flight]) -> tuple[UseByType, ...]:
    """Simulate the same flights with one type of aircraft each: the paper's three, then the other shipped ones."""
    flights = tuple(flights)
    uses = []
    for id_ in _types_compared():
        run = simulator.fly(
            [replace(flight, aircraft=id_) for flight in flights], OccupancyRule.MIDPOINT, Search.GREEDY
        )
        in_use_s = seconds_in_use(run.accepted, simulator.airspaces[run.rule].grid.block_count)
        uses.append(UseByType(simulator.types[id_], run.refused.total(), in_use_s))
    return tuple(uses)


def altitude_balance(simulator: Simulator, unbalanced: Run) -> tuple[Balance, ...]:
    """Simulate the flights of a run again with each weight; the run itself is the one of weight 0 and comes first."""
    grid = simulator.airspaces[unbalanced.rule].grid
    runs = {0: unbalanced} | {
        weight_ms: simulator.fly_balanced(unbalanced.flights, unbalanced.rule, weight_ms)
        for weight_ms in altitude.WEIGHTS_MS
    }
    return tuple(
        Balance(weight_ms, run, seconds_in_use(run.accepted, grid.block_count), simulator.judge(run))
        for weight_ms, run in runs.items()
    )


def trade(simulator: Simulator, demand: Demand, rule: OccupancyRule, search: Search) -> Trade:
    """Simulate one demand under one rule and search."""
    run = simulator.fly(simulator.flights(demand), rule, search)
    return Trade(
        od=demand.od,
        flights=demand.flights,
        rule=rule,
        search=search,
        accepted=len(run.accepted),
        refused=run.refused,
        delay_s=_sum(run.delay_s),
        longest_delay_s=float(np.nanmax(run.delay_s)) if run.accepted else 0.0,
        computing_s=float(run.seconds.sum()),
        expansions=run.expansions,
        verdict=simulator.judge(run),
    )


def _types_compared() -> tuple[str, ...]:
    others = [aircraft.id for aircraft in shipped_aircraft_types() if aircraft.id not in paper.USE_BY_TYPE]
    return (*paper.USE_BY_TYPE, *others)


def _timed(passes: int, fly: Callable[[], Run]) -> Run:
    """Return a run with each flight's median time of several passes."""
    runs = _passes(passes, fly)
    return replace(runs[0], seconds=np.median([run.seconds for run in runs], axis=0))


def _passes(passes: int, measure: Callable[[], T]) -> list[T]:
    """Measure several times, after a first time that does not count."""
    measure()
    return [measure() for _ in range(passes)]


def _sum(seconds: FloatArray) -> float:
    return float(np.nansum(seconds))
