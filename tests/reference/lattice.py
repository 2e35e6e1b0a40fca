"""Lattice distances from their definition, and the paper's case table for them (its section 3.1)."""

import heapq
import itertools

from planner.errors import Block
from planner.links import LinkTimes

STEPS = [(i, j, k) for i, j, k in itertools.product((-1, 0, 1), repeat=3) if (i, j, k) != (0, 0, 0)]


def time_of(times: LinkTimes, step: Block) -> int:
    """The time of one link, by its direction."""
    kinds = {
        (1, 0): times.horizontal,
        (2, 0): times.diagonal,
        (0, 1): times.vertical,
        (1, 1): times.alpha,
        (2, 1): times.beta,
    }
    return kinds[abs(step[0]) + abs(step[1]), abs(step[2])]


def distances(times: LinkTimes, dimensions: Block, start: Block) -> dict[Block, int]:
    """Dijkstra over a grid of blocks without obstacles: times in ms from one block to all."""
    found: dict[Block, int] = {}
    queue = [(0, start)]
    while queue:
        time, block = heapq.heappop(queue)
        if block in found:
            continue
        found[block] = time
        for step in STEPS:
            i, j, k = (part + change for part, change in zip(block, step, strict=True))
            inside = 0 <= i < dimensions[0] and 0 <= j < dimensions[1] and 0 <= k < dimensions[2]
            if inside and (i, j, k) not in found:
                heapq.heappush(queue, (time + time_of(times, step), (i, j, k)))
    return found


def paper_case_table(times: LinkTimes, x: int, y: int, z: int) -> int:
    """The paper's algorithm "Heuristic Function in Three-Dimensional Case", case by case."""
    xyz, xy, xz, x_only, z_only = times.beta, times.diagonal, times.alpha, times.horizontal, times.vertical
    yz, y_only = xz, x_only
    if x >= y >= z:
        return z * xyz + (y - z) * xy + (x - y) * x_only
    if x >= z >= y:
        return y * xyz + (z - y) * xz + (x - z) * x_only
    if y >= x >= z:
        return z * xyz + (x - z) * xy + (y - x) * y_only
    if y >= z >= x:
        return x * xyz + (z - x) * yz + (y - z) * y_only
    if z >= x >= y:
        return y * xyz + (x - y) * xz + (z - x) * z_only
    return x * xyz + (y - x) * yz + (z - y) * z_only
