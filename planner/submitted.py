"""Paths that operators bring themselves: trajectories and 4D volumes, checked, with the blocks they hold."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from planner.airmatrix import AirMatrix, IntArray
from planner.airspace import Airspace, BoolArray
from planner.cfa_star import Performance, Planner, PlanRequest
from planner.errors import (
    BeyondEndurance,
    DwellTooShort,
    EntryOutside,
    InBuilding,
    NoPlan,
    NotAChain,
    NotFlyable,
    NotPlannable,
    OutOfOrder,
    OutOfReach,
    PathRefused,
    SameBlock,
    TooFast,
    TooLong,
)
from planner.holds import flat_index, in_order, links_of, merged, needed
from planner.kernels.intervals import COUNT, ENTER, EXIT, FIRST, OWNER, ended_by
from planner.links import DIRECTIONS
from planner.occupancy import OccupancyIndex
from planner.path import Plan

MAX_ENTRIES = 5_000
MAX_CONFLICTS = 100

# Beyond any departure that a search looks for after the window it was given.
_WAY_OFF_MS = 1 << 32

# Block, enter, exit.
_Volumes = tuple[IntArray, IntArray, IntArray]

_Finding = tuple[BoolArray, type[PathRefused], Callable[[int], str]]


@dataclass(frozen=True, eq=False)
class SubmittedPath:
    """A path and what it holds. Times are int64 ms, blocks flat indices.

    `block`, `arrive_ms`, `depart_ms` (n,) as in `planner.path.Trajectory`; `hold_*` (m,): half-open holds [enter,
    exit), disjoint in each block, sorted by enter, then i, j, k.
    """

    block: IntArray
    arrive_ms: IntArray
    depart_ms: IntArray
    hold_block: IntArray
    hold_enter_ms: IntArray
    hold_exit_ms: IntArray

    @property
    def departure_ms(self) -> int:
        """Start of the first stop and of the first hold."""
        return int(self.arrive_ms[0])

    def plan(self, unconstrained_ms: int, terminal_dwell_ms: int) -> Plan:
        """Return it as the plan of a flight that would take so long without traffic; no search was needed for it."""
        return Plan(
            block=self.block,
            arrive_ms=self.arrive_ms,
            depart_ms=self.depart_ms,
            hold_block=self.hold_block,
            hold_enter_ms=self.hold_enter_ms,
            hold_exit_ms=self.hold_exit_ms,
            earliest_departure_ms=self.departure_ms,
            slot_opens_ms=self.departure_ms,
            unconstrained_ms=unconstrained_ms,
            terminal_dwell_ms=terminal_dwell_ms,
            expansions=0,
            static_expansions=0,
            interval_visits=0,
            is_submitted=True,
        )


class Conflict(NamedTuple):
    """A half-open interval [enter, exit) in which somebody else has a block; a closure's owner is negative."""

    block: int
    enter_ms: int
    exit_ms: int
    owner: int


@dataclass(frozen=True)
class Conflicts:
    """The first conflicts of a path, by enter, then i, j, k, and how many there are in all."""

    first: tuple[Conflict, ...]
    count: int


class PathConflicts(NoPlan):
    """Others have blocks that a path would hold.

    `proposal` is a plan from its first to its last block that would do, None if there is none, and `moves` are the
    owners that would have to make way for it.
    """

    reason = "path_conflicts"

    def __init__(self, found: Conflicts, proposal: Plan | None, moves: tuple[int, ...] = ()) -> None:
        blocks = "a block" if found.count == 1 else f"{found.count} times a block"
        super().__init__(
            f"others have {blocks} that the path would hold",
            tuple(dict.fromkeys(conflict.owner for conflict in found.first)),
        )
        self.found = found
        self.proposal = proposal
        self.moves = moves


def trajectory_path(
    airspace: Airspace,
    performance: Performance,
    blocks: IntArray,
    arrive_ms: IntArray,
    depart_ms: IntArray,
    *,
    longest_ms: int,
) -> SubmittedPath:
    """Check a trajectory and return it with its holds.

    The aircraft is in the centre of each of `blocks` (n, 3), i, j, k, from `arrive_ms` (n,) to `depart_ms` (n,), and
    takes the straight link to the next: as slowly as it likes, but no faster than it is planned with. From the first
    moment to the last no more than `longest_ms` pass.

    Raises
    ------
    PathRefused
        For the first entry that breaks a rule.
    """
    _check_trajectory(airspace, performance, blocks, arrive_ms, depart_ms, longest_ms)
    held, enter_ms, exit_ms, entry = needed(airspace.rule, blocks, arrive_ms, depart_ms)
    hold_block = flat_index(airspace.grid, held)
    inside_building = airspace.occupied[hold_block]
    if inside_building.any():
        first = int(np.argmin(np.where(inside_building, entry, len(blocks))))
        message = f"block {held[first].tolist()}, which the flight must hold, is occupied by a building"
        raise InBuilding(message, int(entry[first]))
    holds = in_order(airspace.grid, *merged(hold_block, enter_ms, exit_ms, touching=False))
    return SubmittedPath(flat_index(airspace.grid, blocks), arrive_ms, depart_ms, *holds)


def volumes_path(
    airspace: Airspace,
    performance: Performance,
    origin: int,
    destination: int,
    blocks: IntArray,
    enter_ms: IntArray,
    exit_ms: IntArray,
    *,
    longest_ms: int,
) -> SubmittedPath:
    """Check 4D volumes and return them merged, with the trajectory of earliest arrival that stays inside them.

    Volumes are half-open intervals [enter, exit) of `blocks` (n, 3), i, j, k, within `longest_ms`. They hang together:
    from the origin's a chain leads to each, every one in a block beside the last one's and overlapping it in time. A
    flight holds nothing before departure or after arrival: so it departs when the origin's volume begins and arrives
    when the destination's ends, and stands there meanwhile. Takes time and memory as the box of blocks that the
    volumes span.

    Raises
    ------
    PathRefused
        For the first volume that breaks a rule, or `NotFlyable`.
    SameBlock
    """
    begins_ms = int(enter_ms.min())
    _refuse_first(
        [
            _outside(airspace.grid, blocks),
            (enter_ms >= exit_ms, OutOfOrder, lambda _: "the volume ends before it begins, or at once"),
            (exit_ms - begins_ms > longest_ms, TooLong, lambda _: f"the volumes span {_more_than(longest_ms)}"),
        ]
    )
    flat = flat_index(airspace.grid, blocks)
    occupied = airspace.occupied[flat]
    _refuse_first([(occupied, InBuilding, lambda n: f"block {blocks[n].tolist()} is occupied by a building")])
    volumes = merged(flat, enter_ms, exit_ms, touching=True)
    for name, end in (("origin", origin), ("destination", destination)):
        if end not in volumes[0]:
            raise NotFlyable(f"no volume is of the {name}'s block, {list(airspace.grid.block(end))}")
    belongs_to = np.searchsorted(_ordered(volumes, *volumes[:2]), _ordered(volumes, flat, enter_ms), side="right") - 1
    unreached = ~_reached(airspace.grid, origin, volumes)[belongs_to]
    chain = "no chain of volumes, each beside the one before and overlapping it in time, leads there from the origin's"
    _refuse_first([(unreached, OutOfReach, lambda _: chain)])
    block, arrive_ms, depart_ms = _way_through(airspace, performance, origin, destination, volumes)
    in_air_ms, endurance_ms = int(depart_ms[-1] - arrive_ms[0]), performance.endurance_ms
    if endurance_ms is not None and in_air_ms > endurance_ms:
        raise BeyondEndurance(
            f"the volumes last {in_air_ms / 1000:g} s, and the aircraft's endurance is {endurance_ms / 1000:g} s"
        )
    early, late = enter_ms < arrive_ms[0], exit_ms > depart_ms[-1] + 1
    _refuse_first(
        [
            (early, OutOfOrder, lambda _: "the volume begins before the origin's, from which the flight departs"),
            (late, OutOfOrder, lambda _: "the volume ends after the destination's, in which the flight arrives"),
        ]
    )
    return SubmittedPath(block, arrive_ms, depart_ms, *in_order(airspace.grid, *volumes))


def conflicts(grid: AirMatrix, index: OccupancyIndex, path: SubmittedPath) -> Conflicts:
    """Return where others already have the blocks that a path holds: exactly the overlaps."""
    table, pool, _ = index.slabs
    found: list[Conflict] = []
    for block, enter_ms, exit_ms in zip(
        path.hold_block.tolist(), path.hold_enter_ms.tolist(), path.hold_exit_ms.tolist(), strict=True
    ):
        first, count = int(table[block, FIRST]), int(table[block, COUNT])
        for slot in range(first + int(ended_by(table, pool, block, enter_ms)), first + count):
            if pool[slot, ENTER] >= exit_ms:
                break
            begins_ms, ends_ms = max(enter_ms, int(pool[slot, ENTER])), min(exit_ms, int(pool[slot, EXIT]))
            found.append(Conflict(block, begins_ms, ends_ms, int(pool[slot, OWNER])))
    found.sort(key=lambda conflict: (conflict.enter_ms, grid.block(conflict.block)))
    return Conflicts(tuple(found[:MAX_CONFLICTS]), len(found))


def _check_trajectory(
    airspace: Airspace,
    performance: Performance,
    blocks: IntArray,
    arrive_ms: IntArray,
    depart_ms: IntArray,
    longest_ms: int,
) -> None:
    count, dwell_ms = len(blocks), airspace.terminal_dwell_ms
    if count < 2:
        raise NotAChain("a trajectory has two entries at least")
    steps = np.diff(blocks, axis=0)
    after = np.append(np.iinfo(np.int64).min, depart_ms[:-1])
    stay_ms, ends = depart_ms - arrive_ms, np.isin(np.arange(count), [0, count - 1])
    _refuse_first(
        [
            _outside(airspace.grid, blocks),
            (stay_ms < 0, OutOfOrder, lambda _: "departs before it arrives"),
            (arrive_ms < after, OutOfOrder, lambda n: f"arrives before entry {n - 1} departs"),
            (np.append(False, np.abs(steps).max(axis=1) != 1), NotAChain, lambda n: _no_neighbour(blocks, n)),
            (
                ends & (stay_ms < dwell_ms),
                DwellTooShort,
                lambda n: f"stays {stay_ms[n]} ms; taking off and landing hold a block for {dwell_ms} ms",
            ),
            (depart_ms - arrive_ms[0] > longest_ms, TooLong, lambda _: f"the flight lasts {_more_than(longest_ms)}"),
        ]
    )
    planned_ms = performance.times.time[links_of(steps)]
    taken_ms = arrive_ms[1:] - depart_ms[:-1]
    endurance_ms = longest_ms if performance.endurance_ms is None else performance.endurance_ms
    _refuse_first(
        [
            (
                np.append(False, taken_ms < planned_ms),
                TooFast,
                lambda n: f"comes in {taken_ms[n - 1]} ms; the aircraft is planned with {planned_ms[n - 1]} ms",
            ),
            (
                depart_ms - arrive_ms[0] > endurance_ms,
                BeyondEndurance,
                lambda _: f"the aircraft's endurance is {endurance_ms / 1000:g} s",
            ),
        ]
    )


def _refuse_first(findings: Iterable[_Finding]) -> None:
    """Raise the error of the first entry that any finding is about; of the first finding, where several are."""
    found = [(int(np.argmax(wrong)), error, text) for wrong, error, text in findings if wrong.any()]
    if found:
        entry, error, text = min(found, key=lambda finding: finding[0])
        raise error(text(entry), entry)


def _outside(grid: AirMatrix, blocks: IntArray) -> _Finding:
    outside: BoolArray = np.any((blocks < 0) | (blocks >= np.array(grid.dimensions)), axis=1)
    return outside, EntryOutside, lambda n: f"block {blocks[n].tolist()} lies outside the airspace"


def _no_neighbour(blocks: IntArray, n: int) -> str:
    return f"block {blocks[n].tolist()} is no neighbour of {blocks[n - 1].tolist()}"


def _more_than(longest_ms: int) -> str:
    return f"more than {longest_ms / 1000:g} s, the most that a path may"


def _reached(grid: AirMatrix, origin: int, volumes: _Volumes) -> BoolArray:
    """Tell which of volumes that are sorted by block and enter a chain leads to from the origin's first: (n,)."""
    block, enter_ms, exit_ms = volumes
    blocks = grid.ijk(block)
    enters, exits = _ordered(volumes, block, enter_ms), _ordered(volumes, block, exit_ms)
    # Those that overlap one in the block beside it follow one another: from a first to before a last, by direction.
    first, last = [], []
    for step in DIRECTIONS:
        is_outside, _, _ = _outside(grid, blocks + step)
        beside = np.where(is_outside, -1, flat_index(grid, blocks + step))
        first.append(np.searchsorted(exits, _ordered(volumes, beside, enter_ms), side="right"))
        last.append(np.searchsorted(enters, _ordered(volumes, beside, exit_ms), side="left"))
    overlapping = np.stack([first, last], axis=-1).swapaxes(0, 1).tolist()
    takes_off = int(np.argmax(block == origin))
    reached, waiting = np.zeros(len(block), dtype=np.bool_), [takes_off]
    reached[takes_off] = True
    while waiting:
        for begin, end in overlapping[waiting.pop()]:
            for other in range(begin, end):
                if not reached[other]:
                    reached[other] = True
                    waiting.append(other)
    return reached


def _ordered(volumes: _Volumes, block: IntArray, time_ms: IntArray) -> IntArray:
    """Return numbers that order blocks and, within one, times from the first of some volumes to their last."""
    _, enter_ms, exit_ms = volumes
    begins_ms, ends_ms = int(enter_ms.min()), int(exit_ms.max())
    return block * (ends_ms - begins_ms + 1) + time_ms - begins_ms


def _way_through(
    airspace: Airspace,
    performance: Performance,
    origin: int,
    destination: int,
    volumes: _Volumes,
) -> tuple[IntArray, IntArray, IntArray]:
    """Search inside volumes that are sorted by block and enter; return block, arrive, depart, with the stands in the
    first and the last volume.
    """
    block, enter_ms, exit_ms = volumes
    grid = airspace.grid
    blocks = grid.ijk(block)
    lowest = blocks.min(axis=0)
    count_i, count_j, count_k = (blocks.max(axis=0) - lowest + 1).tolist()
    part = replace(grid, dimensions=(count_i, count_j, count_k))

    def within(flat: IntArray) -> IntArray:
        return flat_index(part, grid.ijk(flat) - lowest)

    occupied = np.ones(part.block_count, dtype=np.bool_)
    occupied[within(block)] = False
    planner = Planner(replace(airspace, grid=part, occupied=occupied))
    _close_outside(planner.index, within(block), enter_ms, exit_ms)
    # It departs from the origin's first volume, even if it comes by again.
    takes_off = int(np.argmax(block == origin))
    start, end = within(np.array([origin, destination])).tolist()
    request = PlanRequest(start, end, performance, int(enter_ms[takes_off]), int(exit_ms[takes_off]) - 1)
    try:
        plan = planner.plan(request)
    except SameBlock:
        raise
    except (NotPlannable, NoPlan) as error:
        raise NotFlyable("the aircraft has no way through the volumes, at its planned speed or slower") from error
    lands = int(np.argmax((block == destination) & (exit_ms > plan.arrival_ms)))
    arrive_ms, depart_ms = plan.arrive_ms.copy(), plan.depart_ms.copy()
    arrive_ms[0], depart_ms[-1] = enter_ms[takes_off], exit_ms[lands] - 1
    return flat_index(grid, part.ijk(plan.block) + lowest), arrive_ms, depart_ms


def _close_outside(index: OccupancyIndex, block: IntArray, enter_ms: IntArray, exit_ms: IntArray) -> None:
    """Reserve, of blocks with intervals sorted by block and enter, all the time outside these."""
    begins_ms, ends_ms = int(enter_ms.min()) - 1, int(exit_ms.max()) + _WAY_OFF_MS
    first = np.append(True, block[1:] != block[:-1])
    last = np.append(first[1:], True)
    index.reserve(block, np.where(first, begins_ms, np.roll(exit_ms, 1)), enter_ms, owner=0)
    index.reserve(block[last], exit_ms[last], np.full(int(last.sum()), ends_ms), owner=0)
