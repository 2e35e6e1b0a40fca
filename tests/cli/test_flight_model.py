"""Where an aircraft is on its way, as planned and as deviations bend it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.commands.flight_model import Way, places, planned_way

T0 = 1_795_334_400_000


def way(*knots: tuple[int, float, float, float]) -> Way:
    """Return a way through knots of seconds, x, y and altitude."""
    return Way(
        np.array([T0 + seconds * 1000 for seconds, *_ in knots], dtype=np.int64),
        np.array([place for _, *place in knots], dtype=np.float64),
    )


# East for ten seconds, then north and up.
BEND = way((0, 0, 0, 20), (10, 100, 0, 20), (20, 100, 50, 60))


def at(way: Way, seconds: float) -> list[float]:
    """Return a place rounded to millimetres."""
    return [round(float(length), 3) for length in way.at(T0 + int(seconds * 1000))]


def test_between_two_knots_an_aircraft_flies_straight_and_evenly() -> None:
    assert at(BEND, 2.5) == [25, 0, 20]
    assert at(BEND, 15) == [100, 25, 40]


def test_at_a_knot_it_is_there() -> None:
    assert [at(BEND, seconds) for seconds in (0, 10, 20)] == [[0, 0, 20], [100, 0, 20], [100, 50, 60]]


def test_before_its_begin_and_after_its_end_it_stands_still() -> None:
    assert at(BEND, -100) == [0, 0, 20]
    assert at(BEND, 100) == [100, 50, 60]


def test_a_trajectory_with_a_hover_and_dwells_is_flown_as_planned() -> None:
    # Dwells for two seconds, flies for four, hovers for three, flies for four, dwells for one.
    centres = np.array([[10.0, 10, 20], [30, 10, 20], [50, 10, 20]])
    arrive, depart = (T0 + 1000 * np.array(seconds) for seconds in ([0, 6, 13], [2, 9, 14]))
    flown = planned_way(centres, arrive, depart)
    assert (flown.begin_ms, flown.end_ms) == (T0, T0 + 14_000)
    assert [at(flown, seconds)[0] for seconds in (0, 2, 4, 6, 8, 9, 11, 13, 14)] == [10, 10, 20, 30, 30, 30, 40, 50, 50]


def test_where_there_is_neither_hover_nor_dwell_there_is_one_knot_a_block() -> None:
    centres = np.array([[10.0, 10, 20], [30, 10, 20], [50, 10, 20]])
    times = T0 + np.array([0, 2000, 4000])
    assert (planned_way(centres, times, times).time_ms == times).all()


def test_a_delayed_way_is_the_same_way_later() -> None:
    delayed = BEND.delayed(7_000)
    assert [at(delayed, seconds + 7) for seconds in range(21)] == [at(BEND, seconds) for seconds in range(21)]


@pytest.mark.parametrize("stop_s", [4, 10])
def test_a_hover_stops_in_mid_air_and_goes_on_as_much_later(stop_s: int) -> None:
    hovering = BEND.hovering(T0 + stop_s * 1000, 30_000)
    assert hovering.end_ms == BEND.end_ms + 30_000
    for seconds in range(stop_s + 1):
        assert at(hovering, seconds) == at(BEND, seconds)
    assert at(hovering, stop_s + 15) == at(BEND, stop_s)
    for seconds in range(stop_s, 21):
        assert at(hovering, seconds + 30) == at(BEND, seconds)


def test_a_displacement_grows_stays_and_goes_again() -> None:
    displaced = BEND.displaced(np.array([0.0, -30, 0]), T0 + 4_000, T0 + 18_000, 3_000)
    offsets = [
        round(at(displaced, seconds)[1] - at(BEND, seconds)[1], 3) for seconds in (3, 4, 5, 7, 11, 15, 16, 18, 19)
    ]
    assert offsets == [0, 0, -10, -30, -30, -30, -20, 0, 0]
    assert [at(displaced, seconds)[::2] for seconds in range(21)] == [at(BEND, seconds)[::2] for seconds in range(21)]


_ways = st.lists(
    st.tuples(
        st.integers(0, 10_000),
        st.lists(st.tuples(st.integers(1, 5_000), st.floats(-1e6, 1e6)), min_size=1, max_size=5),
    ),
    min_size=1,
    max_size=6,
)


@given(_ways, st.integers(-1_000, 40_000))
def test_all_ways_at_once_are_each_for_itself(drawn: list[tuple[int, list[tuple[int, float]]]], at_ms: int) -> None:
    ways = []
    for begin, knots in drawn:
        times = T0 + begin + np.cumsum([step for step, _ in knots])
        ways.append(Way(times, np.array([[x, -x, 2 * x] for _, x in knots])))
    found = places(ways, T0 + at_ms)
    for place, each in zip(found, ways, strict=True):
        expected = [np.interp(T0 + at_ms, each.time_ms, column) for column in each.place.T]
        assert place == pytest.approx(expected, abs=1e-6)


def test_no_ways_have_no_places() -> None:
    assert places([], T0).shape == (0, 3)
