"""Aircraft that do not do as planned: which, how and when, all from one seed. Pure."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from app.commands.flight_model import Way
from planner.airmatrix import AirMatrix, FloatArray


class Kind(StrEnum):
    """How a flight deviates."""

    LATE = "late"
    DRIFT = "drift"
    LAYER = "layer"
    HOVER = "hover"
    LOST = "lost"
    INTRUDER = "intruder"


@dataclass(frozen=True, eq=False)
class Flown:
    """What becomes of a flight.

    Attributes
    ----------
    way
        Where its aircraft really is.
    kind
        How that deviates from the plan, None where it does not.
    silent_from_ms, silent_until_ms
        Between these nothing is heard of it; without an end, for good.
    intruder
        The way of an aircraft without a flight intent that crosses this one's.
    """

    way: Way
    kind: Kind | None = None
    silent_from_ms: int | None = None
    silent_until_ms: int | None = None
    intruder: Way | None = None

    @property
    def is_lost_for_good(self) -> bool:
        """Tell whether its aircraft never reports its arrival."""
        return self.silent_from_ms is not None and self.silent_until_ms is None

    def is_heard(self, time_ms: int) -> bool:
        """Tell whether its aircraft reports at a time."""
        if self.silent_from_ms is None or time_ms < self.silent_from_ms:
            return True
        return self.silent_until_ms is not None and time_ms >= self.silent_until_ms


@dataclass(frozen=True)
class Deviations:
    """Which flights deviate, and how: of all flights a `share` (0 to 1), or the `first` so many where that is given.

    What becomes of a flight depends on the seed, the kinds, its sequence number and its plan; with a share, on nothing
    else.
    """

    seed: int
    kinds: tuple[Kind, ...] = tuple(Kind)
    share: float = 0.0
    first: int | None = None

    def of(self, way: Way, sequence: int, before: int, grid: AirMatrix) -> Flown:
        """Return what becomes of a flight; `before` so many others of lower sequence numbers are flown."""
        random = np.random.default_rng([self.seed, sequence])
        is_among = random.random() < self.share if self.first is None else before < self.first
        if not (is_among and self.kinds) or way.duration_ms <= 0:
            return Flown(way)
        kind = [kind for kind in Kind if kind in self.kinds][random.integers(len(set(self.kinds)))]
        return replace(_DEVIATE[kind](way, random, grid), kind=kind)


def _late(way: Way, random: np.random.Generator, _grid: AirMatrix) -> Flown:
    return Flown(way.delayed(_ms(random, 8, 30)))


def _drift(way: Way, random: np.random.Generator, grid: AirMatrix) -> Flown:
    """Go sideways by one block and a half to two, and come back."""
    side = np.array([-1.0, 1.0])[random.integers(2)]
    offset = _across(way.place[-1] - way.place[0]) * side * random.uniform(1.5, 2.0) * grid.block_side_m
    west, south, east, north = grid.extent_m
    x, y, _ = way.at(way.begin_ms + way.duration_ms // 2) + offset
    # Out of the airspace it would be nobody's.
    is_inside = west < x < east and south < y < north
    return Flown(_displaced(way, offset if is_inside else -offset, random))


def _layer(way: Way, random: np.random.Generator, grid: AirMatrix) -> Flown:
    """Fly one layer above or below the plan for a while."""
    lowest, highest = (int(height / grid.block_height_m) for height in (way.place[:, 2].min(), way.place[:, 2].max()))
    free = [step for step, is_free in ((1, highest + 1 < grid.dimensions[2]), (-1, lowest > 0)) if is_free]
    step = free[random.integers(len(free))] if free else 1
    return Flown(_displaced(way, np.array([0.0, 0.0, step * grid.block_height_m]), random))


def _hover(way: Way, random: np.random.Generator, _grid: AirMatrix) -> Flown:
    return Flown(way.hovering(_moment(way, random, 0.3, 0.6), _ms(random, 10, 30)))


def _lost(way: Way, random: np.random.Generator, _grid: AirMatrix) -> Flown:
    """Fall silent: one in three for good."""
    silent_ms = _moment(way, random, 0.3, 0.5)
    is_heard_again, after_ms = random.random() < 2 / 3, _ms(random, 15, 45)
    return Flown(way, silent_from_ms=silent_ms, silent_until_ms=silent_ms + after_ms if is_heard_again else None)


def _intruder(way: Way, random: np.random.Generator, grid: AirMatrix) -> Flown:
    """Let somebody cross the way at its height, at about the moment when the flight is there."""
    meeting_ms = _moment(way, random, 0.3, 0.7)
    centre, off_ms = way.at(meeting_ms), _ms(random, -3, 3)
    course = _across(way.place[-1] - way.place[0])
    speed_mps, before_m, after_m = random.uniform(8, 15), *(_reach(centre, course * to, grid) for to in (-1, 1))
    time_ms = meeting_ms + off_ms + np.array([-before_m, 0.0, after_m]) / speed_mps * 1000
    place = centre + np.outer([-before_m, 0.0, after_m], course)
    return Flown(way, intruder=Way(time_ms.astype(np.int64), place))


_DEVIATE: dict[Kind, Callable[[Way, np.random.Generator, AirMatrix], Flown]] = {
    Kind.LATE: _late,
    Kind.DRIFT: _drift,
    Kind.LAYER: _layer,
    Kind.HOVER: _hover,
    Kind.LOST: _lost,
    Kind.INTRUDER: _intruder,
}

# How far an intruder comes from and goes to, and at least: then it stands almost still.
_REACH_M = 300.0
_LEAST_REACH_M = 1.0
# Time to get from one layer to the next, or two blocks sideways; on short flights less.
_RAMP_MS = 8_000


def _displaced(way: Way, offset: FloatArray, random: np.random.Generator) -> Way:
    from_ms, until_ms = _moment(way, random, 0.15, 0.25), _moment(way, random, 0.75, 0.85)
    return way.displaced(offset, from_ms, until_ms, min(_RAMP_MS, (until_ms - from_ms) // 4))


def _across(course: FloatArray) -> FloatArray:
    """Return the horizontal unit vector to the left of a course; north for one that is vertical."""
    length = np.hypot(course[0], course[1])
    return np.array([0.0, 1.0, 0.0]) if length == 0 else np.array([-course[1], course[0], 0.0]) / length


def _reach(place: FloatArray, course: FloatArray, grid: AirMatrix) -> float:
    """Return how far one can go on a horizontal course without leaving the grid."""
    west, south, east, north = grid.extent_m
    limits = np.array([east if course[0] > 0 else west, north if course[1] > 0 else south])
    going = course[:2] != 0
    distance = float(np.min((limits[going] - place[:2][going]) / course[:2][going], initial=_REACH_M))
    return max(distance, _LEAST_REACH_M)


def _moment(way: Way, random: np.random.Generator, earliest: float, latest: float) -> int:
    """Return a time between two shares of a way."""
    return way.begin_ms + int(way.duration_ms * random.uniform(earliest, latest))


def _ms(random: np.random.Generator, shortest_s: float, longest_s: float) -> int:
    return int(random.uniform(shortest_s, longest_s) * 1000)
