"""Leaving a block: which links are open, and from when on their holds are free.

Under either occupancy rule the hold of block p ends `tail` after the start s of a link, and the hold of its neighbour n
begins `lead` after s.
"""

from typing import NamedTuple

from planner.airmatrix import IntArray
from planner.kernels.intervals import COUNT, ENTER, EXIT, FAR_FUTURE, FIRST, ended_by
from planner.kernels.policy import kernel

# Columns of `Motion.links`, a row a link; BOX has a bit for each link whose neighbour is held during this one.
OFFSET, BOX, TIME, LEAD, TAIL = range(5)


class Shape(NamedTuple):
    """Numbers about the grid and the aircraft: block counts, lattice steps beyond `near`, the longest link (ms)."""

    count_i: int
    count_j: int
    horizontal: int
    diagonal: int
    reach: int


class Motion(NamedTuple):
    """One aircraft in one airspace: `links` (26, 5), `near` as in `planner.heuristic`."""

    shape: Shape
    links: IntArray
    near: IntArray


@kernel
def heuristic(shape: Shape, near: IntArray, block: int, destination: int) -> int:
    """Return H: the lattice distance in ms between two blocks (see `planner.heuristic`)."""
    row, x = block // shape.count_i, block % shape.count_i
    row_D, x_D = destination // shape.count_i, destination % shape.count_i
    z = abs(row // shape.count_j - row_D // shape.count_j)
    y = abs(row % shape.count_j - row_D % shape.count_j)
    x = abs(x - x_D)
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
def look_around(
    open_links: IntArray,
    links: IntArray,
    table: IntArray,
    pool: IntArray,
    around: IntArray,
    p: int,
    tau: int,
    reach: int,
) -> int:
    """Find the gap at time `tau` of p's every neighbour; return as bits those reserved within `reach` of it."""
    busy = 0
    for link in range(26):
        if (open_links[p] >> link) & 1:
            n = p + links[link, OFFSET]
            g = 0
            if table[n, COUNT] > 0:
                g = ended_by(table, pool, n, tau)
                if g < table[n, COUNT] and pool[table[n, FIRST] + g, ENTER] <= tau + reach:
                    busy |= 1 << link
            around[link] = g
    return busy


@kernel
def wait_for_sides(
    links: IntArray,
    table: IntArray,
    pool: IntArray,
    around: IntArray,
    p: int,
    sides: int,
    s: int,
    duration: int,
) -> int:
    """Return s or, if a side block is reserved within `duration` of it, a later time before which no start is free."""
    for link in range(26):
        if (sides >> link) & 1:
            block = p + links[link, OFFSET]
            first = table[block, FIRST]
            for slot in range(first + around[link], first + table[block, COUNT]):
                if pool[slot, ENTER] >= s + duration:
                    break
                s = max(s, pool[slot, EXIT])
    return s


@kernel
def first_start(
    links: IntArray,
    table: IntArray,
    pool: IntArray,
    around: IntArray,
    p: int,
    link: int,
    stay: int,
    tau: int,
    last: int,
) -> tuple[int, int]:
    """Return the earliest start of a link in [tau, last] with all its holds free, and the neighbour's gap.

    The neighbour must be free for `stay` ms more. FAR_FUTURE if there is no such start. `look_around` must have been
    called for p at tau or earlier.
    """
    n = p + links[link, OFFSET]
    first, count = table[n, FIRST], table[n, COUNT]
    lead, duration = links[link, LEAD], links[link, TIME] + 1
    sides = links[link, BOX] & ~(1 << link)
    g = around[link]
    s = tau
    while True:
        if g > 0:
            s = max(s, pool[first + g - 1, EXIT] - lead)
        if s > last:
            return FAR_FUTURE, g
        if g < count and pool[first + g, ENTER] < s + duration + stay:
            g += 1
            continue
        free_from = wait_for_sides(links, table, pool, around, p, sides, s, duration)
        if free_from == s:
            return s, g
        s = free_from
