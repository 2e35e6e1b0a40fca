"""States that move by themselves: by what an aircraft does, never by what others do to it."""

import pytest

from app.conformance import Thresholds, move
from app.flight_intents import State
from app.surveillance import Flight, Sighting
from tests.monitoring.sky import Moment, at, flight, ms

OPEN = [State.ACCEPTED, State.ACTIVATED, State.NONCONFORMING, State.CONTINGENT]
OVER = [State.REJECTED, State.CANCELLED, State.ENDED]


def moved(
    flying: Flight,
    sighting: Sighting | None,
    time: float,
    *,
    since: float | None = None,
    stranger: Sighting | None = None,
    thresholds: Thresholds | None = None,
) -> State | None:
    """Return the state that a flight moves to which was seen so, and is lost or violating since a time."""
    seen = {who: position for who, position in ((1, sighting), ("stranger", stranger)) if position is not None}
    thresholds = thresholds or Thresholds()
    assessment = Moment(time, [flying], seen, thresholds=thresholds).of(1)
    return move(assessment, None if since is None else ms(since), ms(time), thresholds)


def eastbound(state: State, *, activated: bool | None = None) -> Flight:
    """Return a flight from A to E, from 0 to 40; in C from 15 to 25."""
    return flight("ABCDE", state=state, activated=activated)


# Accepted


@pytest.mark.parametrize("sighting", [at("B", 12), at("N", 12), at("B", 12, airborne=True), at("B", 6)])
def test_an_accepted_flight_that_is_airborne_is_nonconforming(sighting: Sighting) -> None:
    assert moved(eastbound(State.ACCEPTED), sighting, 12) is State.NONCONFORMING


@pytest.mark.parametrize("sighting", [None, at("A", -2), at("A", -2, airborne=False)])
def test_an_accepted_flight_that_does_not_fly_yet_stays_accepted(sighting: Sighting | None) -> None:
    assert moved(eastbound(State.ACCEPTED), sighting, 0) is None


def test_an_accepted_flight_that_takes_off_before_its_departure_is_nonconforming() -> None:
    assert moved(eastbound(State.ACCEPTED), at("A", -2, airborne=True), -2) is State.NONCONFORMING


def test_an_accepted_flight_that_still_stands_on_its_pad_stays_accepted() -> None:
    assert moved(eastbound(State.ACCEPTED), at("A", 12, airborne=False), 12) is None


# Activated, nonconforming, and back


def test_an_activated_flight_that_conforms_stays_activated() -> None:
    assert moved(eastbound(State.ACTIVATED), at("B", 12), 12) is None


@pytest.mark.parametrize("sighting", [at("N", 12), at("E", 12), at("B", 6.999), at("A", 12.001, airborne=False)])
def test_an_activated_flight_that_deviates_or_is_lost_is_nonconforming(sighting: Sighting) -> None:
    assert moved(eastbound(State.ACTIVATED), sighting, 12.001) is State.NONCONFORMING


@pytest.mark.parametrize("sighting", [None, at("A", -10), at("A", 1, airborne=False)])
def test_an_activated_flight_that_is_not_seen_stays_activated(sighting: Sighting | None) -> None:
    assert moved(eastbound(State.ACTIVATED), sighting, 12) is None


def test_a_nonconforming_flight_that_conforms_is_activated_again() -> None:
    assert moved(eastbound(State.NONCONFORMING), at("B", 12), 12) is State.ACTIVATED


def test_a_nonconforming_flight_that_still_deviates_stays_nonconforming() -> None:
    assert moved(eastbound(State.NONCONFORMING), at("N", 12), 12) is None


def test_a_nonconforming_flight_that_was_never_activated_stays_nonconforming() -> None:
    assert moved(eastbound(State.NONCONFORMING, activated=False), at("B", 12), 12) is None


# Contingent


@pytest.mark.parametrize("state", [State.ACTIVATED, State.NONCONFORMING])
@pytest.mark.parametrize("sighting", [at("B", 30), at("#", 36)])
def test_a_flight_that_is_lost_or_violating_for_long_is_contingent(state: State, sighting: Sighting) -> None:
    assert moved(eastbound(state), sighting, 36, since=6) is State.CONTINGENT


@pytest.mark.parametrize("state", [State.ACTIVATED, State.NONCONFORMING])
def test_a_flight_that_is_lost_for_less_long_is_nonconforming(state: State) -> None:
    after = moved(eastbound(state), at("B", 30), 36, since=6.001)
    assert after is (State.NONCONFORMING if state is State.ACTIVATED else None)


def test_a_flight_that_deviates_for_long_without_violating_is_not_contingent() -> None:
    assert moved(eastbound(State.NONCONFORMING), at("N", 36), 36, since=None) is None


def test_after_how_long_a_flight_is_contingent_is_a_setting() -> None:
    patient = Thresholds(contingent_after_ms=60_000)
    assert moved(eastbound(State.NONCONFORMING), at("B", 30), 36, since=-24, thresholds=patient) is State.CONTINGENT
    assert moved(eastbound(State.NONCONFORMING), at("B", 30), 36, since=-23.999, thresholds=patient) is None


def test_an_accepted_flight_is_nonconforming_before_it_is_contingent() -> None:
    assert moved(eastbound(State.ACCEPTED), at("B", 30), 36, since=-60) is State.NONCONFORMING


@pytest.mark.parametrize("sighting", [at("B", 12), at("N", 12), at("B", 6)])
def test_a_contingent_flight_stays_contingent_in_the_air(sighting: Sighting) -> None:
    assert moved(eastbound(State.CONTINGENT), sighting, 12, since=-60) is None


# What others do moves nobody


@pytest.mark.parametrize("since", [None, -60.0])
def test_a_flight_on_its_reservation_whose_block_somebody_else_enters_stays_as_it_is(since: float | None) -> None:
    assert moved(eastbound(State.ACTIVATED), at("B", 12), 12, since=since, stranger=at("B", 12)) is None


def test_a_nonconforming_flight_is_activated_again_on_its_reservation_although_somebody_else_enters_it() -> None:
    nonconforming = eastbound(State.NONCONFORMING)
    assert moved(nonconforming, at("B", 12), 12, since=-60, stranger=at("B", 12)) is State.ACTIVATED


# Ended


@pytest.mark.parametrize("state", OPEN)
def test_a_flight_that_is_reported_landed_at_its_destination_has_ended(state: State) -> None:
    assert moved(eastbound(state), at("E", 30, airborne=False), 30) is State.ENDED


@pytest.mark.parametrize("state", OPEN)
def test_a_flight_that_was_last_seen_at_its_destination_has_ended_once_its_arrival_and_the_tolerance_have_passed(
    state: State,
) -> None:
    assert moved(eastbound(state), at("E", 36), 42, since=None) is not State.ENDED
    assert moved(eastbound(state), at("E", 36), 42.001, since=None) is State.ENDED


def test_a_flight_that_stands_at_its_destination_after_its_arrival_has_ended() -> None:
    assert moved(eastbound(State.ACTIVATED), at("E", 41), 42) is None
    assert moved(eastbound(State.ACTIVATED), at("E", 41), 42.001) is State.ENDED


def test_a_flight_that_still_flies_at_its_destination_has_not_ended() -> None:
    assert moved(eastbound(State.NONCONFORMING), at("E", 50, airborne=True), 50) is None
    assert moved(eastbound(State.ACTIVATED), at("E", 39), 43) is None


def test_a_flight_that_was_at_its_destination_before_departure_has_not_ended() -> None:
    assert moved(eastbound(State.ACTIVATED), at("E", -1, airborne=False), -1) is None


@pytest.mark.parametrize(
    "sighting", [at("A", -60, airborne=False), at("A", 12, airborne=False), at("N", 30, airborne=False)]
)
@pytest.mark.parametrize("state", OPEN)
def test_a_flight_that_stands_on_any_ground_has_ended_once_its_arrival_has_passed(
    state: State, sighting: Sighting
) -> None:
    assert moved(eastbound(state), sighting, 42) is not State.ENDED
    assert moved(eastbound(state), sighting, 42.001) is State.ENDED


@pytest.mark.parametrize("state", [State.ACCEPTED, State.ACTIVATED])
def test_a_flight_that_was_never_seen_has_ended_once_its_arrival_and_the_tolerance_have_passed(state: State) -> None:
    assert moved(eastbound(state), None, 42) is None
    assert moved(eastbound(state), None, 42.001) is State.ENDED


@pytest.mark.parametrize("state", [State.NONCONFORMING, State.CONTINGENT])
def test_a_flight_that_is_lost_on_its_way_does_not_end_by_itself(state: State) -> None:
    assert moved(eastbound(state), at("D", 36), 3_600) is not State.ENDED


# What never moves


@pytest.mark.parametrize("state", OVER)
@pytest.mark.parametrize("sighting", [None, at("B", 12), at("N", 12), at("E", 12, airborne=False)])
def test_a_flight_that_is_over_stays_as_it_is(state: State, sighting: Sighting | None) -> None:
    assert moved(eastbound(state), sighting, 12, since=-60) is None
    assert moved(eastbound(state), sighting, 60, since=-60) is None


def test_a_refused_flight_that_flies_stays_refused() -> None:
    assert moved(flight(None, state=State.REJECTED), at("B", 12), 12, since=-60) is None


def test_a_track_has_no_state() -> None:
    assessment = Moment(12, [], {"stranger": at("N", 12)}).of("stranger")
    assert move(assessment, ms(-60), ms(12), Thresholds()) is None
