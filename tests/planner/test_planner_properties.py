"""What a planner promises: separation and determinism as properties, and every reason and kind of wait as a story.

In the stories' drawings an aircraft takes 4 ms for a level link or a vertical climb, 6 ms for a diagonal in a plane
and 8 ms for one through space. A flight may depart at one instant only, unless a window is given.
"""

import itertools
from collections.abc import Iterable
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.airspace import Airspace, OccupancyRule
from planner.cfa_star import Planner, PlanRequest, Search
from planner.errors import (
    DestinationBlocked,
    Disconnected,
    EnduranceExceeded,
    NoConflictFreePath,
    NoDepartureSlot,
    NoPlan,
    NotPlannable,
    OriginBlocked,
    SameBlock,
)
from planner.path import Plan
from tests.planner.drawing import drawn
from tests.planner.traffic import (
    EITHER_RULE,
    Situation,
    airspaces,
    flight,
    holds_in,
    planner_in,
    release,
    requests_in,
    reservations_in,
    reserve,
    situations,
    trajectory_of,
)
from tests.reference.planning import Hold, Visit, is_conflict_free

IN_2026 = 1_795_300_000_000
MIDPOINT, CONTAINMENT = OccupancyRule.MIDPOINT, OccupancyRule.CONTAINMENT

unhurried = settings(deadline=None, max_examples=60)
both_searches = pytest.mark.parametrize("search", Search)


def plans_in_order(planner: Planner, requests: Iterable[PlanRequest]) -> list[Plan]:
    """Plan flights one after another, each against all before it; leave out those without a plan."""
    plans: list[Plan] = []
    for owner, request in enumerate(requests):
        try:
            plan = planner.plan(request)
        except (NoPlan, NotPlannable):
            continue
        reserve(planner, holds_in(plan), owner)
        plans.append(plan)
    return plans


def outcome(planner: Planner, request: PlanRequest) -> object:
    """Return all that must not depend on anything but the reservations and the request."""
    try:
        plan = planner.plan(request)
    except (NoPlan, NotPlannable) as refusal:
        return type(refusal), getattr(refusal, "earliest_feasible_departure_ms", None)
    return trajectory_of(plan), holds_in(plan), plan.delay_ms


# Separation

Position = tuple[Fraction, Fraction, Fraction]


def centre(airspace: Airspace, block: int) -> Position:
    """Return where a block's centre is, in block indices."""
    i, j, k = airspace.grid.block(block)
    return Fraction(i), Fraction(j), Fraction(k)


def positions(airspace: Airspace, plan: Plan) -> dict[int, Position]:
    """Return where a flight is at each ms from departure to arrival, as fractions of block indices."""
    trajectory = trajectory_of(plan)
    places: dict[int, Position] = {}
    for visit in trajectory:
        places |= dict.fromkeys(range(visit.arrive_ms, visit.depart_ms + 1), centre(airspace, visit.block))
    for before, after in itertools.pairwise(trajectory):
        (i, j, k), (i2, j2, k2) = centre(airspace, before.block), centre(airspace, after.block)
        for tick in range(before.depart_ms + 1, after.arrive_ms):
            part = Fraction(tick - before.depart_ms, after.arrive_ms - before.depart_ms)
            places[tick] = (i + part * (i2 - i), j + part * (j2 - j), k + part * (k2 - k))
    return places


def distance_in_blocks(one: Position, other: Position) -> Fraction:
    """Return the largest of the three distances: in block sides east and north, in block heights up."""
    return max(abs(a - b) for a, b in zip(one, other, strict=True))


@st.composite
def sequences(draw: st.DrawFn, rules: st.SearchStrategy[OccupancyRule]) -> tuple[Planner, list[PlanRequest]]:
    """Draw an empty airspace and flights to be planned in it one after another."""
    airspace = draw(airspaces(rules))
    search = draw(st.sampled_from(Search))
    return planner_in(airspace, search=search), draw(st.lists(requests_in(airspace), min_size=2, max_size=8))


@given(sequences(EITHER_RULE))
@unhurried
def test_flights_planned_one_after_another_never_hold_a_block_together(
    sequence: tuple[Planner, list[PlanRequest]],
) -> None:
    holds = sorted(hold for plan in plans_in_order(*sequence) for hold in holds_in(plan))
    for one, following in itertools.pairwise(holds):
        assert one.block != following.block or one.exit_ms <= following.enter_ms


@given(sequences(st.just(CONTAINMENT)))
@unhurried
def test_contained_flights_stay_a_block_side_or_a_block_height_apart_and_half_of_it_from_buildings(
    sequence: tuple[Planner, list[PlanRequest]],
) -> None:
    airspace = sequence[0].airspace
    flown = [positions(airspace, plan) for plan in plans_in_order(*sequence)]
    buildings = [centre(airspace, block) for block in np.flatnonzero(airspace.occupied).tolist()]
    for one, other in itertools.combinations(flown, 2):
        for tick in one.keys() & other.keys():
            assert distance_in_blocks(one[tick], other[tick]) >= 1
    for places, building in itertools.product(flown, buildings):
        assert min(distance_in_blocks(place, building) for place in places.values()) >= 1


def test_two_diagonals_over_one_edge_meet_under_the_midpoint_rule() -> None:
    city = drawn("AC DB", rule=MIDPOINT)
    crossing = [flight(city["A"], city["B"], latest=60), flight(city["C"], city["D"], latest=60)]
    one, other = plans_in_order(planner_in(city.airspace), crossing)
    assert trajectory_of(one) == [Visit(city["A"], 0, 0), Visit(city["B"], 6, 6)]
    assert trajectory_of(other) == [Visit(city["C"], 0, 0), Visit(city["D"], 6, 6)]
    assert distance_in_blocks(positions(city.airspace, one)[3], positions(city.airspace, other)[3]) == 0


def test_two_diagonals_over_one_edge_fly_one_after_the_other_under_containment() -> None:
    city = drawn("AC DB")
    crossing = [flight(city["A"], city["B"], latest=60), flight(city["C"], city["D"], latest=60)]
    one, other = plans_in_order(planner_in(city.airspace), crossing)
    assert trajectory_of(one) == [Visit(city["A"], 0, 0), Visit(city["B"], 6, 6)]
    assert trajectory_of(other) == [Visit(city["C"], 7, 7), Visit(city["D"], 13, 13)]


# Determinism


@both_searches
@given(situation=situations(), data=st.data())
@unhurried
def test_the_order_of_reserving_does_not_matter(search: Search, situation: Situation, data: st.DataObject) -> None:
    shuffled = data.draw(st.permutations(situation.reservations))
    one = planner_in(situation.airspace, situation.reservations, search)
    other = planner_in(situation.airspace, shuffled, search)
    assert outcome(one, situation.request) == outcome(other, situation.request)


@both_searches
@given(situation=situations())
@unhurried
def test_forgetting_what_ended_before_the_window_does_not_matter(search: Search, situation: Situation) -> None:
    earliest = situation.request.earliest_departure_ms
    planner = planner_in(situation.airspace, situation.reservations, search)
    before = outcome(planner, situation.request)
    planner.index.forget_before(earliest)
    assert len(planner.index) == sum(hold.exit_ms > earliest for hold in situation.reservations)
    assert outcome(planner, situation.request) == before


@both_searches
@given(situation=situations(), data=st.data())
@unhurried
def test_what_was_reserved_and_released_does_not_matter(
    search: Search, situation: Situation, data: st.DataObject
) -> None:
    planner = planner_in(situation.airspace, situation.reservations, search)
    before = outcome(planner, situation.request)
    extra = [
        hold
        for hold in data.draw(reservations_in(situation.airspace))
        if is_conflict_free([hold], situation.reservations)
    ]
    reserve(planner, extra, owner=len(situation.reservations))
    assert len(planner.index) == len(situation.reservations) + len(extra)
    release(planner, extra)
    assert len(planner.index) == len(situation.reservations)
    assert outcome(planner, situation.request) == before


@both_searches
@given(situation=situations(), data=st.data())
@unhurried
def test_what_was_planned_before_does_not_matter(search: Search, situation: Situation, data: st.DataObject) -> None:
    fresh = planner_in(situation.airspace, situation.reservations, search)
    used = planner_in(situation.airspace, situation.reservations, search)
    for request in data.draw(st.lists(requests_in(situation.airspace), min_size=1, max_size=4)):
        outcome(used, request)
    assert outcome(used, situation.request) == outcome(fresh, situation.request)
    assert len(used.index) == len(situation.reservations)


@both_searches
@given(situation=situations())
@unhurried
def test_the_same_traffic_at_another_time_gives_the_same_plan_at_that_time(
    search: Search, situation: Situation
) -> None:
    planner = planner_in(situation.airspace, situation.reservations, search)
    later = planner_in(
        situation.airspace,
        [Hold(block, enter_ms + IN_2026, exit_ms + IN_2026) for block, enter_ms, exit_ms in situation.reservations],
        search,
    )
    request = situation.request
    same_request = replace(
        request,
        earliest_departure_ms=request.earliest_departure_ms + IN_2026,
        latest_departure_ms=request.latest_departure_ms + IN_2026,
    )
    try:
        plan = planner.plan(request)
    except (NoPlan, NotPlannable) as refusal:
        with pytest.raises(type(refusal)):
            later.plan(same_request)
    else:
        same_plan = later.plan(same_request)
        assert trajectory_of(same_plan) == [
            Visit(block, arrive + IN_2026, depart + IN_2026) for block, arrive, depart in trajectory_of(plan)
        ]
        assert same_plan.delay_ms == plan.delay_ms


# Why there is no plan


def test_a_flight_to_its_own_block_is_refused() -> None:
    city = drawn("A.")
    with pytest.raises(SameBlock):
        planner_in(city.airspace).plan(flight(city["A"], city["A"]))


def test_a_flight_from_a_building_is_refused() -> None:
    city = drawn("#.B")
    with pytest.raises(OriginBlocked):
        planner_in(city.airspace).plan(flight(city["#"], city["B"]))


def test_a_flight_to_a_building_is_refused() -> None:
    city = drawn("A.#")
    with pytest.raises(DestinationBlocked):
        planner_in(city.airspace).plan(flight(city["A"], city["#"]))


@both_searches
def test_a_flight_that_buildings_cut_off_is_refused(search: Search) -> None:
    city = drawn("A#. .#B", rule=CONTAINMENT)
    with pytest.raises(Disconnected):
        planner_in(city.airspace, search=search).plan(flight(city["A"], city["B"]))


def test_between_the_corners_of_two_buildings_the_midpoint_rule_passes() -> None:
    city = drawn("A# #B", rule=MIDPOINT)
    assert planner_in(city.airspace).plan(flight(city["A"], city["B"])).arrival_ms == 6


@both_searches
def test_without_an_instant_to_hold_the_first_block_there_is_no_departure_slot(search: Search) -> None:
    city = drawn("AB")
    planner = planner_in(city.airspace, [Hold(city["A"], 0, 11)], search)
    with pytest.raises(NoDepartureSlot) as refusal:
        planner.plan(flight(city["A"], city["B"], latest=10))
    assert refusal.value.conflicting_owners == (0,)
    assert refusal.value.earliest_feasible_departure_ms == 11


@both_searches
def test_the_last_instant_of_the_window_is_a_departure_slot(search: Search) -> None:
    city = drawn("AB")
    planner = planner_in(city.airspace, [Hold(city["A"], 0, 10)], search)
    plan = planner.plan(flight(city["A"], city["B"], latest=10))
    assert (plan.departure_ms, plan.arrival_ms, plan.delay_ms) == (10, 14, 10)


@both_searches
def test_a_gap_shorter_than_the_dwell_is_no_departure_slot(search: Search) -> None:
    city = drawn("AB", terminal_dwell_ms=5)
    planner = planner_in(city.airspace, [Hold(city["A"], 5, 90)], search)
    with pytest.raises(NoDepartureSlot):
        planner.plan(flight(city["A"], city["B"]))


@both_searches
def test_a_gap_for_the_dwell_alone_is_a_departure_slot_that_leads_nowhere(search: Search) -> None:
    city = drawn("AB", terminal_dwell_ms=5)
    planner = planner_in(city.airspace, [Hold(city["A"], 6, 90)], search)
    with pytest.raises(NoConflictFreePath):
        planner.plan(flight(city["A"], city["B"]))


@both_searches
def test_a_flight_that_can_depart_but_not_get_away_has_no_conflict_free_path(search: Search) -> None:
    city = drawn("AmB")
    planner = planner_in(city.airspace, [Hold(city["m"], 0, 30), Hold(city["A"], 8, 40)], search)
    with pytest.raises(NoConflictFreePath):
        planner.plan(flight(city["A"], city["B"], latest=5))


def test_a_refusal_names_a_departure_after_the_window_that_would_work() -> None:
    city = drawn("AmB")
    planner = planner_in(city.airspace, [Hold(city["m"], 0, 30), Hold(city["A"], 8, 40)])
    with pytest.raises(NoConflictFreePath) as refusal:
        planner.plan(flight(city["A"], city["B"], latest=5))
    assert refusal.value.earliest_feasible_departure_ms == 40
    assert planner.plan(flight(city["A"], city["B"], earliest=40)).arrival_ms == 48


@both_searches
def test_a_flight_that_has_to_hover_longer_than_its_battery_lasts_exceeds_its_endurance(search: Search) -> None:
    city = drawn("AmB")
    planner = planner_in(city.airspace, [Hold(city["m"], 0, 20)], search)
    with pytest.raises(EnduranceExceeded):
        planner.plan(flight(city["A"], city["B"], endurance_ms=27))
    assert planner.plan(flight(city["A"], city["B"], endurance_ms=28)).flight_time_ms == 28
    assert planner.plan(flight(city["A"], city["B"], latest=20, endurance_ms=8)).flight_time_ms == 8


def test_a_flight_whose_earliest_arrival_exceeds_its_endurance_takes_a_later_and_shorter_one() -> None:
    city = drawn("AmnB")
    planner = planner_in(city.airspace, [Hold(city["A"], 10, 70), Hold(city["m"], 35, 60), Hold(city["n"], 0, 30)])
    tireless = planner.plan(flight(city["A"], city["B"], latest=100))
    assert (tireless.departure_ms, tireless.arrival_ms) == (5, 38)
    plan = planner.plan(flight(city["A"], city["B"], latest=100, endurance_ms=12))
    assert (plan.departure_ms, plan.arrival_ms) == (70, 82)
    with pytest.raises(EnduranceExceeded):
        planner.plan(flight(city["A"], city["B"], latest=100, endurance_ms=11))


# Waiting


@both_searches
def test_waiting_for_the_first_link_is_a_ground_hold_that_holds_no_block(search: Search) -> None:
    city = drawn("AmB")
    planner = planner_in(city.airspace, [Hold(city["m"], 0, 20)], search)
    plan = planner.plan(flight(city["A"], city["B"], latest=30))
    assert trajectory_of(plan) == [Visit(city["A"], 20, 20), Visit(city["m"], 24, 24), Visit(city["B"], 28, 28)]
    assert holds_in(plan) == [Hold(city["A"], 20, 25), Hold(city["m"], 20, 29), Hold(city["B"], 24, 29)]
    assert (plan.ground_hold_ms, plan.hover_ms, plan.delay_ms, plan.flight_time_ms) == (20, 0, 20, 8)


@both_searches
def test_what_the_window_does_not_allow_on_the_ground_is_hovered_over_the_first_block(search: Search) -> None:
    city = drawn("AmB")
    planner = planner_in(city.airspace, [Hold(city["m"], 0, 20)], search)
    plan = planner.plan(flight(city["A"], city["B"], latest=12))
    assert trajectory_of(plan) == [Visit(city["A"], 12, 20), Visit(city["m"], 24, 24), Visit(city["B"], 28, 28)]
    assert (plan.ground_hold_ms, plan.hover_ms, plan.delay_ms, plan.flight_time_ms) == (12, 8, 20, 16)


def test_waiting_for_a_later_link_moves_to_the_ground_too() -> None:
    city = drawn("AmnB")
    planner = planner_in(city.airspace, [Hold(city["n"], 0, 30)])
    plan = planner.plan(flight(city["A"], city["B"], latest=60))
    assert (plan.departure_ms, plan.hover_ms, plan.arrival_ms) == (26, 0, 38)


def test_waiting_stays_in_the_air_where_moving_it_would_make_a_conflict() -> None:
    city = drawn("AmnB")
    planner = planner_in(city.airspace, [Hold(city["A"], 6, 60), Hold(city["n"], 0, 30)])
    plan = planner.plan(flight(city["A"], city["B"], latest=60))
    assert trajectory_of(plan) == [
        Visit(city["A"], 1, 1),
        Visit(city["m"], 5, 30),
        Visit(city["n"], 34, 34),
        Visit(city["B"], 38, 38),
    ]


def test_waiting_moves_back_over_a_diagonal_only_as_far_as_its_side_blocks_allow() -> None:
    city = drawn("As# .mB")
    planner = planner_in(city.airspace, [Hold(city["B"], 0, 30), Hold(city["s"], 28, 29)])
    plan = planner.plan(flight(city["A"], city["B"], latest=60))
    assert trajectory_of(plan) == [Visit(city["A"], 21, 21), Visit(city["m"], 27, 30), Visit(city["B"], 34, 34)]


@both_searches
def test_a_flight_that_has_to_leave_its_block_early_takes_two_short_links_for_a_long_one(search: Search) -> None:
    city = drawn("AC #B", rule=MIDPOINT)
    planner = planner_in(city.airspace, [Hold(city["A"], 3, 60)], search)
    plan = planner.plan(flight(city["A"], city["B"]))
    assert trajectory_of(plan) == [Visit(city["A"], 0, 0), Visit(city["C"], 4, 4), Visit(city["B"], 8, 8)]
    assert (plan.flight_time_ms, plan.delay_ms) == (8, 2)


@pytest.mark.parametrize(
    ("rule", "left_until", "trajectory"),
    [
        (CONTAINMENT, 25, [(20, 20), (24, 30), (34, 34), (38, 38)]),
        (MIDPOINT, 21, [(18, 18), (22, 28), (32, 32), (36, 36)]),
    ],
)
def test_a_flight_finds_the_one_instant_at_which_it_can_go(
    rule: OccupancyRule, left_until: int, trajectory: list[tuple[int, int]]
) -> None:
    city = drawn("AmnB", rule=rule)
    planner = planner_in(
        city.airspace, [Hold(city["A"], left_until, 60), Hold(city["m"], 12, 20), Hold(city["n"], 0, 30)]
    )
    plan = planner.plan(flight(city["A"], city["B"], latest=60))
    assert trajectory_of(plan) == [Visit(city[sign], *times) for sign, times in zip("AmnB", trajectory, strict=True)]


def test_head_on_in_a_corridor_the_second_flight_departs_when_the_first_has_landed() -> None:
    city = drawn("A..B")
    one, other = plans_in_order(
        planner_in(city.airspace), [flight(city["B"], city["A"]), flight(city["A"], city["B"], latest=20)]
    )
    assert (one.departure_ms, one.arrival_ms) == (0, 12)
    assert (other.departure_ms, other.arrival_ms, other.hover_ms) == (13, 25, 0)


def test_head_on_in_a_corridor_the_second_flight_is_refused_if_it_cannot_wait_so_long() -> None:
    city = drawn("A..B")
    planner = planner_in(city.airspace)
    plans_in_order(planner, [flight(city["B"], city["A"])])
    with pytest.raises(NoConflictFreePath):
        planner.plan(flight(city["A"], city["B"], latest=7))


def test_head_on_in_a_corridor_a_flight_that_is_in_the_air_hovers_in_a_side_pocket() -> None:
    city = drawn("#p# AmB")
    oncoming = [Hold(city["B"], 0, 21), Hold(city["m"], 16, 25), Hold(city["A"], 20, 25)]
    plan = planner_in(city.airspace, oncoming).plan(flight(city["A"], city["B"], earliest=7))
    assert trajectory_of(plan) == [
        Visit(city["A"], 7, 7),
        Visit(city["m"], 11, 11),
        Visit(city["p"], 15, 25),
        Visit(city["m"], 29, 29),
        Visit(city["B"], 33, 33),
    ]


@both_searches
def test_a_landing_waits_until_its_dwell_fits(search: Search) -> None:
    city = drawn("AB", terminal_dwell_ms=5)
    planner = planner_in(city.airspace, [Hold(city["B"], 14, 20)], search)
    plan = planner.plan(flight(city["A"], city["B"], latest=60))
    assert trajectory_of(plan) == [Visit(city["A"], 15, 20), Visit(city["B"], 24, 29)]
    assert holds_in(plan) == [Hold(city["A"], 15, 25), Hold(city["B"], 20, 30)]
    assert (plan.ground_hold_ms, plan.hover_ms, plan.delay_ms, plan.flight_time_ms) == (15, 0, 15, 14)


@both_searches
def test_a_landing_whose_dwell_just_fits_does_not_wait(search: Search) -> None:
    city = drawn("AB", terminal_dwell_ms=5)
    planner = planner_in(city.airspace, [Hold(city["B"], 15, 20)], search)
    plan = planner.plan(flight(city["A"], city["B"], latest=60))
    assert trajectory_of(plan) == [Visit(city["A"], 0, 5), Visit(city["B"], 9, 14)]
    assert holds_in(plan) == [Hold(city["A"], 0, 10), Hold(city["B"], 5, 15)]


def test_a_flight_turned_away_from_its_landing_comes_back_and_that_is_delay() -> None:
    city = drawn("AB", rule=MIDPOINT, terminal_dwell_ms=3)
    planner = planner_in(city.airspace, [Hold(city["A"], 6, 8), Hold(city["B"], 10, 11)])
    plan = planner.plan(flight(city["A"], city["B"]))
    assert trajectory_of(plan) == [
        Visit(city["A"], 0, 3),
        Visit(city["B"], 7, 7),
        Visit(city["A"], 11, 11),
        Visit(city["B"], 15, 18),
    ]
    assert (plan.flight_time_ms, plan.delay_ms) == (18, 8)


# The paper's search and ours


def test_the_greedy_search_is_lost_where_it_is_too_early_and_the_safe_interval_search_waits_before() -> None:
    city = drawn("AmnB")
    reservations = [Hold(city["m"], 12, 20), Hold(city["n"], 0, 30)]
    request = flight(city["A"], city["B"], latest=60)
    with pytest.raises(NoConflictFreePath):
        planner_in(city.airspace, reservations, Search.GREEDY).plan(request)
    plan = planner_in(city.airspace, reservations, Search.SAFE_INTERVAL).plan(request)
    assert (plan.departure_ms, plan.arrival_ms) == (26, 38)


def test_the_greedy_search_hovers_up_to_its_limit_and_no_longer() -> None:
    city = drawn("AmB")
    reservations, request = [Hold(city["m"], 0, 20)], flight(city["A"], city["B"])
    patient = planner_in(city.airspace, reservations, Search.GREEDY, hover_limit_ms=20)
    assert patient.plan(request).arrival_ms == 28
    with pytest.raises(NoConflictFreePath):
        planner_in(city.airspace, reservations, Search.GREEDY, hover_limit_ms=19).plan(request)


# Instants


@pytest.mark.parametrize(("exit_ms", "departure_ms"), [(2, 0), (3, 1)])
def test_a_block_can_be_entered_at_a_reservations_exclusive_end_and_not_1_ms_before(
    exit_ms: int, departure_ms: int
) -> None:
    city = drawn("AB", rule=MIDPOINT)
    planner = planner_in(city.airspace, [Hold(city["B"], 0, exit_ms)])
    plan = planner.plan(flight(city["A"], city["B"], latest=60))
    assert (plan.departure_ms, plan.arrival_ms) == (departure_ms, departure_ms + 4)


@both_searches
@pytest.mark.parametrize(("enter_ms", "arrival_ms"), [(9, 8), (8, 13)])
def test_the_last_instant_of_a_flight_needs_its_block_too(search: Search, enter_ms: int, arrival_ms: int) -> None:
    city = drawn("A. ..", ".. .B")
    planner = planner_in(city.airspace, [Hold(city["B"], enter_ms, enter_ms + 1)], search)
    assert planner.plan(flight(city["A"], city["B"], latest=60)).arrival_ms == arrival_ms


def test_a_head_on_swap_at_one_instant_is_a_conflict() -> None:
    city = drawn("AB", rule=MIDPOINT)
    planner = planner_in(city.airspace)
    (oncoming,) = plans_in_order(planner, [flight(city["B"], city["A"])])
    assert holds_in(oncoming) == [Hold(city["B"], 0, 3), Hold(city["A"], 2, 5)]
    with pytest.raises(NoConflictFreePath):
        planner.plan(flight(city["A"], city["B"]))
    assert planner.plan(flight(city["A"], city["B"], latest=60)).departure_ms == 5


# Side blocks


@pytest.mark.parametrize(
    "layers",
    [
        ("A# ..", ".. .B"),
        ("A. #.", ".. .B"),
        ("A. .#", ".. .B"),
        ("A. ..", "#. .B"),
        ("A. ..", ".# .B"),
        ("A. ..", ".. #B"),
    ],
)
def test_a_building_in_any_of_six_side_blocks_bars_a_space_diagonal_under_containment_only(
    layers: tuple[str, str],
) -> None:
    contained, midpoint = drawn(*layers, rule=CONTAINMENT), drawn(*layers, rule=MIDPOINT)
    assert planner_in(contained.airspace).plan(flight(contained["A"], contained["B"])).arrival_ms == 10
    assert planner_in(midpoint.airspace).plan(flight(midpoint["A"], midpoint["B"])).arrival_ms == 8


@pytest.mark.parametrize(("rule", "departure_ms"), [(CONTAINMENT, 1), (MIDPOINT, 0)])
def test_a_reserved_side_block_bars_a_diagonal_under_containment_only(rule: OccupancyRule, departure_ms: int) -> None:
    city = drawn("A. sB", rule=rule)
    planner = planner_in(city.airspace, [Hold(city["s"], 0, 1)])
    plan = planner.plan(flight(city["A"], city["B"], latest=60))
    assert (plan.departure_ms, plan.arrival_ms) == (departure_ms, departure_ms + 6)
