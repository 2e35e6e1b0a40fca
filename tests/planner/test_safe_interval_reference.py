"""The planner against the plain safe-interval planner, in airspaces and traffic that are too large for ticks."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.airspace import Airspace, BoolArray, OccupancyRule
from planner.cfa_star import PlanRequest
from planner.errors import NoPlan, NotPlannable
from tests.planner.drawing import airspace_of
from tests.planner.traffic import (
    EITHER_RULE,
    Situation,
    aircraft_times,
    flight,
    holds_in,
    planner_in,
    reserve,
    situations,
)
from tests.reference.planning import Hold, earliest_arrival, holds_of, is_conflict_free
from tests.reference.safe_interval import SafeIntervalPlanner

FLIGHTS = 30
_LONGEST_SIDE, _LAYERS = 12, 3


@dataclass(frozen=True)
class Rush:
    """An airspace, holds in it that are none of a flight's, and flights in filing order."""

    airspace: Airspace
    closures: tuple[Hold, ...]
    requests: tuple[PlanRequest, ...]


@st.composite
def rushes(draw: st.DrawFn) -> Rush:
    """Draw up to 12 x 12 x 3 blocks, some with a building or closed for a while, and flights that all go at once.

    Sizes, aircraft and shares are drawn one by one, what fills them comes from one drawn seed.
    """
    dimensions = (
        draw(st.integers(4, _LONGEST_SIDE)),
        draw(st.integers(4, _LONGEST_SIDE)),
        draw(st.integers(1, _LAYERS)),
    )
    count = dimensions[0] * dimensions[1] * dimensions[2]
    random = np.random.default_rng(draw(st.integers(0, 1 << 32)))
    occupied = random.random(count) < draw(st.sampled_from([0.0, 0.1, 0.25]))
    occupied[random.choice(count, 2, replace=False)] = False
    dwell_ms = draw(st.sampled_from([0, 0, 5]))
    airspace = airspace_of(dimensions, occupied, rule=draw(EITHER_RULE), terminal_dwell_ms=dwell_ms)
    free = np.flatnonzero(~occupied)
    aircraft = draw(st.lists(aircraft_times(), min_size=1, max_size=3))
    longest_wait, departures_within = draw(st.sampled_from([0, 20, 200])), draw(st.sampled_from([1, 50]))
    requests = []
    for _ in range(FLIGHTS):
        origin, destination = random.choice(free, 2, replace=False).tolist()
        earliest = int(random.integers(departures_within))
        latest = earliest + int(random.integers(longest_wait + 1))
        times = aircraft[random.integers(len(aircraft))]
        requests.append(flight(origin, destination, earliest=earliest, latest=latest, times=times))
    closed = random.random(count) < draw(st.sampled_from([0.0, 0.3]))
    closures = []
    for block in np.flatnonzero(closed & ~occupied).tolist():
        enter = int(random.integers(60))
        closures.append(Hold(block, enter, enter + int(random.integers(1, 40))))
    if draw(st.booleans()):
        closures = _volume(dimensions, occupied, random)
    return Rush(airspace, tuple(closures), tuple(requests))


def _volume(dimensions: tuple[int, int, int], occupied: BoolArray, random: np.random.Generator) -> list[Hold]:
    """Return what closes all blocks of a box, with a ragged end."""
    inside = np.ones(dimensions[::-1], dtype=np.bool_)
    for axis, count in enumerate(inside.shape):
        low, high = np.sort(random.integers(count + 1, size=2))
        outside = (np.arange(count) < low) | (np.arange(count) >= high)
        np.moveaxis(inside, axis, 0)[outside] = False
    enter, until = int(random.integers(20)), int(random.integers(40, 150))
    return [
        Hold(block, enter, until + int(random.integers(8)))
        for block in np.flatnonzero(inside.ravel() & ~occupied).tolist()
    ]


def arrival_by(planner: SafeIntervalPlanner, request: PlanRequest) -> int | None:
    path = planner.earliest_path(request)
    return None if path is None else path[-1].depart_ms


@given(rushes())
@settings(deadline=None, max_examples=60)
def test_flight_after_flight_the_planner_arrives_exactly_when_the_plain_one_does(rush: Rush) -> None:
    planner, plain = planner_in(rush.airspace, rush.closures), SafeIntervalPlanner(rush.airspace)
    plain.reserve(rush.closures)
    for owner, request in enumerate(rush.requests, start=len(rush.closures)):
        try:
            plan = planner.plan(request)
        except (NoPlan, NotPlannable):
            assert plain.earliest_path(request) is None
        else:
            assert plan.arrival_ms == arrival_by(plain, request)
            reserve(planner, holds_in(plan), owner)
            plain.reserve(holds_in(plan))


@given(situations())
@settings(deadline=None, max_examples=100)
def test_the_plain_planner_arrives_exactly_when_the_search_by_ticks_does(situation: Situation) -> None:
    plain = SafeIntervalPlanner(situation.airspace)
    plain.reserve(situation.reservations)
    by_ticks = earliest_arrival(situation.airspace, situation.reservations, situation.request)
    assert arrival_by(plain, situation.request) == by_ticks


@given(situations())
@settings(deadline=None, max_examples=100)
def test_the_plain_planners_trajectory_is_free_of_conflicts_and_departs_in_the_window(situation: Situation) -> None:
    airspace, request = situation.airspace, situation.request
    plain = SafeIntervalPlanner(airspace)
    plain.reserve(situation.reservations)
    path = plain.earliest_path(request)
    if path is not None:
        assert request.earliest_departure_ms <= path[0].arrive_ms <= request.latest_departure_ms
        assert is_conflict_free(holds_of(path, airspace.rule, airspace.grid), situation.reservations)


def test_the_plain_planner_refuses_to_book_twice() -> None:
    airspace = airspace_of((2, 1, 1), np.zeros(2, dtype=np.bool_), rule=OccupancyRule.MIDPOINT, terminal_dwell_ms=0)
    plain = SafeIntervalPlanner(airspace)
    plain.reserve([Hold(0, 10, 20), Hold(0, 20, 25), Hold(0, 5, 10)])
    for enter_ms, exit_ms in ((24, 26), (0, 6), (12, 13)):
        with pytest.raises(AssertionError, match="block 0 is not free"):
            plain.reserve([Hold(0, enter_ms, exit_ms)])


@given(situations(), st.sampled_from([1, 2, 4]))
@settings(deadline=None)
def test_with_reservations_weeks_and_months_ahead_the_planner_arrives_when_the_plain_one_does(
    situation: Situation, half_days: int
) -> None:
    """Every time of the situation counts so many half days, but links take what they take."""
    unit = half_days * 43_200_000
    reservations = [Hold(block, enter * unit, exit_ * unit) for block, enter, exit_ in situation.reservations]
    request = replace(
        situation.request,
        earliest_departure_ms=situation.request.earliest_departure_ms * unit,
        latest_departure_ms=situation.request.latest_departure_ms * unit,
    )
    plain = SafeIntervalPlanner(situation.airspace)
    plain.reserve(reservations)
    try:
        arrival = planner_in(situation.airspace, reservations).plan(request).arrival_ms
    except (NoPlan, NotPlannable):
        arrival = None
    assert arrival == arrival_by(plain, request)
