"""The OpenList's order, and the compile policy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba.core.errors import TypingError

from planner.airmatrix import IntArray
from planner.kernels.heap import HEAP_COLUMNS, ITEM, KEY, MAX_F, heap_key, heap_tie, key_f, pop, push
from planner.kernels.policy import allocating_kernel, cache_folder, kernel

entry = st.tuples(st.integers(0, 3), st.integers(0, 3), st.integers(0, 2), st.integers(0, 2))


@settings(deadline=None, max_examples=100)
@given(st.lists(entry, max_size=60))
def test_entries_leave_by_f_then_rank_then_block_then_interval_start_however_they_came(
    entries: list[tuple[int, int, int, int]],
) -> None:
    heap = np.empty((len(entries) + 1, HEAP_COLUMNS), dtype=np.int64)
    size = 0
    for item, (f, rank, block, start) in enumerate(entries):
        size = push(heap, size, heap_key(f, rank), heap_tie(block, start), item)
    left = []
    while size > 0:
        assert key_f(heap[0, KEY]) == entries[heap[0, ITEM]][0]
        left.append(entries[heap[0, ITEM]])
        size = pop(heap, size)
    assert left == sorted(entries)


def test_times_beyond_what_keys_can_order_count_as_the_farthest() -> None:
    assert heap_key(MAX_F + 5, 7) == heap_key(MAX_F, 7) > heap_key(MAX_F - 1, 7) > 0
    assert heap_tie(3, 1 << 50) == heap_tie(3, 1 << 40) < heap_tie(4, 0)


@pytest.mark.compiled
def test_a_kernel_that_makes_arrays_does_not_compile_without_reference_counting() -> None:
    # Two functions: the cache does not tell the policies of one apart.
    def zeros(count: int) -> IntArray:
        return np.zeros(count, dtype=np.int64)

    def zeros_too(count: int) -> IntArray:
        return np.zeros(count, dtype=np.int64)

    with pytest.raises(TypingError, match="zeros"):
        kernel(zeros)(3)
    assert allocating_kernel(zeros_too)(3).tolist() == [0, 0, 0]


def test_bounds_checks_have_a_cache_of_their_own() -> None:
    assert cache_folder(boundscheck=None) == cache_folder(boundscheck=None)
    assert cache_folder(boundscheck=None) != cache_folder(boundscheck=1)
