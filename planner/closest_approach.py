"""The closest approach of every pair of flights, exactly, without comparing all pairs.

Within a leg a flight stands or moves at constant velocity, so the offset between two flights is linear in
time while both are in one leg each. The instants that matter then have closed forms: when the vertical
distance is within a limit, when the horizontal distance is, and when the offset is shortest in such a window.
Nothing is sampled.

Legs are compared only where they can be near: those that share a bucket of time and lie within a search
radius, found by hashing their midpoints into square cells. The radius grows until what was found is provably
nearest: a distance up to the radius cannot be undercut by a pair further apart.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from planner.airmatrix import AirMatrix, FloatArray, IntArray
from planner.airspace import BoolArray
from planner.errors import Block

TOLERANCE_M = 1e-6

# Pairs of legs evaluated at once: bounds memory.
_CHUNK = 250_000

_HORIZONTAL, _VERTICAL = slice(0, 2), slice(2, 3)


@dataclass(frozen=True, eq=False)
class Legs:
    """The judged legs of all flights, n in all; `flight` numbers index `ids`.

    A leg lasts from `start_ms` to `end_ms`, both included: (n,). It begins at `position_m` (n, 3), in metres
    east and north of the grid's corner and above ground, and moves by `velocity` (n, 3), in metres per
    millisecond. It belongs to the link, or the stand, from `first_block` to `last_block` (n,), of which it is
    the `whole` (n,) unless a part of the flight was released.
    """

    ids: tuple[str, ...]
    flight: IntArray
    start_ms: IntArray
    end_ms: IntArray
    position_m: FloatArray
    velocity: FloatArray
    first_block: IntArray
    last_block: IntArray
    whole: BoolArray

    def __len__(self) -> int:
        return len(self.flight)

    @property
    def end_position_m(self) -> FloatArray:
        """Positions at `end_ms`: (n, 3)."""
        return self.position_m + self.velocity * (self.end_ms - self.start_ms)[:, None]


@dataclass(frozen=True)
class Approach:
    """Two flights at the instant that matters, to the nearest ms; the first one's leg begins in `block`."""

    flights: tuple[str, str]
    block: Block
    time_ms: int
    horizontal_m: float
    vertical_m: float


@dataclass(frozen=True)
class Approaches:
    """What the pairs of flights came to.

    `horizontal` is nearest horizontally while within a block height, `vertical` is nearest vertically while
    within a block side; None where no pair ever was. `too_near` holds, for each pair of flights that was
    within both at one instant, the horizontally nearest such instant. `leg_pairs` were evaluated.
    """

    horizontal: Approach | None
    vertical: Approach | None
    too_near: tuple[Approach, ...]
    leg_pairs: int


@dataclass(frozen=True, eq=False)
class _Encounters:
    """Pairs of legs at one instant each, all arrays (n,): `first` and `second` are leg numbers."""

    first: IntArray
    second: IntArray
    time_ms: IntArray
    horizontal_m: FloatArray
    vertical_m: FloatArray

    def take(self, chosen: IntArray) -> "_Encounters":
        return _Encounters(
            self.first[chosen],
            self.second[chosen],
            self.time_ms[chosen],
            self.horizontal_m[chosen],
            self.vertical_m[chosen],
        )

    @staticmethod
    def join(parts: "list[_Encounters]") -> "_Encounters":
        return _Encounters(
            np.concatenate([part.first for part in parts]),
            np.concatenate([part.second for part in parts]),
            np.concatenate([part.time_ms for part in parts]),
            np.concatenate([part.horizontal_m for part in parts]),
            np.concatenate([part.vertical_m for part in parts]),
        )


def closest_approaches(grid: AirMatrix, legs: Legs, on_progress: Callable[[float], None]) -> Approaches:
    """Return the closest approaches of legs of different flights.

    Flights are too near when nearer than a block's side horizontally and its height vertically, by more
    than `TOLERANCE_M`. `on_progress` is called with the fraction done; it starts again when the search
    radius grows.
    """
    if not len(legs):
        return Approaches(None, None, (), 0)
    everywhere = float(np.linalg.norm(np.ptp(_midpoints(legs), axis=0))) + _longest(legs)
    radius = 1.25 * grid.block_side_m
    while True:
        approaches = _search(grid, legs, radius, on_progress)
        found = approaches.horizontal
        if radius >= everywhere or (found and found.horizontal_m <= radius):
            return approaches
        radius = found.horizontal_m * (1 + 1e-9) if found else 2 * radius


def _search(grid: AirMatrix, legs: Legs, radius: float, on_progress: Callable[[float], None]) -> Approaches:
    side_m, height_m = grid.block_side_m - TOLERANCE_M, grid.block_height_m - TOLERANCE_M
    nearest_level: list[_Encounters] = []
    nearest_beside: list[_Encounters] = []
    too_near: list[_Encounters] = []
    leg_pairs = 0
    for first, second, done in _neighbours(legs, radius):
        leg_pairs += len(first)
        motion = _relative_motion(legs, first, second)
        level = _nearest_while(motion, within=_VERTICAL, limit_m=height_m, nearest=_HORIZONTAL)
        beside = _nearest_while(motion, within=_HORIZONTAL, limit_m=side_m, nearest=_VERTICAL)
        nearest_level.append(level.take(_order(level, level.horizontal_m)[:1]))
        nearest_beside.append(beside.take(_order(beside, beside.vertical_m)[:1]))
        too_near.append(level.take(np.flatnonzero(level.horizontal_m < side_m)))
        on_progress(done)
    level, beside = _Encounters.join(nearest_level), _Encounters.join(nearest_beside)
    return Approaches(
        horizontal=_first(grid, legs, level, _order(level, level.horizontal_m)),
        vertical=_first(grid, legs, beside, _order(beside, beside.vertical_m)),
        too_near=_one_per_pair(grid, legs, _Encounters.join(too_near)),
        leg_pairs=leg_pairs,
    )


def _order(encounters: _Encounters, distance_m: FloatArray) -> IntArray:
    """Return the numbers of encounters, nearest first, then earliest."""
    return np.lexsort((encounters.time_ms, distance_m))


def _first(grid: AirMatrix, legs: Legs, encounters: _Encounters, order: IntArray) -> Approach | None:
    return _approach(grid, legs, encounters, order[0]) if order.size else None


def _one_per_pair(grid: AirMatrix, legs: Legs, encounters: _Encounters) -> tuple[Approach, ...]:
    """Keep the nearest encounter of each pair of flights, nearest pairs first."""
    encounters = encounters.take(_order(encounters, encounters.horizontal_m))
    flights = np.sort(np.stack([legs.flight[encounters.first], legs.flight[encounters.second]]), axis=0)
    _, nearest = np.unique(flights[0] * len(legs.ids) + flights[1], return_index=True)
    return tuple(_approach(grid, legs, encounters, number) for number in np.sort(nearest))


def _approach(grid: AirMatrix, legs: Legs, encounters: _Encounters, number: int) -> Approach:
    first, second = sorted((encounters.first[number], encounters.second[number]), key=lambda leg: int(legs.flight[leg]))
    return Approach(
        flights=(legs.ids[legs.flight[first]], legs.ids[legs.flight[second]]),
        block=grid.block(legs.first_block[first]),
        time_ms=int(encounters.time_ms[number]),
        horizontal_m=float(encounters.horizontal_m[number]),
        vertical_m=float(encounters.vertical_m[number]),
    )


# The closed forms.


@dataclass(frozen=True, eq=False)
class _Motion:
    """Relative motion of n pairs of legs: `offset` + `drift` t, for `span_ms` from `begin_ms` on."""

    first: IntArray
    second: IntArray
    begin_ms: IntArray
    span_ms: FloatArray
    offset: FloatArray
    drift: FloatArray


def _relative_motion(legs: Legs, first: IntArray, second: IntArray) -> _Motion:
    begin_ms = np.maximum(legs.start_ms[first], legs.start_ms[second])
    return _Motion(
        first=first,
        second=second,
        begin_ms=begin_ms,
        span_ms=(np.minimum(legs.end_ms[first], legs.end_ms[second]) - begin_ms).astype(np.float64),
        offset=_position(legs, first, begin_ms) - _position(legs, second, begin_ms),
        drift=legs.velocity[first] - legs.velocity[second],
    )


def _position(legs: Legs, chosen: IntArray, time_ms: IntArray) -> FloatArray:
    return legs.position_m[chosen] + legs.velocity[chosen] * (time_ms - legs.start_ms[chosen])[:, None]


def _nearest_while(motion: _Motion, within: slice, limit_m: float, nearest: slice) -> _Encounters:
    """Return the pairs that come within a limit along some axes, when nearest along the others meanwhile."""
    enter, leave = _window_within(motion.offset[:, within], motion.drift[:, within], motion.span_ms, limit_m)
    ever = np.flatnonzero(enter <= leave)
    offset, drift = motion.offset[ever], motion.drift[ever]
    moment = _moment_of_nearest(offset[:, nearest], drift[:, nearest], enter[ever], leave[ever])
    apart = offset + drift * moment[:, None]
    return _Encounters(
        first=motion.first[ever],
        second=motion.second[ever],
        time_ms=motion.begin_ms[ever] + np.rint(moment).astype(np.int64),
        horizontal_m=np.hypot(apart[:, 0], apart[:, 1]),
        vertical_m=np.abs(apart[:, 2]),
    )


def _window_within(
    offset: FloatArray, drift: FloatArray, span_ms: FloatArray, limit_m: float
) -> tuple[FloatArray, FloatArray]:
    """Return from when to when |offset + drift t| <= limit within [0, span], each (n,); from > to: never.

    The roots of (drift·drift) t² + 2 (offset·drift) t + offset·offset - limit² = 0.
    """
    square, half_linear = (drift * drift).sum(axis=1), (offset * drift).sum(axis=1)
    constant = (offset * offset).sum(axis=1) - limit_m**2
    moving = square > 0
    discriminant = half_linear**2 - square * constant
    root = np.sqrt(np.maximum(discriminant, 0))
    enter = np.divide(-half_linear - root, square, out=np.zeros_like(square), where=moving)
    leave = np.divide(-half_linear + root, square, out=span_ms.copy(), where=moving)
    never = np.where(moving, discriminant < 0, constant > 0)
    return np.where(never, 1.0, np.maximum(enter, 0)), np.where(never, 0.0, np.minimum(leave, span_ms))


def _moment_of_nearest(offset: FloatArray, drift: FloatArray, enter: FloatArray, leave: FloatArray) -> FloatArray:
    """Return when |offset + drift t| is least within [enter, leave]: (n,) ms."""
    square = (drift * drift).sum(axis=1)
    turn = np.divide(-(offset * drift).sum(axis=1), square, out=enter.copy(), where=square > 0)
    moment: FloatArray = np.clip(turn, enter, leave)
    return moment


# Which legs to compare.


def _midpoints(legs: Legs) -> FloatArray:
    return (legs.position_m[:, :2] + legs.end_position_m[:, :2]) / 2


def _lengths(legs: Legs) -> FloatArray:
    span = legs.end_position_m[:, :2] - legs.position_m[:, :2]
    return np.hypot(span[:, 0], span[:, 1])


def _longest(legs: Legs) -> float:
    return float(_lengths(legs).max())


def _neighbours(legs: Legs, radius: float) -> Iterator[tuple[IntArray, IntArray, float]]:
    """Yield leg numbers (first, second) of different flights that overlap in time, and the fraction done.

    Every such pair that comes within `radius` metres horizontally is yielded, once, and few that do not: a
    leg within the radius of another has its midpoint in the same or an adjoining cell.
    """
    midpoints, half = _midpoints(legs), _lengths(legs) / 2
    leg, bucket, width_ms = _time_buckets(legs)
    key, column_length = _cell_keys(midpoints[leg], bucket, radius + _longest(legs))
    order = np.argsort(key, kind="stable")
    leg, bucket, key = leg[order], bucket[order], key[order]
    for left, right, done in _adjoining(key, column_length):
        first, second = leg[left], leg[right]
        begin_ms = np.maximum(legs.start_ms[first], legs.start_ms[second])
        together = (legs.flight[first] != legs.flight[second]) & (
            begin_ms <= np.minimum(legs.end_ms[first], legs.end_ms[second])
        )
        # A pair can share several buckets: it counts in the one where the later leg starts.
        together &= begin_ms // width_ms == bucket[left]
        first, second = first[together], second[together]
        apart = midpoints[first] - midpoints[second]
        near = np.hypot(apart[:, 0], apart[:, 1]) <= radius + half[first] + half[second]
        yield first[near], second[near], done


def _time_buckets(legs: Legs) -> tuple[IntArray, IntArray, int]:
    """List every leg once for each time bucket it touches: leg, bucket, and the bucket's width in ms.

    The width is the mean duration of a leg, so that there are at most three entries a leg.
    """
    width_ms = max(1, math.ceil((legs.end_ms - legs.start_ms).mean()))
    earliest = legs.start_ms // width_ms
    counts = legs.end_ms // width_ms - earliest + 1
    leg = np.repeat(np.arange(len(legs)), counts)
    return leg, earliest[leg] + _ranks(counts), width_ms


def _ranks(counts: IntArray) -> IntArray:
    """Count 0, 1, … within each of the runs of these lengths."""
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)


def _cell_keys(midpoints: FloatArray, bucket: IntArray, cell_m: float) -> tuple[IntArray, int]:
    """Number the cells (bucket, x, y), neighbours along y consecutively; also return a column's length.

    An empty last cell keeps the neighbours of a column's cells from belonging to the next column, and an empty
    last column does so for buckets.
    """
    cells = ((midpoints - midpoints.min(axis=0)) // cell_m).astype(np.int64)
    columns, column_length = (int(count) for count in cells.max(axis=0) + 2)
    return ((bucket - bucket.min()) * columns + cells[:, 0]) * column_length + cells[:, 1], column_length


def _adjoining(key: IntArray, column_length: int) -> Iterator[tuple[IntArray, IntArray, float]]:
    """Yield pairs of entries whose cells touch, each pair once, for ascending keys, and the fraction done."""
    entry = np.arange(len(key))
    left = np.concatenate([entry, entry])
    # Later entries of the same cell and the cell north of it; the three cells of the column east of it.
    begin = np.concatenate([entry + 1, np.searchsorted(key, key + column_length - 1, side="left")])
    end = np.searchsorted(key, np.concatenate([key + 1, key + column_length + 1]), side="right")
    counts = end - begin
    totals = np.cumsum(counts)
    cuts = np.unique(np.searchsorted(totals, np.arange(_CHUNK, totals[-1], _CHUNK), side="right"))
    for part in np.split(np.arange(len(left)), cuts):
        yield (
            np.repeat(left[part], counts[part]),
            np.repeat(begin[part], counts[part]) + _ranks(counts[part]),
            float((part[-1] + 1) / len(left)) if part.size else 0.0,
        )
