"""CFA* (paper 3.2): `greedy` as its Algorithm 3, `safe_interval` beyond it; both are A* where nothing is reserved."""

from planner.airmatrix import IntArray
from planner.kernels.heap import heap_key, pop, push
from planner.kernels.intervals import COUNT, EXIT, FAR_FUTURE, FIRST, Slabs, ended_by
from planner.kernels.labels import (
    BLOCK,
    CLOSED,
    FOLLOWING,
    GAP,
    GAP_END,
    GAP_START,
    HEAD,
    PARENT,
    RESUME,
    STAMP,
    START,
    G,
    H,
    Task,
    Workspace,
    add_label,
    can_end,
    gap_bounds,
    label_for,
)
from planner.kernels.motion import BOX, LEAD, OFFSET, TAIL, TIME, Motion, Shape, first_start, heuristic, look_around
from planner.kernels.policy import kernel

FOUND, NO_DEPARTURE_SLOT, NO_PATH, WORKSPACE_FULL = range(4)


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
