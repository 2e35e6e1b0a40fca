"""The planner against its slow twins, on tiny airspaces full of random reservations."""

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.cfa_star import Search
from planner.errors import (
    Disconnected,
    EnduranceExceeded,
    NoConflictFreePath,
    NoDepartureSlot,
    NoPlan,
    NotPlannable,
    PlannerError,
)
from planner.path import Plan
from tests.planner.traffic import (
    Situation,
    flight,
    holds_in,
    planner_in,
    situations,
    situations_with_endurance,
    trajectory_of,
)
from tests.reference.lattice import STEPS, time_of
from tests.reference.planning import (
    Visit,
    can_depart,
    earliest_arrival,
    flight_time_without_traffic,
    greedy_path,
    holds_of,
    is_conflict_free,
)

unhurried = settings(deadline=None, max_examples=120)
HOVER_LIMITS_MS = st.integers(0, 12)


def planned(situation: Situation, search: Search = Search.SAFE_INTERVAL, hover_limit_ms: int = 60_000) -> Plan | None:
    """Return the plan, None where buildings or traffic leave none."""
    try:
        return planner_in(situation.airspace, situation.reservations, search, hover_limit_ms).plan(situation.request)
    except (NoPlan, NotPlannable):
        return None


def refusal_due(situation: Situation) -> type[PlannerError] | None:
    """Return why the request cannot be planned, None where it can: the definition of each reason."""
    airspace, reservations, request = situation.airspace, situation.reservations, situation.request
    if flight_time_without_traffic(airspace, request) is None:
        return Disconnected
    if not can_depart(airspace, reservations, request):
        return NoDepartureSlot
    if earliest_arrival(airspace, reservations, request) is not None:
        return None
    tireless = situation.without_endurance().request
    return NoConflictFreePath if earliest_arrival(airspace, reservations, tireless) is None else EnduranceExceeded


# The safe-interval search


@given(situations())
@unhurried
def test_no_trajectory_arrives_earlier_than_the_plan_and_a_plan_exists_exactly_when_a_trajectory_does(
    situation: Situation,
) -> None:
    due = refusal_due(situation)
    planner = planner_in(situation.airspace, situation.reservations)
    if due is not None:
        with pytest.raises(PlannerError) as refusal:
            planner.plan(situation.request)
        assert refusal.type is due
    else:
        plan = planner.plan(situation.request)
        assert plan.arrival_ms == earliest_arrival(situation.airspace, situation.reservations, situation.request)


@given(situations_with_endurance())
@unhurried
def test_with_an_endurance_no_trajectory_within_it_arrives_earlier_and_it_is_exceeded_only_if_none_fits(
    situation: Situation,
) -> None:
    due = refusal_due(situation)
    planner = planner_in(situation.airspace, situation.reservations)
    if due is not None:
        with pytest.raises(PlannerError) as refusal:
            planner.plan(situation.request)
        assert refusal.type is due
    else:
        plan = planner.plan(situation.request)
        assert situation.request.performance.endurance_ms is not None
        assert plan.flight_time_ms <= situation.request.performance.endurance_ms
        assert plan.arrival_ms == earliest_arrival(situation.airspace, situation.reservations, situation.request)


@given(st.one_of(situations(), situations_with_endurance()))
@unhurried
def test_no_link_of_a_plan_could_be_flown_later_so_waiting_is_as_early_as_possible(
    situation: Situation,
) -> None:
    plan = planned(situation)
    if plan is None:
        return
    airspace, trajectory = situation.airspace, trajectory_of(plan)
    if hover_times(trajectory, airspace.terminal_dwell_ms)[0] > 0:
        assert plan.departure_ms == situation.request.latest_departure_ms
    for n in range(1, len(trajectory) - 1):
        before, after = trajectory[n - 1], trajectory[n]
        for later in range(1, after.depart_ms - after.arrive_ms + 1):
            delayed = [
                *trajectory[: n - 1],
                before._replace(depart_ms=before.depart_ms + later),
                after._replace(arrive_ms=after.arrive_ms + later),
                *trajectory[n + 1 :],
            ]
            holds = holds_of(delayed, airspace.rule, airspace.grid)
            assert not is_conflict_free(holds, situation.reservations)


# The paper's search


@given(situations(), HOVER_LIMITS_MS)
@unhurried
def test_the_greedy_search_flies_the_path_of_the_papers_algorithm(situation: Situation, hover_limit_ms: int) -> None:
    plan = planned(situation, Search.GREEDY, hover_limit_ms)
    expected = greedy_path(situation.airspace, situation.reservations, situation.request, hover_limit_ms)
    assert (None if plan is None else trajectory_of(plan)) == expected


@given(situations(), HOVER_LIMITS_MS)
@unhurried
def test_the_greedy_search_is_never_earlier_than_the_safe_interval_search(
    situation: Situation, hover_limit_ms: int
) -> None:
    greedy, best = planned(situation, Search.GREEDY, hover_limit_ms), planned(situation)
    if greedy is not None:
        assert best is not None
        assert greedy.arrival_ms >= best.arrival_ms


@given(situations(), HOVER_LIMITS_MS)
@unhurried
def test_the_greedy_search_hovers_nowhere_longer_than_its_limit(situation: Situation, hover_limit_ms: int) -> None:
    plan = planned(situation, Search.GREEDY, hover_limit_ms)
    if plan is not None:
        assert max(hover_times(trajectory_of(plan), situation.airspace.terminal_dwell_ms)) <= hover_limit_ms


# Both searches


@pytest.mark.parametrize("search", Search)
@given(situation=st.one_of(situations(), situations_with_endurance()))
@unhurried
def test_a_plan_is_a_conflict_free_trajectory_of_open_links_and_its_holds_are_what_the_rule_says(
    search: Search, situation: Situation
) -> None:
    plan = planned(situation, search)
    if plan is None:
        return
    airspace, request, trajectory = situation.airspace, situation.request, trajectory_of(plan)
    holds = holds_in(plan)
    assert trajectory[0].block == request.origin
    assert trajectory[-1].block == request.destination
    for before, after in itertools.pairwise(trajectory):
        assert after.arrive_ms - before.depart_ms == link_time(situation, before, after)
    assert min(hover_times(trajectory, airspace.terminal_dwell_ms)) >= 0
    assert holds == holds_of(trajectory, airspace.rule, airspace.grid)
    assert is_conflict_free(holds, situation.reservations)
    assert not airspace.occupied[[hold.block for hold in holds]].any()


@pytest.mark.parametrize("search", Search)
@given(situation=situations())
@unhurried
def test_a_plans_figures_follow_from_its_trajectory(search: Search, situation: Situation) -> None:
    plan = planned(situation, search)
    if plan is None:
        return
    request, trajectory = situation.request, trajectory_of(plan)
    without_traffic = flight_time_without_traffic(situation.airspace, request)
    assert without_traffic is not None
    assert request.earliest_departure_ms <= plan.departure_ms <= request.latest_departure_ms
    assert plan.departure_ms == trajectory[0].arrive_ms
    assert plan.arrival_ms == trajectory[-1].depart_ms
    assert plan.flight_time_ms == plan.arrival_ms - plan.departure_ms
    assert plan.ground_hold_ms == plan.departure_ms - request.earliest_departure_ms
    assert plan.hover_ms == sum(hover_times(trajectory, situation.airspace.terminal_dwell_ms))
    assert plan.delay_ms == plan.arrival_ms - request.earliest_departure_ms - without_traffic


@pytest.mark.parametrize("search", Search)
@given(situation=situations())
@unhurried
def test_without_traffic_both_searches_are_a_star_and_greedy_orders_equals_as_the_paper_does(
    search: Search, situation: Situation
) -> None:
    airspace, request = situation.airspace, situation.request
    plan = planned(Situation(airspace, (), request), search)
    if plan is None:
        assert flight_time_without_traffic(airspace, request) is None
    else:
        assert plan.flight_time_ms == flight_time_without_traffic(airspace, request)
        assert plan.delay_ms == plan.ground_hold_ms == plan.hover_ms == 0
        if search is Search.GREEDY:
            assert trajectory_of(plan) == greedy_path(airspace, (), request, hover_limit_ms=0)


@pytest.mark.parametrize("search", Search)
@given(situation=situations())
@unhurried
def test_the_flight_time_without_traffic_does_not_depend_on_the_traffic(search: Search, situation: Situation) -> None:
    planner = planner_in(situation.airspace, situation.reservations, search)
    expected = flight_time_without_traffic(situation.airspace, situation.request)
    if expected is None:
        with pytest.raises(Disconnected):
            planner.unconstrained(situation.request)
    else:
        assert planner.unconstrained(situation.request) == expected


@given(st.one_of(situations(), situations_with_endurance()))
@unhurried
def test_the_departure_that_a_refusal_names_is_after_the_window_and_works(situation: Situation) -> None:
    planner = planner_in(situation.airspace, situation.reservations)
    request = situation.request
    try:
        planner.plan(request)
    except NoPlan as refusal:
        named = refusal.earliest_feasible_departure_ms
        if named is not None:
            assert named > request.latest_departure_ms
            then = flight(
                request.origin,
                request.destination,
                earliest=named,
                times=request.performance.times,
                endurance_ms=request.performance.endurance_ms,
            )
            assert planner.plan(then).departure_ms == named
    except NotPlannable:
        pass


@given(situations())
@unhurried
def test_no_departure_between_the_window_and_the_one_that_a_refusal_names_has_a_plan(situation: Situation) -> None:
    planner = planner_in(situation.airspace, situation.reservations)
    request = situation.request
    try:
        planner.plan(request)
    except NoPlan as refusal:
        named = refusal.earliest_feasible_departure_ms
        if named is not None and named > request.latest_departure_ms + 1:
            between = flight(
                request.origin,
                request.destination,
                earliest=request.latest_departure_ms + 1,
                latest=named - 1,
                times=request.performance.times,
            )
            assert earliest_arrival(situation.airspace, situation.reservations, between) is None
    except NotPlannable:
        pass


def hover_times(trajectory: list[Visit], terminal_dwell_ms: int) -> list[int]:
    """Return the waits at each block's centre, terminal dwell excluded."""
    waits = [visit.depart_ms - visit.arrive_ms for visit in trajectory]
    waits[0] -= terminal_dwell_ms
    waits[-1] -= terminal_dwell_ms
    return waits


def link_time(situation: Situation, before: Visit, after: Visit) -> int:
    """Return what the link between two visits takes, fails where they are no neighbours."""
    grid = situation.airspace.grid
    (i, j, k), (i2, j2, k2) = grid.block(before.block), grid.block(after.block)
    step = i2 - i, j2 - j, k2 - k
    assert step in STEPS
    return time_of(situation.request.performance.times, step)
