"""CFA* (paper 3.2): `greedy` as its Algorithm 3, and `safe_interval` beyond it; both are A* where nothing is reserved.

A label is an arrival at a block's centre: G its time, H the heuristic, F = G + H. Under either occupancy rule the
hold of block p ends `tail` after the start s of a link and the hold of its neighbour n begins `lead` after s.
"""

from typing import NamedTuple

import numpy as np

from planner.airmatrix import IntArray
from planner.kernels.heap import (
    BLOCK,
    CLOSED,
    DEPARTURE,
    FLOWN,
    FOLLOWING,
    GAP,
    GAP_END,
    GAP_START,
    LABEL_COLUMNS,
    PARENT,
    RESUME,
    START,
    G,
    H,
    heap_key,
    pop,
    push,
)
from planner.kernels.intervals import COUNT, ENTER, EXIT, FAR_FUTURE, FIRST, Slabs, ended_by
from planner.kernels.policy import kernel

FOUND, NO_DEPARTURE_SLOT, NO_PATH, WORKSPACE_FULL = range(4)

# Columns of `Motion.links`, a row a link; BOX has a bit for each link whose neighbour is held during this one.
OFFSET, BOX, TIME, LEAD, TAIL = range(5)

# Columns of `Workspace.marks`, a row a block: the search that last touched it, and its first label there.
STAMP, HEAD = range(2)


class Shape(NamedTuple):
    """Numbers about the grid and the aircraft: block counts, lattice steps beyond `near`, the longest link (ms)."""

    count_i: int
    count_j: int
    horizontal: int
    diagonal: int
    reach: int


class Motion(NamedTuple):
    """One aircraft in one airspace: `links` (26, 5), `near` as in `planner.heuristic`."""

    shape: Shape
    links: IntArray
    near: IntArray


class Task(NamedTuple):
    """One request: blocks, departure window, terminal dwell, the greedy search's hover limit, in ms; its stamp."""

    origin: int
    destination: int
    earliest: int
    latest: int
    dwell: int
    hover_limit: int
    stamp: int


class Workspace(NamedTuple):
    """Memory that searches share, one at a time; stamps say what belongs to the present search.

    `labels` (n, 13) by the columns in `planner.kernels.heap`: G, H, block, gap number and bounds, parent label, the
    start of the link from it, the block's `following` label, `closed`, `resume` (see `safe_interval`), `departure`
    and `flown` (see `within_endurance`). `around` (26,): the gap number at each neighbour of the block expanded.
    """

    marks: IntArray
    labels: IntArray
    heap: IntArray
    around: IntArray


def new_workspace(block_count: int, label_count: int) -> Workspace:
    """Return memory for searches of up to `label_count` labels."""
    return Workspace(
        marks=np.zeros((block_count, 2), dtype=np.int64),
        labels=np.empty((label_count, LABEL_COLUMNS), dtype=np.int64),
        heap=np.empty((4 * label_count, 2), dtype=np.int64),
        around=np.zeros(26, dtype=np.int64),
    )


@kernel
def heuristic(shape: Shape, near: IntArray, block: int, destination: int) -> int:
    """Return H: the lattice distance in ms between two blocks (see `planner.heuristic`)."""
    row, x = block // shape.count_i, block % shape.count_i
    row_D, x_D = destination // shape.count_i, destination % shape.count_i
    z = abs(row // shape.count_j - row_D // shape.count_j)
    y = abs(row % shape.count_j - row_D % shape.count_j)
    x = abs(x - x_D)
    m, q = min(x, y), abs(x - y)
    beyond = 0
    last_m, last_q = near.shape[1] - 1, near.shape[2] - 1
    if m > last_m:
        beyond += (m - last_m) * shape.diagonal
        m = last_m
    if q > last_q:
        beyond += (q - last_q) * shape.horizontal
        q = last_q
    return near[z, m, q] + beyond


@kernel
def gap_bounds(table: IntArray, pool: IntArray, block: int, gap: int, earliest: int) -> tuple[int, int]:
    """Return a gap's start and end; starts before `earliest` are that, so that forgetting the past changes nothing."""
    first = table[block, FIRST]
    start, end = earliest, FAR_FUTURE
    if gap > 0:
        start = max(start, pool[first + gap - 1, EXIT])
    if gap < table[block, COUNT]:
        end = pool[first + gap, ENTER]
    return start, end


@kernel
def look_around(
    open_links: IntArray,
    links: IntArray,
    table: IntArray,
    pool: IntArray,
    around: IntArray,
    p: int,
    tau: int,
    reach: int,
) -> int:
    """Find the gap at time `tau` of p's every neighbour; return as bits those reserved within `reach` of it."""
    busy = 0
    for link in range(26):
        if (open_links[p] >> link) & 1:
            n = p + links[link, OFFSET]
            g = 0
            if table[n, COUNT] > 0:
                g = ended_by(table, pool, n, tau)
                if g < table[n, COUNT] and pool[table[n, FIRST] + g, ENTER] <= tau + reach:
                    busy |= 1 << link
            around[link] = g
    return busy


@kernel
def wait_for_sides(
    links: IntArray,
    table: IntArray,
    pool: IntArray,
    around: IntArray,
    p: int,
    sides: int,
    s: int,
    duration: int,
) -> int:
    """Return s or, if a side block is reserved within `duration` of it, a later time before which no start is free."""
    for link in range(26):
        if (sides >> link) & 1:
            block = p + links[link, OFFSET]
            first = table[block, FIRST]
            for slot in range(first + around[link], first + table[block, COUNT]):
                if pool[slot, ENTER] >= s + duration:
                    break
                s = max(s, pool[slot, EXIT])
    return s


@kernel
def first_start(
    links: IntArray,
    table: IntArray,
    pool: IntArray,
    around: IntArray,
    p: int,
    link: int,
    stay: int,
    tau: int,
    last: int,
) -> tuple[int, int]:
    """Return the earliest start of a link in [tau, last] with all its holds free, and the neighbour's gap.

    The neighbour must be free for `stay` ms more. FAR_FUTURE if there is no such start. `look_around` must have been
    called for p at tau or earlier.
    """
    n = p + links[link, OFFSET]
    first, count = table[n, FIRST], table[n, COUNT]
    lead, duration = links[link, LEAD], links[link, TIME] + 1
    sides = links[link, BOX] & ~(1 << link)
    g = around[link]
    s = tau
    while True:
        if g > 0:
            s = max(s, pool[first + g - 1, EXIT] - lead)
        if s > last:
            return FAR_FUTURE, g
        if g < count and pool[first + g, ENTER] < s + duration + stay:
            g += 1
            continue
        free_from = wait_for_sides(links, table, pool, around, p, sides, s, duration)
        if free_from == s:
            return s, g
        s = free_from


@kernel
def label_for(marks: IntArray, labels: IntArray, stamp: int, block: int, gap: int) -> int:
    """Return the label of a gap in this search, -1 if it has none yet."""
    if marks[block, STAMP] != stamp:
        return -1
    label = marks[block, HEAD]
    while label >= 0 and labels[label, GAP] != gap:
        label = labels[label, FOLLOWING]
    return label


@kernel
def add_label(
    marks: IntArray,
    labels: IntArray,
    stamp: int,
    label: int,
    block: int,
    gap: int,
    start: int,
    end: int,
    h: int,
) -> None:
    """Set up an unused label as the head of its block's list."""
    labels[label, BLOCK] = block
    labels[label, GAP] = gap
    labels[label, GAP_START] = start
    labels[label, GAP_END] = end
    labels[label, H] = h
    labels[label, CLOSED] = 0
    labels[label, FOLLOWING] = marks[block, HEAD] if marks[block, STAMP] == stamp else -1
    marks[block, STAMP] = stamp
    marks[block, HEAD] = label


@kernel
def can_end(labels: IntArray, label: int, task: Task) -> bool:
    """Tell whether a label is an arrival: at the destination, with time for the dwell."""
    return bool(
        labels[label, BLOCK] == task.destination and labels[label, G] + task.dwell + 1 <= labels[label, GAP_END]
    )


@kernel
def open_departures(
    shape: Shape,
    near: IntArray,
    table: IntArray,
    pool: IntArray,
    marks: IntArray,
    labels: IntArray,
    task: Task,
) -> int:
    """Make a label for each gap of the first block that allows a departure; return how many."""
    h = heuristic(shape, near, task.origin, task.destination)
    count = 0
    for gap in range(ended_by(table, pool, task.origin, task.earliest), table[task.origin, COUNT] + 1):
        start, end = gap_bounds(table, pool, task.origin, gap, task.earliest)
        if start > task.latest or count == labels.shape[0]:
            break
        if start + task.dwell + 1 <= end:
            add_label(marks, labels, task.stamp, count, task.origin, gap, start, end, h)
            labels[count, G] = start + task.dwell
            labels[count, PARENT] = -1
            labels[count, START] = start
            count += 1
    return count


@kernel
def open_label(heap: IntArray, size: int, labels: IntArray, label: int, earliest: int) -> int:
    """Put a label on the OpenList; return its new size."""
    h = labels[label, H]
    return push(heap, size, labels, heap_key(labels[label, G] + h - earliest, h), label)


@kernel
def safe_interval(
    open_links: IntArray, motion: Motion, slabs: Slabs, ws: Workspace, task: Task
) -> tuple[int, int, int, bool]:
    """CFA* with one label per (block, free interval): the earliest arrival, or proof that there is none.

    An expansion makes at most one successor per link, the earliest; where the neighbour has a later gap within reach
    of waiting, the label is put back to be resumed at `resume`, the first such start, as if it arrived then. So
    reservations far in the future cost nothing.

    Returns status, goal label (without a path, how many labels there are), expansions, and whether traffic changed
    anything (if not, this was plain A*).
    """
    shape, links, near = motion
    table, pool, _ = slabs
    marks, labels, heap, around = ws
    count = open_departures(shape, near, table, pool, marks, labels, task)
    if count == 0:
        return NO_DEPARTURE_SLOT, -1, 0, True
    disturbed = count > 1 or labels[0, START] != task.earliest
    size = 0
    for label in range(count):
        size = open_label(heap, size, labels, label, task.earliest)
    expansions = 0
    bound = FAR_FUTURE
    while size > 0:
        item = pop(heap, size, labels)
        size -= 1
        label = item if item >= 0 else ~item
        if item >= 0:
            if labels[label, CLOSED]:
                continue
            labels[label, CLOSED] = 1
            if can_end(labels, label, task):
                return FOUND, label, expansions, disturbed
            disturbed |= labels[label, BLOCK] == task.destination
            tau = labels[label, G]
        else:
            disturbed = True
            tau = labels[label, RESUME]
        expansions += 1
        if count + 26 > labels.shape[0] or size + 27 > heap.shape[0]:
            return WORKSPACE_FULL, -1, expansions, disturbed
        p = labels[label, BLOCK]
        busy = look_around(open_links, links, table, pool, around, p, tau, shape.reach)
        resume = FAR_FUTURE
        for link in range(26):
            if not (open_links[p] >> link) & 1:
                continue
            last = labels[label, GAP_END] - 1 - links[link, TAIL]
            s, g = tau, around[link]
            if s > last:
                disturbed = True
                continue
            if links[link, BOX] & busy:
                s, g = first_start(links, table, pool, around, p, link, 0, tau, last)
                if s != tau:
                    disturbed = True
                    if s == FAR_FUTURE:
                        continue
            n = p + links[link, OFFSET]
            if g < table[n, COUNT]:
                later = pool[table[n, FIRST] + g, EXIT] - links[link, LEAD]
                if later <= last:
                    resume = min(resume, later)
            arrival = s + links[link, TIME]
            successor = label_for(marks, labels, task.stamp, n, g)
            if successor < 0:
                h = heuristic(shape, near, n, task.destination)
                if arrival + h > bound:
                    continue
                start, end = gap_bounds(table, pool, n, g, task.earliest)
                successor = count
                add_label(marks, labels, task.stamp, successor, n, g, start, end, h)
                count += 1
            elif arrival >= labels[successor, G] or arrival + labels[successor, H] > bound:
                continue
            labels[successor, G] = arrival
            labels[successor, PARENT] = label
            labels[successor, START] = s
            if can_end(labels, successor, task):
                bound = arrival
            size = open_label(heap, size, labels, successor, task.earliest)
        h = labels[label, H]
        if resume < FAR_FUTURE and resume + h <= bound:
            labels[label, RESUME] = resume
            size = push(heap, size, labels, heap_key(resume + h - task.earliest, h), ~label)
    return NO_PATH, count, expansions, True


@kernel
def greedy(open_links: IntArray, motion: Motion, slabs: Slabs, ws: Workspace, task: Task) -> tuple[int, int, int, bool]:
    """CFA* as the paper's Algorithm 3: one label a block, the smallest hovering at the previous block, or a detour.

    Returns as `safe_interval` does.
    """
    shape, links, near = motion
    table, pool, _ = slabs
    marks, labels, heap, around = ws
    if open_departures(shape, near, table, pool, marks, labels, task) == 0:
        return NO_DEPARTURE_SLOT, -1, 0, True
    # The first departure slot only: the paper has one label a block.
    marks[task.origin, HEAD] = 0
    labels[0, FOLLOWING] = -1
    count = 1
    disturbed = labels[0, START] != task.earliest
    size = open_label(heap, 0, labels, 0, task.earliest)
    expansions = 0
    while size > 0:
        min_F = pop(heap, size, labels)
        size -= 1
        if labels[min_F, CLOSED]:
            continue
        labels[min_F, CLOSED] = 1
        if labels[min_F, BLOCK] == task.destination:
            return FOUND, min_F, expansions, disturbed
        expansions += 1
        if count + 26 > labels.shape[0] or size + 27 > heap.shape[0]:
            return WORKSPACE_FULL, -1, expansions, disturbed
        p = labels[min_F, BLOCK]
        tau = labels[min_F, G]
        busy = look_around(open_links, links, table, pool, around, p, tau, shape.reach)
        for link in range(26):
            if not (open_links[p] >> link) & 1:
                continue
            n = p + links[link, OFFSET]
            node = marks[n, HEAD] if marks[n, STAMP] == task.stamp else -1
            if node >= 0 and labels[node, CLOSED]:
                continue
            last = min(labels[min_F, GAP_END] - 1 - links[link, TAIL], tau + task.hover_limit)
            s, g = tau, around[link]
            if s > last:
                disturbed = True
                continue
            stay = task.dwell if n == task.destination else 0
            if links[link, BOX] & busy or stay > 0:
                s, g = first_start(links, table, pool, around, p, link, stay, tau, last)
                if s != tau:
                    disturbed = True
                    if s == FAR_FUTURE:
                        continue
            arrival = s + links[link, TIME]
            if node >= 0 and arrival >= labels[node, G]:
                continue
            start, end = gap_bounds(table, pool, n, g, task.earliest)
            if node < 0:
                node = count
                h = heuristic(shape, near, n, task.destination)
                add_label(marks, labels, task.stamp, node, n, g, start, end, h)
                count += 1
            labels[node, GAP] = g
            labels[node, GAP_START] = start
            labels[node, GAP_END] = end
            labels[node, G] = arrival
            labels[node, PARENT] = min_F
            labels[node, START] = s
            size = open_label(heap, size, labels, node, task.earliest)
    return NO_PATH, count, expansions, True


@kernel
def window_end(links: IntArray, table: IntArray, pool: IntArray, p: int, link: int, g: int, s: int, last: int) -> int:
    """Return the last start up to which all starts from the feasible start s on are feasible too."""
    duration = links[link, TIME] + 1
    n = p + links[link, OFFSET]
    if g < table[n, COUNT]:
        last = min(last, pool[table[n, FIRST] + g, ENTER] - duration)
    sides = links[link, BOX] & ~(1 << link)
    for side in range(26):
        if (sides >> side) & 1:
            block = p + links[side, OFFSET]
            ended = ended_by(table, pool, block, s)
            if ended < table[block, COUNT]:
                last = min(last, pool[table[block, FIRST] + ended, ENTER] - duration)
    return last


@kernel
def is_dominated(
    marks: IntArray,
    labels: IntArray,
    stamp: int,
    block: int,
    gap: int,
    arrival: int,
    departure: int,
    flown: int,
) -> bool:
    """Tell whether some label of the gap arrives no later, may depart no earlier and has flown no longer."""
    label = marks[block, HEAD] if marks[block, STAMP] == stamp else -1
    while label >= 0:
        if (
            labels[label, GAP] == gap
            and labels[label, G] <= arrival
            and labels[label, DEPARTURE] >= departure
            and labels[label, FLOWN] <= flown
        ):
            return True
        label = labels[label, FOLLOWING]
    return False


@kernel
def within_endurance(
    open_links: IntArray, motion: Motion, slabs: Slabs, ws: Workspace, task: Task, endurance: int
) -> tuple[int, int, int, bool]:
    """The earliest arrival with arrival - departure within `endurance`, for when the earliest of all takes longer.

    A label is a set of departures: leaving at D up to `departure` arrives at max(G, D + `flown`). Every window of
    feasible starts of a link makes one; the time in the air at arrival G is max(`flown`, G - `departure`), which no
    later arrival of the same label undercuts. Returns as `safe_interval` does.
    """
    shape, links, near = motion
    table, pool, _ = slabs
    marks, labels, heap, around = ws
    count = open_departures(shape, near, table, pool, marks, labels, task)
    size = 0
    for label in range(count):
        labels[label, DEPARTURE] = min(task.latest, labels[label, GAP_END] - 1 - task.dwell)
        labels[label, FLOWN] = task.dwell
        size = open_label(heap, size, labels, label, task.earliest)
    expansions = 0
    while size > 0:
        label = pop(heap, size, labels)
        size -= 1
        if can_end(labels, label, task):
            return FOUND, label, expansions, True
        expansions += 1
        p = labels[label, BLOCK]
        look_around(open_links, links, table, pool, around, p, labels[label, G], shape.reach)
        for link in range(26):
            if not (open_links[p] >> link) & 1:
                continue
            last = labels[label, GAP_END] - 1 - links[link, TAIL]
            n = p + links[link, OFFSET]
            h = heuristic(shape, near, n, task.destination)
            in_air = endurance - task.dwell - h
            flown = labels[label, FLOWN] + links[link, TIME]
            tau = labels[label, G]
            while tau <= last and flown <= in_air:
                s, g = first_start(links, table, pool, around, p, link, 0, tau, last)
                arrival = s + links[link, TIME]
                if s == FAR_FUTURE or arrival - labels[label, DEPARTURE] > in_air:
                    break
                until = window_end(links, table, pool, p, link, g, s, last)
                departure = min(labels[label, DEPARTURE], until - labels[label, FLOWN])
                if arrival - departure <= in_air and not is_dominated(
                    marks, labels, task.stamp, n, g, arrival, departure, flown
                ):
                    if count == labels.shape[0] or size == heap.shape[0]:
                        return WORKSPACE_FULL, -1, expansions, True
                    start, end = gap_bounds(table, pool, n, g, task.earliest)
                    add_label(marks, labels, task.stamp, count, n, g, start, end, h)
                    labels[count, G] = arrival
                    labels[count, DEPARTURE] = departure
                    labels[count, FLOWN] = flown
                    labels[count, PARENT] = label
                    labels[count, START] = s
                    size = open_label(heap, size, labels, count, task.earliest)
                    count += 1
                tau = until + 1
    return NO_PATH, count, expansions, True
