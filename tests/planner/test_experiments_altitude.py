"""Altitude balancing: surcharges follow the crowding of layers, and the findings sum up what they do and cost."""

import numpy as np
import pytest

from planner.airspace import Airspace, OccupancyRule
from planner.cfa_star import Planner, PlanRequest, Search
from planner.experiments import altitude, findings
from planner.experiments.altitude import Crowding, lets_flights_choose
from planner.experiments.simulation import GROUND_HOLD_MS, Run, Simulator, Verdict
from planner.experiments.study import Balance, Design, conduct
from planner.experiments.traffic import Demand, Flight, Od
from planner.path import Plan
from tests.planner.drawing import drawn
from tests.planner.experimenting import district, district_study

MIDPOINT = OccupancyRule.MIDPOINT
# One free block below, four above.
TWO_LAYERS = drawn("a###", "bcde")


def holding(*holds: tuple[str, int]) -> Plan:
    """Return a plan of which only the holds matter: a sign of `TWO_LAYERS`, and for how many ms it is held."""
    block = np.array([TWO_LAYERS[sign] for sign, _ in holds])
    enter_ms = 1000 * np.arange(len(holds))
    nowhere = np.zeros(1, dtype=np.int64)
    exit_ms = enter_ms + np.array([held_ms for _, held_ms in holds]) + 1
    return Plan(nowhere, nowhere, nowhere, 0, 0, block, enter_ms, exit_ms, 0, 0, 0, 0, 0)


# The rule


def test_nothing_is_surcharged_before_the_first_flight() -> None:
    assert Crowding(TWO_LAYERS.airspace).surcharges_ms(100) == (0, 0)


def test_the_most_crowded_layer_costs_the_weight_and_others_in_proportion_for_each_free_block() -> None:
    crowding = Crowding(TWO_LAYERS.airspace)
    crowding.add(holding(("a", 3), ("b", 8)))
    crowding.add(holding(("a", 1)))
    # 4 ms a free block below, 8 / 4 above; 24 / 4 above in the end.
    assert crowding.surcharges_ms(100) == (100, 50)
    crowding.add(holding(("e", 16)))
    assert crowding.surcharges_ms(100) == (67, 100)


def test_a_layer_without_free_blocks_costs_nothing() -> None:
    crowding = Crowding(drawn("####", "....").airspace)
    crowding.add(holding(("b", 400)))
    assert crowding.surcharges_ms(100) == (0, 100)


@pytest.mark.parametrize(
    ("airspace", "expected"),
    [
        (drawn("..").airspace, False),
        (drawn("..", "##").airspace, False),
        (drawn("..", ".#").airspace, True),
        (drawn("##", "..", "..").airspace, True),
    ],
)
def test_flights_choose_where_two_layers_have_free_blocks(airspace: Airspace, expected: bool) -> None:
    assert lets_flights_choose(airspace) == expected


# The simulation


def test_each_flight_is_surcharged_for_what_those_before_it_hold() -> None:
    simulator = Simulator(district())
    flights = simulator.flights(Demand(Od.UNIFORM, 40, 5, 3))
    flown = simulator.fly_balanced(flights, MIDPOINT, 300)
    planner = Planner(district(MIDPOINT), Search.SAFE_INTERVAL)
    free = (~district().occupied).reshape(2, 64).sum(axis=1)
    held_ms = [0, 0]
    surcharges = set()
    for number, (flight, plan) in enumerate(zip(flights, flown.plans, strict=True)):
        crowded = [held / blocks for held, blocks in zip(held_ms, free, strict=True)]
        surcharge = tuple(round(300 * one / max(*crowded, 1e-9)) for one in crowded)
        surcharges.add(surcharge)
        latest_ms = flight.departure_ms + GROUND_HOLD_MS
        performance = simulator.performances[flight.aircraft]
        expected = planner.plan(
            PlanRequest(flight.origin, flight.destination, performance, flight.departure_ms, latest_ms, surcharge)
        )
        planner.index.reserve(expected.hold_block, expected.hold_enter_ms, expected.hold_exit_ms, number)
        for block, enter_ms, exit_ms in zip(
            expected.hold_block, expected.hold_enter_ms, expected.hold_exit_ms, strict=True
        ):
            held_ms[block // 64] += int(exit_ms - 1 - enter_ms)
        assert plan is not None
        assert plan.block.tolist() == expected.block.tolist()
        assert plan.arrive_ms.tolist() == expected.arrive_ms.tolist()
    assert len(surcharges) > 30


def test_weight_0_is_the_safe_interval_run_and_every_weight_has_the_same_flights() -> None:
    study = district_study()
    base, *weighted = study.balances
    assert base.weight_ms == 0
    assert base.run is study.reference.safe_interval
    assert [balance.weight_ms for balance in weighted] == list(altitude.WEIGHTS_MS)
    assert all(balance.run.flights == base.run.flights for balance in weighted)
    assert all(balance.run.rule is MIDPOINT for balance in study.balances)


def test_use_differs_between_weights_and_is_conflict_free_at_each() -> None:
    study = district_study()
    used = [tuple(balance.in_use_s.tolist()) for balance in study.balances]
    assert len(set(used)) > 1
    for balance in study.balances:
        held_ms = sum((plan.hold_exit_ms - 1 - plan.hold_enter_ms).sum() for plan in balance.run.accepted)
        assert balance.in_use_s.sum() == pytest.approx(held_ms / 1000)
        assert balance.verdict.pairs > 0
        assert balance.verdict.violations == 0


def test_surcharges_make_the_districts_use_more_even() -> None:
    study = district_study()
    base, *weighted = findings.altitude_uses(study.airspace, study.balances)
    assert min(use.peak for use in weighted) < base.peak


def test_a_surcharged_run_leaves_nothing_behind_for_one_without() -> None:
    simulator = Simulator(district())
    flights = simulator.flights(Demand(Od.UNIFORM, 60, 1, 1))

    def paths(run: Run) -> list[list[int]]:
        return [plan.block.tolist() for plan in run.accepted]

    before = simulator.fly(flights, MIDPOINT, Search.SAFE_INTERVAL)
    surcharged = simulator.fly_balanced(flights, MIDPOINT, 1000)
    after = simulator.fly(flights, MIDPOINT, Search.SAFE_INTERVAL)
    assert paths(before) == paths(after) != paths(surcharged)
    assert paths(simulator.fly_balanced(flights, MIDPOINT, 1000)) == paths(surcharged)


def test_one_layer_is_not_balanced_and_not_counted() -> None:
    told: list[int] = []
    design = Design(5, (1,), (5,), 1, windows_min=(5,))
    flat, floors = drawn("...  ...").airspace, drawn("...  ...", "...  ...").airspace
    study = conduct(flat, design, told.append)
    assert study.balances == ()
    assert told == list(range(1, design.workload(flat) + 1))
    assert design.workload(floors) - design.workload(flat) == 5 * len(altitude.WEIGHTS_MS)


# The findings


def balance(weight_ms: int, plans: list[Plan | None], held_s: list[float]) -> Balance:
    """Return a balance of flights in `TWO_LAYERS`; `held_s` has a value for each of its eight blocks."""
    refusals = tuple(None if plan else "no_conflict_free_path" for plan in plans)
    flights = (Flight(0, 4, "dji-phantom-4", 0),) * len(plans)
    run = Run(MIDPOINT, flights, tuple(plans), refusals, np.full(len(plans), 0.25))
    return Balance(weight_ms, run, np.array(held_s), Verdict(1, ((0, 1),) * weight_ms, 0, 0, None, None))


def flown(signs: str, ground_hold_s: int = 0, hover_s: int = 0) -> Plan:
    """Return a plan through these blocks, a second a link, that hovers at its second; it would take 2 s alone."""
    block = np.array([TWO_LAYERS[sign] for sign in signs])
    arrive_ms = 1000 * (ground_hold_s + np.arange(len(block)))
    arrive_ms[2:] += 1000 * hover_s
    depart_ms = arrive_ms.copy()
    depart_ms[1] += 1000 * hover_s
    none = np.empty(0, dtype=np.int64)
    return Plan(block, arrive_ms, depart_ms, 2000, 0, none, none, none, 0, 0, 0, 0, 0)


def test_shares_and_peak_are_of_the_time_held_and_of_that_for_each_free_block() -> None:
    even = balance(0, [flown("bcd")], [2, 0, 0, 0, 2, 3, 1, 2])
    low = balance(5, [flown("bcd")], [2, 0, 0, 0, 1, 1, 0, 0])
    for use, shares, peak in zip(
        findings.altitude_uses(TWO_LAYERS.airspace, [even, low]),
        [(0.2, 0.8), (0.5, 0.5)],
        [1, 2 / (4 / 5)],
        strict=True,
    ):
        assert use.shares == pytest.approx(shares)
        assert use.peak == pytest.approx(peak)


def test_times_and_climbs_are_means_of_the_flights_that_every_weight_lets_fly() -> None:
    plain = balance(0, [flown("abc"), flown("bcd"), flown("edc")], [1] * 8)
    weighted = balance(4, [flown("abcd", ground_hold_s=3), flown("bcd", hover_s=2), None], [1] * 8)
    base, use = findings.altitude_uses(TWO_LAYERS.airspace, [plain, weighted])
    assert (base.weight_ms, base.flight_time_s, base.price_s, base.delay_s, base.waiting_s) == (0, 2, 0, 0, 0)
    # In the air 3 s and 4 s; delayed by 4 s and 2 s, of which 3 s on the ground and 2 s hovering.
    assert (use.weight_ms, use.flight_time_s, use.price_s, use.delay_s, use.waiting_s) == (4, 3.5, 1.5, 3, 2.5)
    assert base.climb_m == use.climb_m == 20
    assert (base.refused, use.refused) == (0, 1)
    assert (base.too_near, use.too_near) == (0, 4)
    assert use.computing_s == 0.75


def test_descents_are_no_climbs() -> None:
    (use,) = findings.altitude_uses(TWO_LAYERS.airspace, [balance(0, [flown("cba"), flown("abc")], [1] * 8)])
    assert use.climb_m == 20


def test_without_balances_there_is_nothing_to_sum_up() -> None:
    assert findings.altitude_uses(TWO_LAYERS.airspace, []) == ()
