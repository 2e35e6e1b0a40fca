"""A plain safe-interval planner, written from the definition of holds: a twin that reaches where ticks are too slow.

A label is the earliest arrival in a block's centre within one free interval of the block. As a flight may wait there as
long as the block is free, no later arrival in the same interval is of any use. Free intervals are half-open.
"""

import heapq
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from planner.airspace import Airspace, OccupancyRule
from planner.cfa_star import PlanRequest
from planner.links import LinkTimes
from tests.reference import lattice
from tests.reference.lattice import STEPS, time_of
from tests.reference.planning import Hold, Visit

PAST, FUTURE = -(1 << 62), 1 << 62

Interval = tuple[int, int]
# A block and the start of one of its free intervals.
Place = tuple[int, int]


class _Link(NamedTuple):
    """A link that buildings leave open: where to, its index among the steps, and the blocks held beside its ends."""

    to: int
    step: int
    sides: tuple[int, ...]


class _Arrival(NamedTuple):
    """An arrival at `G`, by a link that started at `s` in `parent`; of the starting place both are None."""

    G: int
    parent: Place | None = None
    s: int | None = None


class SafeIntervalPlanner:
    """Earliest arrivals in one airspace among what has been reserved. Knows no endurance."""

    def __init__(self, airspace: Airspace) -> None:
        self.airspace = airspace
        self.free: list[list[Interval]] = [[(PAST, FUTURE)] for _ in range(airspace.grid.block_count)]
        self.links = [_links(airspace, block) for block in range(airspace.grid.block_count)]
        self._lattices: dict[tuple[int, ...], list[list[list[int]]]] = {}

    def reserve(self, holds: Iterable[Hold]) -> None:
        """Cut holds out of the free intervals that contain them."""
        for block, enter_ms, exit_ms in holds:
            intervals = self.free[block]
            number = bisect_right(intervals, (enter_ms, FUTURE)) - 1
            start, end = intervals[number] if number >= 0 else (PAST, PAST)
            assert start <= enter_ms < exit_ms <= end, f"block {block} is not free from {enter_ms} to {exit_ms}"
            parts = [(start, enter_ms), (exit_ms, end)]
            intervals[number : number + 1] = [part for part in parts if part[0] < part[1]]

    def earliest_path(self, request: PlanRequest) -> list[Visit] | None:
        """Return a conflict-free trajectory of earliest arrival, dwells included; None if there is none."""
        dwell_ms = self.airspace.terminal_dwell_ms
        times = [time_of(request.performance.times, step) for step in STEPS]
        heuristic = self._heuristic(request)
        arrivals: dict[Place, _Arrival] = {}
        closed: set[Place] = set()
        queue: list[tuple[int, int, Place]] = []

        def arrive(place: Place, arrival: _Arrival) -> None:
            if place not in arrivals or arrival.G < arrivals[place].G:
                arrivals[place] = arrival
                heapq.heappush(queue, (arrival.G + heuristic(place[0]), -arrival.G, place))

        for start, end in self.free[request.origin]:
            departure = max(start, request.earliest_departure_ms)
            if departure <= request.latest_departure_ms and departure + dwell_ms < end:
                arrive((request.origin, start), _Arrival(departure + dwell_ms))
        while queue:
            _, _, place = heapq.heappop(queue)
            if place in closed:
                continue
            closed.add(place)
            p, start = place
            G = arrivals[place].G
            end = self._end(place)
            if p == request.destination and G + dwell_ms < end:
                return self._visits(arrivals, place, request)
            for link in self.links[p]:
                for to, s in self._starts(link, times[link.step], G, end):
                    if to not in closed:
                        arrive(to, _Arrival(s + times[link.step], place, s))
        return None

    def _starts(self, link: _Link, ms: int, G: int, end: int) -> Iterator[tuple[Place, int]]:
        """Yield for each free interval of the neighbour that can be reached the earliest start of the link.

        The block left is held until s + tail, the neighbour from s + lead to s + ms, the sides all the way.
        """
        contained = self.airspace.rule is OccupancyRule.CONTAINMENT
        lead, tail = (0, ms) if contained else (ms // 2, ms // 2)
        intervals = self.free[link.to]
        first = max(bisect_right(intervals, (G + lead, FUTURE)) - 1, 0)
        for start, stop in intervals[first:]:
            s, last = max(G, start - lead), min(end - 1 - tail, stop - 1 - ms)
            if start - lead > end - 1 - tail:
                return
            while s <= last:
                free_from = max((self._free_from(side, s, ms) for side in link.sides), default=s)
                if free_from == s:
                    yield (link.to, start), s
                    break
                s = free_from

    def _free_from(self, block: int, s: int, ms: int) -> int:
        """Return the earliest time, s or later, from which a block is free for a whole link."""
        intervals = self.free[block]
        for start, end in intervals[max(bisect_right(intervals, (s, FUTURE)) - 1, 0) :]:
            if max(s, start) + ms < end:
                return max(s, start)
        return FUTURE

    def _end(self, place: Place) -> int:
        """Return the end of a free interval."""
        intervals = self.free[place[0]]
        return intervals[bisect_right(intervals, (place[1], FUTURE)) - 1][1]

    def _visits(self, arrivals: dict[Place, _Arrival], goal: Place, request: PlanRequest) -> list[Visit]:
        """Follow the parents back from the goal; the flight departs as late as its first link and the window allow."""
        dwell_ms = self.airspace.terminal_dwell_ms
        place, leave = goal, arrivals[goal].G + dwell_ms
        visits = []
        while (arrival := arrivals[place]).parent is not None:
            visits.append(Visit(place[0], arrival.G, leave))
            assert arrival.s is not None
            place, leave = arrival.parent, arrival.s
        visits.append(Visit(place[0], min(leave - dwell_ms, request.latest_departure_ms), leave))
        return visits[::-1]

    def _heuristic(self, request: PlanRequest) -> Callable[[int], int]:
        """Return the lattice distance to the destination in ms, looked up by how many blocks it is away."""
        kinds = request.performance.times[1:]
        if kinds not in self._lattices:
            self._lattices[kinds] = lattice_table(self.airspace, request.performance.times)
        table = self._lattices[kinds]
        count_i, count_j, _ = self.airspace.grid.dimensions
        i, j, k = self.airspace.grid.block(request.destination)

        def heuristic(block: int) -> int:
            rest, block_i = divmod(block, count_i)
            block_k, block_j = divmod(rest, count_j)
            return table[abs(block_k - k)][abs(block_j - j)][abs(block_i - i)]

        return heuristic


def lattice_table(airspace: Airspace, times: LinkTimes) -> list[list[list[int]]]:
    """Return lattice distances in ms by layers, rows and columns away.

    The lattice goes on around the grid: a climb may be fastest in a zigzag that leaves it, by a block a layer at most.
    """
    count_i, count_j, margin = airspace.grid.dimensions
    found = lattice.distances(times, (count_i + 2 * margin, count_j + 2 * margin, margin), (margin, margin, 0))
    return [[[found[i + margin, j + margin, k] for i in range(count_i)] for j in range(count_j)] for k in range(margin)]


def _links(airspace: Airspace, p: int) -> list[_Link]:
    """Return a block's links that stay in the grid and that, under the airspace's rule, buildings leave open."""
    grid = airspace.grid
    contained = airspace.rule is OccupancyRule.CONTAINMENT
    here = grid.block(p)
    links = []
    for number, step in enumerate(STEPS):
        there = (here[0] + step[0], here[1] + step[1], here[2] + step[2])
        if not grid.contains(there):
            continue
        n = grid.index(there)
        corners = {
            grid.index((i, j, k)) for i in (here[0], there[0]) for j in (here[1], there[1]) for k in (here[2], there[2])
        }
        sides = tuple(sorted(corners - {p, n})) if contained else ()
        if not any(airspace.occupied[block] for block in (p, n, *sides)):
            links.append(_Link(n, number, sides))
    return links
