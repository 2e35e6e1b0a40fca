"""From when on a flight can land: what is reserved around a destination that is not free in time (paper 3.2).

Who has to wait can do so anywhere, and a search by F = G + H would look at all of that before the first arrival. So a
bound of the arrival is found first, from the destination back.
"""

from planner.airmatrix import Int32Array, IntArray
from planner.kernels.heap import ITEM, KEY, pop, push
from planner.kernels.intervals import FAR_FUTURE, Slabs, ended_by
from planner.kernels.labels import STAMP, Task, Workspace, gap_bounds
from planner.kernels.motion import LEAD, OFFSET, STEPS, TIME, Motion, coordinates, lattice_time
from planner.kernels.policy import kernel
from planner.kernels.static_search import Bounds, time_to_go


@kernel
def earliest_presence(
    table: Int32Array, pool: IntArray, block: int, entering: int, stay: int, earliest: int, soonest: int
) -> int:
    """Return a bound, no sooner than `soonest`, of when a flight can be at a block's centre and stay for `stay` ms.

    `entering` is the least time from the start of the block's hold to the arrival at its centre.
    """
    gap = ended_by(table, pool, block, soonest)
    # Behind a closure without an end there is nothing any more.
    while soonest < FAR_FUTURE:
        start, end = gap_bounds(table, pool, block, gap, earliest)
        soonest = max(soonest, start + entering)
        if soonest + stay + 1 <= end:
            break
        gap += 1
    return soonest


@kernel
def earliest_landing(
    open_links: Int32Array, motion: Motion, slabs: Slabs, ws: Workspace, task: Task, bounds: Bounds, departure: int
) -> tuple[int, int]:
    """Return a bound of the arrival of who leaves the first block at `departure`, by what is reserved around the last.

    Nobody leaves a block of a way before a presence there, and has the time to go still to fly then: the arrival is no
    earlier than the largest such sum, on the way where that is least. Blocks are looked at in the order of it, from the
    destination back to where nobody has to wait: through all of a closed volume, but seldom beyond the first one.
    Uses the heap, and marks where one has to wait, and the destination, with the stamp before the task's.

    Returns the bound, and how many blocks beside the destination were looked around.
    """
    shape, links, near = motion
    table, pool, _ = slabs
    marks, heap, stamp, start = ws.marks, ws.heap, task.stamp - 1, bounds.start
    entering = FAR_FUTURE
    for link in range(26):
        entering = min(entering, links[link, TIME] - links[link, LEAD])
    soonest = departure + bounds.optimum
    landing = earliest_presence(table, pool, task.destination, entering, task.dwell, task.earliest, soonest)
    marks[task.destination, STAMP] = stamp
    size = push(heap, 0, landing, task.destination, task.destination)
    landing, looked = FAR_FUTURE, 0
    while (
        size > 0 and heap[0, KEY] < min(landing, task.until + 1) and size + 26 <= heap.shape[0] and looked < task.most
    ):
        behind, p = heap[0, KEY], heap[0, ITEM]
        size = pop(heap, size)
        looked += p != task.destination
        i, j, k = coordinates(shape, p)
        for link in range(26):
            n = p + links[link, OFFSET]
            if not (open_links[p] >> link) & 1 or marks[n, STAMP] == stamp:
                continue
            x, y, z = i + STEPS[link, 0], j + STEPS[link, 1], k + STEPS[link, 2]
            soonest = departure + lattice_time(shape, near, start[0] - x, start[1] - y, start[2] - z)
            present = soonest
            if n != task.origin:
                present = earliest_presence(table, pool, n, entering, 0, task.earliest, soonest)
            h, _ = time_to_go(ws.field, shape, near, bounds, n, x, y, z)
            if present == soonest:
                landing = min(landing, max(behind, present + h))
            else:
                marks[n, STAMP] = stamp
                size = push(heap, size, max(behind, present + h), n, n)
    return landing if size == 0 else min(landing, heap[0, KEY]), looked
