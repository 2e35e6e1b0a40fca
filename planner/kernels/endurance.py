"""The search within the endurance, for when the earliest arrival of all takes longer (docs/decisions/0005)."""

from planner.airmatrix import Int32Array, IntArray
from planner.kernels.heap import ITEM, pop
from planner.kernels.intervals import COUNT, ENTER, FAR_FUTURE, FIRST, Slabs, ended_by
from planner.kernels.labels import (
    BLOCK,
    DEPARTURE,
    FLOWN,
    FOLLOWING,
    GAP,
    GAP_END,
    HEAD,
    PARENT,
    STAMP,
    START,
    G,
    Task,
    Workspace,
    add_label,
    can_end,
    gap_bounds,
)
from planner.kernels.motion import OFFSET, SIDE, SIDES, STEPS, TAIL, TIME, VISITS, Motion, coordinates, first_start
from planner.kernels.policy import kernel
from planner.kernels.search import FOUND, NO_PATH, TOO_LONG, WORKSPACE_FULL, open_departures, open_label
from planner.kernels.static_search import Bounds, time_to_go


@kernel
def window_end(links: IntArray, table: Int32Array, pool: IntArray, p: int, link: int, g: int, s: int, last: int) -> int:
    """Return the last start up to which all starts from the feasible start s on are feasible too."""
    duration = links[link, TIME] + 1
    n = p + links[link, OFFSET]
    if g < table[n, COUNT]:
        last = min(last, pool[table[n, FIRST] + g, ENTER] - duration)
    for place in range(SIDE, SIDE + links[link, SIDES]):
        block = p + links[links[link, place], OFFSET]
        ended = ended_by(table, pool, block, s)
        if ended < table[block, COUNT]:
            last = min(last, pool[table[block, FIRST] + ended, ENTER] - duration)
    return last


@kernel
def is_dominated(
    marks: Int32Array,
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
    open_links: Int32Array, motion: Motion, slabs: Slabs, ws: Workspace, task: Task, bounds: Bounds, endurance: int
) -> tuple[int, int, int]:
    """The earliest arrival with arrival - departure within `endurance`, for when the earliest of all takes longer.

    A label is a set of departures: leaving at D up to `departure` arrives at max(G, D + `flown`). Every window of
    feasible starts of a link makes one; the time in the air at arrival G is max(`flown`, G - `departure`), which no
    later arrival of the same label undercuts. Returns as `safe_interval` does.
    """
    shape, links, near = motion
    table, pool, _ = slabs
    marks, labels, _, around, _, heap, _, field = ws
    around[VISITS] = 0
    i, j, k = bounds.start
    h, rank = time_to_go(field, shape, near, bounds, task.origin, i, j, k)
    count = open_departures(h, rank, table, pool, marks, labels, task)
    if count == labels.shape[0]:
        return WORKSPACE_FULL, -1, 0
    size = 0
    for label in range(count):
        labels[label, DEPARTURE] = min(task.latest, labels[label, GAP_END] - 1 - task.climb_out)
        labels[label, FLOWN] = task.climb_out
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
        p = labels[label, BLOCK]
        i, j, k = coordinates(shape, p)
        for link in range(26):
            around[link] = -1
        for link in range(26):
            if not (open_links[p] >> link) & 1:
                continue
            last = labels[label, GAP_END] - 1 - links[link, TAIL]
            n = p + links[link, OFFSET]
            x, y, z = i + STEPS[link, 0], j + STEPS[link, 1], k + STEPS[link, 2]
            h, rank = time_to_go(field, shape, near, bounds, n, x, y, z)
            in_air = endurance - task.dwell - h
            flown = labels[label, FLOWN] + links[link, TIME]
            tau = labels[label, G]
            while tau <= last and flown <= in_air:
                s, g = first_start(links, table, pool, around, p, link, 0, labels[label, G], tau, last)
                arrival = s + links[link, TIME]
                if s == FAR_FUTURE or arrival - labels[label, DEPARTURE] > in_air:
                    break
                until = window_end(links, table, pool, p, link, g, s, last)
                departure = min(labels[label, DEPARTURE], until - labels[label, FLOWN])
                if arrival - departure <= in_air and not is_dominated(
                    marks, labels, task.stamp, n, g, arrival, departure, flown
                ):
                    if count == labels.shape[0] or size == heap.shape[0]:
                        return WORKSPACE_FULL, -1, expansions
                    start, end = gap_bounds(table, pool, n, g, task.earliest)
                    add_label(marks, labels, task.stamp, count, n, g, start, end, h, rank)
                    labels[count, G] = arrival
                    labels[count, DEPARTURE] = departure
                    labels[count, FLOWN] = flown
                    labels[count, PARENT] = label
                    labels[count, START] = s
                    size = open_label(heap, size, labels, count, arrival + h, task.earliest)
                    count += 1
                tau = until + 1
    return NO_PATH, count, expansions
