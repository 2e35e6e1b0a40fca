"""What the report says: each finding against numbers worked out by hand."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from planner.aircraft import AircraftType, shipped_aircraft_types
from planner.airspace import OccupancyRule
from planner.cfa_star import Search
from planner.experiments import findings
from planner.experiments.metrics import CornerCuts
from planner.experiments.simulation import Verdict
from planner.experiments.study import Trade, Trial, UseByType
from planner.experiments.traffic import Od
from tests.planner.drawing import drawn
from tests.planner.experimenting import district_study

TYPES = {aircraft.id: aircraft for aircraft in shipped_aircraft_types()}


# Block size and aircraft


def test_the_papers_block_follows_from_its_errors_along_east_and_north_but_not_in_height() -> None:
    sizing = findings.sizing()
    assert [finding.is_enough for _, finding in sizing.rows] == [True, True, False, False]
    assert (sizing.needed.side_m, sizing.needed.height_m) == (16, 49)
    assert sizing.check.vertical.needed_m == pytest.approx(48.864)


@pytest.mark.parametrize(
    ("aircraft", "agrees", "lacks_drag"),
    [
        ("dji-mavic-air", True, False),
        ("self-built-drone", False, False),
        ("dji-phantom-4", True, False),
        ("dji-matrice-600-pro", False, True),
    ],
)
def test_printed_speeds_agree_or_lack_the_drag_along_the_link(aircraft: str, agrees: bool, lacks_drag: bool) -> None:
    performance = findings.performance_of(TYPES[aircraft])
    assert (performance.agrees, performance.lacks_drag) == (agrees, lacks_drag)
    assert performance.is_printed


def test_the_inspire_2_is_printed_at_other_elevations_and_does_not_agree_there() -> None:
    assert not findings.performance_of(TYPES["dji-inspire-2"]).is_printed
    speed = findings.speed_at(TYPES["dji-inspire-2"], 45, 7.973)
    assert speed.solved == pytest.approx(8.310, abs=0.0005)
    assert speed.difference == pytest.approx(7.973 / 8.310 - 1, abs=1e-4)
    assert not speed.agrees
    assert not speed.lacks_drag


# Trends


def trial(window_min: int, seed: int, conflicts: int) -> Trial:
    """Return a trial of which only the conflicts matter."""
    return Trial(window_min, seed, conflicts, 0, 0.0, 0, 0, CornerCuts(0, 0), 0.0, 0, 0, 0)


def trend_of(**conflicts: list[int]) -> findings.Trend:
    """Return the trend of conflicts, given for each window (`w10` is 10 minutes) seed by seed."""
    trials = [
        trial(int(window[1:]), seed, count) for window, counts in conflicts.items() for seed, count in enumerate(counts)
    ]
    return findings.trend(trials, lambda one: one.conflicts)


def test_a_trend_goes_from_the_longest_window_to_the_shortest() -> None:
    trend = trend_of(w3=[7, 9, 11], w10=[1, 2, 3], w5=[4, 4, 4])
    assert trend.windows_min == (10, 5, 3)
    assert [spread.median for spread in trend.spreads] == [2, 4, 9]
    assert (trend.spreads[2].low, trend.spreads[2].high) == (8, 10)
    assert trend.rises
    assert trend.factor == 4.5
    assert (trend.seeds, trend.wavering) == (3, 0)


def test_a_trend_may_rise_though_seeds_waver_on_the_way() -> None:
    trend = trend_of(w10=[1, 5, 1], w5=[2, 4, 2], w3=[3, 6, 1])
    assert trend.rises
    assert trend.wavering == 2


def test_equal_medians_rise_and_falling_ones_do_not() -> None:
    assert trend_of(w10=[2], w5=[2]).rises
    assert not trend_of(w10=[2], w5=[1]).rises


def test_the_papers_inversion_is_counted_over_all_pairs_of_draws() -> None:
    # Denser (5 min) below sparser (7 min): 1 < 2, 1 < 3 and 2 < 3, of four pairs.
    assert trend_of(w7=[2, 3], w5=[1, 2]).inversion == 0.75
    assert trend_of(w7=[2, 3], w4=[1, 2]).inversion is None


def test_a_trend_from_nothing_has_no_factor() -> None:
    assert trend_of(w10=[0], w3=[5]).factor is None


@pytest.mark.parametrize(
    ("added", "share"), [([1, 1, 1, 1], 0.5), ([0, 0, 3], 1.0), ([2, np.nan, 1, np.nan], 1 / 3), ([0, 0], None)]
)
def test_the_second_half_has_its_share_of_a_sum(added: list[float], share: float | None) -> None:
    assert findings.second_half(np.array(added)) == (None if share is None else pytest.approx(share))


# Use of layers


def use(aircraft: AircraftType, *layers_s: float) -> UseByType:
    """Return the use of an airspace with one block a layer."""
    return UseByType(aircraft, 0, np.array(layers_s))


def test_use_falls_with_the_ratio_of_speeds_or_does_not() -> None:
    grid = drawn(".", ".").airspace.grid
    slow, middle, fast = (TYPES[id_] for id_ in ("self-built-drone", "dji-mavic-air", "dji-phantom-4"))
    falling = [use(fast, 3, 1), use(slow, 1, 3), use(middle, 2, 2)]
    assert findings.falls_with_ratio(grid, falling)
    assert not findings.falls_with_ratio(grid, [use(fast, 1, 3), *falling[1:]])
    assert [findings.share_above_lowest(grid, one) for one in falling] == [0.25, 0.75, 0.5]
    assert findings.share_above_lowest(grid, use(fast, 0, 0)) == 0


def test_the_layers_share_the_use_and_the_ends_of_flights() -> None:
    study = district_study()
    layers = findings.layer_uses(study.airspace, study.reference)
    assert [(layer.floor_m, layer.ceiling_m) for layer in layers] == [(0, 40), (40, 80)]
    assert sum(layer.share for layer in layers) == pytest.approx(1)
    assert sum(layer.end_share for layer in layers) == pytest.approx(1)
    assert sum(layer.in_use_s for layer in layers) == pytest.approx(study.reference.in_use_s.sum())
    free = (~study.airspace.occupied).reshape(2, -1).sum(axis=1)
    assert [layer.free for layer in layers] == free.tolist()
    low_ends = sum(end < 64 for flight in study.reference.greedy.flights for end in (flight.origin, flight.destination))
    assert layers[0].end_share == low_ends / (2 * len(study.reference.greedy.flights))
    assert layers[0].seconds_a_block == layers[0].in_use_s / layers[0].free


# Searches and rules


def trade(search: Search, refused: int, delay_s: float, computing_s: float = 1.0) -> Trade:
    """Return ten flights under the midpoint rule."""
    verdict = Verdict(0, (), 0, 0, None, None)
    refusals = Counter({"no_conflict_free_path": refused})
    return Trade(
        Od.UNIFORM, 10, OccupancyRule.MIDPOINT, search, 10 - refused, refusals, delay_s, 0.0, computing_s, 0, verdict
    )


def test_delay_sums_are_compared_only_where_nothing_is_refused() -> None:
    pairs = [(0, 5.0, 4.0), (0, 5.0, 5.0), (0, 5.0, 6.0), (2, 1.0, 9.0)]
    trades = [
        one
        for refused, greedy_s, safe_s in pairs
        for one in (trade(Search.GREEDY, refused, greedy_s), trade(Search.SAFE_INTERVAL, 0, safe_s, 1.5))
    ]
    compared = findings.compare_searches(trades)
    assert (compared.configurations, compared.comparable) == (4, 3)
    assert (compared.safe_interval_smaller, compared.equal) == (1, 1)
    assert (compared.greedy_refused, compared.safe_interval_refused) == (2, 0)
    assert compared.slowdown == 1.5


def test_containment_costs_way_and_delay_over_the_flights_that_both_rules_let_fly() -> None:
    reference = district_study().reference
    midpoint, contained = reference.safe_interval, reference.containment
    both = [
        (near, far)
        for near, far in zip(midpoint.plans, contained.plans, strict=True)
        if near is not None and far is not None
    ]
    price = findings.price_of_containment(reference)
    assert price is not None
    assert price.longer_way_s == pytest.approx(
        sum(far.unconstrained_ms - near.unconstrained_ms for near, far in both) / len(both) / 1000
    )
    assert price.longer_way_s > 0
    assert price.containment_delay_s == pytest.approx(sum(far.delay_ms for _, far in both) / len(both) / 1000)
    grounded = replace(contained, plans=(None,) * len(contained.plans))
    assert findings.price_of_containment(replace(reference, containment=grounded)) is None


def test_delays_are_summed_over_accepted_flights() -> None:
    run = district_study().reference.greedy
    delay = findings.delay_of(run)
    delays = [plan.delay_ms / 1000 for plan in run.accepted]
    assert delay.total_s == pytest.approx(sum(delays))
    assert delay.mean_s == pytest.approx(sum(delays) / len(delays))
    assert delay.longest_s == max(delays)
    assert delay.flights == np.count_nonzero(delays)
    assert delay.longest_flight_s == max(plan.flight_time_ms for plan in run.accepted) / 1000
    none = findings.delay_of(replace(run, plans=(None,) * 3))
    assert (none.total_s, none.mean_s, none.longest_s, none.flights) == (0, 0, 0, 0)


def test_growth_compares_thirds_of_the_flights() -> None:
    reference = district_study().reference
    greedy = replace(reference.greedy, seconds=np.array([1.0, 3, 5, 5, 9, 11]))
    astar = replace(reference.astar, seconds=np.full(6, 2.0))
    reference = replace(reference, greedy=greedy, astar=astar, without_traffic_s=np.full(6, 0.5))
    growth = findings.growth(reference)
    assert (growth.first_third_s, growth.last_third_s) == (2, 10)
    assert growth.extra_a_flight_s == pytest.approx(22 / 6)
    assert growth.ratio == pytest.approx(34 / 12)
    assert growth.ratio_beyond == pytest.approx(31 / 9)
    assert findings.growth(replace(reference, without_traffic_s=np.full(6, 2.0))).ratio_beyond is None
