"""A* from both ends without traffic: the static optimum C, and bounds of the time to go for the search with traffic.

Both ends search at once in the order of b = G + F - H', where H' is the lattice distance to the end it comes from: so
what a path wastes near one end is known before the other end's side fans out over all the equally long ways between
(dynamically improved bounds; Sewell and Jacobson 2021). docs/decisions/0009 has the argument.
"""

from typing import NamedTuple

from planner.airmatrix import Int32Array, IntArray
from planner.kernels.heap import ITEM, KEY, MAX_H, heap_key, key_f, pop, push
from planner.kernels.intervals import FAR_FUTURE
from planner.kernels.labels import Workspace
from planner.kernels.motion import OFFSET, STEPS, TIME, Motion, Shape, coordinates, lattice_time
from planner.kernels.policy import kernel

# Columns of `Workspace.field`, a row a block: marks and times in ms from the origin and to the destination. A mark is
# twice the stamp of the search that reached the block, plus one once its time is final.
FROM_MARK, FROM, TO_MARK, TO = range(4)

# More than any b, and twice it still fits into int64.
UNREACHED = FAR_FUTURE >> 1


class Bounds(NamedTuple):
    """What a static search leaves: its ends (i, j, k), the optimum C and the least open b in ms, and its stamp."""

    start: tuple[int, int, int]
    end: tuple[int, int, int]
    optimum: int
    least: int
    stamp: int
    expansions: int


@kernel
def static_search(
    open_links: Int32Array, motion: Motion, ws: Workspace, origin: int, destination: int, stamp: int
) -> tuple[bool, Bounds]:
    """Search from both ends until C is proved, and settle the times to go along the static optima found.

    Ways from either end of more than MAX_H are not followed; C is UNREACHED if there are no others. Returns whether the
    workspace sufficed, and the bounds.
    """
    shape, links, near = motion
    heap_O, heap_D, field = ws.heap, ws.far_heap, ws.field
    start, end = coordinates(shape, origin), coordinates(shape, destination)
    opened, closed = 2 * stamp, 2 * stamp + 1
    h = lattice_time(shape, near, end[0] - start[0], end[1] - start[1], end[2] - start[2])
    field[origin, FROM_MARK], field[origin, FROM] = opened, 0
    field[destination, TO_MARK], field[destination, TO] = opened, 0
    size_O = push(heap_O, 0, heap_key(h, h), origin, origin)
    size_D = push(heap_D, 0, heap_key(h, h), destination, destination)
    C = b_O = b_D = UNREACHED
    from_O = from_D = 0
    while True:
        while size_O > 0 and field[heap_O[0, ITEM], FROM_MARK] == closed:
            size_O = pop(heap_O, size_O)
        while size_D > 0 and field[heap_D[0, ITEM], TO_MARK] == closed:
            size_D = pop(heap_D, size_D)
        b_O = key_f(heap_O[0, KEY]) if size_O > 0 else UNREACHED
        b_D = key_f(heap_D[0, KEY]) if size_D > 0 else UNREACHED
        if b_O + b_D >= 2 * C:
            break
        if size_O + 27 > heap_O.shape[0] or size_D + 27 > heap_D.shape[0]:
            return False, Bounds(start, end, C, 0, stamp, from_O + from_D)
        forwards = size_D == 0 or (size_O > 0 and 2 * from_O < from_D)
        if forwards:
            mark, time, other_mark, other_time = FROM_MARK, FROM, TO_MARK, TO
            p = heap_O[0, ITEM]
            size_O = pop(heap_O, size_O)
            from_O += 1
        else:
            mark, time, other_mark, other_time = TO_MARK, TO, FROM_MARK, FROM
            p = heap_D[0, ITEM]
            size_D = pop(heap_D, size_D)
            from_D += 1
        field[p, mark] = closed
        if forwards and field[p, TO_MARK] == closed:
            continue
        i, j, k = coordinates(shape, p)
        for link in range(26):
            if not (open_links[p] >> link) & 1:
                continue
            n = p + links[link, OFFSET]
            reached = field[p, time] + links[link, TIME]
            if reached > MAX_H or (field[n, mark] >= opened and field[n, time] <= reached):
                continue
            field[n, mark] = opened
            field[n, time] = reached
            if field[n, other_mark] >= opened:
                C = min(C, reached + field[n, other_time])
            x, y, z = i + STEPS[link, 0], j + STEPS[link, 1], k + STEPS[link, 2]
            to_D = lattice_time(shape, near, end[0] - x, end[1] - y, end[2] - z)
            if forwards and reached + to_D >= C:
                continue
            to_O = lattice_time(shape, near, start[0] - x, start[1] - y, start[2] - z)
            if forwards:
                size_O = push(heap_O, size_O, heap_key(2 * reached + to_D - to_O, to_D), n, n)
            else:
                size_D = push(heap_D, size_D, heap_key(2 * reached + to_O - to_D, to_O), n, n)
    # The origin's heap has served.
    settled = settle(open_links, links, field, heap_O, heap_D, size_D, C, stamp)
    return settled, Bounds(start, end, C, min(b_D, MAX_H + 1), stamp, from_O + from_D)


@kernel
def settle(
    open_links: Int32Array,
    links: IntArray,
    field: Int32Array,
    stack: IntArray,
    heap_D: IntArray,
    size_D: int,
    C: int,
    stamp: int,
) -> bool:
    """Follow static optima from where the destination's side stopped back to the origin: there, times to go are final.

    Where the times from the origin and to the destination add up to C, both are exact, and so is the time of a
    predecessor that makes C again. Returns whether the stack sufficed.
    """
    opened, closed = 2 * stamp, 2 * stamp + 1
    depth = 0
    for place in range(size_D):
        n = heap_D[place, ITEM]
        if depth == stack.shape[0]:
            return False
        if field[n, TO_MARK] == opened and field[n, FROM_MARK] >= opened and field[n, FROM] + field[n, TO] == C:
            field[n, TO_MARK] = closed
            stack[depth, ITEM] = n
            depth += 1
    while depth > 0:
        depth -= 1
        p = stack[depth, ITEM]
        if depth + 26 > stack.shape[0]:
            return False
        for link in range(26):
            if (open_links[p] >> link) & 1:
                n = p + links[link, OFFSET]
                to_go = field[p, TO] + links[link, TIME]
                if field[n, FROM_MARK] >= opened and field[n, TO_MARK] != closed and field[n, FROM] + to_go == C:
                    field[n, TO_MARK] = closed
                    field[n, TO] = to_go
                    stack[depth, ITEM] = n
                    depth += 1
    return True


@kernel
def time_to_go(
    field: Int32Array, shape: Shape, near: IntArray, bounds: Bounds, block: int, i: int, j: int, k: int
) -> tuple[int, int]:
    """Return H, the time without traffic from a block to the destination, and its rank among equal F.

    H is exact or a lower bound, and consistent: no link changes it by more than it takes. Exact ones rank first, by H;
    bounds by the lattice distance, since what makes them tight says little about the way ahead.
    """
    start, end = bounds.start, bounds.end
    if field[block, TO_MARK] == 2 * bounds.stamp + 1:
        return field[block, TO], field[block, TO]
    to_D = lattice_time(shape, near, end[0] - i, end[1] - j, end[2] - k)
    to_O = lattice_time(shape, near, start[0] - i, start[1] - j, start[2] - k)
    h = max(to_D, (bounds.least + to_D - to_O) >> 1)
    if field[block, FROM_MARK] == 2 * bounds.stamp + 1:
        h = max(h, bounds.optimum - field[block, FROM])
    return h, MAX_H + 1 + to_D
