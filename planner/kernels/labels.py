"""Labels: arrivals at block centres, and what they are kept in.

A label is an arrival at a block's centre: G its time, H the heuristic, F = G + H. Its free interval is a gap between
reservations of the block.
"""

from typing import NamedTuple

import numpy as np

from planner.airmatrix import Int32Array, IntArray
from planner.kernels.heap import HEAP_COLUMNS
from planner.kernels.intervals import COUNT, ENTER, EXIT, FAR_FUTURE, FIRST
from planner.kernels.policy import kernel

# Columns of `Workspace.labels`, a row a label.
G, H, BLOCK, GAP, GAP_START, GAP_END, PARENT, START, FOLLOWING, RANK, CLOSED, QUEUED, DEPARTURE, FLOWN = range(14)
SURCHARGE = FLOWN
LABEL_COLUMNS = 14

# Columns of `Workspace.marks`, a row a block: the search that last touched it, and its first label there.
STAMP, HEAD = range(2)

# What `pending` says of a link that has no arrival left.
NEVER = (1 << 31) - 1

# The largest stamp: twice as much and one must fit into int32.
LAST_STAMP = (1 << 30) - 1


class Task(NamedTuple):
    """One request: blocks, departure window, terminal dwell, the greedy search's hover limit, in ms; its stamp.

    `climb_out` is the dwell before the first link: none for a flight that is in the air already. Nothing that gets to
    the destination after `until` is looked for, and nothing gets there before `soonest`. A search may
    `dive`: for so many expansions, 0 for none, all F that are too early count alike. After the `most` it gives up.
    """

    origin: int
    destination: int
    earliest: int
    latest: int
    climb_out: int
    dwell: int
    hover_limit: int
    until: int
    soonest: int
    dive: int
    most: int
    stamp: int


class Workspace(NamedTuple):
    """Memory that searches share, one at a time; stamps say what belongs to the present search.

    `labels` (n, 14) by the columns above: G, H, block, gap number and bounds, parent label, the start of the link from
    it, the block's `following` label, its `rank` among equal F, `closed`, the key it is `queued` under, `departure` and
    `flown` (see `within_endurance`) or `surcharge` (see `least_cost`). `pending` (n, 26): by how many ms the next
    arrival by each link would exceed the label's own F, NEVER for none left. Of the neighbours of the block expanded,
    `around` (27,): the gap, and last how many reservations and gaps the search has looked at; `to_go` (26, 2): H and
    rank. `field` (blocks, 4) and `far_heap` serve `planner.kernels.static_search`.
    """

    marks: Int32Array
    labels: IntArray
    pending: Int32Array
    around: IntArray
    to_go: IntArray
    heap: IntArray
    far_heap: IntArray
    field: Int32Array


def new_workspace(block_count: int, label_count: int) -> Workspace:
    """Return memory for searches of up to `label_count` labels."""
    return Workspace(
        marks=np.zeros((block_count, 2), dtype=np.int32),
        labels=np.empty((label_count, LABEL_COLUMNS), dtype=np.int64),
        pending=np.empty((label_count, 26), dtype=np.int32),
        around=np.zeros(27, dtype=np.int64),
        to_go=np.zeros((26, 2), dtype=np.int64),
        heap=np.empty((4 * label_count, HEAP_COLUMNS), dtype=np.int64),
        far_heap=np.empty((4 * label_count, HEAP_COLUMNS), dtype=np.int64),
        field=np.zeros((block_count, 4), dtype=np.int32),
    )


def larger_workspace(ws: Workspace) -> Workspace:
    """Return memory for twice as many labels, with the marks that this one holds."""
    larger = new_workspace(0, 2 * len(ws.labels))
    return larger._replace(marks=ws.marks, field=ws.field)


@kernel
def gap_bounds(table: Int32Array, pool: IntArray, block: int, gap: int, earliest: int) -> tuple[int, int]:
    """Return a gap's start and end; starts before `earliest` are that, so that forgetting the past changes nothing."""
    first = table[block, FIRST]
    start, end = earliest, FAR_FUTURE
    if gap > 0:
        start = max(start, pool[first + gap - 1, EXIT])
    if gap < table[block, COUNT]:
        end = pool[first + gap, ENTER]
    return start, end


@kernel
def label_for(marks: Int32Array, labels: IntArray, stamp: int, block: int, gap: int) -> int:
    """Return the label of a gap in this search, -1 if it has none yet."""
    if marks[block, STAMP] != stamp:
        return -1
    label = marks[block, HEAD]
    while label >= 0 and labels[label, GAP] != gap:
        label = labels[label, FOLLOWING]
    return label


@kernel
def add_label(
    marks: Int32Array,
    labels: IntArray,
    stamp: int,
    label: int,
    block: int,
    gap: int,
    start: int,
    end: int,
    h: int,
    rank: int,
) -> None:
    """Set up an unused label as the head of its block's list."""
    labels[label, BLOCK] = block
    labels[label, GAP] = gap
    labels[label, GAP_START] = start
    labels[label, GAP_END] = end
    labels[label, H] = h
    labels[label, RANK] = rank
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
