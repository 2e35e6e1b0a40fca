"""Altitude balancing, the paper's future work (4.3): links into crowded layers count more than the time they take."""

import numpy as np

from planner.airspace import Airspace
from planner.path import Plan

# What a link into the most crowded layer counts beyond its time, in ms. Links of the paper's scenario take seconds.
WEIGHTS_MS = (10, 100, 300, 1000)


class Crowding:
    """For how long the blocks of each layer are held by the flights added so far, for each of its free blocks."""

    def __init__(self, airspace: Airspace) -> None:
        count_i, count_j, count_k = airspace.grid.dimensions
        self._layer_size = count_i * count_j
        self._free = self._layer_size - np.array(airspace.occupied_per_layer)
        self._held_ms = np.zeros(count_k, dtype=np.int64)

    def add(self, plan: Plan) -> None:
        """Add the holds of a flight."""
        np.add.at(self._held_ms, plan.hold_block // self._layer_size, plan.hold_exit_ms - 1 - plan.hold_enter_ms)

    def surcharges_ms(self, weight_ms: int) -> tuple[int, ...]:
        """Return each layer's surcharge: the weight for the most crowded layer, for others in proportion; (layers,)."""
        crowding = self._held_ms / np.maximum(self._free, 1)
        surcharges: list[int] = np.rint(weight_ms * crowding / max(crowding.max(), 1e-9)).astype(np.int64).tolist()
        return tuple(surcharges)


def lets_flights_choose(airspace: Airspace) -> bool:
    """Tell whether there is more than one layer to fly in."""
    count_i, count_j, _ = airspace.grid.dimensions
    return sum(occupied < count_i * count_j for occupied in airspace.occupied_per_layer) > 1
