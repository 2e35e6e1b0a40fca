"""The OpenList's order, and the compile policy."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.kernels.heap import MAX_F, heap_key, pop, push
from planner.kernels.labels import BLOCK, GAP_START, LABEL_COLUMNS
from planner.kernels.policy import cache_folder

entry = st.tuples(st.integers(0, 3), st.integers(0, 3), st.integers(0, 2), st.integers(0, 2))


@settings(deadline=None, max_examples=100)
@given(st.lists(entry, max_size=60), st.booleans())
def test_entries_leave_by_f_then_h_then_block_then_interval_start_however_they_came(
    entries: list[tuple[int, int, int, int]], resumed: bool
) -> None:
    labels = np.zeros((len(entries), LABEL_COLUMNS), dtype=np.int64)
    heap = np.empty((len(entries) + 1, 2), dtype=np.int64)
    size = 0
    for label, (f, h, block, start) in enumerate(entries):
        labels[label, BLOCK], labels[label, GAP_START] = block, start
        size = push(heap, size, labels, heap_key(f, h), ~label if resumed else label)
    left = []
    while size > 0:
        item = int(pop(heap, size, labels))
        left.append(entries[~item if item < 0 else item])
        size -= 1
    assert left == sorted(entries)


def test_times_beyond_what_keys_can_order_count_as_the_farthest() -> None:
    assert heap_key(MAX_F + 5, 7) == heap_key(MAX_F, 7) > heap_key(MAX_F - 1, 7) > 0


def test_bounds_checks_have_a_cache_of_their_own() -> None:
    assert cache_folder(boundscheck=None) == cache_folder(boundscheck=None)
    assert cache_folder(boundscheck=None) != cache_folder(boundscheck=1)
