"""Leaving a block: how far the destination is, and from when on a link's holds are free.

Under either occupancy rule the hold of block p ends `tail` after the start s of a link, and the hold of its neighbour n
begins `lead` after s. Under containment the side blocks, the rest of the box, are held from s to the arrival.
"""

from typing import NamedTuple

import numpy as np

from planner.airmatrix import Int32Array, IntArray
from planner.kernels.intervals import COUNT, ENTER, EXIT, FAR_FUTURE, FIRST, ended_by
from planner.kernels.policy import kernel
from planner.links import DIRECTIONS

# Columns of `Motion.links`, a row a link: how many side blocks it has, and from SIDE on the links that lead to them.
OFFSET, TIME, LEAD, TAIL, SIDES, SIDE = range(6)
MOST_SIDES = 6

STEPS = np.array(DIRECTIONS, dtype=np.int64)

# Where `Workspace.around` counts what a search has looked at of reservations: growth that no clock shows.
VISITS = 26


class Shape(NamedTuple):
    """Numbers about the grid and the aircraft: block counts, lattice steps beyond `near` (ms)."""

    count_i: int
    count_j: int
    horizontal: int
    diagonal: int


class Motion(NamedTuple):
    """One aircraft in one airspace: `links` (26, 11), `near` as in `planner.heuristic`."""

    shape: Shape
    links: IntArray
    near: IntArray


@kernel
def coordinates(shape: Shape, block: int) -> tuple[int, int, int]:
    """Return (i, j, k) of a flat index."""
    row = block // shape.count_i
    k = row // shape.count_j
    return block - row * shape.count_i, row - k * shape.count_j, k


@kernel
def lattice_time(shape: Shape, near: IntArray, i: int, j: int, k: int) -> int:
    """Return the lattice distance in ms over so many blocks (see `planner.heuristic`)."""
    x, y, z = abs(i), abs(j), abs(k)
    m, q = min(x, y), abs(x - y)
    beyond = 0
    last_m, last_q = near.shape[1] - 1, near.shape[2] - 1
    if m > last_m:
        beyond += (m - last_m) * shape.diagonal
        m = last_m
    if q > last_q:
        beyond += (q - last_q) * shape.horizontal
        q = last_q
    return near[z, m, q] + beyond


@kernel
def heuristic(shape: Shape, near: IntArray, block: int, destination: int) -> int:
    """Return the paper's H, the lattice distance in ms between two blocks."""
    i, j, k = coordinates(shape, block)
    i_D, j_D, k_D = coordinates(shape, destination)
    return lattice_time(shape, near, i - i_D, j - j_D, k - k_D)


@kernel
def gap_around(table: Int32Array, pool: IntArray, around: IntArray, link: int, block: int, time: int) -> int:
    """Return the gap at `time` of the block that `link` leads to; `around` remembers it, -1 for not yet looked up."""
    g = around[link]
    if g < 0:
        g = ended_by(table, pool, block, time)
        around[link] = g
        around[VISITS] += 1
    return g


@kernel
def first_start(
    links: IntArray,
    table: Int32Array,
    pool: IntArray,
    around: IntArray,
    p: int,
    link: int,
    stay: int,
    tau: int,
    earliest: int,
    last: int,
) -> tuple[int, int]:
    """Return the earliest start of a link in [earliest, last] with all its holds free, and the neighbour's gap.

    The neighbour must be free for `stay` ms more. FAR_FUTURE if there is no such start. `around` holds what gaps there
    are at `tau`, which is `earliest` or before.
    """
    n = p + links[link, OFFSET]
    first, count = table[n, FIRST], table[n, COUNT]
    lead, duration = links[link, LEAD], links[link, TIME] + 1
    g = gap_around(table, pool, around, link, n, tau)
    s = earliest
    while True:
        if g > 0:
            s = max(s, pool[first + g - 1, EXIT] - lead)
        if s > last:
            return FAR_FUTURE, g
        if g < count and pool[first + g, ENTER] < s + duration + stay:
            g += 1
            around[VISITS] += 1
            continue
        free_from = s
        for place in range(SIDE, SIDE + links[link, SIDES]):
            side = links[link, place]
            block = p + links[side, OFFSET]
            at_tau = gap_around(table, pool, around, side, block, tau)
            free_from = wait_for(table, pool, around, block, at_tau, free_from, duration)
        if free_from == s:
            return s, g
        s = free_from


@kernel
def wait_for(table: Int32Array, pool: IntArray, around: IntArray, block: int, g: int, s: int, duration: int) -> int:
    """Return s or, if a block is reserved within `duration` of it, when it is free that long; look from gap g on."""
    first = table[block, FIRST]
    for slot in range(first + g, first + table[block, COUNT]):
        if pool[slot, ENTER] >= s + duration:
            break
        around[VISITS] += 1
        s = max(s, pool[slot, EXIT])
    return s
