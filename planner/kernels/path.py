"""From labels to a path: the backward pass and the holds."""

import numpy as np

from planner.airmatrix import Int32Array, IntArray
from planner.kernels.intervals import COUNT, ENTER, FIRST, Slabs, ended_by
from planner.kernels.labels import BLOCK, GAP_END, HEAD, PARENT, STAMP, START, G, Task
from planner.kernels.motion import LEAD, OFFSET, SIDE, SIDES, TAIL, TIME, Motion, Shape, coordinates
from planner.kernels.policy import allocating_kernel, kernel


@allocating_kernel
def trace(labels: IntArray, goal: int, task: Task) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Follow parents from the goal; return blocks, arrivals, departures and the ends of the free intervals.

    The first arrival is the departure of the flight, the last departure its arrival.
    """
    length = 0
    label = goal
    while label >= 0:
        length += 1
        label = labels[label, PARENT]
    block = np.empty(length, dtype=np.int64)
    arrive = np.empty(length, dtype=np.int64)
    depart = np.empty(length, dtype=np.int64)
    gap_end = np.empty(length, dtype=np.int64)
    label = goal
    leaves = labels[goal, G] + task.dwell
    for place in range(length - 1, -1, -1):
        block[place] = labels[label, BLOCK]
        arrive[place] = labels[label, G]
        depart[place] = leaves
        gap_end[place] = labels[label, GAP_END]
        leaves = labels[label, START]
        label = labels[label, PARENT]
    arrive[0] = leaves
    return block, arrive, depart, gap_end


@kernel
def link_between(shape: Shape, p: int, n: int) -> int:
    """Return the link from p to its neighbour n. In narrow grids offsets coincide, so coordinates decide."""
    i_p, j_p, k_p = coordinates(shape, p)
    i_n, j_n, k_n = coordinates(shape, n)
    code = (i_n - i_p + 1) * 9 + (j_n - j_p + 1) * 3 + (k_n - k_p + 1)
    return code if code < 13 else code - 1


@kernel
def latest_start(
    links: IntArray, table: Int32Array, pool: IntArray, p: int, link: int, earliest: int, latest: int
) -> int:
    """Return the latest start of a link in [earliest, latest] with its side blocks free; `earliest` must be one."""
    duration = links[link, TIME] + 1
    s = latest
    moved = True
    while moved and s > earliest:
        moved = False
        for place in range(SIDE, SIDE + links[link, SIDES]):
            block = p + links[links[link, place], OFFSET]
            first = table[block, FIRST]
            g = ended_by(table, pool, block, s)
            while g < table[block, COUNT] and pool[first + g, ENTER] < s + duration:
                s = pool[first + g, ENTER] - duration
                moved = True
                g = ended_by(table, pool, block, s)
    return s


@kernel
def wait_early(
    motion: Motion, slabs: Slabs, block: IntArray, arrive: IntArray, depart: IntArray, gap_end: IntArray
) -> None:
    """Move waiting as early as possible along the path: the latest departures that keep the arrival.

    Every departure stays in the free intervals that the search found, so no hold can meet a reservation.
    """
    shape, links, _ = motion
    table, pool, _ = slabs
    next_start = arrive[-1]
    for place in range(block.shape[0] - 2, -1, -1):
        link = link_between(shape, block[place], block[place + 1])
        latest = min(gap_end[place] - 1 - links[link, TAIL], next_start - links[link, TIME])
        depart[place] = latest_start(links, table, pool, block[place], link, depart[place], latest)
        arrive[place + 1] = depart[place] + links[link, TIME]
        next_start = depart[place]


@kernel
def hold_on_ground(arrive: IntArray, depart: IntArray, task: Task) -> None:
    """Turn waiting in the first block into ground hold, as far as the departure window allows."""
    arrive[0] = max(arrive[0], min(task.latest, depart[0] - task.climb_out))


@allocating_kernel
def holds(
    motion: Motion, marks: Int32Array, stamp: int, block: IntArray, arrive: IntArray, depart: IntArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Return the holds of a path (block, enter, exit), overlapping ones of a block merged, by enter, i, j, k."""
    shape, links, _ = motion
    link_count = block.shape[0] - 1
    held = np.empty((block.shape[0] + 6 * link_count, 3), dtype=np.int64)
    count = 0
    begins = arrive[0]
    for place in range(link_count + 1):
        p, s = block[place], depart[place]
        if place == link_count:
            count = add_hold(marks, stamp, held, count, p, begins, s + 1)
            break
        link = link_between(shape, p, block[place + 1])
        count = add_hold(marks, stamp, held, count, p, begins, s + links[link, TAIL] + 1)
        for place_in_box in range(SIDE, SIDE + links[link, SIDES]):
            side = p + links[links[link, place_in_box], OFFSET]
            count = add_hold(marks, stamp, held, count, side, s, s + links[link, TIME] + 1)
        begins = s + links[link, LEAD]
    sort_holds(shape, marks.shape[0], held, count)
    return held[:count, 0].copy(), held[:count, 1].copy(), held[:count, 2].copy()


@kernel
def add_hold(marks: Int32Array, stamp: int, held: IntArray, count: int, block: int, begins: int, ends: int) -> int:
    """Add a hold, or extend its block's newest one if they overlap; return the new count. Holds come by `begins`."""
    if marks[block, STAMP] == stamp:
        newest = marks[block, HEAD]
        if begins < held[newest, 2]:
            held[newest, 2] = max(held[newest, 2], ends)
            return count
    marks[block, STAMP] = stamp
    marks[block, HEAD] = count
    held[count, 0] = block
    held[count, 1] = begins
    held[count, 2] = ends
    return count + 1


@kernel
def column_order(shape: Shape, block_count: int, block: int) -> int:
    """Return a block's rank by i, then j, then k."""
    i, j, k = coordinates(shape, block)
    return (i * shape.count_j + j) * (block_count // (shape.count_i * shape.count_j)) + k


@kernel
def sort_holds(shape: Shape, block_count: int, held: IntArray, count: int) -> None:
    """Sort by enter, then i, j, k, by insertion: holds come nearly sorted."""
    for last in range(1, count):
        block, begins, ends = held[last, 0], held[last, 1], held[last, 2]
        rank = column_order(shape, block_count, block)
        place = last
        while place > 0 and (
            held[place - 1, 1] > begins
            or (held[place - 1, 1] == begins and column_order(shape, block_count, held[place - 1, 0]) > rank)
        ):
            for column in range(3):
                held[place, column] = held[place - 1, column]
            place -= 1
        held[place, 0] = block
        held[place, 1] = begins
        held[place, 2] = ends
