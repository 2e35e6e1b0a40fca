"""Surcharges on layers: flights prefer the others, and remain conflict-free."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.airmatrix import AirMatrix
from planner.airspace import Airspace, OccupancyRule
from planner.cfa_star import PlanRequest, Search
from planner.errors import NoPlan, NotPlannable
from planner.path import Plan
from tests.planner.drawing import airspace_of
from tests.planner.traffic import Situation, flight, holds_in, planner_in, situations
from tests.reference.planning import is_conflict_free, least_cost, link_times

HOVERER = link_times(horizontal=2, diagonal=4, vertical=6, alpha=6, beta=8)


def surcharged(situation: Situation, surcharge: tuple[int, ...]) -> Situation:
    return replace(situation, request=replace(situation.request, layer_surcharge_ms=surcharge))


def layers_of(plan: Plan, grid: AirMatrix) -> list[int]:
    return [grid.block(int(block))[2] for block in plan.block]


def planned(situation: Situation) -> Plan | None:
    try:
        return planner_in(situation.airspace, situation.reservations).plan(situation.request)
    except (NoPlan, NotPlannable):
        return None


@given(situations(), st.data())
@settings(deadline=None)
def test_no_trajectory_costs_less_and_a_plan_exists_exactly_when_a_trajectory_does(
    situation: Situation, data: st.DataObject
) -> None:
    grid = situation.airspace.grid
    surcharge = tuple(data.draw(st.integers(0, 12)) for _ in range(grid.dimensions[2]))
    situation = surcharged(situation, surcharge)
    plan = planned(situation)
    if situation.request.origin == situation.request.destination or any(
        situation.airspace.occupied[[situation.request.origin, situation.request.destination]]
    ):
        assert plan is None
        return
    least = least_cost(situation.airspace, situation.reservations, situation.request)
    if plan is None:
        assert least is None
    else:
        assert plan.arrival_ms + sum(surcharge[layer] for layer in layers_of(plan, grid)[1:]) == least
        assert is_conflict_free(holds_in(plan), situation.reservations)


def test_a_flight_climbs_out_of_a_layer_that_costs_enough_and_stays_in_one_that_does_not() -> None:
    airspace = two_layers()

    def layers(surcharge: tuple[int, ...]) -> set[int]:
        request = replace(flight(0, 8, times=HOVERER), layer_surcharge_ms=surcharge)
        return set(layers_of(planner_in(airspace).plan(request), airspace.grid))

    assert layers(()) == layers((0, 0)) == layers((1, 0)) == {0}
    assert layers((3, 0)) == {0, 1}


@pytest.mark.parametrize("surcharge", [(1,), (1, 1, 1)])
def test_surcharges_are_one_for_each_layer(surcharge: tuple[int, ...]) -> None:
    planner = planner_in(two_layers())
    with pytest.raises(ValueError, match="one value for each of 2 layers"):
        planner.plan(replace(flight(0, 8, times=HOVERER), layer_surcharge_ms=surcharge))


def test_the_greedy_search_knows_no_surcharges() -> None:
    planner = planner_in(two_layers(), search=Search.GREEDY)
    with pytest.raises(ValueError, match="safe-interval"):
        planner.plan(replace(flight(0, 8, times=HOVERER), layer_surcharge_ms=(1, 1)))


def test_a_surcharge_is_not_negative() -> None:
    request = flight(0, 8, times=HOVERER)
    with pytest.raises(ValueError, match="between 0 and"):
        PlanRequest(0, 8, request.performance, 0, 0, (0, -1))


def two_layers() -> Airspace:
    return airspace_of((9, 1, 2), np.zeros(18, dtype=np.bool_), rule=OccupancyRule.CONTAINMENT, terminal_dwell_ms=0)
