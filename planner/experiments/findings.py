"""What the report says in words and tables, each derived from the study and true of any airspace."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from planner.aircraft import GRAVITY_MPS2, AircraftType
from planner.airmatrix import AirMatrix, FloatArray, IntArray
from planner.airspace import Airspace
from planner.experiments import paper
from planner.experiments.block_sizing import (
    PAPER_TABLE_1,
    BlockCheck,
    BlockSize,
    ErrorStatistics,
    Finding,
    check_block,
    size_block,
)
from planner.experiments.cases import Case, Comparison
from planner.experiments.simulation import Run
from planner.experiments.study import Balance, Reference, Trade, Trial, UseByType
from planner.path import Plan

# Printed speeds have three decimals, drag constants three digits.
_PRINTED_ALIKE_MPS = 0.0025


@dataclass(frozen=True)
class Sizing:
    """The paper's block against its own table 1, row by row, and the block that this table asks for."""

    rows: tuple[tuple[ErrorStatistics, Finding], ...]
    check: BlockCheck
    needed: BlockSize


def sizing() -> Sizing:
    """Size a block from the paper's navigation errors, in whole metres."""
    table = PAPER_TABLE_1
    check = check_block(table, paper.BLOCK_SIDE_M, paper.BLOCK_HEIGHT_M)
    return Sizing(
        tuple(zip((table.east, table.north, table.horizontal, table.vertical), check.findings, strict=True)),
        check,
        size_block(table.east.percentiles, table.north.percentiles, table.vertical.percentiles),
    )


@dataclass(frozen=True)
class Speed:
    """A full-power speed in m/s along a link of some elevation: printed, by the equations, and without drag there."""

    elevation_deg: float
    printed: float | None
    solved: float
    without_drag: float

    @property
    def agrees(self) -> bool:
        """Tell whether the equations give what is printed."""
        return self.printed is not None and abs(self.solved - self.printed) <= _PRINTED_ALIKE_MPS

    @property
    def lacks_drag(self) -> bool:
        """Tell whether the printed speed is what comes out without drag along the link."""
        return self.printed is not None and abs(self.without_drag - self.printed) <= _PRINTED_ALIKE_MPS

    @property
    def difference(self) -> float:
        """The printed speed's relative excess over the equations'."""
        return 0.0 if self.printed is None else self.printed / self.solved - 1


@dataclass(frozen=True)
class Performance:
    """An aircraft in the paper's blocks: its speeds along the steeper (α) and the flatter (β) tilted link."""

    aircraft: AircraftType
    steeper: Speed
    flatter: Speed

    @property
    def is_printed(self) -> bool:
        """Tell whether the paper prints these speeds."""
        return self.steeper.printed is not None

    @property
    def agrees(self) -> bool:
        """Tell whether both printed speeds are the equations'."""
        return self.steeper.agrees and self.flatter.agrees

    @property
    def lacks_drag(self) -> bool:
        """Tell whether both printed speeds leave out the drag along the link."""
        return self.steeper.lacks_drag and self.flatter.lacks_drag


def speed_at(aircraft: AircraftType, elevation_deg: float, printed: float | None) -> Speed:
    """Compare a printed speed with the speed model's."""
    elevation = math.radians(elevation_deg)
    weight = aircraft.mass_kg * GRAVITY_MPS2 * math.sin(elevation)
    return Speed(elevation_deg, printed, aircraft.full_power_speed(elevation), aircraft.max_power_w / weight)


def performance_of(aircraft: AircraftType) -> Performance:
    """Compare an aircraft with its row of the paper's table."""
    printed = paper.SPEEDS.get(aircraft.id)
    steeper, flatter = (None, None) if printed is None else (printed.steeper, printed.flatter)
    alpha_deg, beta_deg = paper.elevations_deg()
    return Performance(aircraft, speed_at(aircraft, alpha_deg, steeper), speed_at(aircraft, beta_deg, flatter))


@dataclass(frozen=True)
class Growth:
    """How the computing time of greedy CFA* compares with that of A*, and grows with the flights already planned.

    `ratio_beyond` compares what both take beyond the search without traffic; None where that is too short to tell.
    """

    ratio: float
    ratio_beyond: float | None
    extra_a_flight_s: float
    first_third_s: float
    last_third_s: float


def growth(reference: Reference) -> Growth:
    """Compare greedy CFA* with A*, and its first third of flights with its last."""
    seconds = reference.greedy.seconds
    third = max(len(seconds) // 3, 1)
    greedy, astar, shared = (
        float(times.sum()) for times in (seconds, reference.astar.seconds, reference.without_traffic_s)
    )
    return Growth(
        ratio=greedy / astar,
        ratio_beyond=(greedy - shared) / (astar - shared) if min(greedy, astar) > shared else None,
        extra_a_flight_s=(greedy - astar) / len(seconds),
        first_third_s=float(seconds[:third].mean()),
        last_third_s=float(seconds[-third:].mean()),
    )


@dataclass(frozen=True)
class Delay:
    """The delays of a run in seconds, over the flights that were not refused; `longest_flight_s` is in the air."""

    total_s: float
    mean_s: float
    longest_s: float
    flights: int
    longest_flight_s: float


def delay_of(run: Run) -> Delay:
    """Sum up the delays of a run."""
    delays = [plan.delay_ms / 1000 for plan in run.accepted]
    return Delay(
        total_s=sum(delays),
        mean_s=sum(delays) / max(len(delays), 1),
        longest_s=max(delays, default=0.0),
        flights=sum(delay > 0 for delay in delays),
        longest_flight_s=max((plan.flight_time_ms / 1000 for plan in run.accepted), default=0.0),
    )


def case_counts(comparisons: Sequence[Comparison]) -> dict[Case, int]:
    """Count the flights of each case."""
    return {case: sum(comparison.case is case for comparison in comparisons) for case in Case}


def second_half(added: FloatArray | IntArray) -> float | None:
    """Return the share of a total that the second half of the flights adds, None of nothing; NaN counts as 0."""
    total = float(np.nansum(added))
    return float(np.nansum(added[len(added) // 2 :])) / total if total > 0 else None


@dataclass(frozen=True)
class Spread:
    """Quartiles of a measure over seeds."""

    low: float
    median: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread":
        """Return the quartiles of at least one value."""
        return cls(*(float(value) for value in np.percentile(values, [25, 50, 75])))


@dataclass(frozen=True)
class Trend:
    """How a measure changes with density, windows from the longest to the shortest.

    `wavering` of the `seeds` have a step to a denser window on which the measure falls. `inversion` is how often the
    denser of the paper's two inverted windows has the smaller value when both are drawn independently; None where the
    windows were not simulated.
    """

    windows_min: tuple[int, ...]
    spreads: tuple[Spread, ...]
    seeds: int
    wavering: int
    inversion: float | None

    @property
    def rises(self) -> bool:
        """Tell whether the medians never fall as density rises."""
        medians = [spread.median for spread in self.spreads]
        return all(sparse <= dense for sparse, dense in pairwise(medians))

    @property
    def factor(self) -> float | None:
        """The median in the densest window by that in the sparsest; None for none."""
        return self.spreads[-1].median / self.spreads[0].median if self.spreads[0].median > 0 else None


def trend(trials: Sequence[Trial], measure: Callable[[Trial], float]) -> Trend:
    """Return how a measure changes with density."""
    windows = sorted({trial.window_min for trial in trials}, reverse=True)
    values = np.array(
        [
            [measure(trial) for trial in sorted(trials, key=lambda one: one.seed) if trial.window_min == window]
            for window in windows
        ],
        dtype=np.float64,
    )
    inversion = None
    if set(paper.INVERTED_WINDOWS_MIN) <= set(windows):
        dense, sparse = (values[windows.index(window)] for window in paper.INVERTED_WINDOWS_MIN)
        inversion = float((dense[:, None] < sparse[None]).mean())
    return Trend(
        windows_min=tuple(windows),
        spreads=tuple(Spread.of(row.tolist()) for row in values),
        seeds=values.shape[1],
        wavering=int((np.diff(values, axis=0) < 0).any(axis=0).sum()),
        inversion=inversion,
    )


@dataclass(frozen=True)
class LayerUse:
    """A layer's free blocks, the ends of flights in it, and for how long its blocks are held."""

    layer: int
    floor_m: float
    ceiling_m: float
    free: int
    end_share: float
    in_use_s: float
    share: float

    @property
    def seconds_a_block(self) -> float:
        """Seconds for which a free block is held."""
        return self.in_use_s / self.free if self.free else 0.0


def layer_uses(airspace: Airspace, reference: Reference) -> tuple[LayerUse, ...]:
    """Return the use of each layer by greedy CFA*, the lowest first."""
    grid = airspace.grid
    layers = grid.dimensions[2]
    free = (~airspace.occupied).reshape(layers, -1).sum(axis=1)
    in_use_s = reference.in_use_s.reshape(layers, -1).sum(axis=1)
    ends = np.array([end for flight in reference.greedy.flights for end in (flight.origin, flight.destination)])
    end_counts = np.bincount(grid.ijk(ends)[:, 2], minlength=layers)
    total = max(float(in_use_s.sum()), 1e-9)
    return tuple(
        LayerUse(
            layer=layer,
            floor_m=layer * grid.block_height_m,
            ceiling_m=(layer + 1) * grid.block_height_m,
            free=int(free[layer]),
            end_share=float(end_counts[layer]) / len(ends),
            in_use_s=float(in_use_s[layer]),
            share=float(in_use_s[layer]) / total,
        )
        for layer in range(layers)
    )


def share_above_lowest(grid: AirMatrix, use: UseByType) -> float:
    """Return the share of the time for which blocks above the lowest layer are held, by one type of aircraft."""
    by_layer = use.in_use_s.reshape(grid.dimensions[2], -1).sum(axis=1)
    total = float(by_layer.sum())
    return float(by_layer[1:].sum()) / total if total > 0 else 0.0


def falls_with_ratio(grid: AirMatrix, uses: Sequence[UseByType]) -> bool:
    """Tell whether the use above the lowest layer never grows with the ratio of horizontal to vertical speed."""
    shares = [share_above_lowest(grid, use) for use in sorted(uses, key=lambda use: use.speed_ratio)]
    return all(before >= after for before, after in pairwise(shares))


@dataclass(frozen=True)
class AltitudeUse:
    """How evenly the layers are used at one weight of surcharges, and what that costs.

    `shares` (layers,) are of the time for which blocks are held. Crowding is that time for each free block; `peak` is
    the most crowded layer's, divided by that of all layers together: 1 for even use. Times in seconds and `climb_m` are
    means over the flights that every weight lets fly; `price_s` is flight time (departure to arrival) beyond that at
    weight 0, `waiting_s` is on the ground or hovering.
    """

    weight_ms: int
    shares: tuple[float, ...]
    peak: float
    flight_time_s: float
    price_s: float
    delay_s: float
    waiting_s: float
    climb_m: float
    refused: int
    too_near: int
    computing_s: float


def altitude_uses(airspace: Airspace, balances: Sequence[Balance]) -> tuple[AltitudeUse, ...]:
    """Sum up the use of the layers at each weight, the first of which is 0."""
    grid = airspace.grid
    layers = grid.dimensions[2]
    free = (~airspace.occupied).reshape(layers, -1).sum(axis=1)
    flown = [
        number
        for number, plans in enumerate(zip(*(balance.run.plans for balance in balances), strict=True))
        if None not in plans
    ]

    def mean(balance: Balance, measure: Callable[[Plan], float]) -> float:
        plans = (balance.run.plans[number] for number in flown)
        return sum(measure(plan) for plan in plans if plan is not None) / max(len(flown), 1)

    def flight_time_s(plan: Plan) -> float:
        return plan.flight_time_ms / 1000

    def climb_m(plan: Plan) -> float:
        return float(np.maximum(np.diff(grid.ijk(plan.block)[:, 2]), 0).sum()) * grid.block_height_m

    uses = []
    for balance in balances:
        held_s = balance.in_use_s.reshape(layers, -1).sum(axis=1)
        total_s = max(float(held_s.sum()), 1e-9)
        uses.append(
            AltitudeUse(
                weight_ms=balance.weight_ms,
                shares=tuple((held_s / total_s).tolist()),
                peak=float((held_s / np.maximum(free, 1)).max()) * int(free.sum()) / total_s,
                flight_time_s=mean(balance, flight_time_s),
                price_s=mean(balance, flight_time_s) - mean(balances[0], flight_time_s),
                delay_s=mean(balance, lambda plan: plan.delay_ms / 1000),
                waiting_s=mean(balance, lambda plan: (plan.ground_hold_ms + plan.hover_ms) / 1000),
                climb_m=mean(balance, climb_m),
                refused=balance.run.refused.total(),
                too_near=len(balance.verdict.too_near),
                computing_s=float(balance.run.seconds.sum()),
            )
        )
    return tuple(uses)


@dataclass(frozen=True)
class SearchesCompared:
    """Greedy against safe-interval over all sizes, rules and generators: refusals, and whose delay sum is smaller.

    Sums count where neither search refused a flight.
    """

    configurations: int
    greedy_refused: int
    safe_interval_refused: int
    comparable: int
    safe_interval_smaller: int
    equal: int
    slowdown: float


def compare_searches(trades: Sequence[Trade]) -> SearchesCompared:
    """Sum up what the two searches come to; the trades of each configuration are greedy, then safe-interval."""
    pairs = list(zip(trades[::2], trades[1::2], strict=True))
    comparable = [(greedy, safe) for greedy, safe in pairs if greedy.accepted == safe.accepted == greedy.flights]
    return SearchesCompared(
        configurations=len(pairs),
        greedy_refused=sum(greedy.flights - greedy.accepted for greedy, _ in pairs),
        safe_interval_refused=sum(safe.flights - safe.accepted for _, safe in pairs),
        comparable=len(comparable),
        safe_interval_smaller=sum(safe.delay_s < greedy.delay_s for greedy, safe in comparable),
        equal=sum(safe.delay_s == greedy.delay_s for greedy, safe in comparable),
        slowdown=sum(safe.computing_s for _, safe in pairs) / sum(greedy.computing_s for greedy, _ in pairs),
    )


@dataclass(frozen=True)
class PriceOfContainment:
    """What containment costs a flight over the midpoint rule, both by safe-interval: seconds, mean over flights."""

    longer_way_s: float
    midpoint_delay_s: float
    containment_delay_s: float


def price_of_containment(reference: Reference) -> PriceOfContainment | None:
    """Compare the flights that both rules let fly; None if there is none."""
    both = ~(np.isnan(reference.safe_interval.delay_s) | np.isnan(reference.containment.delay_s))
    if not both.any():
        return None
    longer = reference.containment.unconstrained_s - reference.safe_interval.unconstrained_s
    return PriceOfContainment(
        float(longer[both].mean()),
        float(reference.safe_interval.delay_s[both].mean()),
        float(reference.containment.delay_s[both].mean()),
    )
