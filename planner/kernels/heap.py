"""The OpenList: a 4-ary heap of labels in the one order that makes planning deterministic.

Keys pack F above H: smaller F first, then smaller H, which among equal F is larger G. Equal keys are ordered by
block index, then by the start of the free interval: by what a label is, never by where it happens to be stored.
"""

from planner.airmatrix import IntArray
from planner.kernels.labels import BLOCK, GAP_START
from planner.kernels.policy import kernel

# 6 days of H, 99 of F.
H_BITS = 29
MAX_H = (1 << H_BITS) - 1
MAX_F = (1 << (62 - H_BITS)) - 1

# Columns of the heap (a row an entry). An item is a label, or ~label for one to be resumed.
KEY, ITEM = range(2)


@kernel
def heap_key(f: int, h: int) -> int:
    """Pack F (relative to the search's first departure) and H into one int64."""
    return (min(f, MAX_F) << H_BITS) | h


@kernel
def comes_before(labels: IntArray, key: int, item: int, other_key: int, other_item: int) -> bool:
    """Tell whether one entry precedes another."""
    if key != other_key:
        return key < other_key
    label = item if item >= 0 else ~item
    other = other_item if other_item >= 0 else ~other_item
    if labels[label, BLOCK] != labels[other, BLOCK]:
        return bool(labels[label, BLOCK] < labels[other, BLOCK])
    return bool(labels[label, GAP_START] < labels[other, GAP_START])


@kernel
def push(heap: IntArray, size: int, labels: IntArray, key: int, item: int) -> int:
    """Add an entry to a heap of `size` entries; return the new size."""
    place = size
    while place > 0:
        above = (place - 1) >> 2
        if not comes_before(labels, key, item, heap[above, KEY], heap[above, ITEM]):
            break
        heap[place, KEY] = heap[above, KEY]
        heap[place, ITEM] = heap[above, ITEM]
        place = above
    heap[place, KEY] = key
    heap[place, ITEM] = item
    return size + 1


@kernel
def pop(heap: IntArray, size: int, labels: IntArray) -> int:
    """Return the first entry's item; the heap then has ``size - 1`` entries."""
    first = heap[0, ITEM]
    last = size - 1
    key, item = heap[last, KEY], heap[last, ITEM]
    place = 0
    while True:
        child = 4 * place + 1
        if child >= last:
            break
        for sibling in range(child + 1, min(child + 4, last)):
            if comes_before(labels, heap[sibling, KEY], heap[sibling, ITEM], heap[child, KEY], heap[child, ITEM]):
                child = sibling
        if not comes_before(labels, heap[child, KEY], heap[child, ITEM], key, item):
            break
        heap[place, KEY] = heap[child, KEY]
        heap[place, ITEM] = heap[child, ITEM]
        place = child
    heap[place, KEY] = key
    heap[place, ITEM] = item
    return first
