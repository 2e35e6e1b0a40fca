"""What the experiments measure of plans: conflicts and use of blocks (paper 4.3); beyond it, how near flights come."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from planner.airmatrix import AirMatrix, FloatArray, IntArray
from planner.airspace import Airspace
from planner.path import Plan, Trajectory

TICK_MS = 1000


def conflicts_added(plans: Sequence[Plan], *, in_whole_seconds: bool = False) -> IntArray:
    """Return how much each plan adds to the paper's conflict metric when plans are taken in order: (n,).

    The metric is the sum over blocks and one-second ticks of U(occupancy - 1), U(x) = 1 for x > 0: a block and tick
    count once, when a second flight comes. As in the paper, a flight occupies a block from its entry to its exit, both
    included. The paper does not say how these instants become seconds: `in_whole_seconds` rounds entries down and
    exits up; otherwise the ticks between them count.
    """
    count = max(len(plans), 1)
    flight, block, enter_ms, exit_ms = _holds(plans)
    leave_ms = exit_ms - 1
    if in_whole_seconds:
        first, last = enter_ms // TICK_MS, -(-leave_ms // TICK_MS)
    else:
        first, last = -(-enter_ms // TICK_MS), leave_ms // TICK_MS
    ticks = np.maximum(last - first + 1, 0)
    hold = np.repeat(np.arange(len(block)), ticks)
    tick = first[hold] + np.arange(len(hold)) - np.repeat(np.cumsum(ticks) - ticks, ticks)
    span = int(np.ptp(tick)) + 1 if len(tick) else 1
    cell = block[hold] * span + (tick - tick.min() if len(tick) else tick)
    cell, visitor = np.divmod(np.unique(cell * count + flight[hold]), count)
    again = np.append(False, cell[1:] == cell[:-1])[: len(cell)]
    second = again & ~np.append(False, again[:-1])[: len(cell)]
    added: IntArray = np.bincount(visitor[second], minlength=len(plans))
    return added


def seconds_in_use(plans: Sequence[Plan], block_count: int) -> FloatArray:
    """Return for how many seconds each block is held by these plans, in all: (blocks,)."""
    _, block, enter_ms, exit_ms = _holds(plans)
    return np.bincount(block, weights=(exit_ms - 1 - enter_ms) / 1000, minlength=block_count).astype(np.float64)


def _holds(plans: Sequence[Plan]) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    none = np.empty(0, dtype=np.int64)
    return (
        np.repeat(np.arange(len(plans)), [len(plan.hold_block) for plan in plans]),
        np.concatenate([none, *(plan.hold_block for plan in plans)]),
        np.concatenate([none, *(plan.hold_enter_ms for plan in plans)]),
        np.concatenate([none, *(plan.hold_exit_ms for plan in plans)]),
    )


@dataclass(frozen=True)
class CornerCuts:
    """Of so many `diagonal` links, so many have a building in the box that they span."""

    diagonal: int
    cut: int


def corner_cuts(airspace: Airspace, trajectories: Sequence[Trajectory]) -> CornerCuts:
    """Count the diagonal links, and those that lead past a statically occupied block of the box they span."""
    grid = airspace.grid
    none = np.empty(0, dtype=np.int64)
    near = grid.ijk(np.concatenate([none, *(trajectory.block[:-1] for trajectory in trajectories)]))
    far = grid.ijk(np.concatenate([none, *(trajectory.block[1:] for trajectory in trajectories)]))
    cut = np.zeros(len(near), dtype=np.bool_)
    for corner in np.ndindex(2, 2, 2):
        i, j, k = np.where(np.array(corner, dtype=np.bool_), far, near).T
        cut |= airspace.occupied[(k * grid.dimensions[1] + j) * grid.dimensions[0] + i]
    diagonal = (near != far).sum(axis=1) > 1
    return CornerCuts(int(diagonal.sum()), int((diagonal & cut).sum()))


@dataclass(frozen=True)
class Encounter:
    """Two flights at the instant of their least separation, to the nearest ms.

    `separation` is in blocks: the larger of horizontal distance by block side and vertical distance by block height.
    Containment promises at least 1.
    """

    time_ms: int
    separation: float
    horizontal_m: float
    vertical_m: float


def encounter(grid: AirMatrix, first: Trajectory, second: Trajectory) -> Encounter | None:
    """Return when two flights are least separated, exactly; None if they are never in the air together.

    Between the instants at which either of them begins or ends a link, their offset is linear in time and the
    separation convex: it is least at an end, where one of both distances is least, or where both are equal.
    """
    begin, end = max(first.departure_ms, second.departure_ms), min(first.arrival_ms, second.arrival_ms)
    if begin > end:
        return None
    turns = [times for flight in (first, second) for times in (flight.arrive_ms, flight.depart_ms)]
    knots = np.unique(np.clip(np.concatenate(turns), begin, end))
    lengths = np.array([grid.block_side_m, grid.block_side_m, grid.block_height_m])
    apart = (positions(grid, first, knots) - positions(grid, second, knots)) / lengths
    # A last piece of no length, so that there is one where they only touch.
    offset, drift = apart, np.diff(apart, axis=0, append=apart[-1:])
    moments = np.clip(_candidates(offset, drift), 0, 1)
    then = offset + drift * moments[:, :, None]
    horizontal, vertical = np.hypot(then[..., 0], then[..., 1]), np.abs(then[..., 2])
    separation = np.maximum(horizontal, vertical)
    moment, piece = np.unravel_index(int(separation.argmin()), separation.shape)
    length_ms = np.diff(knots, append=knots[-1:])[piece]
    return Encounter(
        time_ms=round(float(knots[piece] + moments[moment, piece] * length_ms)),
        separation=float(separation[moment, piece]),
        horizontal_m=float(horizontal[moment, piece]) * grid.block_side_m,
        vertical_m=float(vertical[moment, piece]) * grid.block_height_m,
    )


def _candidates(offset: FloatArray, drift: FloatArray) -> FloatArray:
    """Return moments of pieces (n, 3), as fractions of them, one of which has the least separation: (6, n)."""
    level, sink = (offset[:, :2] * drift[:, :2]).sum(axis=1), offset[:, 2] * drift[:, 2]
    level_speed, sink_speed = (drift[:, :2] ** 2).sum(axis=1), drift[:, 2] ** 2
    # Both distances are equal at the roots of this quadratic, whose leading coefficient may vanish or nearly so.
    square, half_linear = level_speed - sink_speed, level - sink
    constant = (offset[:, :2] ** 2).sum(axis=1) - offset[:, 2] ** 2
    root = np.sqrt(np.maximum(half_linear**2 - square * constant, 0))
    stable = -(half_linear + np.copysign(root, half_linear))
    return np.array(
        [
            np.zeros(len(offset)),
            np.ones(len(offset)),
            _quotient(-level, level_speed),
            _quotient(-sink, sink_speed),
            _quotient(stable, square),
            _quotient(constant, stable),
        ]
    )


def _quotient(dividend: FloatArray, divisor: FloatArray) -> FloatArray:
    """Divide; 0 where that is impossible."""
    quotient: FloatArray = np.divide(dividend, divisor, out=np.zeros_like(dividend), where=divisor != 0)
    return quotient


def positions(grid: AirMatrix, trajectory: Trajectory, times_ms: IntArray) -> FloatArray:
    """Return where a flight is, in metres east and north of the grid's corner and above ground: (n,) -> (n, 3)."""
    centres = grid.centres(trajectory.block) - (grid.origin_x_m, grid.origin_y_m, 0.0)
    stops = np.repeat(centres, 2, axis=0)
    moments = np.stack([trajectory.arrive_ms, trajectory.depart_ms], axis=1).ravel()
    return np.stack([np.interp(times_ms, moments, axis) for axis in stops.T], axis=1)
