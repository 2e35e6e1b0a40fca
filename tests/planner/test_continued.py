"""A flight in the air that is planned anew: what it has flown stands, and what follows is as good as it can be."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from planner.airspace import OccupancyRule
from planner.cfa_star import Performance, Planner, PlanRequest
from planner.errors import EnduranceExceeded, NoConflictFreePath, NoPlan, NotPlannable
from planner.kernels.intervals import FAR_FUTURE
from planner.path import Plan, Trajectory
from planner.separation import CheckedFlight, verify
from tests.planner.drawing import drawn
from tests.planner.traffic import Situation, flight, holds_in, planner_in, reserve, situations, trajectory_of
from tests.reference.planning import Hold

pytestmark = pytest.mark.compiled

LANE = drawn("A...B\n.....\n....C")


def flown(plan: Plan, place: int) -> Trajectory:
    """Return a plan up to a place on its way, as it is flown when that is reached."""
    return Trajectory(
        plan.block[: place + 1],
        plan.arrive_ms[: place + 1],
        plan.depart_ms[: place + 1],
        plan.unconstrained_ms,
        plan.terminal_dwell_ms,
    )


def onward(request: PlanRequest, plan: Plan, place: int, start_ms: int, destination: int | None = None) -> PlanRequest:
    """Return the request for the rest of a flight, from a place on its path at a time."""
    return replace(
        request,
        origin=int(plan.block[place]),
        destination=request.destination if destination is None else destination,
        earliest_departure_ms=start_ms,
        latest_departure_ms=start_ms,
    )


def checked(name: str, plan: Plan) -> CheckedFlight:
    return CheckedFlight(
        name, plan.block, plan.arrive_ms, plan.depart_ms, plan.hold_block, plan.hold_enter_ms, plan.hold_exit_ms
    )


@st.composite
def cut_short(draw: st.DrawFn) -> tuple[Situation, Planner, Plan, int, int]:
    """Draw a flight with a plan, and where and when it is to turn off: wherever its path allows."""
    situation = draw(situations())
    planner = planner_in(situation.airspace, situation.reservations)
    try:
        plan = planner.plan(situation.request)
    except (NoPlan, NotPlannable):
        assume(False)
    place = draw(st.integers(0, len(plan.block) - 2))
    # Its climb-out belongs to the first block.
    since_ms = int(plan.arrive_ms[place]) + (situation.airspace.terminal_dwell_ms if place == 0 else 0)
    return situation, planner, plan, place, draw(st.integers(since_ms, int(plan.depart_ms[place])))


@settings(deadline=None, max_examples=60)
@given(cut_short())
def test_who_goes_on_to_where_it_was_going_arrives_when_it_would_have(
    drawn_flight: tuple[Situation, Planner, Plan, int, int],
) -> None:
    situation, planner, plan, place, start_ms = drawn_flight
    again = planner.continued(flown(plan, place), onward(situation.request, plan, place, start_ms))
    assert again.arrival_ms == plan.arrival_ms
    assert trajectory_of(again)[:place] == trajectory_of(plan)[:place]
    assert (again.block[place], again.arrive_ms[place]) == (plan.block[place], plan.arrive_ms[place])
    assert again.depart_ms[place] >= start_ms


@settings(deadline=None, max_examples=60)
@given(cut_short(), st.data())
def test_who_goes_on_elsewhere_keeps_its_distance_on_the_whole_way(
    drawn_flight: tuple[Situation, Planner, Plan, int, int], data: st.DataObject
) -> None:
    situation, planner, plan, place, start_ms = drawn_flight
    free = np.flatnonzero(~situation.airspace.occupied).tolist()
    request = onward(situation.request, plan, place, start_ms, data.draw(st.sampled_from(free)))
    try:
        again = planner.continued(flown(plan, place), request)
    except (NoPlan, NotPlannable):
        return
    assert trajectory_of(again)[:place] == trajectory_of(plan)[:place]
    assert (again.departure_ms, again.block[-1]) == (plan.departure_ms, request.destination)
    # What it holds covers what it flies, and meets nobody: the planner would refuse to reserve it twice.
    assert verify(situation.airspace, [checked("on", again)]).violations == ()
    reserve(planner, holds_in(again), 99)


@pytest.mark.parametrize("rule", OccupancyRule)
def test_what_was_flown_is_held_for_as_long_as_it_took(rule: OccupancyRule) -> None:
    # An operator that plans for itself may fly slower than the aircraft can: here, half as fast.
    airspace = replace(LANE.airspace, rule=rule)
    path = LANE["A"] + np.arange(3, dtype=np.int64)
    times_ms = np.array([0, 8, 16], dtype=np.int64)
    slow = Trajectory(path, times_ms, times_ms, 0, 0, is_submitted=True)
    again = Planner(airspace).continued(slow, flight(int(path[2]), LANE["C"], earliest=16))
    assert verify(airspace, [checked("slow", again)]).violations == ()
    assert (again.unconstrained_ms, again.delay_ms) == (28, 0)


@pytest.mark.parametrize("rule", OccupancyRule)
@pytest.mark.parametrize("dwell_ms", [0, 10])
def test_without_traffic_it_has_no_delay_wherever_it_is_sent(rule: OccupancyRule, dwell_ms: int) -> None:
    airspace = replace(LANE.airspace, rule=rule, terminal_dwell_ms=dwell_ms)
    planner = Planner(airspace)
    request = flight(LANE["A"], LANE["B"])
    plan = planner.plan(request)
    again = planner.continued(flown(plan, 2), onward(request, plan, 2, int(plan.arrive_ms[2]), LANE["C"]))
    # Two links to the east, two diagonal ones to the south-east; one climb-out, one landing.
    assert again.arrive_ms.tolist() == [0, 4 + dwell_ms, 8 + dwell_ms, 14 + dwell_ms, 20 + dwell_ms]
    assert again.arrival_ms == again.unconstrained_ms == 20 + 2 * dwell_ms
    assert (again.delay_ms, again.hover_ms) == (0, 0)


@pytest.mark.parametrize(("endurance_ms", "suffices"), [(20, True), (19, False), (5, False)])
def test_endurance_counts_from_its_departure(endurance_ms: int, suffices: bool) -> None:
    planner = Planner(LANE.airspace)
    request = flight(LANE["A"], LANE["B"])
    plan = planner.plan(request)
    onwards = onward(request, plan, 2, 8, LANE["C"])
    onwards = replace(onwards, performance=Performance(request.performance.times, endurance_ms))
    if suffices:
        assert planner.continued(flown(plan, 2), onwards).flight_time_ms == endurance_ms
    else:
        with pytest.raises(EnduranceExceeded):
            planner.continued(flown(plan, 2), onwards)


def test_who_is_shut_in_in_the_air_is_told_by_whom_and_of_no_later_departure() -> None:
    planner = planner_in(LANE.airspace, [Hold(LANE["C"], 0, FAR_FUTURE)])
    request = flight(LANE["A"], LANE["B"])
    plan = planner.plan(request)
    with pytest.raises(NoConflictFreePath) as refused:
        planner.continued(flown(plan, 1), onward(request, plan, 1, 4, LANE["C"]))
    assert refused.value.conflicting_owners == (0,)
    assert refused.value.earliest_feasible_departure_ms is None


def test_it_can_wait_where_it_turns_off_if_that_is_the_soonest() -> None:
    planner = Planner(LANE.airspace)
    request = flight(LANE["A"], LANE["B"])
    plan = planner.plan(request)
    # Everything around its place is taken until long after it gets there.
    around = [block for block in range(LANE.airspace.grid.block_count) if block not in plan.block[:3].tolist()]
    for owner, block in enumerate(around):
        reserve(planner, [Hold(block, 0, 100)], owner)
    again = planner.continued(flown(plan, 2), onward(request, plan, 2, 8, LANE["C"]))
    assert again.depart_ms[2] == 100
    assert (again.hover_ms, again.departure_ms) == (92, 0)
