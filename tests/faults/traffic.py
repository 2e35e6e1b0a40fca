"""Random flights over the shipped airspace, each with a reference of its own, which is its idempotency key too."""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
import orjson

from app.times import format_time, now_ms
from planner.airspace import Airspace
from planner.buildings import shipped_airspace
from planner.experiments.traffic import PAPER_AIRCRAFT, Od, random_flights, terminals

DAY_S = 86_400.0
# Nothing departs while a fault lasts, so that all that is reserved stays ahead.
_AHEAD_MS = 3_600_000
# Of so many accepted flights one is cancelled by its operator.
_CANCELLED_OF = 8


@dataclass(frozen=True)
class Request:
    """A flight to ask for, and whether its operator cancels it once it is accepted."""

    reference: str
    body: bytes
    is_cancelled: bool


@cache
def city() -> Airspace:
    """Return the shipped airspace."""
    return shipped_airspace()


class Traffic:
    """Flights of the paper's aircraft from one seed; no two have the same reference."""

    def __init__(self, seed: int) -> None:
        self._chance = np.random.default_rng(seed)
        self._places = terminals(city().grid, city().occupied, Od.UNIFORM)
        self._first_ms = now_ms() + _AHEAD_MS
        self._asked = 0

    def all_day(self) -> Iterator[Request]:
        """Yield flights that depart within a day."""
        return self._flights(self._first_ms, DAY_S)

    def rush(self) -> Iterator[Request]:
        """Yield flights that depart within the same ten minutes of that day, and so are in each other's way."""
        return self._flights(self._first_ms + int(self._chance.integers(int(DAY_S) * 1000)), 600.0)

    def _flights(self, first_ms: int, window_s: float) -> Iterator[Request]:
        seed = int(self._chance.integers(2**31))
        grid = city().grid
        for flight in random_flights(self._places, PAPER_AIRCRAFT, sys.maxsize, window_s, seed):
            self._asked += 1
            reference = f"flight {self._asked}"
            x, y, alt_m = grid.centres(np.array([flight.origin, flight.destination])).T
            lon, lat = grid.unproject(x, y)
            origin, destination = (
                {"lon": float(lon[end]), "lat": float(lat[end]), "alt_m": float(alt_m[end])} for end in (0, 1)
            )
            body = {
                "operator": "campaign",
                "reference": reference,
                "aircraft_type": flight.aircraft,
                "origin": origin,
                "destination": destination,
                "earliest_departure": format_time(first_ms + flight.departure_ms),
            }
            yield Request(reference, orjson.dumps(body), self._asked % _CANCELLED_OF == 0)
