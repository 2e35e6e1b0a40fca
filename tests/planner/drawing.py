"""Tiny airspaces drawn in ASCII: '#' is statically occupied, '.' is free, any other sign names a free block."""

from dataclasses import dataclass

import numpy as np

from planner.airmatrix import AirMatrix
from planner.airspace import Airspace, BoolArray, OccupancyRule
from planner.errors import Block

BLOCK_SIDE_M = 20.0
BLOCK_HEIGHT_M = 40.0


@dataclass(frozen=True)
class Drawing:
    """An airspace and the signs drawn in it."""

    airspace: Airspace
    signs: dict[int, str]

    def __getitem__(self, sign: str) -> int:
        """Return the flat index of the one block drawn with this sign."""
        (block,) = (block for block, drawn in self.signs.items() if drawn == sign)
        return block


def drawn(*layers: str, rule: OccupancyRule = OccupancyRule.CONTAINMENT, terminal_dwell_ms: int = 0) -> Drawing:
    """Return the airspace with these layers, the lowest first; rows are words, the northernmost first."""
    rows = [layer.split()[::-1] for layer in layers]
    count_i, count_j, count_k = dimensions = len(rows[0][0]), len(rows[0]), len(rows)
    blocks = [(i, j, k) for k in range(count_k) for j in range(count_j) for i in range(count_i)]
    signs = [rows[k][j][i] for i, j, k in blocks]
    airspace = airspace_of(
        dimensions,
        np.array([sign == "#" for sign in signs]),
        rule=rule,
        terminal_dwell_ms=terminal_dwell_ms,
    )
    return Drawing(airspace, {airspace.grid.index(block): sign for block, sign in zip(blocks, signs, strict=True)})


def airspace_of(
    dimensions: Block,
    occupied: BoolArray,
    *,
    rule: OccupancyRule,
    terminal_dwell_ms: int,
) -> Airspace:
    """Return a nameless airspace of 20 m x 20 m x 40 m blocks."""
    return Airspace(
        id="tiny",
        name="Tiny",
        grid=AirMatrix(
            epsg=3414,
            origin_x_m=0.0,
            origin_y_m=0.0,
            block_side_m=BLOCK_SIDE_M,
            block_height_m=BLOCK_HEIGHT_M,
            dimensions=dimensions,
        ),
        ceiling_m=dimensions[2] * BLOCK_HEIGHT_M,
        occupied=occupied,
        rule=rule,
        terminal_dwell_ms=terminal_dwell_ms,
    )
