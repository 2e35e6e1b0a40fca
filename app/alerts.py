"""What deviating aircraft threaten: each is projected ahead along its velocity, through the reservations of others."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from app.block_status import Status
from app.conformance import Assessment, Conformance, Thresholds
from app.flight_intents import HeldReservations
from app.surveillance import Aircraft, Sighting
from planner.airmatrix import AirMatrix, IntArray

# Radius of the earth: a minute's flight is short enough for a sphere.
_EARTH_M = 6_371_000.0


class Way(NamedTuple):
    """Blocks that an aircraft passes, each with the ms in which it enters and leaves; (n,) each."""

    block: IntArray
    enter_ms: IntArray
    leave_ms: IntArray


@dataclass(frozen=True, slots=True)
class Threat:
    """A reservation of another flight that an aircraft would enter, and when it would (ms)."""

    sequence: int
    block: int
    enter_ms: int
    exit_ms: int
    reach_ms: int


@dataclass(frozen=True, slots=True)
class Alert:
    """An aircraft that does not conform, since when, and what it threatens, soonest first."""

    assessment: Assessment
    raised_ms: int
    threats: tuple[Threat, ...]

    @property
    def severity(self) -> Status:
        """Red where it is violating, or will be if it goes on like this; else yellow."""
        is_red = self.assessment.conformance is Conformance.VIOLATING or bool(self.threats)
        return Status.RED if is_red else Status.YELLOW


def alerts(
    deviating: Iterable[tuple[Assessment, int]],
    grid: AirMatrix,
    at_ms: int,
    thresholds: Thresholds,
    held_in: Callable[[IntArray, int, int], HeldReservations],
) -> list[Alert]:
    """Return the alerts of assessments that deviate since given times, newest first.

    `held_in` returns the reservations of some blocks that overlap [from, to), by block.
    """
    until_ms = at_ms + thresholds.projection_ms
    found = list(deviating)
    ways = {
        assessment.aircraft: swept(assessment.sighting, grid, until_ms)
        for assessment, _ in found
        if assessment.sighting is not None and assessment.deviates and assessment.is_airborne and assessment.is_fresh
    }
    threats: dict[Aircraft, tuple[Threat, ...]] = {}
    if ways:
        held = held_in(np.concatenate([way.block for way in ways.values()]), at_ms, until_ms)
        threats = {aircraft: _threats(aircraft, way, held, at_ms) for aircraft, way in ways.items()}
    raised = [Alert(assessment, raised_ms, threats.get(assessment.aircraft, ())) for assessment, raised_ms in found]
    return sorted(raised, key=lambda alert: (-alert.raised_ms, alert.assessment.aircraft))


def _threats(aircraft: Aircraft, way: Way, held: HeldReservations, at_ms: int) -> tuple[Threat, ...]:
    """Return whose reservations an aircraft would enter, the soonest of each flight; `held` are by block."""
    threats: dict[int, Threat] = {}
    first = np.searchsorted(held.block, way.block, side="left").tolist()
    last = np.searchsorted(held.block, way.block, side="right").tolist()
    for step, (block, begins, ends) in enumerate(
        zip(way.block.tolist(), way.enter_ms.tolist(), way.leave_ms.tolist(), strict=True)
    ):
        for row in range(first[step], last[step]):
            sequence, enter, leave = int(held.sequence[row]), int(held.enter_ms[row]), int(held.exit_ms[row])
            reach_ms = max(begins, enter, at_ms)
            if max(enter, at_ms) < ends and leave > reach_ms and Aircraft(sequence) != aircraft:
                found = Threat(sequence, block, enter, leave, reach_ms)
                threats[sequence] = min(found, threats.get(sequence, found), key=_soonest)
    return tuple(sorted(threats.values(), key=_soonest))


def _soonest(threat: Threat) -> tuple[int, int, int]:
    return threat.reach_ms, threat.sequence, threat.block


def swept(sighting: Sighting, grid: AirMatrix, until_ms: int) -> Way:
    """Return the blocks that an aircraft passes from where it was seen until a time if its velocity stays; those
    outside the grid are left out.
    """
    seconds = max(until_ms - sighting.time_ms, 0) / 1000
    east, north, up = sighting.velocity or (0.0, 0.0, 0.0)
    degrees = np.degrees(seconds / _EARTH_M)
    lon = sighting.lon + degrees * east / np.cos(np.radians(sighting.lat))
    lat = sighting.lat + degrees * north
    x, y = grid.project([sighting.lon, lon], [sighting.lat, lat])
    lengths = np.array([grid.block_side_m, grid.block_side_m, grid.block_height_m])
    origin = np.array([grid.origin_x_m, grid.origin_y_m, 0.0])
    begin, end = (np.column_stack([x, y, [sighting.alt_m, sighting.alt_m + up * seconds]]) - origin) / lengths
    # Where the straight line crosses faces of blocks, as shares of its length.
    shares = [np.array([0.0, 1.0])]
    for start, stop in zip(begin.tolist(), end.tolist(), strict=True):
        low, high = sorted((start, stop))
        if high > low:
            shares.append((np.arange(np.ceil(low), np.floor(high) + 1) - start) / (stop - start))
    share = np.unique(np.clip(np.concatenate(shares), 0.0, 1.0))
    middle = begin + ((share[:-1] + share[1:]) / 2)[:, None] * (end - begin)
    # As where positions lie: the grid's upper faces belong to its last blocks.
    last = np.array(grid.dimensions) - 1
    inside = ((middle >= 0) & (middle <= last + 1)).all(axis=1)
    i, j, k = np.minimum(np.floor(middle[inside]), last).astype(np.int64).T
    block = (k * grid.dimensions[1] + j) * grid.dimensions[0] + i
    times_ms = sighting.time_ms + np.round(share * seconds * 1000).astype(np.int64)
    return Way(block, times_ms[:-1][inside], np.maximum(times_ms[1:][inside], times_ms[:-1][inside] + 1))
