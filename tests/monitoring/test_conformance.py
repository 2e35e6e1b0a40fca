"""How an aircraft keeps to its plan: its position against its reservations at the position's own time."""

import pytest

from app.conformance import Thresholds
from app.flight_intents import State
from app.surveillance import Path, Sighting
from planner.airspace import OccupancyRule
from tests.monitoring.sky import Moment, Who, at, flight, path

# Ten seconds a link, from 0 to 40: it holds A [0, 10], B [0, 20], C [10, 30], D [20, 40], E [30, 40].
EASTBOUND = flight("ABCDE")


def judged(
    sighting: Sighting | None, time: float, way: Path | str = "ABCDE", rule: OccupancyRule = OccupancyRule.CONTAINMENT
) -> tuple[str, ...]:
    """Return how a flight that was seen so is judged at a time: its conformance, then the reasons."""
    seen: dict[Who, Sighting] = {} if sighting is None else {1: sighting}
    return Moment(time, [flight(way)], seen, rule=rule).says(1)


# On its reservations, give or take the tolerance


@pytest.mark.parametrize(("sign", "time"), [("A", 0), ("A", 10), ("B", 12), ("C", 12), ("D", 39), ("E", 40)])
def test_a_flight_conforms_in_any_block_that_it_holds(sign: str, time: float) -> None:
    assert judged(at(sign, time), time) == ("conforming",)


def test_a_flight_conforms_up_to_the_tolerance_before_its_reservation() -> None:
    assert judged(at("C", 8), 8) == ("conforming",)
    assert judged(at("C", 7.999), 7.999) == ("deviating", "early")


def test_a_flight_conforms_up_to_the_tolerance_after_its_reservation() -> None:
    """The exit of a reservation is one millisecond after the flight has left."""
    assert judged(at("B", 22), 22) == ("conforming",)
    assert judged(at("B", 22.001), 22.001) == ("deviating", "late")


def test_the_tolerance_is_a_setting() -> None:
    strict = Thresholds(tolerance_ms=0)
    assert Moment(10, [EASTBOUND], {1: at("C", 10)}, thresholds=strict).says(1) == ("conforming",)
    assert Moment(9.999, [EASTBOUND], {1: at("C", 9.999)}, thresholds=strict).says(1) == ("deviating", "early")


def test_a_position_is_compared_with_the_reservations_at_its_own_time() -> None:
    """It holds A no longer, but it did when it was seen."""
    assert judged(at("A", 10), 14) == ("conforming",)
    assert judged(at("A", 14), 14) == ("deviating", "late")


def test_the_reservations_of_others_are_none_of_its_own() -> None:
    other = flight("edcba", sequence=2)
    assert Moment(12, [EASTBOUND, other], {1: at("c", 12)}).says(1) == (
        "violating", "wrong_layer", "reserved_by_another",
    )  # fmt: skip


def test_under_the_midpoint_rule_a_flight_conforms_in_its_half_of_a_link_only() -> None:
    assert judged(at("C", 13), 13, rule=OccupancyRule.MIDPOINT) == ("conforming",)
    assert judged(at("C", 12.999), 12.999, rule=OccupancyRule.MIDPOINT) == ("deviating", "early")
    assert judged(at("B", 17), 17, rule=OccupancyRule.MIDPOINT) == ("conforming",)
    assert judged(at("B", 17.001), 17.001, rule=OccupancyRule.MIDPOINT) == ("deviating", "late")


def test_the_side_blocks_of_a_diagonal_are_its_own_under_containment_and_off_its_track_by_midpoint() -> None:
    assert judged(at("C", 4), 4, way="BN") == ("conforming",)
    assert judged(at("C", 4), 4, way="BN", rule=OccupancyRule.MIDPOINT) == ("deviating", "off_track")


# How it deviates


def test_a_flight_is_off_track_in_a_block_that_its_path_never_passes() -> None:
    assert judged(at("N", 12), 12) == ("deviating", "off_track")


def test_a_flight_is_off_track_outside_the_grid() -> None:
    assert judged(at(None, 12), 12) == ("deviating", "off_track")


def test_a_flight_is_in_the_wrong_layer_above_or_below_where_it_should_be() -> None:
    assert judged(at("b", 12), 12) == ("deviating", "wrong_layer")
    assert judged(at("B", 12), 12, way="abcde") == ("deviating", "wrong_layer")


def test_above_where_its_path_passes_at_another_time_a_flight_is_off_track() -> None:
    assert judged(at("e", 12), 12) == ("deviating", "off_track")


def test_a_flight_is_early_in_a_block_that_it_should_reach_later() -> None:
    assert judged(at("E", 12), 12) == ("deviating", "early")


def test_a_flight_is_late_in_a_block_that_it_should_have_left() -> None:
    assert judged(at("A", 30), 30) == ("deviating", "late")


def test_where_a_path_passes_twice_the_nearer_time_tells_whether_a_flight_is_early_or_late() -> None:
    there_and_back = path("ABAB", hover={"B": 30})  # A: 0, 50; B: 10 to 40, 60 to 90
    assert judged(at("A", 20), 20, way=there_and_back) == ("deviating", "late")
    assert judged(at("A", 37), 37, way=there_and_back) == ("deviating", "early")


def test_a_flight_that_comes_back_above_its_path_is_late_below_rather_than_in_the_wrong_layer() -> None:
    assert judged(at("B", 35), 35, way="ABCcb") == ("deviating", "late")


def test_a_climbing_flight_is_early_rather_than_in_the_wrong_layer() -> None:
    assert judged(at("a", 5), 5, way=path("Aab", hover={"A": 30})) == ("deviating", "early")


# Lost


def test_an_airborne_flight_is_lost_when_its_newest_position_is_too_old() -> None:
    assert judged(at("B", 12), 17) == ("conforming",)
    assert judged(at("B", 12), 17.001) == ("lost", "lost")


def test_the_age_at_which_a_position_is_too_old_is_a_setting() -> None:
    patient = Thresholds(freshness_ms=20_000)
    assert Moment(32, [EASTBOUND], {1: at("B", 12)}, thresholds=patient).says(1) == ("conforming",)
    assert Moment(32.001, [EASTBOUND], {1: at("B", 12)}, thresholds=patient).says(1) == ("lost", "lost")


def test_a_deviating_flight_is_lost_too() -> None:
    assert judged(at("N", 12), 17.001) == ("lost", "lost")


def test_a_flight_that_stands_on_the_ground_is_not_lost() -> None:
    assert judged(at("A", -60, airborne=False), 0) == ("conforming",)


def test_a_flight_last_seen_at_its_destination_has_landed_once_its_arrival_has_passed() -> None:
    """It may send nothing any more: that it is down is the likelier story by far."""
    assert judged(at("E", 36), 42) == ("lost", "lost")
    assert judged(at("E", 36), 42.001) == ("conforming",)


def test_a_flight_last_seen_on_its_way_is_lost_also_after_its_arrival() -> None:
    assert judged(at("D", 36), 42.001) == ("lost", "lost")


# Never seen


def test_a_flight_is_missed_once_its_departure_and_the_tolerance_have_passed() -> None:
    assert judged(None, 2) == ("unseen",)
    assert judged(None, 2.001) == ("unseen", "not_seen")


@pytest.mark.parametrize("state", [State.CANCELLED, State.ENDED, State.REJECTED])
def test_a_flight_that_will_not_fly_is_not_missed(state: State) -> None:
    assert Moment(12, [flight("ABCDE", state=state)]).says(1) == ("unseen",)


def test_nobody_is_missed_in_the_future() -> None:
    assert Moment(12, [EASTBOUND], is_forecast=True).says(1) == ("unseen",)


def test_a_flight_that_was_seen_only_on_its_pad_before_departure_is_missed_when_it_is_due() -> None:
    assert judged(at("A", -60, airborne=False), 2) == ("conforming",)
    assert judged(at("A", -60, airborne=False), 2.001) == ("unseen", "not_seen")
    assert judged(at("A", -60), 2.001) == ("unseen", "not_seen")
    assert judged(at("A", -2.999), 2.001) == ("conforming",)


# On the ground


def test_a_flight_conforms_on_any_ground_before_its_departure() -> None:
    assert judged(at("A", -1, airborne=False), -1) == ("conforming",)
    assert judged(at("N", -1, airborne=False), -1) == ("conforming",)


def test_a_flight_that_still_stands_on_its_pad_when_that_is_no_longer_reserved_is_late() -> None:
    assert judged(at("A", 12, airborne=False), 12) == ("conforming",)
    assert judged(at("A", 12.001, airborne=False), 12.001) == ("deviating", "late")


def test_a_flight_that_stands_at_its_destination_conforms() -> None:
    assert judged(at("E", 20, airborne=False), 20) == ("conforming",)
    assert judged(at("E", 50, airborne=False), 70) == ("conforming",)


def test_a_flight_that_has_landed_elsewhere_is_off_track() -> None:
    assert judged(at("N", 12, airborne=False), 12) == ("deviating", "off_track")


@pytest.mark.parametrize(
    ("sighting", "is_airborne"),
    [
        (at("A", -0.001), False),
        (at("A", -0.001, airborne=True), True),
        (at("B", -0.001), True),
        (at("A", 0), True),
        (at("A", 0, airborne=False), False),
        (at("E", 39.999), True),
        (at("E", 40), False),
        (at("E", 40, airborne=True), True),
        (at("D", 40), True),
        (at(None, 40), True),
    ],
)
def test_who_does_not_say_is_airborne_but_at_its_own_ends_before_departure_and_after_arrival(
    sighting: Sighting, is_airborne: bool
) -> None:
    now = Moment(41, [EASTBOUND], {1: sighting}, thresholds=Thresholds(freshness_ms=60_000))
    assert now.of(1).is_airborne is is_airborne


def test_a_flight_that_hovers_over_its_pad_before_departure_is_early() -> None:
    assert judged(at("A", -2.001, airborne=True), -2) == ("deviating", "early")
    assert judged(at("A", -2, airborne=True), -2) == ("conforming",)


def test_a_flight_that_hovers_over_its_destination_after_arrival_is_late() -> None:
    assert judged(at("E", 42, airborne=True), 42) == ("conforming",)
    assert judged(at("E", 42.001, airborne=True), 42.001) == ("deviating", "late")


# Without a plan, or without leave to fly


def test_a_flight_that_conforms_without_having_been_activated_says_so() -> None:
    accepted = flight("ABCDE", state=State.ACCEPTED)
    assert Moment(12, [accepted], {1: at("B", 12)}).says(1) == ("conforming", "not_activated")
    assert Moment(12, [EASTBOUND], {1: at("B", 12)}).says(1) == ("conforming",)


def test_a_flight_that_stands_on_its_pad_need_not_have_been_activated() -> None:
    accepted = flight("ABCDE", state=State.ACCEPTED)
    assert Moment(-10, [accepted], {1: at("A", -10)}).says(1) == ("conforming",)


def test_a_refused_flight_that_flies_deviates() -> None:
    refused = flight(None, state=State.REJECTED)
    assert Moment(12, [refused], {1: at("B", 12)}).says(1) == ("deviating", "not_accepted")
    assert Moment(12, [refused], {1: at("B", 12, airborne=False)}).says(1) == ("conforming",)


@pytest.mark.parametrize("state", [State.CANCELLED, State.ENDED])
def test_a_flight_that_has_given_its_blocks_back_and_flies_deviates(state: State) -> None:
    over = flight("ABCDE", state=state, activated=False)
    assert Moment(12, [over], {1: at("B", 12)}, released=[1]).says(1) == ("deviating", "not_accepted")
    assert Moment(12, [over], {1: at("B", 12)}).says(1) == ("conforming",)


# Tracks


def test_a_track_deviates_since_it_has_no_flight_intent() -> None:
    assert Moment(12, [], {"stranger": at("N", 12)}).says("stranger") == ("deviating", "no_flight_intent")
    assert Moment(12, [], {"stranger": at(None, 12)}).says("stranger") == ("deviating", "no_flight_intent")


def test_a_track_is_lost_when_its_newest_position_is_too_old() -> None:
    assert Moment(17, [], {"stranger": at("N", 12)}).says("stranger") == ("deviating", "no_flight_intent")
    assert Moment(17.001, [], {"stranger": at("N", 12)}).says("stranger") == ("lost", "lost")


def test_a_track_on_the_ground_conforms_and_is_never_lost() -> None:
    landed = {"stranger": at("N", 12, airborne=False)}
    assert Moment(12, [], landed).says("stranger") == ("conforming",)
    assert Moment(60, [], landed).says("stranger") == ("conforming",)


# Violating


def test_an_aircraft_in_a_red_block_violates_and_tells_both_its_own_reasons_and_the_blocks() -> None:
    now = Moment(12, [EASTBOUND], {1: at("B", 12), "stranger": at("C", 12)})
    assert now.says("stranger") == ("violating", "no_flight_intent", "reserved_by_another")


def test_a_flight_whose_block_somebody_else_enters_violates_where_it_is_in_it_itself() -> None:
    now = Moment(12, [EASTBOUND], {1: at("B", 12), "stranger": at("B", 12)})
    assert now.says(1) == ("violating", "several_aircraft", "reserved_by_another")
    assert not now.of(1).deviates


def test_a_flight_whose_reservation_somebody_else_enters_conforms_where_it_is_elsewhere() -> None:
    now = Moment(12, [EASTBOUND], {1: at("B", 12), "stranger": at("C", 12)})
    assert now.says(1) == ("conforming",)


def test_an_aircraft_in_a_yellow_block_does_not_violate() -> None:
    assert judged(at("N", 12), 12) == ("deviating", "off_track")
