"""The study of a small district: it repeats itself, counts what it says, and agrees with the independent checker."""

import csv
import io
import itertools
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from planner.airspace import Airspace, OccupancyRule
from planner.cfa_star import Search
from planner.experiments import paper
from planner.experiments.metrics import conflicts_added, encounter
from planner.experiments.simulation import NothingToStudy, Run, Simulator
from planner.experiments.study import Design, Study, conduct, simulate_reference
from planner.experiments.tables import all_tables
from planner.experiments.traffic import Demand, Flight, Od
from tests.planner.drawing import drawn
from tests.planner.experimenting import DESIGN, district, district_study


@pytest.fixture(scope="module")
def study() -> Study:
    return district_study()


def untimed(study: Study) -> dict[str, list[dict[str, str]]]:
    """Return a study's tables without the columns that tell computing times."""
    return {
        name: [
            {column: cell for column, cell in row.items() if "computing" not in column}
            for row in csv.DictReader(io.StringIO(text))
        ]
        for name, text in all_tables(study).items()
    }


def test_the_same_airspace_and_seeds_give_the_same_study(study: Study) -> None:
    assert untimed(conduct(district(), DESIGN)) == untimed(study)


def test_other_seeds_give_another_study(study: Study) -> None:
    other = conduct(district(), replace(DESIGN, seeds=(4, 5)))
    assert untimed(other)["flights.csv"] != untimed(study)["flights.csv"]


def test_the_airspaces_own_rule_and_dwell_do_not_count(study: Study) -> None:
    dwelling = conduct(district(OccupancyRule.MIDPOINT, terminal_dwell_ms=5000), DESIGN)
    assert untimed(dwelling) == untimed(study)


def test_progress_counts_every_flight_of_the_workload() -> None:
    told: list[int] = []
    conduct(district(), DESIGN, told.append)
    assert told == list(range(1, DESIGN.workload(district()) + 1))


def test_the_district_is_busy_enough_to_show_everything(study: Study) -> None:
    reference = study.reference
    assert reference.conflicts.sum() > 0
    assert np.nansum(reference.greedy.delay_s) > 0
    assert len(reference.near_misses) > 1
    assert reference.corner_cuts.cut > 0


def test_astar_flies_as_if_alone(study: Study) -> None:
    astar = study.reference.astar
    for flight, plan in zip(astar.flights, astar.plans, strict=True):
        assert plan is not None
        assert plan.departure_ms == flight.departure_ms
        assert plan.flight_time_ms == plan.unconstrained_ms
    assert set(astar.delay_s) == {0.0}


def test_both_searches_take_the_same_time_alone(study: Study) -> None:
    astar, other = study.reference.astar, study.reference.safe_interval_alone
    assert other.flights == astar.flights
    assert [plan.arrival_ms for plan in other.accepted] == [plan.arrival_ms for plan in astar.accepted]
    # The safe-interval search goes on from what the search without traffic found, greedy begins anew.
    assert other.static_expansions == astar.static_expansions
    assert astar.static_expansions < other.expansions


def test_the_search_without_traffic_is_timed_flight_by_flight_even_where_there_is_no_way(study: Study) -> None:
    assert study.reference.without_traffic_s.shape == (len(study.reference.astar.flights),)
    flights = [Flight(0, 3, "dji-phantom-4", 0), Flight(0, 1, "dji-phantom-4", 0)]
    assert Simulator(drawn("..#.").airspace).time_without_traffic(flights, OccupancyRule.MIDPOINT).shape == (2,)


def test_conflicts_are_those_of_astar_and_cfa_star_leaves_none(study: Study) -> None:
    reference = study.reference
    assert reference.conflicts.tolist() == conflicts_added(reference.astar.accepted).tolist()
    assert reference.whole_second_conflicts.sum() > reference.conflicts.sum()
    assert reference.conflicts_left == 0


def test_containment_keeps_every_pair_a_block_apart_and_nothing_is_violated(study: Study) -> None:
    assert study.reference.containment_verdict.too_near == ()
    assert sum(trial.containment_too_near for trial in study.trials) == 0
    assert sum(trial.violations for trial in study.trials) == 0
    assert {len(one.verdict.too_near) for one in study.trades if one.rule is OccupancyRule.CONTAINMENT} == {0}
    assert sum(one.verdict.violations for one in study.trades) == 0
    closest = study.reference.containment_verdict.closest
    assert closest is not None
    assert closest.horizontal_m >= 20 - 1e-6


def test_the_near_pairs_of_the_checker_are_those_with_a_separation_below_a_block(study: Study) -> None:
    run, grid = study.reference.greedy, study.airspace.grid
    pairs = {}
    for (first, a), (second, b) in itertools.combinations(enumerate(run.plans), 2):
        if a is not None and b is not None and (met := encounter(grid, a, b)) is not None and met.separation < 1 - 1e-7:
            pairs[first, second] = met
    misses = study.reference.near_misses
    assert {miss.flights: miss.encounter for miss in misses} == pairs
    separations = [miss.encounter.separation for miss in misses]
    assert separations == sorted(separations)


def test_one_seed_is_the_same_traffic_in_every_part_of_the_study(study: Study) -> None:
    reference = study.reference
    trial = next(one for one in study.trials if (one.window_min, one.seed) == (paper.WINDOW_MIN, 1))
    assert trial.conflicts == reference.conflicts.sum()
    assert trial.delay_s == pytest.approx(np.nansum(reference.greedy.delay_s))
    assert trial.too_near == len(reference.near_misses)
    assert trial.corner_cuts == reference.corner_cuts
    assert trial.containment_delay_s == pytest.approx(np.nansum(reference.containment.delay_s))
    for search, run in ((Search.GREEDY, reference.greedy), (Search.SAFE_INTERVAL, reference.safe_interval)):
        (same,) = (
            one
            for one in study.trades
            if (one.od, one.flights, one.rule, one.search) == (Od.UNIFORM, 90, OccupancyRule.MIDPOINT, search)
        )
        assert same.delay_s == pytest.approx(np.nansum(run.delay_s))
        assert same.accepted == len(run.accepted)
        assert same.refused == run.refused
        assert same.expansions == run.expansions


def test_every_size_rule_search_and_generator_is_compared_once(study: Study) -> None:
    counts = Counter((one.od, one.flights, one.rule, one.search) for one in study.trades)
    assert set(counts) == set(itertools.product(Od, DESIGN.sizes, OccupancyRule, Search))
    assert set(counts.values()) == {1}
    assert [one.search for one in study.trades] == [*Search] * (len(study.trades) // 2)


def test_each_type_flies_the_same_flights(study: Study) -> None:
    types = [use.aircraft.id for use in study.use_by_type]
    assert types[:3] == list(paper.USE_BY_TYPE)
    assert len(set(types)) == len(types) == 5
    sums = [use.in_use_s.sum() for use in study.use_by_type]
    # The self-built drone is the slowest of the paper's three, and so holds blocks for longest.
    assert sums[1] == max(sums[:3])
    occupied = study.airspace.occupied
    assert all(use.in_use_s[occupied].sum() == 0 for use in study.use_by_type)


def test_flights_that_buildings_part_are_refused_and_keep_their_number() -> None:
    airspace = drawn("..#.").airspace
    flights = [Flight(0, 1, "dji-phantom-4", 0), Flight(0, 3, "dji-phantom-4", 0), Flight(0, 1, "dji-phantom-4", 0)]
    run = Simulator(airspace).fly_alone(flights, OccupancyRule.MIDPOINT, Search.GREEDY)
    assert run.refusals == (None, "disconnected", None)
    assert [plan is None for plan in run.plans] == [False, True, False]
    assert run.refused == Counter({"disconnected": 1})
    assert np.isnan(run.delay_s).tolist() == [False, True, False]


def test_conflicts_stay_with_their_flight_where_others_are_refused() -> None:
    reference = simulate_reference(Simulator(drawn("...#").airspace), Design(12, (3,), (12,), 1))
    planned = [plan is not None for plan in reference.astar.plans]
    assert not any(reference.conflicts[~np.array(planned)])
    assert reference.conflicts[planned].tolist() == conflicts_added(reference.astar.accepted).tolist()
    assert [one.number for one in reference.comparisons] == [
        number
        for number, (alone, among) in enumerate(zip(reference.astar.plans, reference.greedy.plans, strict=True))
        if alone is not None and among is not None
    ]


@pytest.mark.parametrize("airspace", [drawn("#.#").airspace, drawn(".", ".").airspace, drawn("###").airspace])
def test_an_airspace_without_two_columns_to_fly_between_is_refused(airspace: Airspace) -> None:
    with pytest.raises(NothingToStudy, match="fewer than two columns"):
        conduct(airspace, DESIGN)


def test_an_airspace_whose_free_blocks_are_all_parted_is_refused() -> None:
    with pytest.raises(NothingToStudy, match="buildings part the ends of all 90 flights"):
        conduct(drawn(".#.").airspace, DESIGN)


def test_another_demand_leaves_no_reservation_behind() -> None:
    simulator = Simulator(district())
    flights = simulator.flights(Demand(Od.LOWEST, 30, 1, 1))

    def delays(run: Run) -> list[int]:
        return [plan.delay_ms for plan in run.accepted]

    first = simulator.fly(flights, OccupancyRule.CONTAINMENT, Search.SAFE_INTERVAL)
    again = simulator.fly(flights, OccupancyRule.CONTAINMENT, Search.SAFE_INTERVAL)
    assert delays(again) == delays(first)
    assert sum(delays(first)) > 0


@pytest.mark.parametrize(
    ("quick", "expected"),
    [
        (False, Design(300, tuple(range(1, 21)), (300, 1000, 3000), 5)),
        (True, Design(300, (1, 2, 3), (300,), 1)),
    ],
)
def test_the_designs_are_the_whole_one_and_a_quick_one(quick: bool, expected: Design) -> None:
    assert Design.of(300, 20, 1, quick) == expected


def test_a_quick_design_has_no_more_seeds_than_asked_for() -> None:
    assert Design.of(30, 2, 7, quick=True).seeds == (7, 8)
