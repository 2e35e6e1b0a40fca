"""The index of committed reservations against a plain model of sorted lists."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.airmatrix import IntArray
from planner.kernels import intervals
from planner.occupancy import OccupancyIndex

BLOCKS = 3


class Held(NamedTuple):
    block: int
    enter: int
    exit: int
    owner: int


def columns(held: list[Held]) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    block, enter, leave, owner = np.array(held, dtype=np.int64).reshape(-1, 4).T.copy()
    return block, enter, leave, owner


def contents(index: OccupancyIndex) -> list[Held]:
    table, pool, _ = index.slabs
    found = []
    for block in range(len(table)):
        first, count = table[block, : intervals.SIZE_CLASS]
        found += [Held(block, *(int(part) for part in pool[slot])) for slot in range(first, first + count)]
    return found


held = st.builds(
    lambda block, enter, length, owner: Held(block, enter, enter + length, owner),
    st.integers(0, BLOCKS - 1),
    st.integers(0, 400),
    st.integers(1, 8),
    st.integers(1, 5),
)
steps = st.lists(
    st.one_of(
        st.tuples(st.just("reserve"), held),
        st.tuples(st.just("release"), held),
        st.tuples(st.just("forget"), st.integers(0, 400)),
    ),
    max_size=120,
)


@settings(deadline=None, max_examples=60)
@given(steps)
def test_the_index_holds_exactly_what_was_reserved_and_neither_released_nor_past(
    actions: list[tuple[str, Held | int]],
) -> None:
    index = OccupancyIndex(BLOCKS)
    model: set[Held] = set()
    for action, value in actions:
        if isinstance(value, int):
            gone = {entry for entry in model if entry.exit <= value}
            assert index.forget_before(value) == len(gone)
            model -= gone
        elif action == "reserve":
            block, enter, leave, _ = columns([value])
            if any(e.block == value.block and e.enter < value.exit and value.enter < e.exit for e in model):
                with pytest.raises(ValueError, match=f"block {value.block} is reserved within"):
                    index.reserve(block, enter, leave, value.owner)
            else:
                index.reserve(block, enter, leave, value.owner)
                model.add(value)
        else:
            present = {entry for entry in model if entry[:3] == value[:3]}
            assert index.release(*columns([value])[:3]) == len(present)
            model -= present
        assert contents(index) == sorted(model)
        assert len(index) == len(model)


def test_a_pool_that_is_full_grows_and_keeps_everything() -> None:
    index = OccupancyIndex(1)
    count = 3 * len(index.slabs.pool)
    enter = np.random.default_rng(1).permutation(count).astype(np.int64) * 10
    index.reserve(np.zeros(count, dtype=np.int64), enter, enter + 10, enter)
    assert contents(index) == [Held(0, 10 * n, 10 * n + 10, 10 * n) for n in range(count)]


def test_blocks_that_empty_give_their_slots_to_others() -> None:
    index = OccupancyIndex(100)
    enter = np.arange(50, dtype=np.int64) * 10
    for block in range(100):
        here = np.full(50, block, dtype=np.int64)
        index.reserve(here, enter, enter + 10, owner=1)
        index.forget_before(500)
    assert len(index) == 0
    used = int(index.slabs.chains[intervals.SIZE_CLASSES])
    assert used == sum(intervals.SMALLEST_SLAB << size_class for size_class in range(5))


def test_reservations_that_overlap_are_refused_all_together() -> None:
    index = OccupancyIndex(2)
    index.reserve(*columns([Held(1, 10, 20, 1)])[:3], owner=1)
    block, enter, leave, _ = columns([Held(0, 0, 5, 2), Held(1, 19, 25, 2)])
    with pytest.raises(ValueError, match=r"block 1 is reserved within \[19, 25\)"):
        index.reserve(block, enter, leave, owner=2)
    assert contents(index) == [Held(1, 10, 20, 1)]


def test_an_empty_reservation_is_refused() -> None:
    index = OccupancyIndex(1)
    with pytest.raises(ValueError, match="must end after it begins"):
        index.reserve(*columns([Held(0, 5, 5, 1)])[:3], owner=1)


def test_owners_are_named_once_each_in_order_of_time() -> None:
    index = OccupancyIndex(1)
    block, enter, leave, owner = columns([Held(0, 0, 5, 7), Held(0, 5, 9, 3), Held(0, 20, 30, 7), Held(0, 40, 50, 4)])
    index.reserve(block, enter, leave, owner)
    assert index.owners(0, 4, 40) == (7, 3)
    assert index.owners(0, 9, 20) == ()
    assert index.owners(0, 49, 100) == (4,)


def test_a_cleared_index_is_empty_and_usable() -> None:
    index = OccupancyIndex(1)
    index.reserve(*columns([Held(0, 0, 5, 1)])[:3], owner=1)
    index.clear()
    assert len(index) == 0
    index.reserve(*columns([Held(0, 3, 8, 2)])[:3], owner=2)
    assert contents(index) == [Held(0, 3, 8, 2)]
