"""CFA* (paper 3.2): `greedy` as its Algorithm 3, `safe_interval` beyond it; both are A* where nothing is reserved."""

from planner.airmatrix import Int32Array, IntArray
from planner.kernels.heap import ITEM, KEY, MAX_F, heap_key, heap_tie, key_f, pop, push
from planner.kernels.intervals import COUNT, EXIT, FAR_FUTURE, FIRST, Slabs, ended_by
from planner.kernels.labels import (
    BLOCK,
    CLOSED,
    FOLLOWING,
    GAP,
    GAP_END,
    GAP_START,
    HEAD,
    NEVER,
    PARENT,
    QUEUED,
    RANK,
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
from planner.kernels.landing import earliest_landing
from planner.kernels.motion import (
    LEAD,
    OFFSET,
    STEPS,
    TAIL,
    TIME,
    VISITS,
    Motion,
    coordinates,
    first_start,
    gap_around,
    heuristic,
)
from planner.kernels.policy import kernel
from planner.kernels.static_search import Bounds, time_to_go

FOUND, NO_DEPARTURE_SLOT, NO_PATH, WORKSPACE_FULL, TOO_LONG = range(5)

# Arrivals within so many ms of the F under way are made at once, rather than come back for each.
EAGERNESS = 1000


@kernel
def open_departures(
    h: int,
    rank: int,
    table: Int32Array,
    pool: IntArray,
    marks: Int32Array,
    labels: IntArray,
    task: Task,
) -> int:
    """Make a label for each gap of the first block that allows a departure; return how many."""
    count = 0
    for gap in range(ended_by(table, pool, task.origin, task.earliest), table[task.origin, COUNT] + 1):
        start, end = gap_bounds(table, pool, task.origin, gap, task.earliest)
        if start > task.latest or count == labels.shape[0]:
            break
        if start + task.climb_out + 1 <= end:
            add_label(marks, labels, task.stamp, count, task.origin, gap, start, end, h, rank)
            labels[count, G] = start + task.climb_out
            labels[count, PARENT] = -1
            labels[count, START] = start
            count += 1
    return count


@kernel
def open_label(heap: IntArray, size: int, labels: IntArray, label: int, f: int, earliest: int) -> int:
    """Queue a label on the OpenList with this F; return the list's new size."""
    key = heap_key(f - earliest, labels[label, RANK])
    labels[label, QUEUED] = key
    return push(heap, size, key, heap_tie(labels[label, BLOCK], labels[label, GAP_START] - earliest), label)


@kernel
def undominated_start(
    links: IntArray,
    table: Int32Array,
    pool: IntArray,
    marks: Int32Array,
    labels: IntArray,
    around: IntArray,
    stamp: int,
    p: int,
    link: int,
    tau: int,
    earliest: int,
    last: int,
) -> tuple[int, int]:
    """Return as `first_start` does, but FAR_FUTURE if a label reached the neighbour's first gap no later already."""
    n = p + links[link, OFFSET]
    first, lead = table[n, FIRST], links[link, LEAD]
    g = gap_around(table, pool, around, link, n, tau)
    while g < table[n, COUNT] and pool[first + g, EXIT] - lead <= earliest:
        g += 1
        around[VISITS] += 1
    s = earliest
    if g > 0:
        s = max(s, pool[first + g - 1, EXIT] - lead)
    label = label_for(marks, labels, stamp, n, g)
    if label >= 0 and labels[label, G] <= s + links[link, TIME]:
        return FAR_FUTURE, g
    return first_start(links, table, pool, around, p, link, 0, tau, earliest, last)


@kernel
def safe_interval(
    open_links: Int32Array, motion: Motion, slabs: Slabs, ws: Workspace, task: Task, bounds: Bounds
) -> tuple[int, int, int]:
    """CFA* with one label per (block, free interval): the earliest arrival, or proof that there is none.

    Each link of a label has a sequence of arrivals, one per gap of the neighbour, made only when F gets there
    (partial expansion): a label returns to the OpenList with the least F that its next arrivals can have. So neither
    links that lead away nor reservations far in the future cost anything.

    Returns status, goal label (without a path, how many labels there are, 0 where nobody can land in time), and
    expansions.
    """
    shape, links, near = motion
    table, pool, _ = slabs
    marks, labels, pending, around, to_go, heap, _, field = ws
    around[VISITS] = 0
    i, j, k = bounds.start
    h, rank = time_to_go(field, shape, near, bounds, task.origin, i, j, k)
    count = open_departures(h, rank, table, pool, marks, labels, task)
    if count == 0:
        return NO_DEPARTURE_SLOT, -1, 0
    if count == labels.shape[0]:
        return WORKSPACE_FULL, -1, 0
    landing, expansions, most = 0, 0, task.most
    if task.dive > 0:
        landing, expansions = earliest_landing(open_links, motion, slabs, ws, task, bounds, labels[0, G])
        if landing > min(task.until, FAR_FUTURE - 1):
            return NO_PATH, 0, expansions
        landing = max(landing, task.soonest)
        if landing > labels[0, G] + h:
            most = min(most, task.dive)
    size = 0
    for label in range(count):
        size = open_label(heap, size, labels, label, max(labels[label, G] + h, landing), task.earliest)
    bound = task.until
    f_least = key_f(heap[0, KEY])
    while size > 0:
        key, label = heap[0, KEY], heap[0, ITEM]
        size = pop(heap, size)
        if key != labels[label, QUEUED]:
            continue
        if not labels[label, CLOSED] and can_end(labels, label, task):
            return FOUND, label, expansions
        if expansions >= most:
            return TOO_LONG, -1, expansions
        expansions += 1
        if count + 26 > labels.shape[0] or size + 27 > heap.shape[0]:
            return WORKSPACE_FULL, -1, expansions
        p, G_p, end_p = labels[label, BLOCK], labels[label, G], labels[label, GAP_END]
        F = G_p + labels[label, H]
        f_now = key_f(key)
        until = task.earliest + f_now + EAGERNESS + ((f_now - f_least) >> 1) - F if f_now < MAX_F else FAR_FUTURE
        is_new = not labels[label, CLOSED]
        labels[label, CLOSED] = 1
        i, j, k = coordinates(shape, p)
        tau = FAR_FUTURE
        for link in range(26):
            around[link] = -1
            if is_new:
                if not (open_links[p] >> link) & 1:
                    pending[label, link] = NEVER
                    continue
            elif pending[label, link] == NEVER or pending[label, link] > until:
                continue
            x, y, z = i + STEPS[link, 0], j + STEPS[link, 1], k + STEPS[link, 2]
            h, rank = time_to_go(field, shape, near, bounds, p + links[link, OFFSET], x, y, z)
            to_go[link, 0] = h
            to_go[link, 1] = rank
            if is_new:
                pending[label, link] = links[link, TIME] + h - labels[label, H]
            tau = min(tau, F + pending[label, link] - links[link, TIME] - h)
        least = NEVER
        is_full = False
        for link in range(26):
            detour = pending[label, link]
            if detour == NEVER:
                continue
            if detour > until:
                least = min(least, detour)
                continue
            pending[label, link] = NEVER
            n, h = p + links[link, OFFSET], to_go[link, 0]
            last = end_p - 1 - links[link, TAIL]
            s = F + detour - links[link, TIME] - h
            while s <= last:
                s, g = undominated_start(links, table, pool, marks, labels, around, task.stamp, p, link, tau, s, last)
                arrival = s + links[link, TIME]
                if s < FAR_FUTURE and arrival + h <= bound:
                    successor = label_for(marks, labels, task.stamp, n, g)
                    if successor < 0:
                        start, end = gap_bounds(table, pool, n, g, task.earliest)
                        successor = count
                        add_label(marks, labels, task.stamp, successor, n, g, start, end, h, to_go[link, 1])
                        labels[successor, G] = FAR_FUTURE
                        count += 1
                    if arrival < labels[successor, G]:
                        labels[successor, G] = arrival
                        labels[successor, PARENT] = label
                        labels[successor, START] = s
                        # Where all F up to `landing` count alike, a label can be improved after it was expanded.
                        labels[successor, CLOSED] = 0
                        if can_end(labels, successor, task):
                            bound = arrival
                        size = open_label(heap, size, labels, successor, max(arrival + h, landing), task.earliest)
                if g == table[n, COUNT]:
                    break
                s = pool[table[n, FIRST] + g, EXIT] - links[link, LEAD]
                detour = s + links[link, TIME] + h - F
                if s > last or F + detour > bound:
                    break
                # A detour of weeks, which NEVER would hide, is made at once.
                if until < detour < NEVER:
                    pending[label, link] = detour
                    least = min(least, detour)
                    break
                if count + 26 > labels.shape[0] or size + 27 > heap.shape[0]:
                    is_full = True
                    break
        if is_full:
            return WORKSPACE_FULL, -1, expansions
        if least < NEVER and F + least <= bound:
            size = open_label(heap, size, labels, label, max(F + least, landing), task.earliest)
    return NO_PATH, count, expansions


@kernel
def greedy(open_links: Int32Array, motion: Motion, slabs: Slabs, ws: Workspace, task: Task) -> tuple[int, int, int]:
    """CFA* as the paper's Algorithm 3: one label a block, the smallest hovering at the previous block, or a detour.

    H is the lattice distance, as in the paper. Returns as `safe_interval` does.
    """
    shape, links, near = motion
    table, pool, _ = slabs
    marks, labels, _, around, _, heap, _, _ = ws
    around[VISITS] = 0
    h = heuristic(shape, near, task.origin, task.destination)
    if open_departures(h, h, table, pool, marks, labels, task) == 0:
        return NO_DEPARTURE_SLOT, -1, 0
    # The first departure slot only: the paper has one label a block.
    marks[task.origin, HEAD] = 0
    labels[0, FOLLOWING] = -1
    count = 1
    size = open_label(heap, 0, labels, 0, labels[0, G] + h, task.earliest)
    expansions = 0
    while size > 0:
        min_F = heap[0, ITEM]
        size = pop(heap, size)
        if labels[min_F, CLOSED]:
            continue
        labels[min_F, CLOSED] = 1
        if labels[min_F, BLOCK] == task.destination:
            return FOUND, min_F, expansions
        if expansions == task.most:
            return TOO_LONG, -1, expansions
        expansions += 1
        if count + 26 > labels.shape[0] or size + 27 > heap.shape[0]:
            return WORKSPACE_FULL, -1, expansions
        p = labels[min_F, BLOCK]
        tau = labels[min_F, G]
        for link in range(26):
            around[link] = -1
        for link in range(26):
            if not (open_links[p] >> link) & 1:
                continue
            n = p + links[link, OFFSET]
            node = marks[n, HEAD] if marks[n, STAMP] == task.stamp else -1
            if node >= 0 and labels[node, CLOSED]:
                continue
            last = min(labels[min_F, GAP_END] - 1 - links[link, TAIL], tau + task.hover_limit)
            stay = task.dwell if n == task.destination else 0
            s, g = first_start(links, table, pool, around, p, link, stay, tau, tau, last)
            arrival = s + links[link, TIME]
            if s == FAR_FUTURE or (node >= 0 and arrival >= labels[node, G]):
                continue
            start, end = gap_bounds(table, pool, n, g, task.earliest)
            if node < 0:
                node = count
                h = heuristic(shape, near, n, task.destination)
                add_label(marks, labels, task.stamp, node, n, g, start, end, h, h)
                count += 1
            labels[node, GAP] = g
            labels[node, GAP_START] = start
            labels[node, GAP_END] = end
            labels[node, G] = arrival
            labels[node, PARENT] = min_F
            labels[node, START] = s
            size = open_label(heap, size, labels, node, arrival + labels[node, H], task.earliest)
    return NO_PATH, count, expansions
