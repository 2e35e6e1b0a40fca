"""Random flight intents for the airspace that a service holds, as in the paper's scenario (paper 4.2)."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from app.client import Client, grid_of
from app.errors import StartupError
from app.times import format_time
from planner.airmatrix import AirMatrix, IntArray
from planner.experiments.traffic import PAPER_AIRCRAFT, Flight, Od, random_flights, terminals

# A flight intent as JSON-ready values; `FlightIntentBody` checks it.
Body = dict[str, Any]


@dataclass(frozen=True, eq=False)
class RandomIntents:
    """What random flights can be made of: the airspace, with its title, its terminals (flat indices) and aircraft."""

    title: str
    grid: AirMatrix
    terminals: IntArray
    aircraft: tuple[str, ...]

    @classmethod
    def served_by(cls, client: Client, od: Od) -> "RandomIntents":
        """Ask a service for its airspace; raises `ClientError`, and `StartupError` where there is nowhere to fly."""
        answer = client.airspace()
        grid = grid_of(answer)
        occupied = np.zeros(grid.block_count, dtype=np.bool_)
        occupied[[grid.index(block) for block in client.static_blocks().blocks]] = True
        places = terminals(grid, occupied, od)
        if len(places) < 2:
            raise StartupError("the airspace has fewer than two free blocks to fly between")
        known = tuple(item.id for item in client.aircraft_types())
        aircraft = tuple(id_ for id_ in PAPER_AIRCRAFT if id_ in known) or known
        return cls(f"{answer.name}, {answer.occupancy_rule}, {answer.search}", grid, places, aircraft)

    def bodies(self, flights: int, start_ms: int, window_s: float, seed: int, operator: str | None) -> Iterator[Body]:
        """Yield the requests of flights that want to depart within the window; one seed, one sequence of flights.

        Without an operator, they are the token's.
        """
        wishes = random_flights(self.terminals, self.aircraft, flights, window_s, seed)
        for number, wish in enumerate(wishes, start=1):
            origin, destination = self._ends(wish)
            yield {
                "operator": operator,
                "reference": f"seed {seed}, flight {number}",
                "aircraft_type": wish.aircraft,
                "origin": origin,
                "destination": destination,
                "earliest_departure": format_time(start_ms + wish.departure_ms),
            }

    def _ends(self, flight: Flight) -> list[dict[str, float]]:
        """Return the centres of a flight's first and last block."""
        x, y, alt_m = self.grid.centres(np.array([flight.origin, flight.destination])).T
        lon, lat = self.grid.unproject(x, y)
        return [{"lon": float(lon[end]), "lat": float(lat[end]), "alt_m": float(alt_m[end])} for end in (0, 1)]
