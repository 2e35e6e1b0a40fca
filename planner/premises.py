"""The premises of separation: reservations are disjoint and complete, trajectories hang together.

Part of the independent checker, which `planner.separation` is the entrance to: written from the definition of
the occupancy rules, with none of the planner's code.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from planner.airmatrix import AirMatrix, IntArray
from planner.airspace import Airspace, BoolArray, OccupancyRule
from planner.errors import Block

_EVER = np.iinfo(np.int64).max // 2


@dataclass(frozen=True, eq=False)
class CheckedFlight:
    """A flight as the ledger holds it; blocks are flat indices, times int64 ms since the Unix epoch.

    The aircraft stands at the centre of `block[i]` from `arrive_ms[i]` to `depart_ms[i]`, then takes the
    straight link to the next, all (n,). Its reservations [enter, exit) are in the `hold_` arrays, all (m,).
    `held` is the span of time, both ends included, in which the trajectory is still held and judged; None
    is the whole of it. A flight that was released wholly has empty arrays.
    """

    id: str
    block: IntArray
    arrive_ms: IntArray
    depart_ms: IntArray
    hold_block: IntArray
    hold_enter_ms: IntArray
    hold_exit_ms: IntArray
    held: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if not len(self.block) == len(self.arrive_ms) == len(self.depart_ms):
            raise ValueError(f"flight {self.id}: the arrays of its trajectory differ in length")
        if not len(self.hold_block) == len(self.hold_enter_ms) == len(self.hold_exit_ms):
            raise ValueError(f"flight {self.id}: the arrays of its reservations differ in length")


class Kind(StrEnum):
    """What a violation violates."""

    OVERLAP = "overlapping reservations of a block"
    EMPTY = "reservation that ends before it begins"
    RESERVED_OUTSIDE = "reservation outside the grid"
    RESERVED_OCCUPIED = "reservation of a block with a building"
    OUTSIDE = "trajectory outside the grid"
    OCCUPIED = "trajectory through a block with a building"
    DISCONTINUOUS = "trajectory that jumps or goes back in time"
    NOT_HELD = "trajectory without a reservation"
    TOO_NEAR = "flights nearer than a block"
    BUILDING = "building nearer than half a block"


@dataclass(frozen=True)
class Violation:
    """One finding: who, where and when, from `from_ms` to `to_ms`; `detail` names distances and buildings."""

    kind: Kind
    flights: tuple[str, ...]
    block: Block
    from_ms: int
    to_ms: int
    detail: str = ""


@dataclass(frozen=True, eq=False)
class Traffic:
    """All flights in flat arrays.

    `flight`, `block`, `arrive_ms`, `depart_ms` (n,) are the stops, flight by flight; `hold_flight`,
    `hold_block`, `enter_ms`, `exit_ms` (m,) the reservations; `held_from_ms`, `held_to_ms` (flights,) what
    is judged.
    """

    ids: tuple[str, ...]
    flight: IntArray
    block: IntArray
    arrive_ms: IntArray
    depart_ms: IntArray
    hold_flight: IntArray
    hold_block: IntArray
    enter_ms: IntArray
    exit_ms: IntArray
    held_from_ms: IntArray
    held_to_ms: IntArray

    @classmethod
    def of(cls, flights: Sequence[CheckedFlight]) -> "Traffic":
        """Lay flights out in flat arrays."""
        numbers = np.arange(len(flights))
        held = np.array([flight.held or (-_EVER, _EVER) for flight in flights], dtype=np.int64).reshape(-1, 2)
        return cls(
            ids=tuple(flight.id for flight in flights),
            flight=np.repeat(numbers, [len(flight.block) for flight in flights]),
            block=_join(flight.block for flight in flights),
            arrive_ms=_join(flight.arrive_ms for flight in flights),
            depart_ms=_join(flight.depart_ms for flight in flights),
            hold_flight=np.repeat(numbers, [len(flight.hold_block) for flight in flights]),
            hold_block=_join(flight.hold_block for flight in flights),
            enter_ms=_join(flight.hold_enter_ms for flight in flights),
            exit_ms=_join(flight.hold_exit_ms for flight in flights),
            held_from_ms=held[:, 0],
            held_to_ms=held[:, 1],
        )

    @property
    def links(self) -> IntArray:
        """The stops that a link leads on from."""
        return np.flatnonzero(self.flight[1:] == self.flight[:-1])


def _join(arrays: Iterable[IntArray]) -> IntArray:
    return np.concatenate([np.empty(0, dtype=np.int64), *arrays]).astype(np.int64, casting="safe", copy=False)


def broken_rules(airspace: Airspace, traffic: Traffic) -> Iterator[Violation]:
    """Yield what is wrong with the reservations, and with the trajectories, of all flights."""
    yield from _bad_reservations(airspace, traffic)
    yield from _overlaps(airspace.grid, traffic)
    yield from _bad_stops(airspace, traffic)
    yield from _discontinuities(airspace.grid, traffic)


def _bad_reservations(airspace: Airspace, traffic: Traffic) -> Iterator[Violation]:
    inside, occupied = _standing(airspace, traffic.hold_block)
    findings = {
        Kind.RESERVED_OUTSIDE: ~inside,
        Kind.RESERVED_OCCUPIED: occupied,
        Kind.EMPTY: traffic.enter_ms >= traffic.exit_ms,
    }
    for kind, wrong in findings.items():
        for hold in np.flatnonzero(wrong).tolist():
            yield Violation(
                kind,
                (traffic.ids[traffic.hold_flight[hold]],),
                airspace.grid.block(traffic.hold_block[hold]),
                int(traffic.enter_ms[hold]),
                int(traffic.exit_ms[hold]),
            )


def _standing(airspace: Airspace, blocks: IntArray) -> tuple[BoolArray, BoolArray]:
    """Tell which blocks are inside the grid, and which of these are statically occupied: (n,) each."""
    inside = (blocks >= 0) & (blocks < airspace.grid.block_count)
    return inside, inside & airspace.occupied[np.where(inside, blocks, 0)]


def _overlaps(grid: AirMatrix, traffic: Traffic) -> Iterator[Violation]:
    """Name every reservation that overlaps earlier ones of its block, with the one of these that ends last."""
    some = np.flatnonzero(traffic.enter_ms < traffic.exit_ms)
    holds = some[np.lexsort((traffic.exit_ms[some], traffic.enter_ms[some], traffic.hold_block[some]))]
    block, enter_ms, exit_ms = traffic.hold_block[holds], traffic.enter_ms[holds], traffic.exit_ms[holds]
    # Exits ranked within a range of numbers of their block: the running maximum starts afresh in each block.
    rank = np.unique(block, return_inverse=True)[1] * len(holds) + np.unique(exit_ms, return_inverse=True)[1]
    longest = np.maximum.accumulate(rank)
    lasting = np.maximum.accumulate(np.where(rank == longest, np.arange(len(holds)), 0))
    for later in 1 + np.flatnonzero((block[1:] == block[:-1]) & (enter_ms[1:] < exit_ms[lasting[:-1]])):
        earlier = lasting[later - 1]
        flights = traffic.hold_flight[holds[[earlier, later]]]
        yield Violation(
            Kind.OVERLAP,
            tuple(traffic.ids[flight] for flight in flights),
            grid.block(block[later]),
            int(enter_ms[later]),
            int(min(exit_ms[earlier], exit_ms[later])),
        )


def _bad_stops(airspace: Airspace, traffic: Traffic) -> Iterator[Violation]:
    inside, occupied = _standing(airspace, traffic.block)
    for kind, wrong in {Kind.OUTSIDE: ~inside, Kind.OCCUPIED: occupied}.items():
        for stop in np.flatnonzero(wrong).tolist():
            yield _at_stop(airspace.grid, traffic, kind, stop)


def _at_stop(grid: AirMatrix, traffic: Traffic, kind: Kind, stop: int, detail: str = "") -> Violation:
    return Violation(
        kind,
        (traffic.ids[traffic.flight[stop]],),
        grid.block(traffic.block[stop]),
        int(traffic.arrive_ms[stop]),
        int(traffic.depart_ms[stop]),
        detail,
    )


def _discontinuities(grid: AirMatrix, traffic: Traffic) -> Iterator[Violation]:
    """Name the stops that end before they begin, and those whose link leads too far or arrives too early."""
    for stop in np.flatnonzero(traffic.depart_ms < traffic.arrive_ms).tolist():
        yield _at_stop(grid, traffic, Kind.DISCONTINUOUS, stop, "departs before it arrives")
    link = traffic.links
    step = np.abs(grid.ijk(traffic.block[link + 1]) - grid.ijk(traffic.block[link])).max(axis=1)
    for stop in link[step != 1].tolist():
        detail = f"the next block, {grid.block(traffic.block[stop + 1])}, is no neighbour"
        yield _at_stop(grid, traffic, Kind.DISCONTINUOUS, stop, detail)
    for stop in link[traffic.depart_ms[link] >= traffic.arrive_ms[link + 1]].tolist():
        detail = "arrives at the next block no later than it departs"
        yield _at_stop(grid, traffic, Kind.DISCONTINUOUS, stop, detail)


@dataclass(frozen=True, eq=False)
class _Spans:
    """n spans of time [begin, end) in which a flight needs or holds a block, all arrays (n,)."""

    flight: IntArray
    block: IntArray
    begin_ms: IntArray
    end_ms: IntArray

    @staticmethod
    def join(parts: "Sequence[_Spans]") -> "_Spans":
        return _Spans(
            np.concatenate([part.flight for part in parts]),
            np.concatenate([part.block for part in parts]),
            np.concatenate([part.begin_ms for part in parts]),
            np.concatenate([part.end_ms for part in parts]),
        )


def not_held(airspace: Airspace, traffic: Traffic) -> Iterator[Violation]:
    """Name the spans of time in which a flight is where it holds no reservation; each flight by itself."""
    stands = _Spans(traffic.flight, traffic.block, traffic.arrive_ms, traffic.depart_ms + 1)
    contained = airspace.rule is OccupancyRule.CONTAINMENT
    moves = _boxes(airspace.grid, traffic) if contained else _halves(traffic)
    needed = _Spans.join([stands, *moves])
    held = _Spans(traffic.hold_flight, traffic.hold_block, traffic.enter_ms, traffic.exit_ms)
    judged = _Spans(
        needed.flight,
        needed.block,
        np.maximum(needed.begin_ms, traffic.held_from_ms[needed.flight]),
        np.minimum(needed.end_ms, traffic.held_to_ms[needed.flight] + 1),
    )
    missing = _uncovered(judged, held)
    for flight, block, begin_ms, end_ms in zip(
        missing.flight, missing.block, missing.begin_ms, missing.end_ms, strict=True
    ):
        yield Violation(Kind.NOT_HELD, (traffic.ids[flight],), airspace.grid.block(block), int(begin_ms), int(end_ms))


def _boxes(grid: AirMatrix, traffic: Traffic) -> Iterator[_Spans]:
    """Yield what links need under containment: every block of their boxes, from departure to arrival."""
    link = traffic.links
    near, far = grid.ijk(traffic.block[link]), grid.ijk(traffic.block[link + 1])
    for corner in np.ndindex(2, 2, 2):
        other = np.array(corner, dtype=np.bool_)
        # Where a link does not lead along an axis, only one of the corners along it counts.
        own = ~(other & (near == far)).any(axis=1)
        i, j, k = np.where(other, far, near)[own].T
        stop = link[own]
        block = (k * grid.dimensions[1] + j) * grid.dimensions[0] + i
        yield _Spans(traffic.flight[stop], block, traffic.depart_ms[stop], traffic.arrive_ms[stop + 1] + 1)


def _halves(traffic: Traffic) -> Iterator[_Spans]:
    """Yield what links need by the midpoint rule: each end's block for its half, both at the midpoint."""
    link = traffic.links
    flight, depart_ms, arrive_ms = traffic.flight[link], traffic.depart_ms[link], traffic.arrive_ms[link + 1]
    middle_ms = depart_ms + (arrive_ms - depart_ms) // 2
    yield _Spans(flight, traffic.block[link], depart_ms, middle_ms + 1)
    yield _Spans(flight, traffic.block[link + 1], middle_ms, arrive_ms + 1)


def _uncovered(needed: _Spans, held: _Spans) -> _Spans:
    """Return the spans that are needed and not held, by sweeping over the times of each flight and block."""
    spans = _Spans.join([needed, held])
    some = np.flatnonzero(spans.begin_ms < spans.end_ms)
    is_need = some < len(needed.flight)
    flight, block = np.tile(spans.flight[some], 2), np.tile(spans.block[some], 2)
    time_ms = np.concatenate([spans.begin_ms[some], spans.end_ms[some]])
    opened = np.repeat([1, -1], len(some))
    order = np.lexsort((time_ms, block, flight))
    needs = np.cumsum((opened * np.tile(is_need, 2))[order])
    holds = np.cumsum((opened * np.tile(~is_need, 2))[order])
    flight, block, time_ms = flight[order], block[order], time_ms[order]
    gap = np.flatnonzero((needs[:-1] > 0) & (holds[:-1] == 0) & (time_ms[:-1] < time_ms[1:]))
    flight, block, begin_ms, end_ms = flight[gap], block[gap], time_ms[gap], time_ms[gap + 1]
    # Where needs begin or end within a gap, its pieces touch.
    touch = (flight[1:] == flight[:-1]) & (block[1:] == block[:-1]) & (begin_ms[1:] == end_ms[:-1])
    first, last = np.append(True, ~touch)[: len(gap)], np.append(~touch, True)[: len(gap)]
    return _Spans(flight[first], block[first], begin_ms[first], end_ms[last])
