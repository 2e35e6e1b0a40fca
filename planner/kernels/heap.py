"""Open lists: 4-ary heaps of (key, tie, item), in the one order that makes planning deterministic.

Keys pack F and a rank among equal F: H, which is larger G first, or what `time_to_go` says. Ties are broken by block
index, then by the start of the free interval: by what a label is, never by where it happens to be stored.
"""

from planner.airmatrix import IntArray
from planner.kernels.policy import kernel

# 37 hours of H, 198 days of F; 33 million blocks, 8 years of free intervals.
MAX_H = (1 << 27) - 1
RANK_BITS = 28
MAX_F = (1 << (62 - RANK_BITS)) - 1
TIME_BITS = 38

# Columns of a heap, a row an entry.
KEY, TIE, ITEM = range(3)
HEAP_COLUMNS = 3


@kernel
def heap_key(f: int, rank: int) -> int:
    """Pack F (relative to the search's first departure) and a rank among equal F into one int64."""
    return (min(f, MAX_F) << RANK_BITS) | rank


@kernel
def key_f(key: int) -> int:
    """Return the F of a key."""
    return key >> RANK_BITS


@kernel
def heap_tie(block: int, gap_start: int) -> int:
    """Pack a block and the start of a free interval (relative as F is) into one int64."""
    return (block << TIME_BITS) | min(gap_start, (1 << TIME_BITS) - 1)


@kernel
def push(heap: IntArray, size: int, key: int, tie: int, item: int) -> int:
    """Add an entry to a heap of `size` entries; return the new size."""
    place = size
    while place > 0:
        above = (place - 1) >> 2
        if key > heap[above, KEY] or (key == heap[above, KEY] and tie >= heap[above, TIE]):
            break
        heap[place, KEY] = heap[above, KEY]
        heap[place, TIE] = heap[above, TIE]
        heap[place, ITEM] = heap[above, ITEM]
        place = above
    heap[place, KEY] = key
    heap[place, TIE] = tie
    heap[place, ITEM] = item
    return size + 1


@kernel
def pop(heap: IntArray, size: int) -> int:
    """Remove the first entry, row 0; return the new size."""
    last = size - 1
    key, tie, item = heap[last, KEY], heap[last, TIE], heap[last, ITEM]
    place = 0
    while True:
        child = 4 * place + 1
        if child >= last:
            break
        for sibling in range(child + 1, min(child + 4, last)):
            if heap[sibling, KEY] < heap[child, KEY] or (
                heap[sibling, KEY] == heap[child, KEY] and heap[sibling, TIE] < heap[child, TIE]
            ):
                child = sibling
        if key < heap[child, KEY] or (key == heap[child, KEY] and tie <= heap[child, TIE]):
            break
        heap[place, KEY] = heap[child, KEY]
        heap[place, TIE] = heap[child, TIE]
        heap[place, ITEM] = heap[child, ITEM]
        place = child
    heap[place, KEY] = key
    heap[place, TIE] = tie
    heap[place, ITEM] = item
    return last
