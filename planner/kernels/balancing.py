"""The search that would rather fly where there is room: links into crowded layers cost more than they take.

The paper leaves altitude assignment to future work (section 4.3); this is the smallest such cost. It is off by default.
"""

from planner.airmatrix import Int32Array, IntArray
from planner.kernels.heap import ITEM, pop
from planner.kernels.intervals import COUNT, EXIT, FAR_FUTURE, FIRST, Slabs
from planner.kernels.labels import (
    BLOCK,
    FOLLOWING,
    GAP,
    GAP_END,
    HEAD,
    PARENT,
    STAMP,
    START,
    SURCHARGE,
    G,
    Task,
    Workspace,
    add_label,
    can_end,
    gap_bounds,
)
from planner.kernels.motion import LEAD, OFFSET, STEPS, TAIL, TIME, VISITS, Motion, coordinates, first_start
from planner.kernels.policy import kernel
from planner.kernels.search import (
    FOUND,
    NO_DEPARTURE_SLOT,
    NO_PATH,
    TOO_LONG,
    WORKSPACE_FULL,
    open_departures,
    open_label,
)
from planner.kernels.static_search import Bounds, time_to_go


@kernel
def is_undercut(
    marks: Int32Array, labels: IntArray, stamp: int, block: int, gap: int, arrival: int, surcharge: int
) -> bool:
    """Tell whether some label of the gap arrives no later and has paid no more."""
    label = marks[block, HEAD] if marks[block, STAMP] == stamp else -1
    while label >= 0:
        if labels[label, GAP] == gap and labels[label, G] <= arrival and labels[label, SURCHARGE] <= surcharge:
            return True
        label = labels[label, FOLLOWING]
    return False


@kernel
def least_cost(
    open_links: Int32Array,
    motion: Motion,
    slabs: Slabs,
    ws: Workspace,
    task: Task,
    bounds: Bounds,
    layer_surcharge: IntArray,
) -> tuple[int, int, int]:
    """The least arrival plus surcharges, with `layer_surcharge` (layers,) ms for each link that ends in a layer.

    A label is an arrival and what has been paid for it; one that another undercuts in both is dropped. Returns as
    `safe_interval` does.
    """
    shape, links, near = motion
    table, pool, _ = slabs
    marks, labels, _, around, _, heap, _, field = ws
    around[VISITS] = 0
    i, j, k = bounds.start
    h, rank = time_to_go(field, shape, near, bounds, task.origin, i, j, k)
    count = open_departures(h, rank, table, pool, marks, labels, task)
    if count == 0:
        return NO_DEPARTURE_SLOT, -1, 0
    if count == labels.shape[0]:
        return WORKSPACE_FULL, -1, 0
    size = 0
    for label in range(count):
        labels[label, SURCHARGE] = 0
        size = open_label(heap, size, labels, label, labels[label, G] + h, task.earliest)
    expansions = 0
    while size > 0:
        label = heap[0, ITEM]
        size = pop(heap, size)
        if can_end(labels, label, task):
            return FOUND, label, expansions
        if expansions == task.most:
            return TOO_LONG, -1, expansions
        expansions += 1
        p, tau = labels[label, BLOCK], labels[label, G]
        i, j, k = coordinates(shape, p)
        for link in range(26):
            around[link] = -1
        for link in range(26):
            if not (open_links[p] >> link) & 1:
                continue
            n = p + links[link, OFFSET]
            x, y, z = i + STEPS[link, 0], j + STEPS[link, 1], k + STEPS[link, 2]
            h, rank = time_to_go(field, shape, near, bounds, n, x, y, z)
            surcharge = labels[label, SURCHARGE] + layer_surcharge[z]
            last = labels[label, GAP_END] - 1 - links[link, TAIL]
            s = tau
            while s <= last:
                s, g = first_start(links, table, pool, around, p, link, 0, tau, s, last)
                if s == FAR_FUTURE:
                    break
                arrival = s + links[link, TIME]
                if not is_undercut(marks, labels, task.stamp, n, g, arrival, surcharge):
                    if count == labels.shape[0] or size == heap.shape[0]:
                        return WORKSPACE_FULL, -1, expansions
                    start, end = gap_bounds(table, pool, n, g, task.earliest)
                    add_label(marks, labels, task.stamp, count, n, g, start, end, h, rank)
                    labels[count, G] = arrival
                    labels[count, SURCHARGE] = surcharge
                    labels[count, PARENT] = label
                    labels[count, START] = s
                    size = open_label(heap, size, labels, count, arrival + surcharge + h, task.earliest)
                    count += 1
                if g == table[n, COUNT]:
                    break
                s = pool[table[n, FIRST] + g, EXIT] - links[link, LEAD]
    return NO_PATH, count, expansions
