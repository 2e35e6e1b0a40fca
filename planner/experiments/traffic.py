"""The paper's traffic: random flights between free blocks, all from one seed (paper 4.2)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from planner.airmatrix import AirMatrix, IntArray
from planner.airspace import BoolArray

# The paper's table of aircraft; others that are known do not take part.
PAPER_AIRCRAFT = ("dji-mavic-air", "self-built-drone", "dji-phantom-4", "dji-matrice-600-pro")


class Od(StrEnum):
    """Where flights begin and end: anywhere free, as in the paper, or on the ground, as real pads lie."""

    UNIFORM = "uniform"
    LOWEST = "lowest"


@dataclass(frozen=True)
class Flight:
    """A wish to fly: from block to block (flat indices), by aircraft type, at a departure in ms."""

    origin: int
    destination: int
    aircraft: str
    departure_ms: int


@dataclass(frozen=True)
class Demand:
    """Which random flights: so many within a window, from one seed."""

    od: Od
    flights: int
    window_min: int
    seed: int


def terminals(grid: AirMatrix, occupied: BoolArray, od: Od) -> IntArray:
    """Return the blocks where flights may begin and end."""
    if od is Od.UNIFORM:
        return np.flatnonzero(~occupied)
    columns = grid.dimensions[0] * grid.dimensions[1]
    free = ~occupied.reshape(-1, columns)
    lowest: IntArray = np.argmax(free, axis=0) * columns + np.arange(columns)
    return lowest[free.any(axis=0)]


def random_flights(
    places: IntArray, aircraft: Sequence[str], flights: int, window_s: float, seed: int
) -> Iterator[Flight]:
    """Yield flights in filing order: endpoints, aircraft and departures from 0 on uniform, all from one seed.

    Another window moves the departures in proportion and changes nothing else.
    """
    random = np.random.default_rng(seed)
    for _ in range(flights):
        origin, destination = random.choice(places, size=2, replace=False).tolist()
        departure_ms = int(random.uniform(0, window_s * 1000))
        yield Flight(origin, destination, aircraft[int(random.integers(len(aircraft)))], departure_ms)
