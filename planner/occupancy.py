"""Who holds which block when: the rules' geometry and the index of committed reservations (paper 2.1, 2.4)."""

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


class OccupancyIndex:
    """The committed reservations of an airspace, per block and sorted: a cache of the ledger that kernels can read.

    Not for several threads at once: a kernel that reads it runs without the GIL.
    """

    def __init__(self, block_count: int) -> None:
        self.slabs = intervals.empty_slabs(block_count, pool_size=1 << 12)
        self._size = 0

    def __len__(self) -> int:
        return self._size

    def reserve(self, blocks: IntArray, enters_ms: IntArray, exits_ms: IntArray, owner: int | IntArray) -> None:
        """Add half-open reservations [enter, exit), disjoint among themselves, of one owner or one each: all or none.

        Raises
        ------
        ValueError
            One is empty, or overlaps a reservation of its block.
        """
        if np.any(enters_ms >= exits_ms):
            raise ValueError("a reservation must end after it begins")
        clash = intervals.first_overlap(self.slabs.table, self.slabs.pool, blocks, enters_ms, exits_ms)
        if clash >= 0:
            raise ValueError(f"block {blocks[clash]} is reserved within [{enters_ms[clash]}, {exits_ms[clash]})")
        owners = np.broadcast_to(np.asarray(owner, dtype=np.int64), blocks.shape).copy()
        done = 0
        while (done := intervals.insert(*self.slabs, blocks, enters_ms, exits_ms, owners, done)) < len(blocks):
            self._grow()
        self._size += len(blocks)

    def release(self, blocks: IntArray, enters_ms: IntArray, exits_ms: IntArray) -> int:
        """Remove exactly these reservations where they are present; return how many were."""
        removed = int(intervals.remove(*self.slabs, blocks, enters_ms, exits_ms))
        self._size -= removed
        return removed

    def forget_before(self, time_ms: int) -> int:
        """Drop the reservations that end by `time_ms`; return how many."""
        dropped = int(intervals.forget(*self.slabs, time_ms))
        self._size -= dropped
        return dropped

    def clear(self) -> None:
        """Drop everything."""
        self.slabs = intervals.empty_slabs(len(self.slabs.table), len(self.slabs.pool))
        self._size = 0

    def owners(self, block: int, from_ms: int, to_ms: int) -> tuple[int, ...]:
        """Return the owners of a block's reservations that overlap [from, to), in order of time, each once."""
        first, count = self.slabs.table[block, : intervals.SIZE_CLASS]
        held = self.slabs.pool[first : first + count] if count else self.slabs.pool[:0]
        overlapping = (held[:, intervals.ENTER] < to_ms) & (held[:, intervals.EXIT] > from_ms)
        return tuple(dict.fromkeys(int(owner) for owner in held[overlapping, intervals.OWNER]))

    def _grow(self) -> None:
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
