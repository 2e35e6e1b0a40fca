"""The heuristic H: flight time between two blocks in a lattice without obstacles (paper 3.1).

The paper's case tables are exact only while no mix of link types beats them, which fails for its own aircraft
(at δ = (1, 1, 2) two tilted links beat its choice). This module computes the exact lattice distance instead, so
H is admissible and consistent for every aircraft that `planner.links` accepts; docs/decisions/0002 has the
argument.
"""

from typing import NamedTuple

import numpy as np

from planner.airmatrix import IntArray
from planner.links import LinkTimes


class LatticeDistance(NamedTuple):
    """Exact lattice distances in ms.

    `near[z, m, q]` for δz = z, m = min(δx, δy) and q = |δx - δy|; beyond the table every further m costs one
    plane diagonal and every further q one horizontal link.
    """

    near: IntArray
    horizontal: int
    diagonal: int


def lattice_distance(times: LinkTimes, layers: int) -> LatticeDistance:
    """Build the table for a grid with this many layers.

    An optimal chain has δz climbing links and no descending ones (a climb and a descent can be replaced by their
    level projections, which are no slower), and links commute: so the distance is the best of nine climbing
    links, layer by layer, then the level octile distance.
    """
    climbs = layers - 1
    m_size, q_size = climbs + 1, 2 * climbs + 1
    reach = m_size + q_size + 2 * climbs
    axis = np.abs(np.arange(-reach, reach + 1))
    low, high = np.minimum.outer(axis, axis), np.maximum.outer(axis, axis)
    layer = low * times.diagonal + (high - low) * times.horizontal
    climb_cost = {0: times.vertical, 1: times.alpha, 2: times.beta}
    near = np.empty((layers, m_size, q_size), dtype=np.int64)
    m, q = np.meshgrid(np.arange(m_size), np.arange(q_size), indexing="ij")
    for z in range(layers):
        centre = reach - z
        near[z] = layer[centre + m + q, centre + m]
        # Each layer shrinks by one ring: its nine predecessors must all be inside the one below.
        size = layer.shape[0] - 2
        layer = np.min(
            [
                layer[1 + x : 1 + x + size, 1 + y : 1 + y + size] + climb_cost[abs(x) + abs(y)]
                for x in (-1, 0, 1)
                for y in (-1, 0, 1)
            ],
            axis=0,
        )
    return LatticeDistance(near, times.horizontal, times.diagonal)
