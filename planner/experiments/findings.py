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
from planner.experiments.study import Reference, Run, Trade, Trial, UseByType

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
    """How the computing time of CFA* grows with the flights already planned."""

    extra_a_flight_s: float
    first_third_s: float
    last_third_s: float


def growth(reference: Reference) -> Growth:
    """Compare greedy CFA* with A*, and its first third of flights with its last."""
    seconds = reference.greedy.seconds
    third = max(len(seconds) // 3, 1)
    extra = float(seconds.sum() - reference.astar.seconds.sum()) / len(seconds)
    return Growth(extra, float(seconds[:third].mean()), float(seconds[-third:].mean()))


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
