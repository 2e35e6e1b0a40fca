"""The paper's typical cases: how a CFA* trajectory differs from the A* trajectory of the same flight (paper 4.3)."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from planner.airmatrix import AirMatrix
from planner.path import Plan

# From this share of common blocks on, two trajectories count as similar.
SIMILAR = 0.5


class Case(StrEnum):
    """The paper's four cases, and waiting on an unchanged path, which it has no figure of."""

    OVERLAPPING = "overlapping"
    SAME_TIME = "slightly different, same flight time"
    DETOUR = "similar, with a detour"
    DIFFERENT = "totally different"
    WAITING = "same path, later"


@dataclass(frozen=True, eq=False)
class Comparison:
    """A flight (its number, from 0) by A* and by CFA*.

    `common` is the share of the blocks of either that both use, `apart_m` the greatest distance of a block of either
    from the nearest block of the other.
    """

    number: int
    astar: Plan
    cfa_star: Plan
    common: float
    apart_m: float
    case: Case


def compare(grid: AirMatrix, number: int, astar: Plan, cfa_star: Plan) -> Comparison:
    """Tell which case a flight is.

    The same blocks in the same order are `OVERLAPPING` without delay and `WAITING` with it. Of other trajectories,
    those with less than half of their blocks in common are `DIFFERENT`; the rest is `DETOUR` with a delay and
    `SAME_TIME` without.
    """
    both = np.intersect1d(astar.block, cfa_star.block).size
    common = both / np.union1d(astar.block, cfa_star.block).size
    offsets = grid.centres(astar.block)[:, None] - grid.centres(cfa_star.block)[None]
    distances = np.linalg.norm(offsets, axis=2)
    apart_m = max(distances.min(axis=0).max(), distances.min(axis=1).max())
    late = cfa_star.delay_ms > 0
    if np.array_equal(astar.block, cfa_star.block):
        case = Case.WAITING if late else Case.OVERLAPPING
    elif common < SIMILAR:
        case = Case.DIFFERENT
    else:
        case = Case.DETOUR if late else Case.SAME_TIME
    return Comparison(number, astar, cfa_star, common, float(apart_m), case)


def typical(comparisons: Sequence[Comparison], case: Case) -> Comparison | None:
    """Return the clearest example of a case, None without any; of equal ones the first.

    The longest flight where the blocks are the same, the longest delay of the detours, and of the others the
    trajectories that are farthest apart.
    """

    def clarity(comparison: Comparison) -> float:
        if case in (Case.OVERLAPPING, Case.WAITING):
            return comparison.astar.flight_time_ms
        return comparison.cfa_star.delay_ms if case is Case.DETOUR else comparison.apart_m

    return max((one for one in comparisons if one.case is case), key=clarity, default=None)
