"""Who holds which block when: the rules' geometry and the index of committed reservations (paper 2.1, 2.4)."""

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from planner.airmatrix import Int32Array, IntArray
from planner.airspace import Airspace, OccupancyRule
from planner.errors import AircraftProfileError, Block
from planner.heuristic import lattice_distance
from planner.kernels import intervals
from planner.kernels.heap import MAX_H
from planner.kernels.motion import LEAD, MOST_SIDES, OFFSET, SIDE, SIDES, TAIL, TIME, Motion, Shape
from planner.links import DIRECTIONS, LINK_COUNT, LinkTimes, box_steps, build_offsets

_LINK_OF = {direction: link for link, direction in enumerate(DIRECTIONS)}


class Closure(NamedTuple):
    """Blocks that nobody may enter in [enter, exit): (n,) each, int64 and ms."""

    block: IntArray
    enter_ms: IntArray
    exit_ms: IntArray

    @classmethod
    def of(cls, blocks: IntArray, from_ms: int, until_ms: int | None) -> "Closure":
        """Return what closes all of some blocks within [from, until), or for good."""
        until_ms = intervals.FAR_FUTURE if until_ms is None else until_ms
        return cls(blocks, np.full_like(blocks, from_ms), np.full_like(blocks, until_ms))


class OccupancyIndex:
    """The committed reservations of an airspace, per block and sorted: a cache of the ledger that kernels can read.

    Closures lie around the reservations: a flight that was there first keeps what it holds of them. Not for several
    threads at once: a kernel that reads it runs without the GIL.
    """

    def __init__(self, block_count: int) -> None:
        self.slabs = intervals.empty_slabs(block_count, pool_size=1 << 12)
        self._size = 0
        self._closures: dict[int, Closure] = {}
        # Block, enter, exit and owner of each closure's blocks, by block and number.
        self._closed_rows = np.empty((4, 0), dtype=np.int64)
        self._is_closed = np.zeros(block_count, dtype=np.bool_)

    def __len__(self) -> int:
        return self._size

    def reserve(self, blocks: IntArray, enters_ms: IntArray, exits_ms: IntArray, owner: int | IntArray) -> None:
        """Add half-open reservations [enter, exit), disjoint among themselves, of one owner or one each: all or none.

        They may lie in closures; who plans asks first.

        Raises
        ------
        ValueError
            One is empty, or overlaps a reservation of its block.
        """
        if np.any(enters_ms >= exits_ms):
            raise ValueError("a reservation must end after it begins")
        with self._opened(blocks):
            clash = intervals.first_overlap(self.slabs.table, self.slabs.pool, blocks, enters_ms, exits_ms)
            if clash >= 0:
                raise ValueError(f"block {blocks[clash]} is reserved within [{enters_ms[clash]}, {exits_ms[clash]})")
            owners = np.broadcast_to(np.asarray(owner, dtype=np.int64), blocks.shape).copy()
            self._insert(intervals.insert, blocks, enters_ms, exits_ms, owners)
            self._size += len(blocks)

    def release(self, blocks: IntArray, enters_ms: IntArray, exits_ms: IntArray) -> int:
        """Remove exactly these reservations where they are present; return how many were."""
        with self._opened(blocks):
            removed = int(intervals.remove(*self.slabs, blocks, enters_ms, exits_ms))
            self._size -= removed
        return removed

    @property
    def closed(self) -> frozenset[int]:
        """The numbers under which something is closed."""
        return frozenset(self._closures)

    @property
    def closed_count(self) -> int:
        """How many blocks are closed, each counted for each closure."""
        return self._closed_rows.shape[1]

    def close(self, closures: Mapping[int, Closure]) -> None:
        """Close blocks under numbers above 0; the owner of what is closed is the negative number."""
        self._closures.update(closures)
        self._index_closures()
        with self._opened(np.concatenate([closure.block for closure in closures.values()])):
            pass

    def reopen(self, numbers: Collection[int]) -> None:
        """Take back what was closed under some numbers, where anything was."""
        gone = [number for number in numbers if number in self._closures]
        if gone:
            with self._opened(np.concatenate([self._closures[number].block for number in gone])):
                for number in gone:
                    del self._closures[number]
                self._index_closures()

    def copy(self) -> "OccupancyIndex":
        """Return an index with the same reservations and closures."""
        copied = OccupancyIndex(0)
        used = int(self.slabs.chains[-1])
        copied.slabs = intervals.Slabs(
            self.slabs.table.copy(),
            np.concatenate([self.slabs.pool[:used], np.empty((max(used, 1 << 12), 3), dtype=np.int64)]),
            self.slabs.chains.copy(),
        )
        copied._size = self._size
        copied._closures = dict(self._closures)
        copied._closed_rows, copied._is_closed = self._closed_rows, self._is_closed
        return copied

    def without(self, owners: IntArray, from_ms: int = 0, to_ms: int = intervals.FAR_FUTURE) -> "OccupancyIndex":
        """Return a copy of what overlaps [from, to), without the reservations of one or more owners.

        Closures reach where those were.
        """
        first_owner = int(owners.min())
        is_dropped = np.zeros(int(owners.max()) - first_owner + 1, dtype=np.bool_)
        is_dropped[owners - first_owner] = True
        kept = (self.slabs.table, self.slabs.pool, is_dropped, first_owner, from_ms, to_ms)
        copied = OccupancyIndex(len(self.slabs.table))
        intervals.copy_kept(*kept, copied.slabs.table, np.empty((0, 3), dtype=np.int64))
        copied.slabs = intervals.with_room(copied.slabs.table)
        intervals.copy_kept(*kept, copied.slabs.table, copied.slabs.pool)
        copied._size = int(copied.slabs.table[:, intervals.COUNT].sum())
        copied._closures = dict(self._closures)
        copied._closed_rows, copied._is_closed = self._closed_rows, self._is_closed
        closed = self._closed_rows[:, (self._closed_rows[2] > from_ms) & (self._closed_rows[1] < to_ms)]
        copied._insert(intervals.close_blocks, *closed)
        return copied

    def forget_before(self, time_ms: int) -> int:
        """Drop the reservations and closures that end by `time_ms`; return how many reservations."""
        self.reopen([number for number, closure in self._closures.items() if np.all(closure.exit_ms <= time_ms)])
        dropped = int(intervals.forget(*self.slabs, time_ms))
        self._size -= dropped
        return dropped

    def clear(self) -> None:
        """Drop everything."""
        self.slabs = intervals.empty_slabs(len(self.slabs.table), len(self.slabs.pool))
        self._size = 0
        self._closures.clear()
        self._index_closures()

    def owners(self, block: int, from_ms: int, to_ms: int) -> tuple[int, ...]:
        """Return the owners of what overlaps [from, to) in a block, in order of time, each once; a closure's is its
        negative number.
        """
        return self.owners_within(*(np.array([value], dtype=np.int64) for value in (block, from_ms, to_ms)))

    def owners_within(self, blocks: IntArray, enters_ms: IntArray, exits_ms: IntArray) -> tuple[int, ...]:
        """Return the owners of what overlaps half-open intervals of blocks, in their order, each once."""
        found = intervals.owners_within(self.slabs.table, self.slabs.pool, blocks, enters_ms, exits_ms)
        return tuple(dict.fromkeys(found.tolist()))

    @contextmanager
    def _opened(self, blocks: IntArray) -> Iterator[None]:
        """Change the reservations of some blocks without the closures that lie around them."""
        closed = np.unique(blocks[self._is_closed[blocks]])
        if not len(closed):
            yield
            return
        intervals.open_blocks(*self.slabs, closed)
        try:
            yield
        finally:
            self._lay_closures(closed)

    def _index_closures(self) -> None:
        """Make anew, for copies share them, what is looked up of closures by block."""
        parts = [
            np.stack([*closure, np.full_like(closure.block, -number)]) for number, closure in self._closures.items()
        ]
        rows = np.concatenate([np.empty((4, 0), dtype=np.int64), *parts], axis=1)
        self._closed_rows = rows[:, np.lexsort((-rows[3], rows[0]))]
        self._is_closed = np.zeros(len(self.slabs.table), dtype=np.bool_)
        self._is_closed[rows[0]] = True

    def _lay_closures(self, blocks: IntArray) -> None:
        """Lay the closures around the reservations of some blocks (ascending), in the order of their numbers."""
        first = np.searchsorted(self._closed_rows[0], blocks, side="left")
        count = np.searchsorted(self._closed_rows[0], blocks, side="right") - first
        # The rows first, first + 1, … of each block.
        here = np.arange(count.sum()) + np.repeat(first - np.cumsum(count) + count, count)
        self._insert(intervals.close_blocks, *self._closed_rows[:, here])

    def _insert(self, kernel: Callable[..., int], *rows: IntArray) -> None:
        """Run a kernel that adds rows, with a larger pool as often as it needs one."""
        done = 0
        while (done := kernel(*self.slabs, *rows, done)) < len(rows[0]):
            self.slabs = self.slabs._replace(pool=np.concatenate([self.slabs.pool, np.empty_like(self.slabs.pool)]))


def boxes(rule: OccupancyRule) -> list[list[Block]]:
    """Return for each link the steps to all blocks that a flight along it must find free of buildings."""
    if rule is OccupancyRule.CONTAINMENT:
        return [box_steps(direction) for direction in DIRECTIONS]
    return [[(0, 0, 0), direction] for direction in DIRECTIONS]


def open_links(airspace: Airspace) -> Int32Array:
    """Return for each block, as 26 bits, the links that stay in the grid and, under its rule, cut no building."""
    count_i, count_j, count_k = airspace.grid.dimensions
    free = np.pad(~airspace.occupied.reshape(count_k, count_j, count_i), 1)
    bits = np.zeros((count_k, count_j, count_i), dtype=np.int32)
    for link, box in enumerate(boxes(airspace.rule)):
        is_open = np.ones_like(bits, dtype=np.bool_)
        for i, j, k in box:
            is_open &= free[1 + k : 1 + k + count_k, 1 + j : 1 + j + count_j, 1 + i : 1 + i + count_i]
        bits |= is_open.astype(np.int32) << link
    return bits.ravel()


def build_motion(times: LinkTimes, airspace: Airspace) -> Motion:
    """Return an aircraft's link times with what the airspace's rule makes of them, and its lattice distance.

    From the start s of a link, the block left is held until s + tail, the neighbour from s + lead on.
    """
    count_i, count_j, count_k = airspace.grid.dimensions
    distance = lattice_distance(times, count_k)
    if int(distance.near.max()) + (count_i + count_j) * int(times.time.max()) > MAX_H:
        raise AircraftProfileError("too slow: flights across this airspace would take longer than the search can order")
    contained = airspace.rule is OccupancyRule.CONTAINMENT
    links = np.zeros((LINK_COUNT, SIDE + MOST_SIDES), dtype=np.int64)
    links[:, OFFSET] = build_offsets(airspace.grid)
    links[:, TIME] = times.time
    links[:, LEAD] = 0 if contained else times.time // 2
    links[:, TAIL] = times.time if contained else times.time // 2
    for link, box in enumerate(boxes(airspace.rule)):
        sides = [_LINK_OF[step] for step in box if step not in ((0, 0, 0), DIRECTIONS[link])]
        links[link, SIDES] = len(sides)
        links[link, SIDE : SIDE + len(sides)] = sides
    shape = Shape(count_i, count_j, distance.horizontal, distance.diagonal)
    return Motion(shape, links, distance.near)
