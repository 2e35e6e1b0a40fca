"""Which typical case a flight is, and which flights are shown."""

import numpy as np
import pytest

from planner.airmatrix import AirMatrix
from planner.errors import Block
from planner.experiments.cases import Case, Comparison, compare, typical
from planner.path import Plan

GRID = AirMatrix(3414, 0.0, 0.0, 20.0, 40.0, (8, 4, 2))
STRAIGHT: list[Block] = [(i, 0, 0) for i in range(6)]


def plan(blocks: list[Block], delay_ms: int = 0, link_ms: int = 1000) -> Plan:
    """Return a plan through these blocks, a second a link, that departs late by its delay."""
    block = np.array([GRID.index(block) for block in blocks])
    times = delay_ms + link_ms * np.arange(len(blocks))
    none = np.empty(0, dtype=np.int64)
    return Plan(block, times, times, link_ms * (len(blocks) - 1), 0, none, none, none, 0, 0, 0, 0, 0)


def comparison(cfa_star: list[Block], delay_ms: int = 0, number: int = 0) -> Comparison:
    """Compare a straight A* trajectory with another."""
    return compare(GRID, number, plan(STRAIGHT), plan(cfa_star, delay_ms))


@pytest.mark.parametrize(
    ("cfa_star", "delay_ms", "case", "common"),
    [
        (STRAIGHT, 0, Case.OVERLAPPING, 1.0),
        (STRAIGHT, 1, Case.WAITING, 1.0),
        ([*STRAIGHT[:2], (2, 1, 0), *STRAIGHT[3:]], 0, Case.SAME_TIME, 5 / 7),
        ([*STRAIGHT[:2], (2, 1, 0), *STRAIGHT[3:]], 1, Case.DETOUR, 5 / 7),
        # Four blocks of eight in common are half of them; two of ten are not.
        ([(0, 0, 0), (1, 1, 0), (2, 1, 0), *STRAIGHT[3:]], 0, Case.SAME_TIME, 4 / 8),
        ([(0, 0, 0), *((i, 1, 0) for i in range(1, 5)), (5, 0, 0)], 0, Case.DIFFERENT, 2 / 10),
        ([(0, 0, 0), *((i, 1, 0) for i in range(1, 5)), (5, 0, 0)], 9, Case.DIFFERENT, 2 / 10),
    ],
)
def test_a_case_follows_from_common_blocks_and_delay(
    cfa_star: list[Block], delay_ms: int, case: Case, common: float
) -> None:
    found = comparison(cfa_star, delay_ms)
    assert found.case is case
    assert found.common == pytest.approx(common)


def test_the_same_blocks_in_another_order_are_another_path() -> None:
    there = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)]
    other = [(0, 0, 0), (0, 1, 0), (1, 0, 0), (1, 1, 0)]
    assert compare(GRID, 0, plan(there), plan(other)).case is Case.SAME_TIME


def test_trajectories_are_as_far_apart_as_the_remotest_block_of_either() -> None:
    assert comparison(STRAIGHT).apart_m == 0
    assert comparison([*STRAIGHT[:2], (2, 3, 0), *STRAIGHT[3:]]).apart_m == 60
    shortened = compare(GRID, 0, plan(STRAIGHT), plan(STRAIGHT[:3]))
    assert shortened.apart_m == 60


def test_the_clearest_example_of_a_case_is_shown_and_the_first_of_equal_ones() -> None:
    near, far = [*STRAIGHT[:2], (2, 1, 0), *STRAIGHT[3:]], [*STRAIGHT[:2], (2, 3, 0), *STRAIGHT[3:]]
    long = compare(GRID, 0, plan(STRAIGHT), plan(STRAIGHT))
    short = compare(GRID, 1, plan(STRAIGHT[:3]), plan(STRAIGHT[:3]))
    comparisons = [
        short,
        long,
        comparison(near, number=2),
        comparison(far, number=3),
        comparison(near, 50, number=4),
        comparison(far, 40, number=5),
        comparison(near, 50, number=6),
    ]
    shown = {case: example.number for case in Case if (example := typical(comparisons, case)) is not None}
    assert shown == {Case.OVERLAPPING: 0, Case.SAME_TIME: 3, Case.DETOUR: 4}


def test_a_case_without_flights_has_no_example() -> None:
    assert typical([], Case.DIFFERENT) is None
