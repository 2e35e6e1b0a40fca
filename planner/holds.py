"""What a path must hold when, whatever its links take: the geometry of both occupancy rules (paper 2.1, 2.4).

Under the paper's rule the two halves of a link meet at its midpoint. A link of an odd number of ms has it half way
through a ms: the block left is held to the end of that ms, the neighbour from its beginning on, so that what is held
covers the paper's closed intervals.
"""

import numpy as np

from planner.airmatrix import AirMatrix, IntArray
from planner.airspace import Airspace, OccupancyRule
from planner.links import DIRECTIONS, box_steps


def holds_of(
    airspace: Airspace, block: IntArray, arrive_ms: IntArray, depart_ms: IntArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Return the holds of a trajectory: block, enter, exit, overlapping ones of a block merged, by enter, i, j, k.

    The trajectory is a chain of neighbouring blocks (n,), flat indices, each from arrival to departure.
    """
    held, enter_ms, exit_ms, _ = needed(airspace.rule, airspace.grid.ijk(block), arrive_ms, depart_ms)
    flat = flat_index(airspace.grid, held)
    return in_order(airspace.grid, *merged(flat, enter_ms, exit_ms, touching=False))


def flat_index(grid: AirMatrix, blocks: IntArray) -> IntArray:
    """Return flat indices: shape (n, 3) -> (n,)."""
    i, j, k = blocks.T
    flat: IntArray = (k * grid.dimensions[1] + j) * grid.dimensions[0] + i
    return flat


def links_of(steps: IntArray) -> IntArray:
    """Return the links that lead to neighbours: shape (n, 3) -> (n,), positions in `DIRECTIONS`."""
    code: IntArray = (steps + 1) @ np.array([9, 3, 1])
    return code - (code > len(DIRECTIONS) // 2)


def needed(
    rule: OccupancyRule, blocks: IntArray, arrive_ms: IntArray, depart_ms: IntArray
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Return what a trajectory must hold, not yet merged: blocks (m, 3), enter, exit, and the entry that needs it."""
    entry = np.arange(len(blocks))
    start_ms, end_ms, entered = depart_ms[:-1], arrive_ms[1:], entry[1:]
    parts = [(blocks, arrive_ms, depart_ms, entry)]
    if rule is OccupancyRule.MIDPOINT:
        parts.append((blocks[:-1], start_ms, (start_ms + end_ms + 1) // 2, entry[:-1]))
        parts.append((blocks[1:], (start_ms + end_ms) // 2, end_ms, entered))
    else:
        links = links_of(np.diff(blocks, axis=0))
        for link in np.unique(links):
            taken = np.flatnonzero(links == link)
            for step in box_steps(DIRECTIONS[link]):
                parts.append((blocks[taken] + step, start_ms[taken], end_ms[taken], entered[taken]))
    held, enter_ms, last_ms, entries = (np.concatenate(column) for column in zip(*parts, strict=True))
    return held, enter_ms, last_ms + 1, entries


def merged(
    block: IntArray, enter_ms: IntArray, exit_ms: IntArray, *, touching: bool
) -> tuple[IntArray, IntArray, IntArray]:
    """Merge intervals of a block that overlap or, if asked for, touch; return them by block and enter."""
    order = np.lexsort((enter_ms, block))
    block, enter_ms, exit_ms = block[order], enter_ms[order], exit_ms[order]
    # Exits moved so that those of a block lie beyond those of the blocks before it.
    apart = np.unique(block, return_inverse=True)[1] * (int(exit_ms.max()) - int(enter_ms.min()) + 2)
    latest_ms = np.maximum.accumulate(exit_ms + apart)
    reach_ms = latest_ms[:-1] + int(touching)
    first = np.append(True, enter_ms[1:] + apart[1:] >= reach_ms)
    last = np.append(first[1:], True)
    return block[first], enter_ms[first], (latest_ms - apart)[last]


def in_order(
    grid: AirMatrix, block: IntArray, enter_ms: IntArray, exit_ms: IntArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Return holds sorted by enter, then i, j, k."""
    i, j, k = grid.ijk(block).T
    order = np.lexsort((k, j, i, enter_ms))
    return block[order], enter_ms[order], exit_ms[order]
