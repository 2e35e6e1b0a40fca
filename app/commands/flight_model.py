"""Where aircraft are that fly their trajectories, on plan or not. Pure.

Times are int64 ms. Places are rows of x, y (projected metres) and altitude (metres above the ground datum).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from planner.airmatrix import FloatArray, IntArray

# Longer than any flight lasts: what keeps the times of one way apart from those of the next.
_APART_MS = 1 << 32


@dataclass(frozen=True, eq=False)
class Way:
    """How an aircraft moves: straight and evenly from knot to knot, standing still before the first and after the last.

    Attributes
    ----------
    time_ms
        Shape (n,), strictly increasing, n at least 1.
    place
        Shape (n, 3).
    """

    time_ms: IntArray
    place: FloatArray

    @property
    def begin_ms(self) -> int:
        """When it starts to move, or to hold its first place in the air."""
        return int(self.time_ms[0])

    @property
    def end_ms(self) -> int:
        """When it has arrived."""
        return int(self.time_ms[-1])

    @property
    def duration_ms(self) -> int:
        """From begin to end."""
        return self.end_ms - self.begin_ms

    def at(self, time_ms: int) -> FloatArray:
        """Return the place at a time: shape (3,)."""
        place: FloatArray = places([self], time_ms)[0]
        return place

    def delayed(self, by_ms: int) -> "Way":
        """Return the same way, flown later."""
        return Way(self.time_ms + by_ms, self.place)

    def hovering(self, at_ms: int, for_ms: int) -> "Way":
        """Return the way with a stop in mid-air; what comes after it is flown that much later."""
        way = self._with_knots(at_ms)
        stop = int(np.searchsorted(way.time_ms, at_ms))
        time_ms = np.concatenate([way.time_ms[: stop + 1], way.time_ms[stop:] + for_ms])
        return Way(time_ms, np.concatenate([way.place[: stop + 1], way.place[stop:]]))

    def displaced(self, offset: FloatArray, from_ms: int, until_ms: int, ramp_ms: int) -> "Way":
        """Return the way moved by an offset, shape (3,): growing from a time on, and gone again at another."""
        corners = (from_ms, from_ms + ramp_ms, until_ms - ramp_ms, until_ms)
        way = self._with_knots(*corners)
        weight = np.interp(way.time_ms, corners, (0.0, 1.0, 1.0, 0.0))
        return Way(way.time_ms, way.place + weight[:, None] * offset)

    def _with_knots(self, *times_ms: int) -> "Way":
        """Return the same way with knots at these times, where it lasts that long."""
        inside = [time_ms for time_ms in times_ms if self.begin_ms < time_ms < self.end_ms]
        time_ms = np.union1d(self.time_ms, np.array(inside, dtype=np.int64))
        columns = [np.interp(time_ms, self.time_ms, column) for column in self.place.T]
        return Way(time_ms, np.stack(columns, axis=-1))


def planned_way(centres: FloatArray, arrive_ms: IntArray, depart_ms: IntArray) -> Way:
    """Return the way along a trajectory: block centres, shape (n, 3), when each is reached and when it is left."""
    time_ms = np.stack([arrive_ms, depart_ms], axis=-1).ravel()
    is_new = np.diff(time_ms, prepend=time_ms[0] - 1) > 0
    return Way(time_ms[is_new], np.repeat(centres, 2, axis=0)[is_new])


def places(ways: Sequence[Way], time_ms: int) -> FloatArray:
    """Return where each aircraft is at a time: shape (len(ways), 3)."""
    if not ways:
        return np.empty((0, 3))
    lengths = [len(way.time_ms) for way in ways]
    begins = np.array([way.begin_ms for way in ways])
    ends = np.array([way.end_ms for way in ways])
    # One axis for all: each way has a stretch of it to itself, and a time is looked up in its own stretch.
    stretch = np.arange(len(ways)) * _APART_MS
    knots = np.concatenate([way.time_ms for way in ways]) + np.repeat(stretch - begins, lengths)
    wanted = np.clip(time_ms, begins, ends) + stretch - begins
    columns = np.concatenate([way.place for way in ways]).T
    return np.stack([np.interp(wanted, knots, column) for column in columns], axis=-1)
