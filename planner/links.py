"""The 26 links of a block and their times for one aircraft (paper 2.3 and 3.1).

Times are int64 milliseconds, rounded up once to the next even one, so that half a link is exact.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np

from planner.aircraft import AircraftType
from planner.airmatrix import AirMatrix, IntArray
from planner.errors import AircraftProfileError, Block

# Order is part of determinism: where two links reach a block equally early, the earlier one wins.
DIRECTIONS: tuple[Block, ...] = tuple(
    (i, j, k) for i, j, k in itertools.product((-1, 0, 1), repeat=3) if (i, j, k) != (0, 0, 0)
)
LINK_COUNT = len(DIRECTIONS)


class LinkTimes(NamedTuple):
    """One aircraft's times in ms: `time` (26,) of the links, and the five kinds they are made of."""

    time: IntArray
    horizontal: int
    diagonal: int
    vertical: int
    alpha: int
    beta: int


def build_offsets(grid: AirMatrix) -> IntArray:
    """Return the 26 links' offsets in flat block indices."""
    count_i, count_j, _ = grid.dimensions
    return np.array([(k * count_j + j) * count_i + i for i, j, k in DIRECTIONS], dtype=np.int64)


def box_steps(direction: Block) -> list[Block]:
    """Return the steps to all blocks of the box spanned by a block and its neighbour, these two included."""
    i, j, k = ({0, part} for part in direction)
    return [(di, dj, dk) for di in sorted(i) for dj in sorted(j) for dk in sorted(k)]


def even_ms(seconds: float) -> int:
    """Round seconds up to the next even millisecond."""
    return 2 * math.ceil(seconds * 500)


def build_link_times(aircraft: AircraftType, grid: AirMatrix) -> LinkTimes:
    """Return an aircraft's planned link times in a grid.

    Raises
    ------
    AircraftProfileError
        A tilted link would be faster than its level projection, which no multirotor does and which the
        lattice distance (`planner.heuristic`) relies on.
    """
    a, h = grid.block_side_m, grid.block_height_m
    speeds = aircraft.link_speeds(a, h)
    factor = aircraft.speed_factor
    horizontal = even_ms(a / (factor * speeds.horizontal))
    diagonal = even_ms(math.sqrt(2) * a / (factor * speeds.horizontal))
    vertical = even_ms(h / (factor * speeds.vertical))
    alpha = even_ms(math.hypot(a, h) / (factor * speeds.alpha))
    beta = even_ms(math.sqrt(2 * a * a + h * h) / (factor * speeds.beta))
    if alpha < horizontal or beta < diagonal:
        raise AircraftProfileError(
            f"aircraft {aircraft.id!r}: a climb over a block takes less time ({alpha} and {beta} ms) than the level "
            f"flight below it ({horizontal} and {diagonal} ms); check link_speeds_mps"
        )
    kinds = {(1, 0): horizontal, (2, 0): diagonal, (0, 1): vertical, (1, 1): alpha, (2, 1): beta}
    time = np.array([kinds[abs(i) + abs(j), abs(k)] for i, j, k in DIRECTIONS], dtype=np.int64)
    return LinkTimes(time, horizontal, diagonal, vertical, alpha, beta)
