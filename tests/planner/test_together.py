"""Flights planned together: what is promised of every batch, and what it is for, as stories."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.airspace import Airspace, OccupancyRule
from planner.cfa_star import Planner, PlanRequest
from planner.errors import NoPlan
from planner.path import Plan
from planner.together import Interrupted, Schedule, Together, _worth
from tests.benchmark import workloads
from tests.planner.drawing import Drawing, drawn
from tests.planner.traffic import EITHER_RULE, airspaces, flight, holds_in, planner_in, requests_in, reservations_in
from tests.reference.planning import Hold, is_conflict_free, link_times

Batch = tuple[Airspace, tuple[Hold, ...], list[PlanRequest]]


def never() -> bool:
    return False


def one_by_one(planner: Planner, requests: Sequence[PlanRequest]) -> list[int | None]:
    """Plan requests in order, each against all before it; return arrivals in ms."""
    arrivals: list[int | None] = []
    for owner, request in enumerate(requests):
        try:
            plan = planner.plan(request)
        except NoPlan:
            arrivals.append(None)
            continue
        planner.index.reserve(plan.hold_block, plan.hold_enter_ms, plan.hold_exit_ms, owner)
        arrivals.append(plan.arrival_ms)
    return arrivals


def arrivals_in(schedule: Schedule) -> list[int | None]:
    return [None if plan is None else plan.arrival_ms for plan in schedule.plans]


def plan_of(delay_ms: int, alone_ms: int = 100) -> Plan:
    """Return a plan of nothing but its delay, on the ground before a flight of `alone_ms`."""
    none = np.empty(0, dtype=np.int64)
    return Plan(
        block=np.array([0, 1]),
        arrive_ms=np.array([delay_ms, delay_ms + alone_ms]),
        depart_ms=np.array([delay_ms, delay_ms + alone_ms]),
        unconstrained_ms=alone_ms,
        terminal_dwell_ms=0,
        hold_block=none,
        hold_enter_ms=none,
        hold_exit_ms=none,
        earliest_departure_ms=0,
        slot_opens_ms=0,
        expansions=0,
        static_expansions=0,
        interval_visits=0,
    )


def a_lane() -> Drawing:
    return drawn("a....b")


@st.composite
def batches(draw: st.DrawFn) -> Batch:
    """Draw up to six flights that can be planned at all, in traffic."""
    airspace = draw(airspaces(EITHER_RULE))
    planner = Planner(airspace)
    requests = [draw(requests_in(airspace)) for _ in range(draw(st.integers(1, 6)))]
    components = planner._components
    possible = [request for request in requests if components[request.origin] == components[request.destination]]
    return airspace, draw(reservations_in(airspace)) if draw(st.booleans()) else (), possible


@given(batches(), st.integers(0, 3))
@settings(deadline=None, max_examples=40)
def test_a_batch_is_never_worse_than_first_come_first_served_and_never_in_conflict(batch: Batch, seed: int) -> None:
    airspace, reservations, requests = batch
    planner = planner_in(airspace, reservations)
    together = Together(planner, requests, seed=seed)
    assert arrivals_in(together.first_come) == one_by_one(planner_in(airspace, reservations), requests)
    together.improve(never, 12)
    taken = list(reservations)
    for request, plan in zip(requests, together.best.plans, strict=True):
        if plan is not None:
            assert (plan.block[0], plan.block[-1]) == (request.origin, request.destination)
            assert request.earliest_departure_ms <= plan.departure_ms <= request.latest_departure_ms
            assert is_conflict_free(holds_in(plan), taken)
            taken += holds_in(plan)
    before_ms, after_ms = together.first_come.delay_ms, together.best.delay_ms
    assert np.all(after_ms[before_ms >= 0] >= 0)
    if together.best.figures.refused == together.first_come.figures.refused:
        assert after_ms.sum() <= before_ms.sum()
        assert after_ms.max(initial=0) <= before_ms.max(initial=0)


@pytest.mark.compiled
def test_the_index_that_is_planned_around_is_left_as_it_was() -> None:
    workload = workloads.from_file("lowest_300")
    planner = Planner(workload.airspace)
    plan = planner.plan(workload.requests[0])
    planner.index.reserve(plan.hold_block, plan.hold_enter_ms, plan.hold_exit_ms, 7)
    before = planner.index.copy()
    together = Together(planner, workload.requests[1:40], seed=1)
    together.improve(never, 10)
    assert len(planner.index) == len(before)
    assert planner.plan(workload.requests[50]).arrival_ms == planner.plan(workload.requests[50], before).arrival_ms


def test_another_index_can_be_planned_around_than_the_planners_own() -> None:
    lane = a_lane()
    planner = planner_in(lane.airspace)
    taken = planner_in(lane.airspace, [Hold(lane["b"], 0, 1000)]).index
    together = Together(planner, [flight(lane["a"], lane["b"], latest=5000)], taken)
    (plan,) = together.best.plans
    assert plan is not None
    assert plan.arrival_ms >= 1000


@pytest.mark.compiled
def test_much_of_the_delay_of_a_busy_batch_goes_and_the_same_seed_finds_the_same() -> None:
    workload = workloads.from_file("uniform_300")

    def improved(seed: int) -> Together:
        together = Together(Planner(workload.airspace), workload.requests[:150], seed=seed)
        together.improve(never, 120)
        return together

    together = improved(1)
    first, best = together.first_come.figures, together.best.figures
    assert best.refused == first.refused == 0
    assert best.total_ms < 0.5 * first.total_ms
    assert best.spread_ms < 0.5 * first.spread_ms
    assert best.fairness > first.fairness
    assert arrivals_in(improved(1).best) == arrivals_in(together.best)


def test_who_would_be_refused_gets_a_plan_where_another_can_wait() -> None:
    lane = a_lane()
    patient, urgent = flight(lane["a"], lane["b"], latest=5000), flight(lane["a"], lane["b"])
    together = Together(planner_in(lane.airspace), [patient, urgent])
    assert arrivals_in(together.first_come) == [20, None]
    together.improve(never, 20)
    first, second = arrivals_in(together.best)
    assert second == 20
    assert first is not None
    assert together.best.figures.refused == 0


def test_nobody_loses_a_plan_for_others_even_if_they_are_more() -> None:
    lane = drawn("a.pq.rsb")
    through = flight(lane["a"], lane["b"], endurance_ms=28)  # not enough to wait in the air
    requests = [through, flight(lane["p"], lane["q"], earliest=8), flight(lane["r"], lane["s"], earliest=20)]
    planner = planner_in(lane.airspace)
    assert [planner.plan(request).delay_ms for request in requests] == [0, 0, 0]
    together = Together(planner, requests)
    assert arrivals_in(together.first_come) == [28, None, None]
    together.improve(never, 30)
    assert arrivals_in(together.best) == [28, None, None]


def test_two_delays_are_better_than_one_of_their_sum_and_any_delay_is_better_than_a_refusal() -> None:
    delays = [[10_000, 10_000], [0, 20_000], [0, 300_000], [0, -1]]
    worth = [_worth(np.array(delay_ms)) for delay_ms in delays]
    assert worth == sorted(worth)
    assert worth[1] == (0, 20_000 + 13_333)


def test_neither_the_sum_nor_the_longest_delay_grows_where_nobody_else_gets_a_plan() -> None:
    lane = drawn("a....b", rule=OccupancyRule.MIDPOINT)
    slow = link_times(horizontal=4000, diagonal=6000, vertical=4000, alpha=6000, beta=8000)
    ends = [("a", "b"), ("b", "a"), ("b", "a")]
    requests = [flight(lane[first], lane[last], latest=300_000, times=slow) for first, last in ends]
    together = Together(planner_in(lane.airspace), requests)
    delays = together.first_come.delay_ms.tolist()
    assert delays == [0, 20_001, 24_002]
    assert together._is_kept(np.array([14_000, 14_000, 16_003]))
    assert not together._is_kept(np.array([14_000, 14_000, 16_004]))  # at less cost
    assert not together._is_kept(np.array([0, 0, 24_003]))


def test_it_stops_by_itself_where_nobody_is_delayed_by_another_of_the_batch() -> None:
    lane = a_lane()
    # Delayed by what is reserved, which no order helps against.
    planner = planner_in(lane.airspace, [Hold(lane["b"], 0, 1000)])
    together = Together(planner, [flight(lane["a"], lane["b"], latest=5000)])
    assert not together.is_best_possible
    together.improve(never)
    assert together.is_best_possible
    assert together.iterations == 0
    assert together.best.figures.total_ms > 0


@pytest.mark.compiled
def test_told_to_stop_it_has_what_it_had_and_an_interrupted_order_does_not_count() -> None:
    workload = workloads.from_file("uniform_300")
    together = Together(Planner(workload.airspace), workload.requests[:60])
    together.improve(lambda: True)
    assert together.iterations == 0
    assert together.best.plans == together.first_come.plans
    asked = iter(range(1000))
    together.improve(lambda: next(asked) > 30)
    assert together.iterations == 0
    assert together.best.plans == together.first_come.plans


def test_told_to_stop_before_each_flight_was_planned_once_there_is_nothing() -> None:
    lane = a_lane()
    requests = [flight(lane["a"], lane["b"], latest=5000)] * 3
    asked = iter([False, False, True])
    with pytest.raises(Interrupted, match="3 flights"):
        Together(planner_in(lane.airspace), requests, should_stop=asked.__next__)


def test_it_can_be_stopped_before_it_knows_what_each_flight_would_get_alone() -> None:
    lane = a_lane()
    requests = [flight(lane["a"], lane["b"], earliest=at, latest=at) for at in (0, 5000, 10_000)]
    together = Together(planner_in(lane.airspace), requests)
    asked = iter([False, False, False, True, True])
    together.improve(asked.__next__)
    assert not together.is_best_possible
    together.improve(never)
    assert together.is_best_possible


def test_nobody_who_is_refused_has_a_later_departure_looked_for() -> None:
    class WithoutOutlook(Planner):
        def _earliest_feasible_departure(self, *_: object) -> int | None:
            raise AssertionError("nobody reads it")

    lane = a_lane()
    together = Together(WithoutOutlook(lane.airspace), [flight(lane["a"], lane["b"])] * 2)
    assert together.first_come.figures.refused == 1


def test_a_batch_of_nobody_is_the_best_possible() -> None:
    together = Together(planner_in(a_lane().airspace), [])
    together.improve(never)
    assert together.is_best_possible
    assert together.best.figures == Schedule(()).figures


@pytest.mark.parametrize(
    ("delays", "fairness"),
    [([0, 0, 0], 1.0), ([100, 100], 1.0), ([None, None], 1.0), ([0, None], 0.5), ([0, 100], 0.9)],
)
def test_fairness_is_jains_index_of_the_share_that_each_gets(delays: list[int | None], fairness: float) -> None:
    schedule = Schedule(tuple(None if delay is None else plan_of(delay) for delay in delays))
    assert schedule.figures.fairness == pytest.approx(fairness)


def test_figures_are_of_the_flights_that_have_a_plan() -> None:
    figures = Schedule((plan_of(0), None, plan_of(300), plan_of(600))).figures
    assert (figures.refused, figures.total_ms, figures.mean_ms, figures.worst_ms) == (1, 900, 300.0, 600)
    assert figures.spread_ms == pytest.approx(244.949, abs=0.001)
    assert figures.p95_ms == pytest.approx(570.0)
