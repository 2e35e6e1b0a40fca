"""Positions of aircraft as they are reported: checked, compared with what is known, and written to the ledger."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from anyio import to_thread

from app.errors import (
    PositionInTheFuture,
    PositionOutOfOrder,
    PositionRefused,
    PositionRemote,
    PositionTooOld,
    UnknownFlight,
)
from app.ledger import Ledger, Transaction
from app.surveillance import Aircraft, Sighting, Velocity
from app.times import format_time
from app.writer import Writer
from planner.airmatrix import AirMatrix

# How far outside the airspace an aircraft may be and still concern it.
_REMOTE_M = 20_000.0
# Faster than any aircraft that flies between blocks of a city.
_IMPLAUSIBLE_MPS = 60.0
# A velocity is that between two positions as far apart as this.
_VELOCITY_BEYOND_MS, _VELOCITY_WITHIN_MS = 500, 10_000
# Metres of a degree of latitude; good to half a percent, and positions are not better.
_DEGREE_M = 111_320.0


@dataclass(frozen=True, slots=True)
class Report:
    """One position: of a flight intent, or of a track."""

    sighting: Sighting
    flight_intent_id: str | None = None
    track_id: str | None = None


@dataclass(frozen=True)
class Receipt:
    """What became of a report, an entry a position, in its order: a refusal, or whether the position is implausible."""

    entries: Sequence[PositionRefused | bool]


class Telemetry:
    """Takes positions; a process that only reads takes none."""

    def __init__(
        self,
        ledger: Ledger,
        writer: Writer,
        grid: AirMatrix,
        clock: Callable[[], int],
        *,
        ahead_ms: int,
        kept_ms: int,
    ) -> None:
        self._ledger = ledger
        self._writer = writer
        self._grid = grid
        self._clock = clock
        self._ahead_ms = ahead_ms
        self._kept_ms = kept_ms

    async def report(self, reports: Sequence[Report], operator: str | None = None) -> Receipt:
        """Record positions, of flights only an operator's own where one is given, and return when they are durable.

        What was recorded before is not recorded again, so a report may be repeated.

        Raises
        ------
        QueueFull, LedgerUnavailable, OutcomeUnknown
            Nothing is known to be recorded.
        """
        # No thread waits for the writer: there are only so many, and reads need them.
        entries, known = await to_thread.run_sync(self._known, reports, operator)
        if known:
            stored = await self._writer.perform(
                lambda transaction, now: self._store(transaction, now, known), lambda: None
            )
            for (index, _, _), entry in zip(known, stored, strict=True):
                entries[index] = entry
        return Receipt(entries)

    def _known(
        self, reports: Sequence[Report], operator: str | None
    ) -> tuple[list[PositionRefused | bool], list[tuple[int, Aircraft, Sighting]]]:
        """Return what is wrong with each position, and those with which nothing is by index, of whom and what."""
        entries = self._checked(reports)
        ids = [report.flight_intent_id for report in reports if report.flight_intent_id is not None]
        sequences = self._ledger.sequences(ids, operator)
        known: list[tuple[int, Aircraft, Sighting]] = []
        for index, report in enumerate(reports):
            if isinstance(entries[index], PositionRefused):
                continue
            if report.track_id is not None:
                known.append((index, Aircraft(0, report.track_id), report.sighting))
            elif report.flight_intent_id in sequences:
                known.append((index, Aircraft(sequences[report.flight_intent_id]), report.sighting))
            else:
                entries[index] = UnknownFlight(f"there is no flight intent {report.flight_intent_id}")
        return entries, known

    def _checked(self, reports: Sequence[Report]) -> list[PositionRefused | bool]:
        """Return what is wrong with each position by itself, False where that is nothing."""
        now = self._clock()
        x0, y0, x1, y1 = self._grid.extent_m
        x, y = self._grid.project(
            [report.sighting.lon for report in reports], [report.sighting.lat for report in reports]
        )
        with np.errstate(invalid="ignore"):
            beyond = np.hypot(np.maximum(x0 - x, x - x1).clip(0), np.maximum(y0 - y, y - y1).clip(0))
        return [
            self._flaw(report.sighting, now, distance_m)
            for report, distance_m in zip(reports, np.atleast_1d(beyond).tolist(), strict=True)
        ]

    def _flaw(self, sighting: Sighting, now: int, distance_m: float) -> PositionRefused | bool:
        taken = format_time(sighting.time_ms) if abs(sighting.time_ms - now) > self._ahead_ms else ""
        if sighting.time_ms > now + self._ahead_ms:
            return PositionInTheFuture(f"taken at {taken}, but it is {format_time(now)}")
        if sighting.time_ms < now - self._kept_ms:
            return PositionTooOld(f"taken at {taken}; positions are kept for {self._kept_ms / 3_600_000:g} h")
        if not distance_m <= _REMOTE_M or abs(sighting.alt_m) > _REMOTE_M:
            away = f"{distance_m / 1000:.0f} km" if math.isfinite(distance_m) else "far"
            return PositionRemote(f"{away} away from the airspace, at {sighting.alt_m:g} m")
        return False

    def _store(
        self, transaction: Transaction, now: int, known: Sequence[tuple[int, Aircraft, Sighting]]
    ) -> list[PositionRefused | bool]:
        newest = transaction.newest_positions(aircraft for _, aircraft, _ in known)
        entries: list[PositionRefused | bool] = []
        new: list[tuple[Aircraft, Sighting]] = []
        for _, aircraft, sighting in known:
            last = newest.get(aircraft)
            if last is not None and last.time_ms > now + self._ahead_ms:
                # Recorded while the clock was wrong: it would refuse all there is until then.
                last = None
            if last is not None and sighting.time_ms <= last.time_ms:
                is_known = _same(sighting, last)
                entries.append(last.is_implausible if is_known else _out_of_order(sighting, last))
                continue
            moved = _moved(sighting, last)
            newest[aircraft] = moved
            new.append((aircraft, moved))
            entries.append(moved.is_implausible)
        transaction.store_positions(new)
        return entries


def _same(one: Sighting, other: Sighting) -> bool:
    return (one.time_ms, one.lon, one.lat, one.alt_m, one.airborne) == (
        other.time_ms, other.lon, other.lat, other.alt_m, other.airborne,
    )  # fmt: skip


def _out_of_order(sighting: Sighting, last: Sighting) -> PositionOutOfOrder:
    taken = format_time(sighting.time_ms)
    if sighting.time_ms == last.time_ms:
        return PositionOutOfOrder(f"another position taken at {taken} is known")
    return PositionOutOfOrder(f"taken at {taken}; one taken at {format_time(last.time_ms)} is known")


def _moved(sighting: Sighting, last: Sighting | None) -> Sighting:
    """Return a position with the velocity since the last one, and whether that is one no aircraft has."""
    if last is None:
        return sighting
    if sighting.time_ms - last.time_ms < _VELOCITY_BEYOND_MS:
        # Too short a way: mostly noise.
        return replace(sighting, velocity=last.velocity)
    seconds = (sighting.time_ms - last.time_ms) / 1000
    metres = Velocity(
        (sighting.lon - last.lon) * _DEGREE_M * math.cos(math.radians(sighting.lat)),
        (sighting.lat - last.lat) * _DEGREE_M,
        sighting.alt_m - last.alt_m,
    )
    is_implausible = math.hypot(*metres) > _IMPLAUSIBLE_MPS * seconds
    velocity = None
    if seconds * 1000 <= _VELOCITY_WITHIN_MS and not is_implausible:
        velocity = Velocity(*(distance / seconds for distance in metres))
    return replace(sighting, velocity=velocity, is_implausible=is_implausible)
