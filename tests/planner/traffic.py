"""Traffic on tiny airspaces: reservations, requests, and their random generation."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from hypothesis import strategies as st

from planner.airmatrix import IntArray
from planner.airspace import Airspace, OccupancyRule
from planner.cfa_star import Performance, Planner, PlanRequest, Search
from planner.errors import Block
from planner.links import LinkTimes
from planner.path import Plan
from tests.planner.drawing import airspace_of
from tests.reference.planning import Hold, Visit, flight_time_without_traffic, link_times

SHAPES: tuple[Block, ...] = ((4, 3, 2), (4, 3, 1), (4, 2, 2), (4, 1, 2), (4, 1, 1), (3, 3, 2), (3, 2, 1), (2, 2, 2))
EITHER_RULE = st.sampled_from(OccupancyRule)
TIMES = link_times(horizontal=4, diagonal=6, vertical=4, alpha=6, beta=8)


@dataclass(frozen=True)
class Situation:
    """An airspace, what is reserved in it, and a flight to be planned there."""

    airspace: Airspace
    reservations: tuple[Hold, ...]
    request: PlanRequest

    def without_endurance(self) -> "Situation":
        """Return the same for an aircraft that can stay in the air for ever."""
        return replace(self, request=_with_endurance(self.request, None))


def planner_in(
    airspace: Airspace,
    reservations: Iterable[Hold] = (),
    search: Search = Search.SAFE_INTERVAL,
    hover_limit_ms: int = 60_000,
) -> Planner:
    """Return a planner that knows these reservations."""
    planner = Planner(airspace, search=search, hover_limit_ms=hover_limit_ms)
    for owner, hold in enumerate(reservations):
        reserve(planner, [hold], owner)
    return planner


def reserve(planner: Planner, holds: Iterable[Hold], owner: int) -> None:
    """Reserve these holds for one owner."""
    blocks, enters_ms, exits_ms = _columns(holds)
    planner.index.reserve(blocks, enters_ms, exits_ms, owner)


def release(planner: Planner, holds: Iterable[Hold]) -> None:
    """Release reservations that are exactly these holds."""
    blocks, enters_ms, exits_ms = _columns(holds)
    planner.index.release(blocks, enters_ms, exits_ms)


def flight(
    origin: int,
    destination: int,
    *,
    earliest: int = 0,
    latest: int | None = None,
    times: LinkTimes = TIMES,
    endurance_ms: int | None = None,
) -> PlanRequest:
    """Return a request, without any freedom to depart later unless `latest` gives it."""
    return PlanRequest(
        origin=origin,
        destination=destination,
        performance=Performance(times=times, endurance_ms=endurance_ms),
        earliest_departure_ms=earliest,
        latest_departure_ms=earliest if latest is None else latest,
    )


def trajectory_of(plan: Plan) -> list[Visit]:
    """Return a plan's visits."""
    return [
        Visit(*visit)
        for visit in zip(plan.block.tolist(), plan.arrive_ms.tolist(), plan.depart_ms.tolist(), strict=True)
    ]


def holds_in(plan: Plan) -> list[Hold]:
    """Return a plan's holds, in the plan's order."""
    return [
        Hold(*hold)
        for hold in zip(plan.hold_block.tolist(), plan.hold_enter_ms.tolist(), plan.hold_exit_ms.tolist(), strict=True)
    ]


def _with_endurance(request: PlanRequest, endurance_ms: int | None) -> PlanRequest:
    return replace(request, performance=Performance(request.performance.times, endurance_ms))


def _columns(holds: Iterable[Hold]) -> tuple[IntArray, IntArray, IntArray]:
    table = np.array([*holds], dtype=np.int64).reshape(-1, 3)
    blocks, enters_ms, exits_ms = np.ascontiguousarray(table.T)
    return blocks, enters_ms, exits_ms


# Random generation


@st.composite
def aircraft_times(draw: st.DrawFn) -> LinkTimes:
    """Draw link times that every multirotor obeys: a climb over a block is no faster than the level flight below."""
    half_horizontal = draw(st.integers(1, 2))
    half_diagonal = draw(st.integers(half_horizontal, 2 * half_horizontal))
    return link_times(
        horizontal=2 * half_horizontal,
        diagonal=2 * half_diagonal,
        vertical=2 * draw(st.integers(1, 4)),
        alpha=2 * draw(st.integers(half_horizontal, half_horizontal + 2)),
        beta=2 * draw(st.integers(half_diagonal, half_diagonal + 2)),
    )


@st.composite
def airspaces(draw: st.DrawFn, rules: st.SearchStrategy[OccupancyRule]) -> Airspace:
    """Draw an airspace of at most 4 x 3 x 2 blocks, two of them free at least."""
    dimensions = draw(st.sampled_from(SHAPES))
    count = dimensions[0] * dimensions[1] * dimensions[2]
    buildings = draw(st.sets(st.integers(0, count - 1), max_size=min(count - 2, 6)))
    occupied = np.zeros(count, dtype=np.bool_)
    occupied[list(buildings)] = True
    return airspace_of(
        dimensions, occupied, rule=draw(rules), terminal_dwell_ms=draw(st.sampled_from([0, 0, 0, 1, 3, 6]))
    )


@st.composite
def requests_in(draw: st.DrawFn, airspace: Airspace) -> PlanRequest:
    """Draw a flight between two free blocks, mostly far from each other, without an endurance."""
    grid = airspace.grid
    free = np.flatnonzero(~airspace.occupied).tolist()
    origin = draw(st.sampled_from(free))
    farthest_first = sorted(
        (block for block in free if block != origin),
        key=lambda block: -max(abs(a - b) for a, b in zip(grid.block(block), grid.block(origin), strict=True)),
    )
    destination = farthest_first[draw(st.one_of(st.integers(0, 2), st.integers(0, 30))) % len(farthest_first)]
    earliest = draw(st.integers(0, 8))
    return flight(
        origin,
        destination,
        earliest=earliest,
        latest=earliest + draw(st.one_of(st.just(0), st.integers(0, 12))),
        times=draw(aircraft_times()),
    )


@st.composite
def reservations_in(draw: st.DrawFn, airspace: Airspace) -> tuple[Hold, ...]:
    """Draw disjoint reservations for each free block: short ones, long ones, and ones that touch."""
    spans = st.tuples(
        st.one_of(st.integers(0, 1), st.integers(4, 16)), st.one_of(st.integers(1, 4), st.integers(4, 20))
    )
    reservations: list[Hold] = []
    for block in np.flatnonzero(~airspace.occupied).tolist():
        time = draw(st.integers(-10, 20))
        for gap, length in draw(st.lists(spans, min_size=draw(st.integers(0, 4)), max_size=6)):
            reservations.append(Hold(block, time + gap, time + gap + length))
            time += gap + length
    return tuple(reservations)


@st.composite
def situations(draw: st.DrawFn) -> Situation:
    """Draw a flight in traffic, under either rule.

    Half of the flights have to leave their first block early, or else much later, and cannot have the last one before
    some time: they wait somewhere in between. Of the others, often nobody else is ever in the first or the last block.
    """
    airspace = draw(airspaces(EITHER_RULE))
    request = draw(requests_in(airspace))
    origin, destination = request.origin, request.destination
    reservations = draw(reservations_in(airspace))
    if draw(st.booleans()):
        request = replace(request, latest_departure_ms=request.earliest_departure_ms + draw(st.integers(0, 60)))
        leave = request.earliest_departure_ms + airspace.terminal_dwell_ms + draw(st.integers(3, 12))
        at_the_ends = (
            Hold(origin, leave, leave + draw(st.integers(4, 40))),
            Hold(destination, 0, leave + draw(st.integers(0, 50))),
        )
        elsewhere = tuple(hold for hold in reservations if hold.block not in (origin, destination))
        return Situation(airspace, at_the_ends + elsewhere, request)
    quiet = draw(st.sets(st.sampled_from([origin, destination])))
    return Situation(airspace, tuple(hold for hold in reservations if hold.block not in quiet), request)


@st.composite
def situations_with_endurance(draw: st.DrawFn) -> Situation:
    """Draw a flight in traffic with about the endurance that it needs without traffic."""
    situation = draw(situations())
    needed_ms = flight_time_without_traffic(situation.airspace, situation.request) or 2
    endurance_ms = needed_ms + draw(st.one_of(st.integers(-2, 4), st.integers(0, 20)))
    return replace(situation, request=_with_endurance(situation.request, endurance_ms))
