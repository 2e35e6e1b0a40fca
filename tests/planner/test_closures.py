"""Closed blocks in the index of reservations, against a plain model: who has each block at each millisecond."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.airmatrix import IntArray
from planner.cfa_star import Planner, Search
from planner.errors import NoConflictFreePath, NoDepartureSlot
from planner.kernels.intervals import FAR_FUTURE
from planner.occupancy import Closure, OccupancyIndex
from tests.planner.drawing import drawn
from tests.planner.test_occupancy_index import Held, contents
from tests.planner.traffic import flight

BLOCKS, END = 3, 120
Span = tuple[int, int, int]

spans = st.builds(
    lambda block, enter, length: (block, enter, min(enter + length, END)),
    st.integers(0, BLOCKS - 1),
    st.integers(0, END - 1),
    st.integers(1, 30),
)
steps = st.lists(
    st.one_of(
        st.tuples(st.just("reserve"), spans, st.integers(1, 4)),
        st.tuples(st.just("release"), spans, st.just(0)),
        st.tuples(st.just("release any"), st.just((0, 0, 0)), st.integers(0, 50)),
        st.tuples(st.just("close"), spans, st.integers(1, 3)),
        st.tuples(st.just("reopen"), st.just((0, 0, 0)), st.integers(1, 3)),
        st.tuples(st.just("forget"), spans, st.just(0)),
        st.tuples(st.just("without"), st.just((0, 0, 0)), st.integers(1, 4)),
    ),
    max_size=40,
)


def columns(*held: Span) -> tuple[IntArray, IntArray, IntArray]:
    block, enter, leave = np.array(held, dtype=np.int64).reshape(-1, 3).T.copy()
    return block, enter, leave


def painted(held: list[Held], since: int) -> IntArray:
    """Return who has each block at each moment, 0 for nobody; whoever is there twice fails."""
    moments = np.zeros((BLOCKS, END), dtype=np.int64)
    for block, enter, leave, owner in held:
        assert not moments[block, max(enter, 0) : leave].any()
        moments[block, max(enter, 0) : leave] = owner
    return moments[:, since:]


def expected(reserved: list[Held], closed: dict[int, Span], since: int) -> IntArray:
    moments = np.zeros((BLOCKS, END), dtype=np.int64)
    for number, (block, enter, leave) in sorted(closed.items(), reverse=True):
        moments[block, enter:leave] = -number
    for block, enter, leave, owner in reserved:
        moments[block, enter:leave] = owner
    return moments[:, since:]


@settings(deadline=None, max_examples=150)
@given(steps)
def test_closures_lie_around_whatever_is_reserved(actions: list[tuple[str, Span, int]]) -> None:
    index = OccupancyIndex(BLOCKS)
    reserved: list[Held] = []
    closed: dict[int, Span] = {}
    since = 0
    for action, span, number in actions:
        block, enter, leave = span
        if action == "reserve":
            is_free = all(e.block != block or e.exit <= enter or leave <= e.enter for e in reserved)
            if is_free and enter >= since:
                index.reserve(*columns(span), number)
                reserved.append(Held(*span, number))
            elif not is_free:
                with pytest.raises(ValueError, match="is reserved within"):
                    index.reserve(*columns(span), number)
        elif action == "release":
            gone = [e for e in reserved if e[:3] == span]
            assert index.release(*columns(span)) == len(gone)
            reserved = [e for e in reserved if e not in gone]
        elif action == "release any" and reserved:
            gone = [reserved[number % len(reserved)]]
            assert index.release(*columns(gone[0][:3])) == 1
            reserved.remove(gone[0])
        elif action == "close" and number not in closed:
            index.close({number: Closure(*columns(span))})
            closed[number] = span
        elif action == "reopen":
            index.reopen([number])
            closed.pop(number, None)
        elif action == "forget":
            since = max(since, enter)
            gone = [e for e in reserved if e.exit <= since]
            assert index.forget_before(since) == len(gone)
            reserved = [e for e in reserved if e not in gone]
            closed = {number: span for number, span in closed.items() if span[2] > since}
        elif action == "without":
            left = [e for e in reserved if e.owner != number]
            copy = index.without(np.array([number], dtype=np.int64))
            assert np.array_equal(painted(contents(copy), since), expected(left, closed, since))
            assert len(copy) == len(left)
        assert np.array_equal(painted(contents(index), since), expected(reserved, closed, since))
        assert len(index) == len(reserved)


def test_a_copy_goes_its_own_way() -> None:
    index = OccupancyIndex(BLOCKS)
    index.reserve(*columns((0, 0, 10), (1, 5, 9)), 1)
    copy = index.copy()
    copy.reserve(*columns((2, 0, 10)), 2)
    copy.release(*columns((0, 0, 10)))
    copy.close({1: Closure(*columns((1, 0, 20)))})
    assert contents(index) == [Held(0, 0, 10, 1), Held(1, 5, 9, 1)]
    assert contents(copy) == [Held(1, 0, 5, -1), Held(1, 5, 9, 1), Held(1, 9, 20, -1), Held(2, 0, 10, 2)]


def test_a_copy_of_some_time_has_what_overlaps_that() -> None:
    index = OccupancyIndex(BLOCKS)
    index.reserve(*columns((0, 0, 10), (0, 10, 20), (0, 20, 30), (0, 30, 40)), np.array([1, 2, 3, 4]))
    index.close({1: Closure(*columns((1, 0, 10), (1, 12, 15), (2, 30, 40)))})
    copy = index.without(np.array([3], dtype=np.int64), 10, 30)
    assert contents(copy) == [Held(0, 10, 20, 2), Held(1, 12, 15, -1)]
    assert len(copy) == 1
    # There is room for more.
    copy.reserve(*columns(*((0, 100 + n, 101 + n) for n in range(20))), 5)
    assert len(copy) == 21


def test_closures_that_need_more_room_than_there_is_make_some() -> None:
    index = OccupancyIndex(1)
    count = 3 * len(index.slabs.pool)
    enter = np.arange(count, dtype=np.int64) * 10
    index.reserve(np.zeros(count, dtype=np.int64), enter, enter + 5, owner=1)
    index.close({1: Closure(*columns((0, 0, 10 * count)))})
    assert [held.owner for held in contents(index)] == [1, -1] * count


@pytest.mark.parametrize("search", Search)
def test_a_flight_waits_until_the_only_way_is_open_again(search: Search) -> None:
    sketch = drawn("A.B")
    planner = Planner(sketch.airspace, search)
    planner.index.close({1: Closure(*columns((1, 0, 500)))})
    plan = planner.plan(flight(sketch["A"], sketch["B"], earliest=0, latest=600))
    assert plan.hold_enter_ms[plan.hold_block == 1][0] >= 500
    assert plan.departure_ms >= 496


@pytest.mark.parametrize("search", Search)
@pytest.mark.parametrize("block", [1, 2])
def test_nothing_gets_to_what_is_closed_for_good(block: int, search: Search) -> None:
    sketch = drawn("A.B")
    planner = Planner(sketch.airspace, search)
    planner.index.close({7: Closure(*columns((block, 100, FAR_FUTURE)))})
    assert planner.plan(flight(sketch["A"], sketch["B"], earliest=0, latest=50)).arrival_ms < 100
    with pytest.raises(NoConflictFreePath) as refused:
        planner.plan(flight(sketch["A"], sketch["B"], earliest=100, latest=200))
    assert refused.value.conflicting_owners == (-7,)
    assert refused.value.earliest_feasible_departure_ms is None


def test_nobody_departs_where_it_is_closed_for_good() -> None:
    sketch = drawn("A.B")
    planner = Planner(sketch.airspace)
    planner.index.close({7: Closure(*columns((0, 100, FAR_FUTURE)))})
    with pytest.raises(NoDepartureSlot) as refused:
        planner.plan(flight(sketch["A"], sketch["B"], earliest=100, latest=200))
    assert refused.value.conflicting_owners == (-7,)


def test_a_planner_can_be_asked_about_another_index_than_its_own() -> None:
    sketch = drawn("A.B")
    planner = Planner(sketch.airspace)
    planner.index.reserve(*columns((1, 0, 500)), 1)
    request = flight(sketch["A"], sketch["B"], earliest=0, latest=600)
    assert planner.plan(request).arrival_ms > 500
    assert planner.plan(request, planner.index.without(np.array([1]))).departure_ms == 0


def test_a_flight_whose_destination_is_closed_for_long_is_refused_at_once_where_detours_are_bounded() -> None:
    sketch = drawn("A.B")
    planner = Planner(sketch.airspace, detour_limit_ms=100)
    planner.index.close({1: Closure(*columns((2, 0, 5_000)))})
    with pytest.raises(NoConflictFreePath) as refused:
        planner.plan(flight(sketch["A"], sketch["B"], earliest=0, latest=10))
    assert refused.value.conflicting_owners == (-1,)
    assert refused.value.expansions < 5
    departure = refused.value.earliest_feasible_departure_ms
    assert departure is not None
    assert planner.plan(flight(sketch["A"], sketch["B"], earliest=departure)).arrival_ms >= 5_000


def test_a_flight_to_what_a_ring_of_closed_airspace_lies_around_is_refused_at_once() -> None:
    sketch = drawn("A......B")
    planner = Planner(sketch.airspace, detour_limit_ms=100)
    planner.index.close({1: Closure(*columns((5, 0, 5_000), (6, 0, 5_000)))})
    with pytest.raises(NoConflictFreePath) as refused:
        planner.plan(flight(sketch["A"], sketch["B"], earliest=0, latest=10))
    assert refused.value.conflicting_owners == (-1,)
    # The look for a later departure comes on top.
    assert refused.value.expansions < 20


@pytest.mark.parametrize(("limit", "is_refused"), [(98, True), (99, False)])
def test_a_flight_is_in_the_air_for_so_much_longer_than_alone_and_no_longer(limit: int, is_refused: bool) -> None:
    """It has to leave its pad by 1, and cannot land before 108: 107 ms for what takes 8 without traffic."""
    sketch = drawn("A.B")
    planner = Planner(sketch.airspace, detour_limit_ms=limit)
    planner.index.reserve(*columns((0, 6, 9), (2, 0, 104)), 1)
    request = flight(sketch["A"], sketch["B"], earliest=0, latest=8)
    if is_refused:
        with pytest.raises(NoConflictFreePath):
            planner.plan(request)
    else:
        plan = planner.plan(request)
        assert (plan.departure_ms, plan.arrival_ms) == (1, 108)
