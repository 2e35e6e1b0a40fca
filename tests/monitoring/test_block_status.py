"""Block status, cell by cell of its table: who has reserved a block against who is in it."""

import pytest

from app.flight_intents import State
from app.surveillance import Sighting
from planner.airspace import OccupancyRule
from tests.monitoring.sky import CITY, Moment, aircraft, at, flight, path

# Ten seconds a link, from 0 to 40: it holds A [0, 10], B [0, 20], C [10, 30], D [20, 40], E [30, 40]; it is in B from
# 5 to 15, in C to 25, in D to 35.
EASTBOUND = flight("ABCDE")
# Above it, from e to a at the same times.
WESTBOUND = flight("edcba", sequence=2)


# Green


def test_a_block_is_green_where_the_flight_that_has_reserved_it_is() -> None:
    now = Moment(12, [EASTBOUND], {1: at("B", 12)})
    assert now["B"] == ("green",)
    assert now.concerned("B") == [aircraft(1)]


def test_a_reserved_block_is_green_while_its_flight_conforms_elsewhere() -> None:
    assert Moment(12, [EASTBOUND], {1: at("B", 12)})["C"] == ("green",)


def test_a_reserved_block_is_green_until_its_flight_is_due_to_depart() -> None:
    assert Moment(2.0, [EASTBOUND])["A"] == ("green",)


def test_blocks_with_neither_reservation_nor_aircraft_are_idle_and_not_listed() -> None:
    now = Moment(12, [EASTBOUND], {1: at("B", 12)})
    assert len(now.blocks) == 2
    assert now["A"] is None
    assert now["D"] is None


def test_a_reservation_covers_its_enter_and_not_its_exit() -> None:
    seen = {1: at("B", 9.999)}
    assert Moment(9.999, [EASTBOUND], seen)["C"] is None
    assert Moment(10.0, [EASTBOUND], seen)["C"] == ("green",)
    assert Moment(10.0, [EASTBOUND], seen)["A"] == ("green",)
    assert Moment(10.001, [EASTBOUND], seen)["A"] is None


def test_the_blocks_of_a_cancelled_flight_that_keeps_them_are_green_although_it_is_not_seen() -> None:
    assert Moment(12, [flight("ABCDE", state=State.CANCELLED)])["B"] == ("green",)


@pytest.mark.parametrize("state", [State.ACCEPTED, State.ACTIVATED, State.NONCONFORMING])
def test_the_state_of_a_flight_that_conforms_makes_no_block_yellow(state: State) -> None:
    assert Moment(12, [flight("ABCDE", state=state)], {1: at("B", 12)})["B"] == ("green",)


# Red


def test_a_block_is_red_where_two_aircraft_are() -> None:
    now = Moment(12, [], {"one": at("N", 12), "two": at("N", 12)})
    assert now["N"] == ("red", "several_aircraft", "unplanned_use")
    assert now.concerned("N") == [aircraft("one"), aircraft("two")]


def test_a_block_is_not_red_where_the_second_aircraft_is_on_the_ground() -> None:
    now = Moment(12, [], {"one": at("N", 12), "two": at("N", 12, airborne=False)})
    assert now["N"] == ("yellow", "unplanned_use")
    assert now.concerned("N") == [aircraft("one")]


def test_a_block_is_red_where_another_flight_is_than_the_one_that_has_reserved_it() -> None:
    now = Moment(12, [EASTBOUND, WESTBOUND], {1: at("B", 12), 2: at("C", 12)})
    assert now["C"] == ("red", "reserved_by_another")
    assert now.concerned("C") == [aircraft(1), aircraft(2)]


def test_a_block_is_red_where_a_track_is_that_has_no_flight_intent() -> None:
    now = Moment(12, [EASTBOUND], {1: at("B", 12), "stranger": at("C", 12)})
    assert now["C"] == ("red", "reserved_by_another")
    assert now.concerned("C") == [aircraft(1), aircraft("stranger")]
    assert now["B"] == ("green",)


def test_a_block_is_red_where_somebody_meets_the_flight_that_has_reserved_it() -> None:
    now = Moment(12, [EASTBOUND], {1: at("B", 12), "stranger": at("B", 12)})
    assert now["B"] == ("red", "several_aircraft", "reserved_by_another")
    assert now["C"] == ("green",)


def test_a_reserved_block_is_not_red_where_another_aircraft_is_on_the_ground() -> None:
    now = Moment(12, [EASTBOUND], {1: at("B", 12), "stranger": at("B", 12, airborne=False)})
    assert now["B"] == ("green",)


def test_a_block_is_red_where_an_aircraft_is_in_a_building() -> None:
    now = Moment(12, [EASTBOUND], {1: at("#", 12)})
    assert now["#"] == ("red", "in_building", "unplanned_use")


def test_a_block_with_a_building_is_idle_where_an_aircraft_stands_on_it() -> None:
    assert Moment(12, [], {"stranger": at("#", 12, airborne=False)})["#"] is None


def test_the_free_block_above_a_building_is_not_red() -> None:
    over_the_house = flight(path("BCb"))
    assert Moment(12, [over_the_house], {1: at("C", 12)})["C"] == ("green",)


def test_a_block_is_red_where_an_aircraft_is_in_closed_airspace() -> None:
    now = Moment(12, [EASTBOUND], {"stranger": at("N", 12)}, closed=["NC"])
    assert now["N"] == ("red", "in_constraint", "unplanned_use")
    assert now.says("stranger") == ("violating", "no_flight_intent", "in_constraint")


def test_a_flight_on_its_own_reservation_in_closed_airspace_is_red_and_violating_by_no_doing_of_its_own() -> None:
    now = Moment(12, [EASTBOUND], {1: at("B", 12)}, closed=["B"])
    assert now["B"] == ("red", "in_constraint")
    assert now.says(1) == ("violating", "in_constraint")
    assert not now.of(1).deviates


def test_closed_airspace_is_not_red_where_only_a_reservation_or_an_aircraft_on_the_ground_is() -> None:
    now = Moment(12, [EASTBOUND], {1: at("B", 12), "stranger": at("E", 12, airborne=False)}, closed=["CE", "cN"])
    assert (now["C"], now["E"], now["N"]) == (("green",), None, None)
    assert now["B"] == ("green",)


def test_a_block_tells_all_constraints_that_close_it() -> None:
    now = Moment(12, [EASTBOUND], {1: at("B", 12)}, closed=["BC", "A", "C"])
    assert (now.closes("B"), now.closes("C")) == (("constraint-1",), ("constraint-1", "constraint-3"))


# Yellow


def test_a_block_that_nobody_has_reserved_is_yellow_where_an_aircraft_is() -> None:
    now = Moment(12, [EASTBOUND], {1: at("N", 12)})
    assert now["N"] == ("yellow", "unplanned_use")
    assert now.concerned("N") == [aircraft(1)]


@pytest.mark.parametrize(
    ("time", "seen", "reason"),
    [
        (12, at("N", 12), "off_track"),
        (12, at(None, 12), "off_track"),
        (12, at("c", 12), "wrong_layer"),
        (12, at("E", 12), "early"),
        (29, at("B", 29), "late"),
        (12, at("B", 6.999), "lost"),
    ],
)
def test_a_reserved_block_is_yellow_while_its_flight_does_not_conform(time: float, seen: Sighting, reason: str) -> None:
    now = Moment(time, [EASTBOUND], {1: seen})
    assert now["C"] == ("yellow", reason)
    assert now.concerned("C") == [aircraft(1)]


def test_a_lost_aircraft_is_in_no_block() -> None:
    assert Moment(12, [EASTBOUND], {1: at("N", 6.999)})["N"] is None


def test_a_reserved_block_is_yellow_while_its_flight_is_contingent() -> None:
    contingent = flight("ABCDE", state=State.CONTINGENT)
    assert Moment(12, [contingent], {1: at("B", 12)})["B"] == ("yellow", "contingent")
    assert Moment(12, [contingent], {1: at("B", 6.999)})["B"] == ("yellow", "lost", "contingent")


def test_a_reserved_block_is_yellow_when_its_flight_was_due_to_depart_and_has_never_been_seen() -> None:
    assert Moment(2.001, [EASTBOUND])["A"] == ("yellow", "not_seen")


def test_a_block_is_green_again_as_soon_as_its_flight_conforms_again() -> None:
    assert Moment(12, [EASTBOUND], {1: at("N", 12)})["C"] == ("yellow", "off_track")
    assert Moment(13, [EASTBOUND], {1: at("C", 13)})["C"] == ("green",)


# Red beats yellow, and all is told


def test_a_red_block_tells_also_why_it_would_be_yellow() -> None:
    now = Moment(12, [EASTBOUND], {1: at("N", 12), "stranger": at("C", 12)})
    assert now["C"] == ("red", "reserved_by_another", "off_track")


def test_a_block_tells_all_reasons_and_all_aircraft_who_has_reserved_it_first() -> None:
    contingent = flight("ABCDE", state=State.CONTINGENT)
    now = Moment(12, [contingent, WESTBOUND], {1: at("N", 12), 2: at("C", 12), "stranger": at("C", 12)})
    assert now["C"] == ("red", "several_aircraft", "reserved_by_another", "off_track", "contingent")
    assert now.concerned("C") == [aircraft(1), aircraft(2), aircraft("stranger")]


def test_blocks_are_listed_in_the_order_of_their_indices() -> None:
    now = Moment(12, [], {"one": at("e", 12), "two": at("a", 12), "three": at("B", 12), "four": at("#", 12)})
    assert [CITY.signs[entry.block] for entry in now.blocks] == ["#", "B", "a", "e"]


# Where an aircraft counts


def test_a_conforming_aircraft_counts_where_its_trajectory_puts_it_now() -> None:
    """It was seen in B, but by now it is in C."""
    seen = {1: at("B", 14.9)}
    assert Moment(15, [EASTBOUND], seen | {"stranger": at("C", 15)})["C"] == (
        "red", "several_aircraft", "reserved_by_another",
    )  # fmt: skip
    assert Moment(15, [EASTBOUND], seen | {"stranger": at("B", 15)})["B"] == ("red", "reserved_by_another")


def test_half_of_a_links_time_an_aircraft_counts_in_the_block_behind() -> None:
    seen = {1: at("B", 14.9), "stranger": at("B", 14.9)}
    assert Moment(14.999, [EASTBOUND], seen)["B"] == ("red", "several_aircraft", "reserved_by_another")


def test_a_hovering_aircraft_counts_where_it_hovers() -> None:
    hovering = flight(path("ABC", hover={"B": 60}))  # in B from 10 to 70
    assert Moment(74.9, [hovering], {1: at("B", 74.9), "stranger": at("B", 74.9)})["B"] == (
        "red", "several_aircraft", "reserved_by_another",
    )  # fmt: skip


def test_any_other_aircraft_counts_where_it_was_last_seen() -> None:
    assert Moment(12, [EASTBOUND], {1: at("N", 7)})["N"] == ("yellow", "unplanned_use")


def test_a_conforming_aircraft_counts_nowhere_after_its_arrival() -> None:
    seen = {1: at("E", 39), "stranger": at("E", 39)}
    assert Moment(39.999, [EASTBOUND], seen)["E"] == ("red", "several_aircraft", "reserved_by_another")
    assert Moment(40, [EASTBOUND], seen)["E"] == ("red", "reserved_by_another")
    assert Moment(40.001, [EASTBOUND], seen)["E"] == ("yellow", "unplanned_use")


@pytest.mark.parametrize("airborne", [True, None])
def test_a_flight_in_its_own_first_block_before_departure_counts_nowhere(airborne: bool | None) -> None:
    before = flight("CA", sequence=2)
    leaves_c_at_minus_1 = flight(path("BCD", departure=-21))
    now = Moment(-5, [leaves_c_at_minus_1, before], {1: at("C", -5), 2: at("C", -5, airborne=airborne)})
    assert now["C"] == ("green",)


@pytest.mark.parametrize("airborne", [True, None])
def test_a_flight_in_its_own_last_block_after_arrival_counts_nowhere(airborne: bool | None) -> None:
    after = flight(path("AB", departure=-20), sequence=2)
    now = Moment(9, [EASTBOUND, after], {1: at("B", 9), 2: at("B", 9, airborne=airborne)})
    assert now["B"] == ("green",)


@pytest.mark.parametrize("airborne", [True, None])
def test_a_flight_in_its_own_last_block_before_arrival_counts_there(airborne: bool | None) -> None:
    early = flight(path("NC", departure=50), sequence=2)
    now = Moment(12, [EASTBOUND, early], {1: at("B", 12), 2: at("C", 12, airborne=airborne)})
    assert now["C"] == ("red", "reserved_by_another")


@pytest.mark.parametrize("airborne", [True, None])
def test_a_flight_in_its_own_first_block_after_departure_counts_there(airborne: bool | None) -> None:
    late = flight(path("CN", departure=-20), sequence=2)
    now = Moment(12, [EASTBOUND, late], {1: at("B", 12), 2: at("C", 12, airborne=airborne)})
    assert now["C"] == ("red", "reserved_by_another")


# The occupancy rule


def test_by_the_midpoint_rule_only_one_end_of_a_link_is_reserved() -> None:
    seen = {1: at("B", 12)}
    by_midpoint = Moment(12, [EASTBOUND], seen, rule=OccupancyRule.MIDPOINT)
    assert (by_midpoint["B"], by_midpoint["C"]) == (("green",), None)


def test_by_the_containment_rule_the_side_blocks_of_a_diagonal_are_reserved() -> None:
    diagonal = flight("BN")
    seen = {1: at("B", 4)}
    assert Moment(4, [diagonal], seen)["C"] == ("green",)
    assert Moment(4, [diagonal], seen, rule=OccupancyRule.MIDPOINT)["C"] is None


# The future


@pytest.mark.parametrize("state", [State.ACCEPTED, State.ACTIVATED, State.NONCONFORMING, State.CONTINGENT])
def test_in_the_future_all_that_is_reserved_is_green(state: State) -> None:
    ahead = Moment(12, [flight("ABCDE", state=state)], is_forecast=True)
    assert [entry.status.value for entry in ahead.blocks] == ["green", "green"]
    assert ahead["B"] == ("green",)
