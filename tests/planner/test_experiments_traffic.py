"""The paper's random flights, and where they may begin and end."""

import numpy as np
import pytest

from planner.errors import Block
from planner.experiments.traffic import PAPER_AIRCRAFT, Od, random_flights, terminals
from tests.planner.drawing import drawn


@pytest.mark.parametrize(
    ("od", "expected"),
    [(Od.UNIFORM, [(1, 0, 0), (1, 0, 2), (2, 0, 2)]), (Od.LOWEST, [(1, 0, 0), (2, 0, 2)])],
)
def test_terminals_are_all_free_blocks_or_the_lowest_of_each_column(od: Od, expected: list[Block]) -> None:
    airspace = drawn("#.#", "###", "#..").airspace
    assert [airspace.grid.block(index) for index in terminals(airspace.grid, airspace.occupied, od)] == expected


def test_the_same_seed_draws_the_same_flights_and_another_does_not() -> None:
    places = np.arange(10, 60)
    first, again, other = (list(random_flights(places, PAPER_AIRCRAFT, 50, 300.0, seed)) for seed in (4, 4, 5))
    assert first == again
    assert first != other


def test_flights_differ_in_their_ends_depart_within_the_window_and_use_every_type() -> None:
    places = np.arange(10, 60)
    flights = list(random_flights(places, PAPER_AIRCRAFT, 400, 30.0, 1))
    assert all(flight.origin != flight.destination for flight in flights)
    assert {end for flight in flights for end in (flight.origin, flight.destination)} == set(places.tolist())
    assert all(0 <= flight.departure_ms < 30_000 for flight in flights)
    assert {flight.aircraft for flight in flights} == set(PAPER_AIRCRAFT)
    quarters = np.histogram([flight.departure_ms for flight in flights], 4, (0, 30_000))[0]
    assert quarters.min() > 70


def test_a_shorter_window_only_presses_departures_together() -> None:
    places = np.arange(100)
    long, short = (list(random_flights(places, PAPER_AIRCRAFT, 40, window, 9)) for window in (600.0, 60.0))
    for slow, fast in zip(long, short, strict=True):
        assert (slow.origin, slow.destination, slow.aircraft) == (fast.origin, fast.destination, fast.aircraft)
        assert fast.departure_ms == pytest.approx(slow.departure_ms / 10, abs=1)
