"""Committed reservations, sorted per block in contiguous slabs of one pool.

A slab holds ``4 << size_class`` reservations. A block whose slab is full moves to one of the next class; freed slabs
are chained through the first slot's enter. Free intervals ("gaps") are the spaces between
reservations: gap g of a block lies before reservation g, so a block with c reservations has gaps 0 … c.

What closes a block without being a flight's reservation has a negative owner: a part of a closure, laid around the
reservations there. A closure without an end exits in the far future: nothing fits behind it.
"""

from typing import NamedTuple

import numpy as np

from planner.airmatrix import Int32Array, IntArray
from planner.airspace import BoolArray
from planner.kernels.policy import allocating_kernel, kernel

FAR_FUTURE = 1 << 62

SMALLEST_SLAB = 4
SIZE_CLASSES = 40


# Columns of `table` (a row a block), and of `pool` (a row a reservation).
FIRST, COUNT, SIZE_CLASS, LAST = range(4)
ENTER, EXIT, OWNER = range(3)


class Slabs(NamedTuple):
    """`table` (blocks, 4): first slot, count, size class, `ended_by`'s last answer. `pool` (slots, 3): enter, exit,
    owner.

    `chains` (SIZE_CLASSES + 1,): heads of the chains of freed slabs, -1 for none; last, how many slots were ever
    handed out.
    """

    table: Int32Array
    pool: IntArray
    chains: IntArray


def empty_slabs(block_count: int, pool_size: int) -> Slabs:
    """Return an index of `block_count` blocks without reservations."""
    chains = np.full(SIZE_CLASSES + 1, -1, dtype=np.int64)
    chains[-1] = 0
    table = np.zeros((block_count, 4), dtype=np.int32)
    table[:, FIRST] = -1
    return Slabs(table, np.empty((pool_size, 3), dtype=np.int64), chains)


def with_room(table: Int32Array) -> Slabs:
    """Return a table and an empty pool with a slab for as many reservations of each block as the table counts."""
    slabs = -(-table[:, COUNT].astype(np.int64) // SMALLEST_SLAB)
    size_class = np.ceil(np.log2(np.maximum(slabs, 1))).astype(np.int64)
    slots = np.where(slabs > 0, SMALLEST_SLAB << size_class, 0)
    end = np.cumsum(slots)
    table[:, FIRST] = np.where(slabs > 0, end - slots, -1)
    table[:, SIZE_CLASS] = np.where(slabs > 0, size_class, 0)
    chains = empty_slabs(0, 0).chains
    chains[SIZE_CLASSES] = end[-1]
    return Slabs(table, np.empty((end[-1] + (1 << 12), 3), dtype=np.int64), chains)


@kernel
def ended_by(table: Int32Array, pool: IntArray, block: int, time: int) -> int:
    """Return how many of a block's reservations have ended by `time`: the gap or reservation that holds it.

    Searches ask for the same block at nearby times again and again, so it looks near the last answer first.
    """
    first, count = table[block, FIRST], table[block, COUNT]
    if count == 0:
        return 0
    low, high = 0, count
    guess = min(table[block, LAST], count)
    if guess < count and pool[first + guess, EXIT] <= time:
        low = guess + 1
        step = 1
        while low + step <= high and pool[first + low + step - 1, EXIT] <= time:
            low += step
            step *= 2
        high = min(high, low + step - 1)
    else:
        high = guess
        step = 1
        while high - step >= low and pool[first + high - step, EXIT] > time:
            high -= step
            step *= 2
        low = max(low, high - step + 1)
    while low < high:
        middle = (low + high) >> 1
        if pool[first + middle, EXIT] <= time:
            low = middle + 1
        else:
            high = middle
    table[block, LAST] = low
    return low


@kernel
def take_slab(pool: IntArray, chains: IntArray, size_class: int) -> int:
    """Return the first slot of an unused slab, -1 if the pool is exhausted."""
    slot = chains[size_class]
    if slot >= 0:
        chains[size_class] = pool[slot, ENTER]
        return slot
    slot = chains[SIZE_CLASSES]
    end = slot + (SMALLEST_SLAB << size_class)
    if end > pool.shape[0]:
        return -1
    chains[SIZE_CLASSES] = end
    return slot


@kernel
def give_slab_back(pool: IntArray, chains: IntArray, slot: int, size_class: int) -> None:
    """Chain a slab into the free list of its class."""
    pool[slot, ENTER] = chains[size_class]
    chains[size_class] = slot


@kernel
def move(pool: IntArray, source: int, target: int) -> None:
    """Copy a reservation from one slot to another."""
    pool[target, ENTER] = pool[source, ENTER]
    pool[target, EXIT] = pool[source, EXIT]
    pool[target, OWNER] = pool[source, OWNER]


@kernel
def make_room(table: Int32Array, pool: IntArray, chains: IntArray, block: int) -> bool:
    """Make room for one more reservation in the block's slab; False if the pool is exhausted."""
    first, count, size_class = table[block, FIRST], table[block, COUNT], table[block, SIZE_CLASS]
    if first >= 0 and count < SMALLEST_SLAB << size_class:
        return True
    larger = size_class + 1 if first >= 0 else 0
    slot = take_slab(pool, chains, larger)
    if slot < 0:
        return False
    if first >= 0:
        for g in range(count):
            move(pool, first + g, slot + g)
        give_slab_back(pool, chains, first, size_class)
    table[block, FIRST] = slot
    table[block, SIZE_CLASS] = larger
    return True


@kernel
def first_overlap(table: Int32Array, pool: IntArray, blocks: IntArray, enters: IntArray, exits: IntArray) -> int:
    """Return the position of the first given interval that overlaps a reservation, -1 if none does."""
    for n in range(blocks.shape[0]):
        block = blocks[n]
        g = ended_by(table, pool, block, enters[n])
        if g < table[block, COUNT] and pool[table[block, FIRST] + g, ENTER] < exits[n]:
            return n
    return -1


@kernel
def insert(
    table: Int32Array,
    pool: IntArray,
    chains: IntArray,
    blocks: IntArray,
    enters: IntArray,
    exits: IntArray,
    owners: IntArray,
    start: int,
) -> int:
    """Insert disjoint intervals from position `start` on; return where it stopped for want of pool slots."""
    for n in range(start, blocks.shape[0]):
        block = blocks[n]
        if not make_room(table, pool, chains, block):
            return n
        first, count = table[block, FIRST], table[block, COUNT]
        slot = first + ended_by(table, pool, block, enters[n])
        for later in range(first + count, slot, -1):
            move(pool, later - 1, later)
        pool[slot, ENTER] = enters[n]
        pool[slot, EXIT] = exits[n]
        pool[slot, OWNER] = owners[n]
        table[block, COUNT] = count + 1
    return blocks.shape[0]


@kernel
def drop_range(table: Int32Array, pool: IntArray, chains: IntArray, block: int, start: int, stop: int) -> None:
    """Drop a block's reservations start … stop - 1; an empty block gives its slab back."""
    first, count = table[block, FIRST], table[block, COUNT]
    gone = stop - start
    for slot in range(first + start, first + count - gone):
        move(pool, slot + gone, slot)
    table[block, COUNT] = count - gone
    if count == gone:
        give_slab_back(pool, chains, first, table[block, SIZE_CLASS])
        table[block, FIRST] = -1
        table[block, SIZE_CLASS] = 0


@kernel
def remove(
    table: Int32Array, pool: IntArray, chains: IntArray, blocks: IntArray, enters: IntArray, exits: IntArray
) -> int:
    """Remove the given intervals where they are present exactly; return how many were."""
    removed = 0
    for n in range(blocks.shape[0]):
        block = blocks[n]
        g = ended_by(table, pool, block, enters[n])
        slot = table[block, FIRST] + g
        if g < table[block, COUNT] and pool[slot, ENTER] == enters[n] and pool[slot, EXIT] == exits[n]:
            drop_range(table, pool, chains, block, g, g + 1)
            removed += 1
    return removed


@kernel
def forget(table: Int32Array, pool: IntArray, chains: IntArray, time: int) -> int:
    """Drop every reservation, and part of a closure, that has ended by `time`; return how many were reservations."""
    dropped = 0
    for block in range(table.shape[0]):
        if table[block, COUNT] > 0:
            ended = ended_by(table, pool, block, time)
            if ended > 0:
                first = table[block, FIRST]
                for slot in range(first, first + ended):
                    dropped += pool[slot, OWNER] >= 0
                drop_range(table, pool, chains, block, 0, ended)
    return dropped


@kernel
def copy_kept(
    table: Int32Array,
    pool: IntArray,
    is_dropped: BoolArray,
    first_owner: int,
    from_ms: int,
    to_ms: int,
    kept_table: Int32Array,
    kept_pool: IntArray,
) -> None:
    """Copy the reservations that overlap [from, to) to where `kept_table` has room for them, and count them there; not
    those of owners for whom `is_dropped` (owners,) says so, which begins with `first_owner`, nor parts of closures.

    With an empty `kept_pool` they are only counted.
    """
    for block in range(table.shape[0]):
        first, count, kept = table[block, FIRST], table[block, COUNT], 0
        for slot in range(first + ended_by(table, pool, block, from_ms), first + count):
            if pool[slot, ENTER] >= to_ms:
                break
            place = pool[slot, OWNER] - first_owner
            if pool[slot, OWNER] < 0 or (0 <= place < is_dropped.shape[0] and is_dropped[place]):
                continue
            if kept_pool.shape[0] > 0:
                target = kept_table[block, FIRST] + kept
                for column in range(3):
                    kept_pool[target, column] = pool[slot, column]
            kept += 1
        kept_table[block, COUNT] = kept


@kernel
def open_blocks(table: Int32Array, pool: IntArray, chains: IntArray, blocks: IntArray) -> None:
    """Drop the parts of closures in some blocks."""
    for n in range(blocks.shape[0]):
        block = blocks[n]
        for g in range(table[block, COUNT] - 1, -1, -1):
            if pool[table[block, FIRST] + g, OWNER] < 0:
                drop_range(table, pool, chains, block, g, g + 1)


@kernel
def close_blocks(
    table: Int32Array,
    pool: IntArray,
    chains: IntArray,
    blocks: IntArray,
    enters: IntArray,
    exits: IntArray,
    owners: IntArray,
    start: int,
) -> int:
    """Lay closures from position `start` on around what is there; return where it stopped for want of pool slots.

    What lies already there stays, so that the rest can be laid by calling it again from where it stopped.
    """
    for n in range(start, blocks.shape[0]):
        block, begins, ends = blocks[n], enters[n], exits[n]
        g = ended_by(table, pool, block, begins)
        while begins < ends:
            until = ends
            if g < table[block, COUNT]:
                slot = table[block, FIRST] + g
                if pool[slot, ENTER] <= begins:
                    begins = pool[slot, EXIT]
                    g += 1
                    continue
                until = min(ends, pool[slot, ENTER])
            if not make_room(table, pool, chains, block):
                return n
            first, count = table[block, FIRST], table[block, COUNT]
            for later in range(first + count, first + g, -1):
                move(pool, later - 1, later)
            pool[first + g, ENTER] = begins
            pool[first + g, EXIT] = until
            pool[first + g, OWNER] = owners[n]
            table[block, COUNT] = count + 1
            begins = until
            g += 1
    return blocks.shape[0]


@allocating_kernel
def owners_within(table: Int32Array, pool: IntArray, blocks: IntArray, enters: IntArray, exits: IntArray) -> IntArray:
    """Return the owner of each reservation or part of a closure that overlaps the given intervals, repeats included."""
    owners = np.empty(blocks.shape[0], dtype=np.int64)
    found = 0
    for n in range(blocks.shape[0]):
        block = blocks[n]
        first, count = table[block, FIRST], table[block, COUNT]
        for slot in range(first + ended_by(table, pool, block, enters[n]), first + count):
            if pool[slot, ENTER] >= exits[n]:
                break
            if found == owners.shape[0]:
                larger = np.empty(2 * found, dtype=np.int64)
                larger[:found] = owners
                owners = larger
            owners[found] = pool[slot, OWNER]
            found += 1
    return owners[:found].copy()
