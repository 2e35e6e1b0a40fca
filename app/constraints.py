"""Closed airspace: volumes that nobody may fly in for a while, or for good. Pure."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.airmatrix import IntArray
from planner.airspace import BoolArray
from planner.occupancy import Closure

# So many may be in force or to come: each is asked, every second, which of the blocks in use belong to it.
MOST_CONSTRAINTS = 500
# So many blocks they may close together, each counted as often as it is closed: every process has them in memory.
MOST_CLOSED_BLOCKS = 3_000_000
# What the journal says of a flight that holds some of what a constraint closes and can no longer make way.
UNMOVED = "unmoved"


@dataclass(frozen=True, eq=False)
class Constraint:
    """A no-fly volume with the blocks (n,) that belong to it, ascending; None: no top, no end, not removed.

    `number` orders constraints and stands for them in the occupancy index; it is 0 until the constraint is recorded.
    """

    number: int
    id: str
    name: str
    polygon: Mapping[str, Any]
    base_m: float
    top_m: float | None
    from_ms: int
    until_ms: int | None
    blocks: IntArray
    created_ms: int
    removed_ms: int | None = None

    @property
    def closure(self) -> Closure:
        """What it closes."""
        return Closure.of(self.blocks, self.from_ms, self.until_ms)

    def covers(self, blocks: IntArray) -> BoolArray:
        """Tell which of some blocks (n,) belong to it."""
        place = np.minimum(np.searchsorted(self.blocks, blocks), len(self.blocks) - 1)
        covered: BoolArray = self.blocks[place] == blocks
        return covered
