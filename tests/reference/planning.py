"""Slow, plain twins of the planner, written from the definitions of holds and of search, not from its kernels.

Time runs in ticks of 1 ms. A block is either reserved at a tick or not, and a flight that stands in a block's
centre may, at every tick, wait for one more or start along any link: nothing here knows of intervals.
"""

import heapq
import itertools
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from planner.airmatrix import AirMatrix
from planner.airspace import Airspace, OccupancyRule
from planner.cfa_star import PlanRequest
from planner.errors import Block
from planner.links import DIRECTIONS, LinkTimes
from tests.reference import lattice
from tests.reference.lattice import STEPS, time_of


class Hold(NamedTuple):
    """A block (flat index) held or reserved during the half-open [enter_ms, exit_ms)."""

    block: int
    enter_ms: int
    exit_ms: int


class Visit(NamedTuple):
    """A stay in a block's centre (flat index), from arrival to departure; equal where there is no wait."""

    block: int
    arrive_ms: int
    depart_ms: int


def link_times(horizontal: int, diagonal: int, vertical: int, alpha: int, beta: int) -> LinkTimes:
    """Return the times of an aircraft with these five kinds of links, in even ms."""
    times = LinkTimes(np.empty(0, dtype=np.int64), horizontal, diagonal, vertical, alpha, beta)
    return times._replace(time=np.array([time_of(times, direction) for direction in DIRECTIONS], dtype=np.int64))


# Earliest arrival


def earliest_arrival(airspace: Airspace, reservations: Iterable[Hold], request: PlanRequest) -> int | None:
    """Return the earliest arrival in ms of any conflict-free trajectory, dwell included; None if there is none."""
    traffic = _Traffic(airspace, reservations, request)
    endurance_ms = request.performance.endurance_ms
    if endurance_ms is None:
        return traffic.earliest_arrival(traffic.departures())
    arrivals = ((departure, traffic.earliest_arrival([departure])) for departure in traffic.departures())
    return min(
        (arrival for departure, arrival in arrivals if arrival is not None and arrival - departure <= endurance_ms),
        default=None,
    )


def least_cost(airspace: Airspace, reservations: Iterable[Hold], request: PlanRequest) -> int | None:
    """Return the least arrival in ms plus surcharges of the layers flown into; None if there is no trajectory."""
    traffic = _Traffic(airspace, reservations, request)
    return traffic.least_cost(traffic.departures())


def can_depart(airspace: Airspace, reservations: Iterable[Hold], request: PlanRequest) -> bool:
    """Tell whether the first block is ever free in the departure window, for the dwell if there is one."""
    return bool(_Traffic(airspace, reservations, request).departures())


def flight_time_without_traffic(airspace: Airspace, request: PlanRequest) -> int | None:
    """Return the static optimum in ms, dwell at both ends included; None where buildings leave no path."""
    links = _links(airspace, request.performance.times)
    times = {request.origin: 0}
    queue = [(0, request.origin)]
    while queue:
        time, p = heapq.heappop(queue)
        if time > times[p]:
            continue
        for link in links[p]:
            if link.to not in times or time + link.ms < times[link.to]:
                times[link.to] = time + link.ms
                heapq.heappush(queue, (times[link.to], link.to))
    if request.destination not in times:
        return None
    return times[request.destination] + 2 * airspace.terminal_dwell_ms


class _Link(NamedTuple):
    """A link that buildings leave open. `box` is what containment holds: all blocks from p to n, both included."""

    to: int
    ms: int
    box: tuple[int, ...]


class _Traffic:
    """What is reserved at which tick, seen by one request."""

    def __init__(self, airspace: Airspace, reservations: Iterable[Hold], request: PlanRequest) -> None:
        self.rule = airspace.rule
        self.dwell_ms = airspace.terminal_dwell_ms
        self.request = request
        self.links = _links(airspace, request.performance.times)
        self.reserved: dict[int, set[int]] = defaultdict(set)
        for block, enter_ms, exit_ms in reservations:
            self.reserved[block].update(range(enter_ms, exit_ms))
        # From then on nothing is reserved and every block that can be reached is, without a detour in time.
        quiet = max([request.latest_departure_ms + self.dwell_ms, *itertools.chain(*self.reserved.values())])
        longest = max(request.performance.times.time.tolist())
        self.horizon = quiet + 1 + longest * airspace.grid.block_count

    def is_free(self, block: int, first: int, last: int) -> bool:
        """Tell whether a block is free at every tick from `first` to `last`, both included."""
        return self.reserved[block].isdisjoint(range(first, last + 1))

    def is_link_free(self, p: int, link: _Link, s: int) -> bool:
        """Tell whether everything that flying a link at `s` holds is free."""
        if self.rule is OccupancyRule.MIDPOINT:
            middle = s + link.ms // 2
            return self.is_free(p, s, middle) and self.is_free(link.to, middle, s + link.ms)
        return all(self.is_free(block, s, s + link.ms) for block in link.box)

    def departures(self) -> list[int]:
        """Return all departures in the window at which the first block is free, until its dwell is over."""
        window = range(self.request.earliest_departure_ms, self.request.latest_departure_ms + 1)
        return [tick for tick in window if self.is_free(self.request.origin, tick, tick + self.dwell_ms)]

    def earliest_arrival(self, departures: Sequence[int]) -> int | None:
        """Search all (block, tick) in the order of ticks, from these departures."""
        standing: dict[int, set[int]] = defaultdict(set)
        for departure in departures:
            standing[departure + self.dwell_ms].add(self.request.origin)
        for tick in range(min(standing, default=0), self.horizon + 1):
            for p in standing.pop(tick, ()):
                if p == self.request.destination and self.is_free(p, tick, tick + self.dwell_ms):
                    return tick + self.dwell_ms
                if self.is_free(p, tick + 1, tick + 1):
                    standing[tick + 1].add(p)
                for link in self.links[p]:
                    if self.is_link_free(p, link, tick):
                        standing[tick + link.ms].add(link.to)
            if not standing:
                return None
        return None

    def least_cost(self, departures: Sequence[int]) -> int | None:
        """Search all (block, tick) in the order of ticks, with the least paid so far to stand in each."""
        blocks_a_layer = len(self.links) // len(self.request.layer_surcharge_ms)
        standing: dict[int, dict[int, int]] = defaultdict(dict)
        for departure in departures:
            standing[departure + self.dwell_ms][self.request.origin] = 0
        costs = []
        for tick in range(min(standing, default=0), self.horizon + 1):
            for p, paid in standing.pop(tick, {}).items():
                if p == self.request.destination and self.is_free(p, tick, tick + self.dwell_ms):
                    costs.append(tick + self.dwell_ms + paid)
                if self.is_free(p, tick + 1, tick + 1):
                    standing[tick + 1][p] = min(paid, standing[tick + 1].get(p, paid))
                for link in self.links[p]:
                    if self.is_link_free(p, link, tick):
                        there = standing[tick + link.ms]
                        then = paid + self.request.layer_surcharge_ms[link.to // blocks_a_layer]
                        there[link.to] = min(then, there.get(link.to, then))
        return min(costs, default=None)


def _links(airspace: Airspace, times: LinkTimes) -> list[list[_Link]]:
    """Return, for each block, the links that buildings leave open; none to or from a building."""
    grid = airspace.grid
    links: list[list[_Link]] = []
    for p in range(grid.block_count):
        links.append([])
        for step in STEPS:
            neighbour = _moved(grid.block(p), step)
            if not grid.contains(neighbour):
                continue
            n = grid.index(neighbour)
            box = _box(grid, p, n)
            needed = (p, n) if airspace.rule is OccupancyRule.MIDPOINT else box
            if not airspace.occupied[list(needed)].any():
                links[p].append(_Link(n, time_of(times, step), box))
    return links


def _moved(block: Block, step: Block) -> Block:
    return block[0] + step[0], block[1] + step[1], block[2] + step[2]


def _box(grid: AirMatrix, p: int, n: int) -> tuple[int, ...]:
    """Return all blocks of the box spanned by two neighbours."""
    parts = [sorted({one, other}) for one, other in zip(grid.block(p), grid.block(n), strict=True)]
    return tuple(grid.index((i, j, k)) for i in parts[0] for j in parts[1] for k in parts[2])


# Holds


def holds_of(path: Sequence[Visit], rule: OccupancyRule, grid: AirMatrix) -> list[Hold]:
    """Return what a trajectory holds, merged where it overlaps itself, by enter, then i, j, k.

    The trajectory's first arrival is its departure and its last departure its arrival, dwells included.
    """
    closed: list[tuple[int, int, int]] = []
    if rule is OccupancyRule.MIDPOINT:
        halves = [(after.arrive_ms - before.depart_ms) // 2 for before, after in itertools.pairwise(path)]
        for visit, half_in, half_out in zip(path, [0, *halves], [*halves, 0], strict=True):
            closed.append((visit.block, visit.arrive_ms - half_in, visit.depart_ms + half_out))
    else:
        closed.extend(path)
        for before, after in itertools.pairwise(path):
            for block in _box(grid, before.block, after.block):
                closed.append((block, before.depart_ms, after.arrive_ms))
    merged: list[Hold] = []
    for block, enter_ms, last_ms in sorted(closed):
        exit_ms = last_ms + 1
        if merged and merged[-1].block == block and enter_ms < merged[-1].exit_ms:
            merged[-1] = Hold(block, merged[-1].enter_ms, max(merged[-1].exit_ms, exit_ms))
        else:
            merged.append(Hold(block, enter_ms, exit_ms))
    return sorted(merged, key=lambda hold: (hold.enter_ms, grid.block(hold.block)))


def is_conflict_free(holds: Iterable[Hold], reservations: Sequence[Hold]) -> bool:
    """Tell whether no hold shares a block and a tick with any of the reservations."""
    return not any(
        hold.block == other.block and hold.enter_ms < other.exit_ms and other.enter_ms < hold.exit_ms
        for hold in holds
        for other in reservations
    )


# The paper's Algorithm 3


class _Node(NamedTuple):
    """A label. G is the arrival in the centre in ms, as a time of day; `parent` is None for the starting node."""

    G: int
    F: int
    parent: int | None


def greedy_path(
    airspace: Airspace, reservations: Iterable[Hold], request: PlanRequest, hover_limit_ms: int
) -> list[Visit] | None:
    """Return the path of the paper's CFA*: one label a block, closed for good, the smallest hovering before a link.

    The search departs as soon as the first block is free. Of the waiting it does there before the first link, the
    window allows a part on the ground, before the departure. None where the algorithm finds nothing.
    """
    traffic = _Traffic(airspace, reservations, request)
    departures = traffic.departures()
    if not departures:
        return None
    heuristic = _heuristic(airspace.grid, request)
    origin, destination, dwell_ms = request.origin, request.destination, traffic.dwell_ms
    start_G = departures[0] + dwell_ms
    open_list = {origin: _Node(start_G, start_G + heuristic[origin], None)}
    close_list: dict[int, _Node] = {}
    while open_list and destination not in close_list:
        p = min(open_list, key=lambda block: (open_list[block].F, -open_list[block].G, block))
        close_list[p] = open_list.pop(p)
        for link in traffic.links[p]:
            n = link.to
            if n in close_list:
                continue
            hovering = _hovering_time(traffic, p, link, close_list[p].G, hover_limit_ms)
            if hovering is None:
                continue
            G = close_list[p].G + hovering + link.ms
            if n not in open_list or G < open_list[n].G:
                open_list[n] = _Node(G, G + heuristic[n], p)
    if destination not in close_list:
        return None
    visits = _visits(traffic, close_list)
    departure = min(visits[0].depart_ms - dwell_ms, request.latest_departure_ms)
    return [visits[0]._replace(arrive_ms=departure), *visits[1:]]


def _hovering_time(traffic: _Traffic, p: int, link: _Link, arrival: int, limit_ms: int) -> int | None:
    """Return the smallest wait in p, free meanwhile, after which the link (and the landing) can be flown."""
    for wait in range(limit_ms + 1):
        s = arrival + wait
        if not traffic.is_free(p, s, s):
            return None
        n_arrival = s + link.ms
        can_land = link.to != traffic.request.destination or traffic.is_free(
            link.to, n_arrival, n_arrival + traffic.dwell_ms
        )
        if can_land and traffic.is_link_free(p, link, s):
            return wait
    return None


def _visits(traffic: _Traffic, close_list: dict[int, _Node]) -> list[Visit]:
    """Follow the parents back from the destination; the first arrival is the end of the first dwell."""
    block = traffic.request.destination
    node = close_list[block]
    visits = [Visit(block, node.G, node.G + traffic.dwell_ms)]
    while node.parent is not None:
        (link,) = (link for link in traffic.links[node.parent] if link.to == block)
        depart = node.G - link.ms
        block, node = node.parent, close_list[node.parent]
        visits.append(Visit(block, node.G, depart))
    return visits[::-1]


def _heuristic(grid: AirMatrix, request: PlanRequest) -> list[int]:
    """Return every block's lattice distance to the destination in ms.

    The lattice goes on around the grid: a climb may be fastest in a zigzag that leaves it, by a block a layer at most.
    """
    count_i, count_j, margin = grid.dimensions

    def in_lattice(block: int) -> Block:
        i, j, k = grid.block(block)
        return i + margin, j + margin, k

    distances = lattice.distances(
        request.performance.times,
        (count_i + 2 * margin, count_j + 2 * margin, margin),
        in_lattice(request.destination),
    )
    return [distances[in_lattice(block)] for block in range(grid.block_count)]
