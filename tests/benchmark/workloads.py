"""What the benchmark plans: the six files of flight intents, the shipped airspace, a city made of it."""

import itertools
import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from planner.aircraft import shipped_aircraft_types
from planner.airmatrix import AirMatrix
from planner.airspace import Airspace, OccupancyRule
from planner.buildings import shipped_airspace
from planner.cfa_star import Performance, Planner, PlanRequest
from planner.errors import NotPlannable
from planner.experiments.traffic import PAPER_AIRCRAFT, Od, random_flights, terminals

GROUND_HOLD_MS = 300_000
FILES = [f"{od}_{flights}" for od in ("uniform", "lowest") for flights in (300, 1000, 3000)]
CITY_TILES = 12


@dataclass(frozen=True, eq=False)
class Workload:
    """An airspace under the containment rule, and requests in filing order."""

    airspace: Airspace
    requests: tuple[PlanRequest, ...]


@cache
def from_file(name: str) -> Workload:
    """Read one of the files beside this module."""
    document = json.loads((Path(__file__).parent / f"{name}.json").read_text())
    grid = AirMatrix(3414, 0.0, 0.0, 20.0, 40.0, tuple(document["dims"]))
    occupied = np.zeros(grid.block_count, dtype=np.bool_)
    occupied[document["blocked"]] = True
    performances = list(performances_in(grid).values())
    requests = (
        _request(flight["o"], flight["d"], performances[flight["type"]], flight["dep_ms"])
        for flight in document["flights"]
    )
    airspace = Airspace(name, name, grid, 120.0, occupied, OccupancyRule.CONTAINMENT)
    return Workload(airspace, tuple(requests))


def astana() -> Airspace:
    """Return the shipped airspace: 2 km x 2 km, 100 x 100 x 3 blocks."""
    return shipped_airspace()


def city() -> Airspace:
    """Return 24 km x 24 km: the shipped airspace 12 x 12 times, every other tile mirrored so that edges fit."""
    tile = shipped_airspace()
    count_i, count_j, count_k = tile.grid.dimensions
    more = CITY_TILES - 1
    occupied = np.pad(
        tile.occupied.reshape(count_k, count_j, count_i),
        ((0, 0), (0, more * count_j), (0, more * count_i)),
        mode="symmetric",
    ).ravel()
    grid = AirMatrix(
        tile.grid.epsg,
        tile.grid.origin_x_m,
        tile.grid.origin_y_m,
        tile.grid.block_side_m,
        tile.grid.block_height_m,
        (CITY_TILES * count_i, CITY_TILES * count_j, count_k),
    )
    return Airspace("city", "City", grid, tile.ceiling_m, occupied, OccupancyRule.CONTAINMENT)


def random_requests(planner: Planner, od: Od, window_s: float, seed: int) -> Iterator[PlanRequest]:
    """Yield random requests without end, between blocks that buildings do not cut off from each other."""
    airspace = planner.airspace
    places = terminals(airspace.grid, airspace.occupied, od)
    performances = performances_in(airspace.grid)
    for batch in itertools.count():
        for flight in random_flights(places, PAPER_AIRCRAFT, 1000, window_s, seed=seed * 1_000_000 + batch):
            try:
                planner.check(flight.origin, flight.destination)
            except NotPlannable:
                continue
            yield _request(flight.origin, flight.destination, performances[flight.aircraft], flight.departure_ms)


def performances_in(grid: AirMatrix) -> dict[str, Performance]:
    """Return the performance of the paper's aircraft, in the order of its table."""
    profiles = {profile.id: profile for profile in shipped_aircraft_types()}
    return {name: Performance.of(profiles[name], grid) for name in PAPER_AIRCRAFT}


def _request(origin: int, destination: int, performance: Performance, departure_ms: int) -> PlanRequest:
    return PlanRequest(origin, destination, performance, departure_ms, departure_ms + GROUND_HOLD_MS)
