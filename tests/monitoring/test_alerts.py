"""Alerts: who deviates, projected ahead along its velocity, and whose reservations it would enter when."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.alerts import Alert, alerts, swept
from app.block_status import Status
from app.conformance import Assessment, Conformance, Thresholds
from app.flight_intents import HeldReservations
from app.surveillance import Aircraft, Sighting, Velocity
from planner.airmatrix import AirMatrix, IntArray
from tests.monitoring.sky import CITY, aircraft, flight, ms

GRID = AirMatrix(32642, 668_920.0, 5_665_220.0, 20.0, 40.0, (5, 3, 2))
HOVER = Velocity(0.0, 0.0, 0.0)
EAST = Velocity(2.0, 0.0, 0.0)  # ten seconds a block


def about(expected: float | list[float]) -> Any:
    """Return what equals seconds that are nearly as expected: over a minute, a sphere and the ellipsoid put a slow
    aircraft less than half a metre apart.
    """
    return pytest.approx(expected, abs=0.25)


def seen_at(x: float, y: float, alt_m: float, velocity: Velocity | None, time: float = 0) -> Sighting:
    """Return a position given in metres from the grid's lower south-west corner."""
    lon, lat = GRID.unproject(GRID.origin_x_m + x, GRID.origin_y_m + y)
    block = int(GRID.blocks_at(float(lon), float(lat), alt_m)[0])
    return Sighting(ms(time), float(lon), float(lat), alt_m, velocity=velocity, block=None if block < 0 else block)


def seconds(time_ms: int) -> float:
    """Return a time of day in ms as seconds of the test."""
    return (time_ms - ms(0)) / 1000


def way_of(sighting: Sighting, until: float = 60) -> list[tuple[str, float, float]]:
    """Return the signs of the blocks that an aircraft passes, with the seconds in which it enters and leaves."""
    way = swept(sighting, GRID, ms(until))
    return [
        (CITY.signs[block], seconds(enter), seconds(leave))
        for block, enter, leave in zip(way.block.tolist(), way.enter_ms.tolist(), way.leave_ms.tolist(), strict=True)
    ]


# The way ahead


def test_an_aircraft_sweeps_the_blocks_along_its_velocity() -> None:
    way = way_of(seen_at(10, 30, 20, EAST))
    assert [sign for sign, _, _ in way] == ["A", "B", "C", "D", "E"]
    assert [enter for _, enter, _ in way] == about([0, 5, 15, 25, 35])
    assert [leave for _, _, leave in way] == about([5, 15, 25, 35, 45])


def test_an_aircraft_sweeps_northward_and_upward_too() -> None:
    climbing_north = way_of(seen_at(50, 30, 20, Velocity(0.0, 1.0, 3.0)), until=13)
    assert [sign for sign, _, _ in climbing_north] == ["C", "c", "."]
    assert [enter for _, enter, _ in climbing_north] == about([0, 20 / 3, 10])


def test_an_aircraft_sweeps_westward_and_downward_too() -> None:
    sinking_west = way_of(seen_at(50, 30, 60, Velocity(-2.0, 0.0, -2.0)), until=13)
    assert [sign for sign, _, _ in sinking_west] == ["c", "b", "B"]
    assert [enter for _, enter, _ in sinking_west] == about([0, 5, 10])


@pytest.mark.parametrize("velocity", [HOVER, None])
def test_an_aircraft_that_hovers_or_whose_velocity_is_unknown_stays_where_it_is(velocity: Velocity | None) -> None:
    assert way_of(seen_at(30, 30, 20, velocity)) == [("B", 0, 60)]


def test_blocks_outside_the_grid_are_left_out() -> None:
    assert [sign for sign, _, _ in way_of(seen_at(70, 30, 20, EAST))] == ["D", "E"]
    assert way_of(seen_at(110, 30, 20, EAST)) == []


def test_an_aircraft_that_comes_from_outside_sweeps_the_grid() -> None:
    way = way_of(seen_at(-10, 30, 20, EAST), until=12)
    assert [sign for sign, _, _ in way] == ["A"]
    assert way[0][1] == about(5)


def test_the_way_ahead_ends_when_it_is_asked_to() -> None:
    assert way_of(seen_at(10, 30, 20, EAST), until=12)[-1] == ("B", about(5), 12)


def test_the_way_ahead_begins_where_and_when_the_aircraft_was_seen() -> None:
    assert way_of(seen_at(10, 30, 20, EAST, time=-4))[0] == ("A", -4, about(1))


def test_at_the_ceiling_an_aircraft_is_in_the_highest_layer() -> None:
    assert way_of(seen_at(30, 30, 80, HOVER)) == [("b", 0, 60)]
    assert way_of(seen_at(30, 30, 80.001, HOVER)) == []


METRES = st.floats(-30, 130)
SPEED = st.floats(-6, 6)


@settings(deadline=None)
@given(
    start=st.tuples(METRES, METRES, st.floats(-10, 90)),
    velocity=st.builds(Velocity, SPEED, SPEED, SPEED),
    share=st.floats(0, 1),
)
def test_at_any_time_an_aircraft_is_in_the_block_that_it_passes_then(
    start: tuple[float, float, float], velocity: Velocity, share: float
) -> None:
    """The twin looks where a straight line is at one time; at a face, a few ms off are as good."""
    sighting = seen_at(*start, velocity)
    degrees_a_metre = 1 / 111_194.93
    lon = sighting.lon + 60 * velocity.east * degrees_a_metre / np.cos(np.radians(sighting.lat))
    lat = sighting.lat + 60 * velocity.north * degrees_a_metre
    x, y = GRID.project([sighting.lon, lon], [sighting.lat, lat])
    place = [
        (x[0] + share * (x[1] - x[0]) - GRID.origin_x_m) / 20,
        (y[0] + share * (y[1] - y[0]) - GRID.origin_y_m) / 20,
        (start[2] + share * 60 * velocity.up) / 40,
    ]
    is_inside = all(0 <= part < count for part, count in zip(place, GRID.dimensions, strict=True))
    is_on_a_face = any(abs(part - round(part)) < 1e-4 for part in place)
    way = swept(sighting, GRID, ms(60))
    time_ms = ms(60 * share)
    then = (way.enter_ms <= time_ms) & (time_ms <= way.leave_ms)
    if is_inside:
        i, j, k = map(int, place)
        assert GRID.index((i, j, k)) in way.block[then] or is_on_a_face
    else:
        assert not then.any() or is_on_a_face


# Threats and severity

DRIFTING = aircraft(1)
OTHER = 2


def deviating(sighting: Sighting | None, who: Aircraft = DRIFTING, **changes: Any) -> Assessment:
    """Return the assessment of an aircraft that is off its track."""
    attributes: dict[str, Any] = {
        "own": Conformance.DEVIATING,
        "reasons": ("off_track",),
        "is_airborne": True,
        "is_fresh": True,
        **changes,
    }
    flying = flight(None, sequence=who.sequence) if who.sequence else None
    return Assessment(who, flying, sighting, place=None, **attributes)


def holding(*rows: tuple[str, float, float, int]) -> HeldReservations:
    """Return reservations from a block's sign, enter, exit and who holds it."""
    table = [(CITY[sign], ms(enter), ms(leave), sequence) for sign, enter, leave, sequence in rows]
    block, enter_ms, exit_ms, sequence = np.array(sorted(table), dtype=np.int64).reshape(-1, 4).T
    return HeldReservations(block, enter_ms, exit_ms, sequence)


def raised(
    *assessments: Assessment,
    held: HeldReservations | None = None,
    at: float = 0,
    since: Sequence[float] = (),
    thresholds: Thresholds | None = None,
) -> list[Alert]:
    """Return the alerts at a time; the ledger gives the reservations that it is asked for."""
    held = holding() if held is None else held

    def held_in(blocks: IntArray, from_ms: int, to_ms: int) -> HeldReservations:
        wanted = np.isin(held.block, blocks) & (held.enter_ms < to_ms) & (held.exit_ms > from_ms)
        return HeldReservations(held.block[wanted], held.enter_ms[wanted], held.exit_ms[wanted], held.sequence[wanted])

    times = [ms(time) for time in since] or [ms(at)] * len(assessments)
    return alerts(zip(assessments, times, strict=True), GRID, ms(at), thresholds or Thresholds(), held_in)


def threatened(alert: Alert) -> list[tuple[int, str, float]]:
    """Return whose reservations an alert says are threatened: their holders, blocks, and the seconds to reach them."""
    return [(threat.sequence, CITY.signs[threat.block], seconds(threat.reach_ms)) for threat in alert.threats]


def test_a_deviating_aircraft_threatens_the_reservation_of_another_that_it_would_enter() -> None:
    held = holding(("C", 10, 30, OTHER))
    (alert,) = raised(deviating(seen_at(10, 30, 20, EAST)), held=held)
    assert threatened(alert) == [(OTHER, "C", about(15))]
    assert (seconds(alert.threats[0].enter_ms), seconds(alert.threats[0].exit_ms)) == (10, 30)
    assert alert.severity is Status.RED


def test_a_reservation_that_begins_while_it_is_in_the_block_is_reached_when_it_begins() -> None:
    (alert,) = raised(deviating(seen_at(10, 30, 20, EAST)), held=holding(("C", 20, 30, OTHER)))
    assert threatened(alert) == [(OTHER, "C", 20)]


@pytest.mark.parametrize("reservation", [("C", 0, 14, OTHER), ("C", 26, 60, OTHER), ("N", 0, 60, OTHER)])
def test_a_reservation_that_is_over_or_not_yet_begun_or_elsewhere_is_not_threatened(
    reservation: tuple[str, float, float, int],
) -> None:
    (alert,) = raised(deviating(seen_at(10, 30, 20, EAST)), held=holding(reservation))
    assert alert.threats == ()
    assert alert.severity is Status.YELLOW


def test_its_own_reservation_is_not_threatened() -> None:
    (alert,) = raised(deviating(seen_at(10, 30, 20, EAST)), held=holding(("C", 10, 30, DRIFTING.sequence)))
    assert alert.threats == ()


def test_threats_are_sorted_by_when_they_are_reached() -> None:
    held = holding(("E", 0, 60, 5), ("A", 40, 60, 2), ("A", 2, 4, 6), ("C", 0, 60, 4))
    (alert,) = raised(deviating(seen_at(10, 30, 20, EAST)), held=held)
    assert [(sequence, sign) for sequence, sign, _ in threatened(alert)] == [(6, "A"), (4, "C"), (5, "E")]


def test_a_reservation_where_the_aircraft_is_now_is_reached_now() -> None:
    (alert,) = raised(deviating(seen_at(10, 30, 20, HOVER, time=-4)), held=holding(("A", -10, 30, OTHER)))
    assert threatened(alert) == [(OTHER, "A", 0)]


def test_a_block_that_the_aircraft_has_passed_by_now_is_not_threatened() -> None:
    """It was seen four seconds ago, a metre before the end of A."""
    passing = seen_at(19, 30, 20, EAST, time=-4)
    (alert,) = raised(deviating(passing), held=holding(("A", -10, 30, OTHER), ("B", -10, 30, OTHER)))
    assert threatened(alert) == [(OTHER, "B", 0)]


def test_a_reservation_is_threatened_if_it_is_reached_within_a_minute() -> None:
    slow = Velocity(0.5, 0.0, 0.0)  # 20 s to the end of A, 60 to the end of B
    held = holding(("C", 0, 600, OTHER))
    assert raised(deviating(seen_at(11, 30, 20, slow)), held=held)[0].severity is Status.RED
    assert raised(deviating(seen_at(9, 30, 20, slow)), held=held)[0].severity is Status.YELLOW


def test_how_far_ahead_a_deviating_aircraft_is_projected_is_a_setting() -> None:
    held = holding(("C", 0, 60, OTHER))
    drifting = deviating(seen_at(10, 30, 20, EAST))
    assert raised(drifting, held=held, thresholds=Thresholds(projection_ms=14_000))[0].threats == ()
    assert len(raised(drifting, held=held, thresholds=Thresholds(projection_ms=16_000))[0].threats) == 1


@pytest.mark.parametrize(
    "change",
    [
        {"is_airborne": False},
        {"is_fresh": False, "own": Conformance.LOST, "reasons": ("lost",)},
        {"own": Conformance.CONFORMING, "reasons": ("not_activated",)},
    ],
)
def test_who_is_on_the_ground_or_lost_or_on_its_own_reservation_threatens_nobody(change: dict[str, Any]) -> None:
    held = holding(("C", 10, 30, OTHER))
    (alert,) = raised(deviating(seen_at(10, 30, 20, EAST), **change), held=held)
    assert alert.threats == ()
    assert alert.severity is Status.YELLOW


def test_who_was_never_seen_threatens_nobody() -> None:
    missing = deviating(None, own=Conformance.UNSEEN, reasons=("not_seen",), is_airborne=False, is_fresh=False)
    (alert,) = raised(missing, held=holding(("C", 10, 30, OTHER)))
    assert (alert.threats, alert.severity) == ((), Status.YELLOW)


def test_who_violates_now_is_a_red_alert_without_any_threat() -> None:
    (alert,) = raised(deviating(seen_at(50, 10, 20, HOVER), alarms=("in_building",)))
    assert (alert.threats, alert.severity) == ((), Status.RED)


def test_a_track_threatens_reservations_like_any_aircraft() -> None:
    stranger = aircraft("stranger")
    (alert,) = raised(deviating(seen_at(10, 30, 20, EAST), who=stranger), held=holding(("C", 10, 30, OTHER)))
    assert [sequence for sequence, _, _ in threatened(alert)] == [OTHER]


def test_two_aircraft_may_threaten_one_reservation() -> None:
    from_the_west, from_above = seen_at(10, 30, 20, EAST), seen_at(50, 30, 60, Velocity(0.0, 0.0, -1.0))
    both = raised(deviating(from_the_west), deviating(from_above, who=aircraft(3)), held=holding(("C", 10, 30, OTHER)))
    assert [threatened(alert) for alert in both] == [
        [(OTHER, "C", about(15))],
        [(OTHER, "C", about(20))],
    ]


def test_the_newest_alert_comes_first() -> None:
    sighting = seen_at(10, 30, 20, HOVER)
    listed = raised(
        *(deviating(sighting, who=aircraft(who)) for who in (4, 3, 5, "stranger")), since=[-20, -10, -20, -30]
    )
    assert [(alert.assessment.aircraft, seconds(alert.raised_ms)) for alert in listed] == [
        (aircraft(3), -10),
        (aircraft(4), -20),
        (aircraft(5), -20),
        (aircraft("stranger"), -30),
    ]


def test_without_deviations_there_are_no_alerts() -> None:
    assert raised() == []
