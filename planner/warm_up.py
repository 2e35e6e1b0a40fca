"""Load or compile every kernel before the first request has to wait for it."""

from contextlib import suppress

import numpy as np

from planner.airmatrix import AirMatrix
from planner.airspace import Airspace
from planner.cfa_star import Performance, Planner, PlanRequest, Search
from planner.errors import EnduranceExceeded
from planner.kernels.policy import is_compiled as kernels_are_compiled
from planner.links import LinkTimes
from planner.occupancy import Closure

__all__ = ["kernels_are_compiled", "warm_up"]


def warm_up() -> None:
    """Plan in a tiny airspace so that each kernel runs once; seconds with an empty cache, otherwise a moment."""
    grid = AirMatrix(32631, 0.0, 0.0, 1.0, 1.0, (3, 3, 2))
    airspace = Airspace("warm-up", "warm-up", grid, 2.0, np.zeros(grid.block_count, dtype=np.bool_))
    times = LinkTimes(np.full(26, 2, dtype=np.int64), 2, 2, 2, 2, 2)
    # One ms less than the flight takes: the search within the endurance runs too, and finds nothing.
    for performance, search, surcharge in (
        (Performance(times), Search.GREEDY, ()),
        (Performance(times, endurance_ms=3), Search.SAFE_INTERVAL, ()),
        (Performance(times), Search.SAFE_INTERVAL, (0, 0)),
    ):
        planner = Planner(airspace, search)
        block, enter, leave = (np.array([value], dtype=np.int64) for value in (4, 0, 1))
        planner.index.reserve(block, enter, leave, owner=1)
        planner.index.release(block, enter, leave)
        planner.index.close({1: Closure(block, enter, leave)})
        planner.index.without(block).owners(4, 0, 1)
        planner.index.forget_before(0)
        request = PlanRequest(0, grid.block_count - 1, performance, 0, 0, surcharge)
        with suppress(EnduranceExceeded):
            planner.plan(request)
        planner.unconstrained(request)
