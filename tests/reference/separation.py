"""Slow, plain twins of the independent checker: every pair, every instant that matters, every millisecond.

Nothing here is vectorised, bucketed or searched: a flight is looked up where it is at one time, and all pairs of
flights, and all milliseconds of small times, are gone through.
"""

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from planner.airmatrix import AirMatrix
from planner.airspace import Airspace, OccupancyRule
from planner.separation import CheckedFlight

TOLERANCE_M = 1e-6


class Apart(NamedTuple):
    """How far two flights are apart at one instant, in metres."""

    horizontal_m: float
    vertical_m: float


class Moment(NamedTuple):
    """A pair of flights (numbers), apart by so much."""

    pair: tuple[int, int]
    apart: Apart


class _Stage(NamedTuple):
    """A stand or a link of one flight: from place to place (metres) in a closed span of time (ms)."""

    start_ms: int
    end_ms: int
    start: tuple[float, ...]
    end: tuple[float, ...]

    def at(self, time_ms: float) -> tuple[float, ...]:
        lasted = self.end_ms - self.start_ms
        share = (time_ms - self.start_ms) / lasted if lasted else 0.0
        return tuple(a + (b - a) * share for a, b in zip(self.start, self.end, strict=True))


def apart_at(grid: AirMatrix, one: CheckedFlight, other: CheckedFlight, time_ms: float) -> Apart:
    """Return how far two flights are apart at a time at which both are in the air."""
    places = [
        next(stage.at(time_ms) for stage in _stages(grid, flight) if stage.start_ms <= time_ms <= stage.end_ms)
        for flight in (one, other)
    ]
    return _apart(*places)


def nearest_level(grid: AirMatrix, flights: Sequence[CheckedFlight]) -> list[Moment]:
    """Return, for each pair that comes within a block height, its horizontally nearest moment meanwhile."""
    limit = grid.block_height_m - TOLERANCE_M
    return [
        Moment(pair, min(level, key=lambda apart: apart.horizontal_m))
        for pair, moments in _moments(grid, flights)
        if (level := [apart for apart in moments if apart.vertical_m <= limit + 1e-9])
    ]


def nearest_beside(grid: AirMatrix, flights: Sequence[CheckedFlight]) -> list[Moment]:
    """Return, for each pair that comes within a block side, its vertically nearest moment meanwhile."""
    limit = grid.block_side_m - TOLERANCE_M
    return [
        Moment(pair, min(beside, key=lambda apart: apart.vertical_m))
        for pair, moments in _moments(grid, flights)
        if (beside := [apart for apart in moments if apart.horizontal_m <= limit + 1e-9])
    ]


def _moments(grid: AirMatrix, flights: Sequence[CheckedFlight]) -> Iterator[tuple[tuple[int, int], list[Apart]]]:
    stages = [list(_stages(grid, flight)) for flight in flights]
    for pair in itertools.combinations(range(len(flights)), 2):
        together = itertools.product(*(stages[number] for number in pair))
        yield pair, [apart for one, other in together for apart in _instants_that_matter(grid, one, other)]


def _stages(grid: AirMatrix, flight: CheckedFlight) -> Iterator[_Stage]:
    i, j, k = grid.ijk(flight.block).T.tolist()
    side, height = grid.block_side_m, grid.block_height_m
    centres = [((a + 0.5) * side, (b + 0.5) * side, (c + 0.5) * height) for a, b, c in zip(i, j, k, strict=True)]
    arrive, depart = flight.arrive_ms.tolist(), flight.depart_ms.tolist()
    for stop, centre in enumerate(centres):
        yield _Stage(arrive[stop], depart[stop], centre, centre)
        if stop + 1 < len(centres):
            yield _Stage(depart[stop], arrive[stop + 1], centre, centres[stop + 1])


def _instants_that_matter(grid: AirMatrix, one: _Stage, other: _Stage) -> Iterator[Apart]:
    """Yield the distances at all instants at which a nearest moment can be: ends, turns and limits."""
    begin, end = max(one.start_ms, other.start_ms), min(one.end_ms, other.end_ms)
    if begin > end:
        return
    first = [a - b for a, b in zip(one.at(begin), other.at(begin), strict=True)]
    last = [a - b for a, b in zip(one.at(end), other.at(end), strict=True)]
    way = [b - a for a, b in zip(first, last, strict=True)]
    shares = [0.0, 1.0]
    for axes, limit in (((0, 1), grid.block_side_m), ((2,), grid.block_height_m)):
        square = sum(way[axis] ** 2 for axis in axes)
        if square < 1e-18:
            continue
        turn = -sum(first[axis] * way[axis] for axis in axes) / square
        nearest_square = sum((first[axis] + turn * way[axis]) ** 2 for axis in axes)
        shares.append(turn)
        if nearest_square <= (limit - TOLERANCE_M) ** 2:
            reach = math.sqrt(((limit - TOLERANCE_M) ** 2 - nearest_square) / square)
            shares += [turn - reach, turn + reach]
    for share in shares:
        if 0 <= share <= 1:
            yield _apart([a + share * w for a, w in zip(first, way, strict=True)], [0.0, 0.0, 0.0])


def _apart(one: Sequence[float], other: Sequence[float]) -> Apart:
    return Apart(math.hypot(one[0] - other[0], one[1] - other[1]), abs(one[2] - other[2]))


def blocks_needed(airspace: Airspace, flight: CheckedFlight) -> set[tuple[int, int]]:
    """Return every (block, ms) that a flight must hold by the airspace's rule, in what is held of it."""
    grid = airspace.grid
    blocks = [grid.block(block) for block in flight.block.tolist()]
    arrive, depart = flight.arrive_ms.tolist(), flight.depart_ms.tolist()
    needed = {(block, time) for block, a, d in zip(blocks, arrive, depart, strict=True) for time in range(a, d + 1)}
    for stop, (near, far) in enumerate(itertools.pairwise(blocks)):
        start, end = depart[stop], arrive[stop + 1]
        for time in range(start, end + 1):
            if airspace.rule is OccupancyRule.CONTAINMENT:
                box = itertools.product(*({a, b} for a, b in zip(near, far, strict=True)))
                needed |= {((i, j, k), time) for i, j, k in box}
            else:
                # Within the ms that begins at `time` the flight is before its midpoint, at it, or after it.
                needed |= {(near, time)} if 2 * time <= start + end else set()
                needed |= {(far, time)} if 2 * (time + 1) > start + end else set()
    first, last = flight.held or (-math.inf, math.inf)
    return {(grid.index(block), time) for block, time in needed if first <= time <= last}


def blocks_held(flight: CheckedFlight) -> Counter[tuple[int, int]]:
    """Count the reservations of a flight for every (block, ms)."""
    reservations: Iterable[tuple[int, int, int]] = zip(
        flight.hold_block.tolist(), flight.hold_enter_ms.tolist(), flight.hold_exit_ms.tolist(), strict=True
    )
    return Counter((block, time) for block, enter, leave in reservations for time in range(enter, leave))
