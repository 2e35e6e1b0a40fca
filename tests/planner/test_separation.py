"""The independent checker: what it must find, what it must let pass, and that it looks at everything."""

import dataclasses
import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.airmatrix import AirMatrix, IntArray
from planner.airspace import Airspace, Building, OccupancyRule
from planner.errors import Block
from planner.separation import Approach, CheckedFlight, Kind, Report, Violation, verify
from tests.reference.separation import apart_at, blocks_held, blocks_needed, nearest_beside, nearest_level

SIDE_M, HEIGHT_M = 20.0, 40.0
EPOCH_MS = 1_795_334_400_000

Stop = tuple[Block, int, int]


def airspace(
    dimensions: Block = (6, 6, 3),
    rule: OccupancyRule = OccupancyRule.CONTAINMENT,
    *,
    occupied: Iterable[Block] = (),
    buildings: tuple[Building, ...] = (),
) -> Airspace:
    """Return an airspace of 20 m x 20 m x 40 m blocks; buildings do not occupy blocks unless told."""
    grid = AirMatrix(3414, 16_000.0, 34_000.0, SIDE_M, HEIGHT_M, dimensions)
    blocked = np.zeros(grid.block_count, dtype=np.bool_)
    blocked[[grid.index(block) for block in occupied]] = True
    return Airspace("test", "Test", grid, dimensions[2] * HEIGHT_M, blocked, rule, buildings=buildings)


AIRSPACE = airspace()
MIDPOINT = airspace(rule=OccupancyRule.MIDPOINT)


def flight(
    name: str,
    *stops: Stop,
    within: Airspace = AIRSPACE,
    holds: Iterable[Stop] | None = None,
    held: tuple[int, int] | None = None,
) -> CheckedFlight:
    """Return a flight over stops (block, arrive, depart) with its holds, or exactly the reservations it needs."""
    grid = within.grid
    block, arrive, depart = columns([(grid.index(block), *times) for block, *times in stops])
    bare = CheckedFlight(name, block, arrive, depart, *columns([]), held=held)
    rows = [(grid.index(block), *times) for block, *times in holds] if holds is not None else runs(bare, within)
    return holding(bare, rows)


def holding(one: CheckedFlight, rows: Sequence[tuple[int, ...]]) -> CheckedFlight:
    """Return a flight with these reservations (block, enter, exit)."""
    block, enter_ms, exit_ms = columns(rows)
    return dataclasses.replace(one, hold_block=block, hold_enter_ms=enter_ms, hold_exit_ms=exit_ms)


def columns(rows: Sequence[tuple[int, ...]]) -> tuple[IntArray, IntArray, IntArray]:
    """Turn rows of three into three arrays."""
    first, second, third = np.array(rows, dtype=np.int64).reshape(-1, 3).T.copy()
    return first, second, third


def runs(trajectory: CheckedFlight, within: Airspace) -> list[tuple[int, int, int]]:
    """Return the reservations a trajectory needs, as few as possible."""
    needed = blocks_needed(within, trajectory)
    starts = sorted((block, time) for block, time in needed if (block, time - 1) not in needed)
    ends = sorted((block, time) for block, time in needed if (block, time + 1) not in needed)
    return [(block, enter, leave + 1) for (block, enter), (_, leave) in zip(starts, ends, strict=True)]


def found(report: Report, kind: Kind) -> list[tuple[tuple[str, ...], Block, int, int]]:
    """Return the violations of one kind: flights, block, from, to."""
    return [(v.flights, v.block, v.from_ms, v.to_ms) for v in report.violations if v.kind is kind]


def too_near(report: Report) -> set[frozenset[str]]:
    """Return the pairs of flights that are nearer than a block, promised or not."""
    return {frozenset(v.flights) for v in (*report.violations, *report.near_misses) if v.kind is Kind.TOO_NEAR}


def moved(flights: Iterable[CheckedFlight], by_ms: int) -> list[CheckedFlight]:
    """Return the same flights at another time."""
    return [
        dataclasses.replace(
            one,
            arrive_ms=one.arrive_ms + by_ms,
            depart_ms=one.depart_ms + by_ms,
            hold_enter_ms=one.hold_enter_ms + by_ms,
            hold_exit_ms=one.hold_exit_ms + by_ms,
            held=None if one.held is None else (one.held[0] + by_ms, one.held[1] + by_ms),
        )
        for one in flights
    ]


def nearest(approach: Approach | None) -> tuple[float, float]:
    """Return the distances of an approach that must exist, to the micrometre."""
    assert approach is not None
    return round(approach.horizontal_m, 6), round(approach.vertical_m, 6)


# Separation


HEAD_ON = (
    flight("east", ((0, 0, 0), 0, 0), ((1, 0, 0), 1000, 1000)),
    flight("west", ((1, 0, 0), 0, 0), ((0, 0, 0), 1000, 1000)),
)


def test_flights_that_meet_head_on_come_to_no_distance_half_way() -> None:
    report = verify(AIRSPACE, HEAD_ON)

    assert report.closest == Approach(("east", "west"), (0, 0, 0), 500, 0.0, 0.0)
    assert found(report, Kind.TOO_NEAR) == [(("east", "west"), (0, 0, 0), 500, 500)]


def test_diagonals_that_cross_at_one_edge_collide_though_they_share_no_block() -> None:
    crossing = (
        flight("a", ((0, 0, 0), 0, 0), ((1, 1, 0), 1000, 1000), within=MIDPOINT),
        flight("b", ((1, 0, 0), 0, 0), ((0, 1, 0), 1000, 1000), within=MIDPOINT),
    )

    assert found(verify(MIDPOINT, crossing), Kind.OVERLAP) == []
    assert nearest(verify(MIDPOINT, crossing).closest) == (0, 0)
    assert found(verify(AIRSPACE, crossing), Kind.TOO_NEAR) == [(("a", "b"), (0, 0, 0), 500, 500)]


def test_parallel_neighbours_at_exactly_a_block_side_are_separated() -> None:
    report = verify(
        AIRSPACE,
        [
            flight("east", ((0, 0, 0), 0, 0), ((1, 0, 0), 900, 900), ((2, 0, 0), 1800, 1800)),
            flight("west", ((2, 1, 0), 0, 0), ((1, 1, 0), 700, 700), ((0, 1, 0), 1400, 1400)),
        ],
    )

    assert report.ok
    assert nearest(report.closest) == (20, 0)


def test_flights_stacked_at_exactly_a_block_height_are_separated() -> None:
    report = verify(
        AIRSPACE,
        [
            flight("low", ((0, 0, 0), 0, 0), ((1, 0, 0), 900, 900)),
            flight("high", ((1, 0, 1), 0, 0), ((0, 0, 1), 900, 900)),
        ],
    )

    assert report.ok
    assert report.closest is None
    assert report.closest_vertical is not None
    assert report.closest_vertical.vertical_m == 40


def test_a_flight_that_climbs_towards_one_above_it_is_too_near_once_within_a_block_height() -> None:
    report = verify(
        AIRSPACE,
        [
            flight("climbing", ((0, 0, 0), 0, 0), ((0, 0, 1), 4000, 4000)),
            flight("standing", ((0, 0, 2), 0, 4000)),
        ],
    )
    assert report.ok

    report = verify(
        AIRSPACE,
        [
            flight("climbing", ((0, 0, 0), 0, 0), ((0, 0, 1), 4000, 4000)),
            flight("standing", ((0, 0, 1), 0, 2000)),
        ],
    )
    assert too_near(report) == {frozenset({"climbing", "standing"})}
    assert nearest(report.closest_vertical) == (0, 20)


def test_a_hovering_flight_is_judged_against_one_that_passes() -> None:
    hovering = flight("hovering", ((2, 1, 0), 0, 60_000))
    passing = flight("passing", *(((i, 0, 0), 30_000 + 1000 * i, 30_000 + 1000 * i) for i in range(5)))
    through = flight("through", *(((i, 1, 0), 30_000 + 1000 * i, 30_000 + 1000 * i) for i in range(5)))

    assert verify(AIRSPACE, [hovering, passing]).closest == Approach(
        ("hovering", "passing"), (2, 1, 0), 32_000, 20.0, 0.0
    )
    assert found(verify(AIRSPACE, [hovering, through]), Kind.TOO_NEAR) == [
        (("hovering", "through"), (2, 1, 0), 32_000, 32_000)
    ]


def test_a_flight_is_not_judged_against_itself() -> None:
    to_and_fro = flight("one", ((0, 0, 0), 0, 0), ((1, 0, 0), 1000, 1000), ((0, 0, 0), 2000, 2000))

    report = verify(AIRSPACE, [to_and_fro])

    assert report.ok
    assert (report.closest, report.closest_vertical, report.flight_pairs) == (None, None, 0)


@pytest.mark.parametrize(("gap_ms", "closest_m"), [(0, 0.0), (1, None)])
def test_flights_through_one_block_meet_only_if_they_share_an_instant(gap_ms: int, closest_m: float | None) -> None:
    leaving = flight("leaving", ((0, 0, 0), 0, 0), ((1, 0, 0), 1000, 1000))
    coming = flight("coming", ((1, 0, 0), 1000 + gap_ms, 1000 + gap_ms), ((2, 0, 0), 2000 + gap_ms, 2000 + gap_ms))

    report = verify(AIRSPACE, [leaving, coming])

    assert (report.closest.horizontal_m if report.closest else None) == closest_m
    assert report.ok == (closest_m is None)
    assert report.flight_pairs == (0 if closest_m is None else 1)


@pytest.mark.parametrize("blocks", [1, 2, 3, 5, 8, 13, 34, 57])
def test_the_closest_approach_is_exact_however_far_the_flights_are(blocks: int) -> None:
    wide = airspace((60, 3, 2))

    report = verify(
        wide,
        [
            flight("here", ((1, 1, 0), 0, 1000), within=wide),
            flight("there", ((1 + blocks, 1, 0), 0, 1000), within=wide),
            flight("above", ((1, 1, 1), 0, 1000), within=wide),
            flight("later", ((1, 1, 0), 1001, 2000), within=wide),
        ],
    )

    assert report.ok
    assert report.closest is not None
    assert report.closest.flights == ("here", "there")
    assert nearest(report.closest) == (20 * blocks, 0)


@pytest.mark.parametrize("step", [(1, 0), (0, 1), (1, 1), (1, -1)], ids=["east", "north", "north-east", "south-east"])
def test_the_nearest_pair_is_found_whatever_lies_between_and_however_near_others_are(step: tuple[int, int]) -> None:
    wide = airspace((30, 30, 1))
    i, j = step

    report = verify(
        wide,
        [
            flight("corner", ((0, 0, 0), 2000, 3000), within=wide),
            flight("here", ((2, 2 + (j < 0), 0), 0, 1000), within=wide),
            flight("there", ((2 + i, 2 + (j > 0), 0), 0, 1000), within=wide),
            flight("one", ((20, 20, 0), 0, 1000), within=wide),
            flight("other", ((22, 20, 0), 0, 1000), within=wide),
        ],
    )

    assert report.closest is not None
    assert report.closest.flights == ("here", "there")
    assert nearest(report.closest) == (round(float(20 * np.hypot(i, j)), 6), 0)


def test_every_pair_that_is_too_near_is_found_whatever_the_nearest() -> None:
    others = (
        flight("standing", ((4, 3, 1), 0, 1000)),
        flight("cut", ((3, 3, 1), 0, 0), ((4, 3, 1), 1000, 1000), held=(300, 300)),
    )

    report = verify(AIRSPACE, [*HEAD_ON, *others])

    assert too_near(report) == {frozenset({"east", "west"}), frozenset({"standing", "cut"})}


def test_under_the_midpoint_rule_what_comes_near_is_reported_and_no_violation() -> None:
    report = verify(MIDPOINT, [flight(one.id, *stops_of(one), within=MIDPOINT, holds=[]) for one in HEAD_ON])

    assert {v.kind for v in report.violations} == {Kind.NOT_HELD}
    assert [(v.kind, v.flights) for v in report.near_misses] == [(Kind.TOO_NEAR, ("east", "west"))]


def stops_of(one: CheckedFlight) -> list[Stop]:
    """Return the stops a flight was made of."""
    rows = zip(one.block.tolist(), one.arrive_ms.tolist(), one.depart_ms.tolist(), strict=True)
    return [(AIRSPACE.grid.block(block), arrive, depart) for block, arrive, depart in rows]


# Reservations


def test_where_reservations_are_wrong_wholesale_distances_are_not_looked_at() -> None:
    many = [((1, 1, 1), 0, 1000)] * 10_002
    report = verify(AIRSPACE, [flight("one", holds=many)])

    assert len(report.violations) == 10_001
    assert not report.motion_judged
    assert verify(AIRSPACE, [flight("one", holds=many[1:])]).motion_judged


def test_reservations_of_a_block_that_touch_are_disjoint() -> None:
    report = verify(
        AIRSPACE,
        [
            flight("first", holds=[((1, 1, 1), 0, 1000)]),
            flight("second", holds=[((1, 1, 1), 1000, 2000), ((1, 1, 0), 500, 1500)]),
        ],
    )

    assert report.ok
    assert (report.flights, report.released, report.reservations) == (2, 2, 3)


def test_an_overlap_of_one_millisecond_is_found() -> None:
    report = verify(
        AIRSPACE,
        [flight("first", holds=[((1, 1, 1), 0, 1001)]), flight("second", holds=[((1, 1, 1), 1000, 2000)])],
    )

    assert found(report, Kind.OVERLAP) == [(("first", "second"), (1, 1, 1), 1000, 1001)]


def test_a_block_reserved_twice_by_one_flight_is_an_overlap() -> None:
    report = verify(AIRSPACE, [flight("one", holds=[((0, 0, 0), 0, 9), ((0, 0, 0), 5, 7)])])

    assert found(report, Kind.OVERLAP) == [(("one", "one"), (0, 0, 0), 5, 7)]


def test_an_overlap_with_a_long_reservation_is_found_behind_a_short_one() -> None:
    report = verify(
        AIRSPACE,
        [
            flight("long", holds=[((0, 0, 0), 0, 9000), ((1, 0, 0), 0, 90_000)]),
            flight("short", holds=[((0, 0, 0), 100, 200)]),
            flight("late", holds=[((0, 0, 0), 8000, 9500)]),
        ],
    )

    assert found(report, Kind.OVERLAP) == [
        (("long", "short"), (0, 0, 0), 100, 200),
        (("long", "late"), (0, 0, 0), 8000, 9000),
    ]


def test_reservations_on_buildings_outside_the_grid_or_without_duration_are_found() -> None:
    built = airspace(occupied=[(1, 0, 0)])
    outside = built.grid.block_count

    report = verify(
        built,
        [
            CheckedFlight("one", *columns([]), *columns([(1, 0, 9), (outside, 10, 19), (-1, 20, 29)])),
            flight("two", holds=[((2, 0, 0), 5, 5), ((3, 0, 0), 7, 6), ((4, 0, 0), 7, 8)]),
            flight("three", holds=[((2, 0, 0), 0, 10), ((3, 0, 0), 0, 10)]),
        ],
    )

    assert found(report, Kind.RESERVED_OCCUPIED) == [(("one",), (1, 0, 0), 0, 9)]
    assert found(report, Kind.RESERVED_OUTSIDE) == [
        (("one",), built.grid.block(outside), 10, 19),
        (("one",), built.grid.block(-1), 20, 29),
    ]
    assert found(report, Kind.EMPTY) == [(("two",), (2, 0, 0), 5, 5), (("two",), (3, 0, 0), 7, 6)]
    assert len(report.violations) == 5


# Trajectories and what they hold


def test_a_trajectory_through_a_building_or_out_of_the_grid_is_found() -> None:
    built = airspace(occupied=[(1, 0, 0)])
    through = flight("through", ((0, 0, 0), 0, 0), ((1, 0, 0), 10, 12), within=built)
    out = CheckedFlight("out", *columns([(-1, 0, 5)]), *columns([]))

    report = verify(built, [through, out])

    assert found(report, Kind.OCCUPIED) == [(("through",), (1, 0, 0), 10, 12)]
    assert found(report, Kind.OUTSIDE) == [(("out",), built.grid.block(-1), 0, 5)]
    assert (report.legs, report.flights, report.released) == (2, 2, 1)


@pytest.mark.parametrize(
    ("stops", "where"),
    [
        ([((0, 0, 0), 0, 0), ((2, 0, 0), 10, 10)], ((0, 0, 0), 0, 0)),
        ([((0, 0, 0), 0, 0), ((0, 0, 0), 10, 10)], ((0, 0, 0), 0, 0)),
        ([((5, 0, 0), 0, 0), ((0, 1, 0), 10, 10)], ((5, 0, 0), 0, 0)),
        ([((0, 0, 0), 0, 5), ((1, 0, 0), 5, 10)], ((0, 0, 0), 0, 5)),
        ([((0, 0, 0), 0, 5), ((1, 0, 0), 10, 9)], ((1, 0, 0), 10, 9)),
    ],
    ids=["two blocks at once", "to itself", "around the grid's edge", "in no time", "leaves before it comes"],
)
def test_a_trajectory_that_jumps_or_goes_back_in_time_is_found(stops: list[Stop], where: Stop) -> None:
    report = verify(AIRSPACE, [flight("odd", *stops, holds=[])])

    assert found(report, Kind.DISCONTINUOUS) == [(("odd",), *where)]


CLIMB = (((1, 1, 0), 0, 100), ((2, 1, 1), 400, 500))


def climb_holding(*changes: tuple[Block, int, int], rule: OccupancyRule = OccupancyRule.CONTAINMENT) -> Report:
    """Judge a slanting climb whose reservations are all of its box, but for these changes."""
    holds = dict.fromkeys(itertools.product((1, 2), (1,), (0, 1)), (0, 501))
    holds |= {block: (enter, leave) for block, enter, leave in changes}
    rows = [(block, *times) for block, times in holds.items()]
    return verify(airspace(rule=rule), [flight("climbing", *CLIMB, holds=rows)])


def test_a_flight_that_holds_the_whole_box_of_its_links_is_contained() -> None:
    assert climb_holding().ok
    assert climb_holding(((1, 1, 0), 0, 401), ((1, 1, 1), 100, 401), ((2, 1, 0), 100, 401), ((2, 1, 1), 100, 501)).ok


@pytest.mark.parametrize(
    ("hold", "missing"),
    [
        (((2, 1, 0), 0, 0), ((2, 1, 0), 100, 401)),
        (((1, 1, 1), 0, 400), ((1, 1, 1), 400, 401)),
        (((1, 1, 1), 101, 401), ((1, 1, 1), 100, 101)),
        (((1, 1, 0), 1, 401), ((1, 1, 0), 0, 1)),
        (((1, 1, 0), 90, 401), ((1, 1, 0), 0, 90)),
        (((2, 1, 1), 100, 401), ((2, 1, 1), 401, 501)),
        (((2, 1, 1), 100, 500), ((2, 1, 1), 500, 501)),
        (((1, 1, 0), 0, 50), ((1, 1, 0), 50, 401)),
    ],
    ids=[
        "a side block",
        "the instant of arrival",
        "the first instant of the link",
        "the first instant",
        "the first hover",
        "the last hover",
        "the last instant",
        "the rest of a hover and the link as one",
    ],
)
def test_a_flight_without_one_of_its_reservations_is_found(hold: Stop, missing: Stop) -> None:
    report = climb_holding(hold)

    assert found(report, Kind.NOT_HELD) == [(("climbing",), *missing)]


def test_a_reservation_of_another_flight_does_not_help() -> None:
    report = verify(
        AIRSPACE,
        [flight("bare", ((0, 0, 0), 0, 10), holds=[]), flight("rich", holds=[((0, 0, 0), 0, 11)])],
    )

    assert found(report, Kind.NOT_HELD) == [(("bare",), (0, 0, 0), 0, 11)]


@pytest.mark.parametrize(
    ("near_leaves", "far_enters", "missing"),
    [
        (251, 250, []),
        (250, 250, [((1, 1, 0), 250, 251)]),
        (251, 251, [((2, 1, 1), 250, 251)]),
    ],
)
def test_the_midpoint_rule_asks_for_each_half_and_for_both_at_the_midpoint(
    near_leaves: int, far_enters: int, missing: list[Stop]
) -> None:
    report = climb_holding(
        ((1, 1, 0), 0, near_leaves),
        ((2, 1, 1), far_enters, 501),
        ((1, 1, 1), 0, 0),
        ((2, 1, 0), 0, 0),
        rule=OccupancyRule.MIDPOINT,
    )

    assert found(report, Kind.NOT_HELD) == [(("climbing",), *stop) for stop in missing]


def test_only_the_part_of_a_flight_that_is_still_held_is_judged() -> None:
    cut = flight("cut", *CLIMB, held=(0, 200))
    other = flight("other", ((2, 1, 1), 300, 500))

    report = verify(AIRSPACE, [cut, other])

    assert report.ok
    assert (report.flights, report.cut, report.released, report.flight_pairs) == (2, 1, 0, 0)
    assert too_near(verify(AIRSPACE, [flight("whole", *CLIMB), other])) == {frozenset({"whole", "other"})}


def test_a_flight_cut_within_a_link_is_where_it_was_then() -> None:
    cut = flight("cut", *CLIMB, held=(175, 250))
    standing = flight("standing", ((1, 3, 0), 0, 1000))

    # A quarter of the link: 5 m east of its start and 10 m up, two blocks south of the one that stands.
    report = verify(AIRSPACE, [cut, standing])
    assert nearest(report.closest) == (round(float(np.hypot(40, 5)), 6), 10)
    assert report.closest is not None
    assert report.closest.time_ms == 175


def test_arrays_that_differ_in_length_are_refused() -> None:
    with pytest.raises(ValueError, match="trajectory"):
        dataclasses.replace(HEAD_ON[0], block=HEAD_ON[0].block[:1])
    with pytest.raises(ValueError, match="reservations"):
        dataclasses.replace(HEAD_ON[0], hold_exit_ms=HEAD_ON[0].hold_exit_ms[:1])


def test_no_flights_are_no_violation() -> None:
    report = verify(AIRSPACE, [])

    assert report.ok
    assert (report.flights, report.legs, report.closest, report.clearance) == (0, 0, None, None)


# Buildings


def building(height_m: float, *rings: list[tuple[float, float]], name: str = "tower") -> Building:
    """Return a building over rings of corners, in metres from the grid's corner: an outline, then courtyards."""
    return Building(name, height_m, "test", {"type": "Polygon", "coordinates": degrees(rings)})


def degrees(rings: Iterable[list[tuple[float, float]]]) -> list[Any]:
    """Return closed rings in degrees."""
    grid = AIRSPACE.grid
    corners = [np.array([*ring, ring[0]]).T for ring in rings]
    return [np.column_stack(grid.unproject(x + grid.origin_x_m, y + grid.origin_y_m)).tolist() for x, y in corners]


def box(west: float, south: float, east: float, north: float) -> list[tuple[float, float]]:
    """Return the corners of a rectangle in metres."""
    return [(west, south), (east, south), (east, north), (west, north)]


def clearance_m(report: Report) -> float:
    """Return the smallest clearance, to a hundredth of a millimetre."""
    assert report.clearance is not None
    return round(report.clearance.distance_m, 5)


DIAGONAL = (((0, 0, 0), 0, 0), ((1, 1, 0), 1000, 1000))


def test_a_diagonal_that_cuts_a_buildings_corner_is_found() -> None:
    built = airspace(buildings=(building(30, box(20, 0, 40, 20)),))
    report = verify(built, [flight("cutting", *DIAGONAL)])

    assert clearance_m(report) == 0
    assert found(report, Kind.BUILDING) == [(("cutting",), (0, 0, 0), 0, 0)]
    assert "tower" in report.violations[0].detail

    report = verify(dataclasses.replace(built, rule=OccupancyRule.MIDPOINT), [flight("cutting", *DIAGONAL)])
    assert [(v.kind, v.flights) for v in report.near_misses] == [(Kind.BUILDING, ("cutting",))]
    assert found(report, Kind.BUILDING) == []


def test_half_a_block_from_a_building_is_clear() -> None:
    built = airspace(buildings=(building(300, box(19, 20, 21, 40)),))

    report = verify(built, [flight("along", ((0, 0, 0), 0, 0), ((1, 0, 0), 1000, 1000))])

    assert report.ok
    assert clearance_m(report) == 10
    assert report.clearance is not None
    assert (report.clearance.flight, report.clearance.building) == ("along", "tower")


@pytest.mark.parametrize(("reach_m", "clear"), [(0.001, True), (0.1, False)])
def test_what_static_occupancy_overlooks_of_a_corner_is_no_violation(reach_m: float, clear: bool) -> None:
    corner = [(30.0, 20 - reach_m), (30 + 20.0, 40.0), (30 - 20.0, 40.0)]
    built = airspace(buildings=(building(30, corner),))

    report = verify(built, [flight("along", ((0, 0, 0), 0, 0), ((1, 0, 0), 10, 10), ((2, 0, 0), 20, 20))])

    assert clearance_m(report) == 10 - reach_m
    assert report.ok == clear


@pytest.mark.parametrize(("height_m", "clear"), [(40.0, True), (40.001, False)])
def test_a_roof_half_a_block_height_below_is_far_enough(height_m: float, clear: bool) -> None:
    built = airspace(buildings=(building(height_m, box(20, 0, 40, 20)),))

    report = verify(built, [flight("over", ((0, 0, 1), 0, 0), ((1, 0, 1), 10, 10), ((2, 0, 1), 20, 20))])

    assert report.ok == clear
    assert report.clearance is None if clear else clearance_m(report) == 0


@pytest.mark.parametrize("climbs", [False, True], ids=["sinking", "climbing"])
def test_only_the_part_of_a_leg_that_is_low_is_near_a_building(climbs: bool) -> None:
    # From 60 m over block 2 to 20 m over block 1 and on to block 0: it is below 30 m + 20 m up to x = 45 m.
    built = airspace(buildings=(building(30, box(48, 0, 58, 20)),))
    sinking = (((2, 0, 1), 0, 0), ((1, 0, 0), 4000, 4000), ((0, 0, 0), 6000, 6000))

    report = verify(built, [flight("one", *(reversed_in_time(sinking) if climbs else sinking))])

    assert clearance_m(report) == 3
    assert len(found(report, Kind.BUILDING)) == 1


def reversed_in_time(stops: tuple[Stop, ...]) -> list[Stop]:
    """Return the way back, some time later."""
    return [(block, 20_000 - depart, 20_000 - arrive) for block, arrive, depart in reversed(stops)]


def test_a_flight_straight_up_a_courtyard_is_as_far_as_the_walls() -> None:
    ring = building(100, box(0, 0, 60, 60), box(21, 18, 39, 42))
    built = airspace(buildings=(ring,))

    report = verify(built, [flight("up", ((1, 1, 0), 0, 0), ((1, 1, 1), 1000, 1000))])

    assert clearance_m(report) == 9


def test_every_part_of_a_building_in_parts_counts() -> None:
    parts = [degrees([box(100, 100, 120, 120)]), degrees([box(25, 35, 35, 45)])]
    built = airspace(buildings=(Building("halves", 30, "test", {"type": "MultiPolygon", "coordinates": parts}),))

    report = verify(built, [flight("below", ((1, 0, 0), 0, 1000))])

    assert clearance_m(report) == 25


def test_the_clearance_is_exact_however_far_the_building_is() -> None:
    built = airspace(buildings=(building(30, box(1020, 0, 1030, 20)), building(30, box(-3000, 0, -2990, 20))))

    assert clearance_m(verify(built, [flight("far", ((0, 0, 0), 0, 1000))])) == 1010


def test_every_flight_on_a_link_that_is_too_near_is_named() -> None:
    cut_by_a_corner = building(30, box(20, 0, 40, 20))
    four_metres_aside = building(30, box(94, 88, 96, 92))
    built = airspace(buildings=(cut_by_a_corner, four_metres_aside))
    flights = [
        flight("there", *DIAGONAL),
        flight("back", *reversed_in_time(DIAGONAL)),
        flight("cut before the corner", *DIAGONAL, held=(0, 0)),
        flight("elsewhere", ((4, 4, 0), 0, 1000)),
        flight("clear", ((0, 4, 0), 0, 0), ((0, 5, 0), 1000, 1000)),
    ]

    report = verify(built, flights)

    assert sorted(named for named, *_ in found(report, Kind.BUILDING)) == [("back",), ("elsewhere",), ("there",)]


# Everything is looked at


def test_times_since_the_epoch_keep_their_precision() -> None:
    wide = airspace((60, 60, 3))
    pair = [
        flight("a", *(((i, 30, 1), 1750 * i, 1750 * i) for i in range(40)), within=wide, holds=[]),
        flight("b", *(((20, 59 - j, 1), 1667 * j, 1667 * j) for j in range(40)), within=wide, holds=[]),
    ]

    early, late = verify(wide, pair), verify(wide, moved(pair, EPOCH_MS))

    assert early.closest is not None
    assert late.closest is not None
    assert late.closest.time_ms == early.closest.time_ms + EPOCH_MS
    assert late.closest.horizontal_m == early.closest.horizontal_m


def test_a_crowd_is_judged_completely() -> None:
    """More pairs of legs than are evaluated at once: a column of standing flights, and one in the wrong place."""
    tall = airspace((2, 1, 400))
    crowd = [
        flight(str(number), (tall.grid.block(number), 0, 1000), within=tall) for number in range(tall.grid.block_count)
    ]

    report = verify(tall, crowd)
    assert report.ok
    assert report.leg_pairs > 250_000
    assert report.flight_pairs == 800 * 799 // 2
    assert (nearest(report.closest), nearest(report.closest_vertical)) == ((20, 0), (0, 40))

    for place in (0, 400, 799):
        report = verify(tall, [*crowd, flight("intruder", (tall.grid.block(place), 500, 600), within=tall)])
        assert too_near(report) == {frozenset({"intruder", str(place)})}
        assert found(report, Kind.OVERLAP) == [((str(place), "intruder"), tall.grid.block(place), 500, 601)]


@pytest.mark.parametrize("place", [0, 1300, 2499])
def test_a_crowd_is_judged_completely_against_buildings(place: int) -> None:
    """More links and stands than are looked up at once."""
    x, y = (AIRSPACE.grid.block_side_m * (part + 0.5) for part in (place % 50, place // 50))
    wide = airspace((50, 50, 1), buildings=(building(30, box(x + 3, y, x + 4, y + 1)),))
    crowd = [flight(str(number), (wide.grid.block(number), 0, 9), within=wide) for number in range(2500)]

    report = verify(wide, crowd)

    assert clearance_m(report) == 3
    assert found(report, Kind.BUILDING) == [((str(place),), wide.grid.block(place), 0, 0)]


def test_progress_is_reported_for_each_stage() -> None:
    seen: list[tuple[str, float]] = []
    built = airspace(buildings=(building(30, box(20, 0, 40, 20)),))

    verify(built, HEAD_ON, lambda stage, done: seen.append((stage, done)))

    assert {stage for stage, done in seen if done == 1} == {"reservations", "closest approach", "buildings"}
    assert all(0 <= done <= 1 for _, done in seen)


def neighbours(block: Block, dimensions: Block) -> list[Block]:
    """Return the up to 26 blocks around one."""
    ranges = [range(max(0, part - 1), min(count, part + 2)) for part, count in zip(block, dimensions, strict=True)]
    return [(i, j, k) for i, j, k in itertools.product(*ranges) if (i, j, k) != block]


@st.composite
def trajectories(draw: st.DrawFn, dimensions: Block, longest_ms: int, latest_ms: int) -> list[Stop]:
    """Draw a walk over neighbouring blocks, with and without hovering."""
    block = draw(st.tuples(*(st.integers(0, count - 1) for count in dimensions)))
    time = draw(st.integers(0, latest_ms))
    hover = st.one_of(st.just(0), st.just(0), st.integers(0, longest_ms))
    stops = []
    for _ in range(draw(st.integers(1, 5))):
        depart = time + draw(hover)
        stops.append((block, time, depart))
        block = draw(st.sampled_from(neighbours(block, dimensions)))
        time = depart + draw(st.one_of(st.just(longest_ms), st.integers(1, longest_ms)))
    return stops


@st.composite
def traffic(draw: st.DrawFn, dimensions: Block = (6, 6, 3), most: int = 6) -> tuple[Airspace, list[CheckedFlight]]:
    """Draw a few flights, most of them at the same time, that know nothing of each other."""
    within = airspace(dimensions)
    routes = draw(st.lists(trajectories(dimensions, 40, 120), min_size=2, max_size=most))
    start_ms = draw(st.one_of(st.integers(0, 50), st.just(EPOCH_MS)))
    flights = [flight(str(number), *stops, within=within, holds=[]) for number, stops in enumerate(routes)]
    return within, moved(flights, start_ms)


@settings(deadline=None, max_examples=150)
@given(traffic(dimensions=(3, 3, 2), most=2))
def test_no_sampled_instant_is_nearer_than_the_closed_form_and_one_is_as_near(
    situation: tuple[Airspace, list[CheckedFlight]],
) -> None:
    within, (one, other) = situation
    begin, end = max(one.arrive_ms[0], other.arrive_ms[0]), min(one.depart_ms[-1], other.depart_ms[-1])
    times = [int(begin) + 0.125 * step for step in range(8 * max(0, int(end - begin)) + (begin <= end))]
    samples = [apart_at(within.grid, one, other, time) for time in times]

    report = verify(within, [one, other])

    level = [apart.horizontal_m for apart in samples if apart.vertical_m < HEIGHT_M - 2e-6]
    beside = [apart.vertical_m for apart in samples if apart.horizontal_m < SIDE_M - 2e-6]
    for approach, sampled in ((report.closest, level), (report.closest_vertical, beside)):
        assert approach is not None or not sampled
        if approach is not None:
            own = approach.horizontal_m if approach is report.closest else approach.vertical_m
            assert own <= min(sampled, default=np.inf) + 1e-6
    if report.closest is not None:
        # A link lasts at least 1 ms, so that in the half to which times are rounded nobody moves farther than this.
        apart = apart_at(within.grid, one, other, report.closest.time_ms)
        assert abs(apart.horizontal_m - report.closest.horizontal_m) <= 2 * SIDE_M * 2**0.5
    assert bool(too_near(report)) >= any(
        apart.horizontal_m < SIDE_M - 2e-6 and apart.vertical_m < HEIGHT_M - 2e-6 for apart in samples
    )


@pytest.mark.parametrize("dimensions", [(4, 4, 2), (9, 9, 3), (50, 40, 1)])
@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_the_search_finds_what_comparing_all_pairs_finds(dimensions: Block, data: st.DataObject) -> None:
    within, flights = data.draw(traffic(dimensions=dimensions, most=8))

    report = verify(within, flights)

    level, beside = nearest_level(within.grid, flights), nearest_beside(within.grid, flights)
    closest = min((moment.apart.horizontal_m for moment in level), default=None)
    closest_vertical = min((moment.apart.vertical_m for moment in beside), default=None)
    near = {moment.pair for moment in level if moment.apart.horizontal_m < SIDE_M - 1e-6}
    assert (report.closest.horizontal_m if report.closest else None) == pytest.approx(closest, abs=1e-6)
    assert (report.closest_vertical.vertical_m if report.closest_vertical else None) == pytest.approx(
        closest_vertical, abs=1e-6
    )
    assert too_near(report) == {frozenset(map(str, pair)) for pair in near}


@settings(deadline=None, max_examples=60)
@given(traffic(), st.integers(1, 200))
def test_where_the_buckets_of_time_begin_makes_no_difference(
    situation: tuple[Airspace, list[CheckedFlight]], by_ms: int
) -> None:
    within, flights = situation

    here, there = verify(within, flights), verify(within, moved(flights, by_ms))

    assert at_another_time(here.violations, by_ms) == list(there.violations)
    assert (here.leg_pairs, here.flight_pairs) == (there.leg_pairs, there.flight_pairs)


def at_another_time(violations: Iterable[Violation], by_ms: int) -> list[Violation]:
    """Return violations as they are of flights moved in time."""
    return [dataclasses.replace(v, from_ms=v.from_ms + by_ms, to_ms=v.to_ms + by_ms) for v in violations]


@pytest.mark.parametrize("rule", OccupancyRule)
@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_reservations_are_compared_with_trajectories_to_the_millisecond(
    rule: OccupancyRule, data: st.DataObject
) -> None:
    within = airspace((3, 3, 2), rule)
    routes = data.draw(st.lists(trajectories((3, 3, 2), 7, 10), min_size=1, max_size=3))
    spans = st.one_of(st.none(), st.tuples(st.integers(0, 20), st.integers(0, 20)))
    flights = []
    for number, stops in enumerate(routes):
        whole = flight(str(number), *stops, within=within, held=data.draw(spans))
        changed = [
            (block, enter + data.draw(NUDGE), leave + data.draw(NUDGE)) for block, enter, leave in runs(whole, within)
        ]
        lost = data.draw(st.sets(st.integers(0, 2 * len(changed)), max_size=2))
        flights.append(holding(whole, [row for number, row in enumerate(changed) if number not in lost]))

    report = verify(within, flights)

    held = [blocks_held(one) for one in flights]
    missing = {
        (one.id, block, time)
        for one, own in zip(flights, held, strict=True)
        for block, time in blocks_needed(within, one)
        if not own[block, time]
    }
    assert every_ms(within, found(report, Kind.NOT_HELD)) == Counter(missing)
    twice = {tick for tick, times in sum(held, Counter[tuple[int, int]]()).items() if times > 1}
    overlaps = every_ms(within, found(report, Kind.OVERLAP))
    assert {(block, time) for _, block, time in overlaps} == twice


NUDGE = st.sampled_from([0, 0, 0, 0, -1, 1, 3])


def every_ms(
    within: Airspace, findings: Iterable[tuple[tuple[str, ...], Block, int, int]]
) -> Counter[tuple[str, int, int]]:
    """Spread findings over their milliseconds: the (first) flight, the block and the ms, counted."""
    return Counter(
        (flights[0], within.grid.index(block), time)
        for flights, block, begin, end in findings
        for time in range(begin, end)
    )
