"""Does each aircraft fly as it is reserved? A position is compared with the reservations at its own time. Pure."""

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise

import numpy as np

from app.flight_intents import OPEN_STATES, State
from app.surveillance import Aircraft, AirPicture, Flight, Path, Sighting
from planner.airmatrix import AirMatrix


class Conformance(StrEnum):
    """How an aircraft keeps to its plan; a track has none to keep to."""

    CONFORMING = "conforming"
    DEVIATING = "deviating"
    VIOLATING = "violating"
    LOST = "lost"
    UNSEEN = "unseen"


class Reason(StrEnum):
    """Why an aircraft does not simply conform."""

    OFF_TRACK = "off_track"
    WRONG_LAYER = "wrong_layer"
    EARLY = "early"
    LATE = "late"
    LOST = "lost"
    NOT_SEEN = "not_seen"
    NOT_ACTIVATED = "not_activated"
    NOT_ACCEPTED = "not_accepted"
    NO_FLIGHT_INTENT = "no_flight_intent"


@dataclass(frozen=True)
class Thresholds:
    """Milliseconds: how old a position may be to say where an aircraft is; how far a flight may be off in time; after
    how long a lost or violating flight is contingent; how far ahead a deviating aircraft is projected.
    """

    freshness_ms: int = 5_000
    tolerance_ms: int = 2_000
    contingent_after_ms: int = 30_000
    projection_ms: int = 60_000


@dataclass(frozen=True, slots=True)
class Assessment:
    """How one aircraft does at the picture's time.

    `own` is how it keeps to its plan whatever others do, `reasons` why. `place` is the block it counts in, None where
    it is in none or on the ground; `is_fresh` tells whether its position is. `alarms` are those of the red block it is
    in: then it is violating, also where somebody else is to blame.
    """

    aircraft: Aircraft
    flight: Flight | None
    sighting: Sighting | None
    own: Conformance
    reasons: tuple[str, ...] = ()
    place: int | None = None
    is_airborne: bool = False
    is_fresh: bool = False
    alarms: tuple[str, ...] = ()

    @property
    def conformance(self) -> Conformance:
        """How it does, as others see it."""
        return Conformance.VIOLATING if self.alarms else self.own

    @property
    def all_reasons(self) -> tuple[str, ...]:
        """Its own and the alarms."""
        return (*self.reasons, *self.alarms)

    @property
    def deviates(self) -> bool:
        """Tell whether it is not where it should be, or not known to be, by its own doing."""
        return self.own is not Conformance.CONFORMING and bool(self.reasons)


def assess(picture: AirPicture, grid: AirMatrix, thresholds: Thresholds) -> dict[Aircraft, Assessment]:
    """Return an assessment of each flight and track in a picture."""
    on_reservation = _on_reservation(picture, thresholds.tolerance_ms)
    assessed = {}
    for sequence, flight in picture.flights.items():
        aircraft = Aircraft(sequence)
        sighting = picture.sightings.get(aircraft)
        is_on = sequence in on_reservation
        assessed[aircraft] = _flight(picture, aircraft, flight, sighting, grid, thresholds, is_on_reservation=is_on)
    for aircraft, sighting in picture.sightings.items():
        if aircraft.track_id:
            assessed[aircraft] = _track(picture, aircraft, sighting, thresholds)
    return assessed


def _on_reservation(picture: AirPicture, tolerance_ms: int) -> set[int]:
    """Return the sequence numbers of the flights that were seen in a block of theirs, give or take the tolerance."""
    seen = [
        (aircraft.sequence, sighting.block, sighting.time_ms)
        for aircraft, sighting in picture.sightings.items()
        if aircraft.sequence and sighting.block is not None
    ]
    if not seen:
        return set()
    sequence, block, time_ms = np.array(sorted(seen), dtype=np.int64).T
    held = picture.held
    mine = np.minimum(np.searchsorted(sequence, held.sequence), len(sequence) - 1)
    covers = (
        (sequence[mine] == held.sequence)
        & (block[mine] == held.block)
        & (held.enter_ms - tolerance_ms <= time_ms[mine])
        & (time_ms[mine] < held.exit_ms + tolerance_ms)
    )
    return set(held.sequence[covers].tolist())


def _track(picture: AirPicture, aircraft: Aircraft, sighting: Sighting, thresholds: Thresholds) -> Assessment:
    is_fresh = picture.at_ms - sighting.time_ms <= thresholds.freshness_ms
    if sighting.airborne is False:
        return Assessment(aircraft, None, sighting, Conformance.CONFORMING, is_fresh=is_fresh)
    if not is_fresh:
        return Assessment(aircraft, None, sighting, Conformance.LOST, (Reason.LOST,), is_airborne=True)
    return Assessment(
        aircraft, None, sighting, Conformance.DEVIATING, (Reason.NO_FLIGHT_INTENT,), sighting.block, True, True
    )


def _flight(
    picture: AirPicture,
    aircraft: Aircraft,
    flight: Flight,
    sighting: Sighting | None,
    grid: AirMatrix,
    thresholds: Thresholds,
    *,
    is_on_reservation: bool,
) -> Assessment:
    now, tolerance_ms, path = picture.at_ms, thresholds.tolerance_ms, flight.path
    is_due = path is not None and path.arrive_ms[0] + tolerance_ms < now and not picture.is_forecast
    if sighting is None:
        reasons = (Reason.NOT_SEEN,) if is_due and flight.state in OPEN_STATES else ()
        return Assessment(aircraft, flight, None, Conformance.UNSEEN, reasons)
    is_fresh = -tolerance_ms <= now - sighting.time_ms <= thresholds.freshness_ms
    if not is_airborne(flight, sighting):
        return _on_the_ground(
            aircraft, flight, sighting, is_due=is_due, is_fresh=is_fresh, is_on_reservation=is_on_reservation
        )
    if not is_fresh:
        if path is not None and _reached_its_end(path, sighting) and now > path.depart_ms[-1] + tolerance_ms:
            return Assessment(aircraft, flight, sighting, Conformance.CONFORMING)
        return Assessment(aircraft, flight, sighting, Conformance.LOST, (Reason.LOST,), is_airborne=True)
    if path is not None and is_on_reservation:
        reasons = (Reason.NOT_ACTIVATED,) if flight.activated_ms is None and flight.state in OPEN_STATES else ()
        place = _block_at(path, now)
        return Assessment(aircraft, flight, sighting, Conformance.CONFORMING, reasons, place, True, True)
    reason = _deviation(flight, sighting, grid, tolerance_ms)
    place = None if _is_on_pad(flight, sighting) else sighting.block
    return Assessment(aircraft, flight, sighting, Conformance.DEVIATING, (reason,), place, True, True)


def _on_the_ground(
    aircraft: Aircraft, flight: Flight, sighting: Sighting, *, is_due: bool, is_fresh: bool, is_on_reservation: bool
) -> Assessment:
    own, reason = Conformance.CONFORMING, None
    path = flight.path
    if path is not None and flight.state in OPEN_STATES:
        is_before = sighting.time_ms < path.arrive_ms[0]
        has_arrived = sighting.block == path.blocks[-1] and not is_before
        is_right = has_arrived or (is_fresh and (is_before or is_on_reservation))
        if not is_right and not is_before and sighting.block != path.blocks[0]:
            own, reason = Conformance.DEVIATING, Reason.OFF_TRACK
        elif not is_right and is_fresh:
            own, reason = Conformance.DEVIATING, Reason.LATE
        elif not is_right and is_due:
            own, reason = Conformance.UNSEEN, Reason.NOT_SEEN
    return Assessment(aircraft, flight, sighting, own, () if reason is None else (reason,), is_fresh=is_fresh)


def is_airborne(flight: Flight, sighting: Sighting) -> bool:
    """Tell whether a flight's aircraft flew when it was seen: as reported, else unless it stood at one of its ends."""
    if sighting.airborne is not None:
        return sighting.airborne
    return not _is_on_pad(flight, sighting)


def _is_on_pad(flight: Flight, sighting: Sighting) -> bool:
    """Tell whether a flight was in its first block before departure, or in its last after arrival."""
    path = flight.path
    if path is None or sighting.block is None:
        return False
    before = sighting.block == path.blocks[0] and sighting.time_ms < path.arrive_ms[0]
    return before or (sighting.block == path.blocks[-1] and sighting.time_ms >= path.depart_ms[-1])


def _block_at(path: Path, time_ms: int) -> int | None:
    """Return the block that a trajectory is in at a time, None before departure and after arrival.

    From one centre to the next, the straight link leaves the one block for the other at half its time.
    """
    if not path.arrive_ms[0] <= time_ms < path.depart_ms[-1]:
        return None
    step = bisect_right(path.arrive_ms, time_ms) - 1
    if step + 1 < len(path.blocks) and 2 * time_ms >= path.depart_ms[step] + path.arrive_ms[step + 1]:
        step += 1
    return path.blocks[step]


def _deviation(flight: Flight, sighting: Sighting, grid: AirMatrix, tolerance_ms: int) -> Reason:
    """Return how a position that is in none of its flight's reservations deviates from the planned path."""
    if flight.path is None or flight.state not in OPEN_STATES:
        return Reason.NOT_ACCEPTED
    if sighting.block is None:
        return Reason.OFF_TRACK
    i, j, k = grid.block(sighting.block)
    time_ms, nearest_ms, nearest = sighting.time_ms, None, Reason.OFF_TRACK
    for (west, south, low), (east, north, high), begins, ends in _boxes(flight.path, grid):
        if not (west <= i <= east and south <= j <= north):
            continue
        is_now = begins - tolerance_ms <= time_ms < ends + tolerance_ms
        if not low <= k <= high:
            if is_now and nearest_ms is None:
                nearest = Reason.WRONG_LAYER
            continue
        off_ms = begins - time_ms if time_ms < begins else time_ms - ends
        if not is_now and (nearest_ms is None or off_ms < nearest_ms):
            nearest_ms, nearest = off_ms, Reason.EARLY if time_ms < begins else Reason.LATE
    return nearest


_Corner = tuple[int, int, int]


def _boxes(path: Path, grid: AirMatrix) -> Iterator[tuple[_Corner, _Corner, int, int]]:
    """Yield the boxes of blocks that a path passes through: lowest and highest indices, and from when to when."""
    corners = [grid.block(block) for block in path.blocks]
    for corner, arrive, depart in zip(corners, path.arrive_ms, path.depart_ms, strict=True):
        yield corner, corner, arrive, depart
    for step, (one, other) in enumerate(pairwise(corners)):
        low = (min(one[0], other[0]), min(one[1], other[1]), min(one[2], other[2]))
        high = (max(one[0], other[0]), max(one[1], other[1]), max(one[2], other[2]))
        yield low, high, path.depart_ms[step], path.arrive_ms[step + 1]


def move(assessment: Assessment, since_ms: int | None, now_ms: int, thresholds: Thresholds) -> State | None:
    """Return the state that a flight moves to by itself, None where it stays.

    `since_ms`: since when it is lost or violating, None where it is neither.
    """
    flight, sighting = assessment.flight, assessment.sighting
    if flight is None or flight.path is None or flight.state not in OPEN_STATES:
        return None
    over_ms = flight.path.depart_ms[-1] + thresholds.tolerance_ms
    if sighting is None:
        return State.ENDED if now_ms > over_ms and flight.state in (State.ACCEPTED, State.ACTIVATED) else None
    if _is_over(flight.path, assessment, now_ms, over_ms):
        return State.ENDED
    is_long = since_ms is not None and now_ms - since_ms >= thresholds.contingent_after_ms
    match flight.state:
        case State.ACCEPTED if assessment.is_airborne:
            return State.NONCONFORMING
        case State.ACTIVATED | State.NONCONFORMING if is_long and assessment.deviates:
            return State.CONTINGENT
        case State.ACTIVATED if assessment.deviates and assessment.own is not Conformance.UNSEEN:
            return State.NONCONFORMING
        case State.NONCONFORMING if flight.activated_ms is not None and not assessment.deviates:
            return State.ACTIVATED
    return None


def _is_over(path: Path, assessment: Assessment, now_ms: int, over_ms: int) -> bool:
    """Tell whether a flight that was seen is over: its aircraft was reported on the ground at its destination; or its
    arrival has passed, and the aircraft is on the ground or was last seen at its destination.
    """
    sighting = assessment.sighting
    if sighting is None:
        return False
    if sighting.airborne is False and _reached_its_end(path, sighting):
        return True
    return now_ms > over_ms and not assessment.is_airborne


def _reached_its_end(path: Path, sighting: Sighting) -> bool:
    """Tell whether a flight was seen in its last block since its departure."""
    return sighting.block == path.blocks[-1] and sighting.time_ms >= path.arrive_ms[0]
