"""Who deviates, how and when: all from one seed, and each kind does what it says."""

from collections import Counter

import numpy as np
import pytest

from app.commands.deviations import Deviations, Flown, Kind
from app.commands.flight_model import Way
from planner.airmatrix import AirMatrix, FloatArray

T0 = 1_795_334_400_000
GRID = AirMatrix(32642, 668_920.0, 5_665_220.0, 20.0, 40.0, (100, 100, 3))
# Of a hundred seconds.
DURATION_MS = 100_000


def way(layer: int = 1, row: int = 50) -> Way:
    """Return a way from west to east along a row, 11 m a second, one knot a second."""
    times = np.arange(0, DURATION_MS + 1, 1000)
    east = GRID.origin_x_m + 300 + 0.011 * times
    north = np.full(len(times), GRID.origin_y_m + 20.0 * row + 10)
    return Way(T0 + times, np.stack([east, north, np.full(len(times), 40.0 * layer + 20)], axis=-1))


def flown(kind: Kind, sequence: int, plan: Way | None = None) -> Flown:
    """Return what becomes of a flight when all deviate in one way."""
    return Deviations(7, (kind,), share=1.0).of(way() if plan is None else plan, sequence, 0, GRID)


def off(flight: Flown, plan: Way) -> FloatArray:
    """Return how far a flight is off its plan, second by second: shape (n, 3)."""
    seconds = range(plan.begin_ms, plan.end_ms + 1, 1000)
    return np.array([flight.way.at(time_ms) - plan.at(time_ms) for time_ms in seconds])


def fate(flight: Flown) -> tuple[object, ...]:
    """Return all there is to a flight, so that two can be compared."""
    ways = [each and (each.time_ms.tolist(), each.place.tolist()) for each in (flight.way, flight.intruder)]
    return (*ways, flight.kind, flight.silent_from_ms, flight.silent_until_ms)


def test_the_same_seed_and_flights_deviate_alike_whatever_comes_first() -> None:
    deviations = Deviations(3, share=0.5)
    one_way = {sequence: fate(deviations.of(way(), sequence, 0, GRID)) for sequence in range(40)}
    other_way = {sequence: fate(deviations.of(way(), sequence, 99, GRID)) for sequence in reversed(range(40))}
    assert one_way == other_way


def test_the_order_in_which_kinds_are_named_does_not_matter() -> None:
    there, back = (Deviations(3, kinds, share=1.0) for kinds in (tuple(Kind), tuple(reversed(Kind))))
    for sequence in range(20):
        assert fate(there.of(way(), sequence, 0, GRID)) == fate(back.of(way(), sequence, 0, GRID))


def test_another_seed_picks_others() -> None:
    chosen = [
        [sequence for sequence in range(100) if Deviations(seed, share=0.3).of(way(), sequence, 0, GRID).kind]
        for seed in (1, 2)
    ]
    assert chosen[0] != chosen[1]


def test_about_the_share_that_was_asked_for_deviates_in_all_ways() -> None:
    kinds = Counter(Deviations(1, share=0.2).of(way(), sequence, 0, GRID).kind for sequence in range(2000))
    assert 320 <= 2000 - kinds.pop(None) <= 480
    assert set(kinds) == set(Kind)
    assert min(kinds.values()) >= 40


def test_a_greater_share_deviates_in_the_same_flights_and_more() -> None:
    few, many = (
        {sequence for sequence in range(300) if Deviations(1, share=share).of(way(), sequence, 0, GRID).kind}
        for share in (0.1, 0.4)
    )
    assert few < many


def test_of_a_number_the_first_deviate() -> None:
    deviations = Deviations(1, first=3)
    assert [deviations.of(way(), 10 + number, number, GRID).kind is not None for number in range(5)] == [
        True, True, True, False, False,
    ]  # fmt: skip


def test_without_deviations_all_fly_as_planned() -> None:
    plan = way()
    flight = Deviations(1).of(plan, 5, 0, GRID)
    assert fate(flight) == fate(Flown(plan))
    assert flight.is_heard(T0)
    assert flight.is_heard(T0 + DURATION_MS)


@pytest.mark.parametrize("sequence", range(8))
class TestEachKind:
    def test_a_late_flight_is_the_plan_later(self, sequence: int) -> None:
        flight = flown(Kind.LATE, sequence)
        late_ms = flight.way.begin_ms - T0
        assert 8_000 <= late_ms <= 30_000
        assert flight.way.end_ms == T0 + DURATION_MS + late_ms
        assert flight.way.at(T0 + late_ms + 40_000) == pytest.approx(way().at(T0 + 40_000))

    def test_a_drift_goes_sideways_by_more_than_a_block_and_returns(self, sequence: int) -> None:
        sideways = off(flown(Kind.DRIFT, sequence), way())
        assert (sideways[:, [0, 2]] == 0).all()
        assert 30 <= np.abs(sideways[50, 1]) <= 40
        assert (sideways[:15] == 0).all()
        assert (sideways[86:] == 0).all()
        assert np.abs(np.diff(sideways[:, 1])).max() <= 6

    def test_at_the_edge_a_drift_stays_in_the_airspace(self, sequence: int) -> None:
        for row in (0, 99):
            north = flown(Kind.DRIFT, sequence, way(row=row)).way.place[:, 1] - GRID.origin_y_m
            assert (north > 0).all()
            assert (north < 2000).all()

    def test_a_wrong_layer_is_the_next_one_for_a_while(self, sequence: int) -> None:
        for layer, steps in ((0, {40}), (1, {40, -40}), (2, {-40})):
            upward = off(flown(Kind.LAYER, sequence, way(layer)), way(layer))
            assert (upward[:, :2] == 0).all()
            assert upward[50, 2] in steps
            assert (upward[:15] == 0).all()
            assert (upward[86:] == 0).all()

    def test_a_hover_arrives_as_much_later_as_it_stops(self, sequence: int) -> None:
        flight = flown(Kind.HOVER, sequence)
        stop_ms = flight.way.end_ms - T0 - DURATION_MS
        assert 10_000 <= stop_ms <= 30_000
        standing = (np.diff(flight.way.place, axis=0) == 0).all(axis=1)
        (at,) = np.flatnonzero(standing)
        assert np.diff(flight.way.time_ms)[at] == stop_ms
        assert 30_000 <= flight.way.time_ms[at] - T0 <= 60_000

    def test_a_lost_link_is_silence_on_the_planned_way(self, sequence: int) -> None:
        flight = flown(Kind.LOST, sequence)
        assert (off(flight, way()) == 0).all()
        heard = [flight.is_heard(time_ms) for time_ms in range(T0, T0 + DURATION_MS + 1, 1000)]
        first = heard.index(False)
        assert 30 <= first <= 51
        if flight.silent_until_ms is None:
            assert not any(heard[first:])
        else:
            assert 15 <= heard[first:].index(True) <= 46
            assert all(heard[first + heard[first:].index(True) :])

    def test_an_intruder_crosses_the_way_where_and_when_the_flight_passes(self, sequence: int) -> None:
        flight = flown(Kind.INTRUDER, sequence)
        intruder = flight.intruder
        assert intruder is not None
        assert (off(flight, way()) == 0).all()
        times = range(intruder.begin_ms, intruder.end_ms, 100)
        apart = [float(np.linalg.norm(intruder.at(time_ms) - way().at(time_ms))) for time_ms in times]
        assert min(apart) < 40
        assert T0 + 27_000 <= times[int(np.argmin(apart))] <= T0 + 73_000
        assert np.ptp(intruder.place[:, 2]) == 0
        assert np.ptp(intruder.place[:, 1]) == pytest.approx(600)


def test_an_intruder_stays_in_the_airspace() -> None:
    intruder = flown(Kind.INTRUDER, 1, way(row=2)).intruder
    assert intruder is not None
    north = intruder.place[:, 1] - GRID.origin_y_m
    assert [round(abs(metres), 6) for metres in sorted(north)] == [0, 50, 350]


def test_both_ways_of_losing_the_link_occur() -> None:
    for_good = [flown(Kind.LOST, sequence).silent_until_ms is None for sequence in range(60)]
    assert 8 <= sum(for_good) <= 32


@pytest.mark.parametrize("kind", Kind)
def test_the_shortest_and_the_vertical_flight_can_deviate_too(kind: Kind) -> None:
    up = Way(np.array([T0, T0 + 1852]), np.array([[669_930.0, 5_666_230, 20], [669_930.0, 5_666_230, 60]]))
    for sequence in range(10):
        flight = flown(kind, sequence, up)
        assert (np.diff(flight.way.time_ms) > 0).all()
        assert np.isfinite(flight.way.place).all()
