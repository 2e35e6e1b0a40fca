"""A slow, plain twin of conformance and block status, written from their definitions, not from the service's code.

Every block is asked who has reserved it and who is in it; every aircraft is compared with every reservation.
"""

import itertools
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from app.conformance import Thresholds
from app.flight_intents import State
from app.surveillance import Aircraft, AirPicture, Flight, Path, Sighting
from planner.airmatrix import AirMatrix
from planner.airspace import BoolArray
from planner.errors import Block

OPEN = {"accepted", "activated", "nonconforming", "contingent"}


class Keeping(NamedTuple):
    """How an aircraft keeps to its plan, why not (each of these is as good a reason), and the block it is in."""

    conformance: str
    reasons: frozenset[str] = frozenset()
    block: int | None = None


class Use(NamedTuple):
    """A block's status, all reasons for it, the aircraft concerned, and the constraints that close it."""

    status: str
    reasons: frozenset[str]
    aircraft: frozenset[Aircraft]
    constraints: frozenset[str]


class _Stage(NamedTuple):
    """A stand or a link of a path: the blocks of its box, and when it lasts (ms)."""

    box: frozenset[Block]
    begins: int
    ends: int


def keeping(picture: AirPicture, grid: AirMatrix, thresholds: Thresholds) -> dict[Aircraft, Keeping]:
    """Return how each flight and each track keeps to its plan, others left aside."""
    flights = {Aircraft(sequence): flight for sequence, flight in picture.flights.items()}
    tracks = [aircraft for aircraft in picture.sightings if aircraft.track_id]
    kept = {track: _track(picture, picture.sightings[track], thresholds) for track in tracks}
    for aircraft, flight in flights.items():
        sighting = picture.sightings.get(aircraft)
        if sighting is None:
            never_seen = _is_expected(picture, flight, thresholds)
            kept[aircraft] = Keeping("unseen", frozenset({"not_seen"} if never_seen else ()))
        elif _stands(flight, sighting):
            kept[aircraft] = _standing(picture, flight, sighting, thresholds)
        else:
            kept[aircraft] = _flying(picture, flight, sighting, grid, thresholds)
    return kept


def uses(picture: AirPicture, kept: dict[Aircraft, Keeping], occupied: BoolArray) -> dict[int, Use]:
    """Return the status of each block that is not idle."""
    used = {}
    for block in range(len(occupied)):
        reserved_by = [
            Aircraft(sequence)
            for held, enter, leave, sequence in _reservations(picture)
            if held == block and enter <= picture.at_ms < leave
        ]
        inside = {aircraft for aircraft, how in kept.items() if how.block == block}
        if not reserved_by and not inside:
            continue
        red, yellow = set(), set()
        if len(inside) >= 2:
            red.add("several_aircraft")
        if reserved_by and inside - set(reserved_by):
            red.add("reserved_by_another")
        if inside and occupied[block]:
            red.add("in_building")
        closed_by = {constraint.id for constraint in picture.constraints if block in constraint.blocks.tolist()}
        if inside and closed_by:
            red.add("in_constraint")
        if inside and not reserved_by:
            yellow.add("unplanned_use")
        for holder in reserved_by:
            if kept[holder].conformance != "conforming":
                yellow |= kept[holder].reasons
            if picture.flights[holder.sequence].state is State.CONTINGENT and not picture.is_forecast:
                yellow.add("contingent")
        status = "red" if red else "yellow" if yellow else "green"
        concerned = frozenset(inside | set(reserved_by))
        used[block] = Use(status, frozenset(red | yellow), concerned, frozenset(closed_by))
    return used


def _track(picture: AirPicture, sighting: Sighting, thresholds: Thresholds) -> Keeping:
    if sighting.airborne is False:
        return Keeping("conforming")
    if not _is_fresh(picture, sighting, thresholds):
        return Keeping("lost", frozenset({"lost"}))
    return Keeping("deviating", frozenset({"no_flight_intent"}), sighting.block)


def _flying(
    picture: AirPicture, flight: Flight, sighting: Sighting, grid: AirMatrix, thresholds: Thresholds
) -> Keeping:
    """Compare a newest fresh position with the flight's reservations at the position's own time."""
    path, tolerance = flight.path, thresholds.tolerance_ms
    if not _is_fresh(picture, sighting, thresholds):
        has_landed = path is not None and (
            sighting.block == path.blocks[-1]
            and sighting.time_ms >= path.arrive_ms[0]
            and picture.at_ms > path.depart_ms[-1] + tolerance
        )
        return Keeping("conforming") if has_landed else Keeping("lost", frozenset({"lost"}))
    if path is not None and _is_on_its_own(picture, flight, sighting, thresholds):
        is_unactivated = flight.state in OPEN and flight.activated_ms is None
        return Keeping(
            "conforming", frozenset({"not_activated"} if is_unactivated else ()), _on_trajectory(path, picture.at_ms)
        )
    place = None if _is_at_an_end(flight, sighting) else sighting.block
    return Keeping("deviating", frozenset(_ways_off(flight, sighting, grid, tolerance)), place)


def _standing(picture: AirPicture, flight: Flight, sighting: Sighting, thresholds: Thresholds) -> Keeping:
    """Judge an aircraft on the ground: it is in no block, but it may be overdue on its pad, or on a wrong one."""
    path = flight.path
    if path is None or flight.state not in OPEN:
        return Keeping("conforming")
    departure = path.arrive_ms[0]
    if sighting.time_ms >= departure and sighting.block == path.blocks[-1]:
        return Keeping("conforming")
    is_fresh = _is_fresh(picture, sighting, thresholds)
    if is_fresh and (sighting.time_ms < departure or _is_on_its_own(picture, flight, sighting, thresholds)):
        return Keeping("conforming")
    if sighting.time_ms >= departure and sighting.block != path.blocks[0]:
        return Keeping("deviating", frozenset({"off_track"}))
    if is_fresh:
        return Keeping("deviating", frozenset({"late"}))
    is_missed = _is_expected(picture, flight, thresholds)
    return Keeping("unseen", frozenset({"not_seen"})) if is_missed else Keeping("conforming")


def _is_on_its_own(picture: AirPicture, flight: Flight, sighting: Sighting, thresholds: Thresholds) -> bool:
    """Tell whether a position lies in a reservation of its flight at its own time, give or take the tolerance."""
    return any(
        sequence == flight.sequence and block == sighting.block
        and enter - thresholds.tolerance_ms <= sighting.time_ms < leave + thresholds.tolerance_ms
        for block, enter, leave, sequence in _reservations(picture)
    )  # fmt: skip


def _is_fresh(picture: AirPicture, sighting: Sighting, thresholds: Thresholds) -> bool:
    return sighting.time_ms >= picture.at_ms - thresholds.freshness_ms


def _is_expected(picture: AirPicture, flight: Flight, thresholds: Thresholds) -> bool:
    return (
        not picture.is_forecast
        and flight.state in OPEN
        and flight.path is not None
        and picture.at_ms > flight.path.arrive_ms[0] + thresholds.tolerance_ms
    )


def _stands(flight: Flight, sighting: Sighting) -> bool:
    return _is_at_an_end(flight, sighting) if sighting.airborne is None else not sighting.airborne


def _is_at_an_end(flight: Flight, sighting: Sighting) -> bool:
    """Tell whether a flight is in its own first block before departure, or in its last after arrival."""
    if flight.path is None:
        return False
    is_before, is_after = sighting.time_ms < flight.path.arrive_ms[0], sighting.time_ms >= flight.path.depart_ms[-1]
    at_first, at_last = (sighting.block == flight.path.blocks[end] for end in (0, -1))
    return (is_before and at_first) or (is_after and at_last)


def _on_trajectory(path: Path, time_ms: int) -> int | None:
    """Return the block whose centre is nearest on the trajectory: midway along a link, the one ahead."""
    visits = list(zip(path.blocks, path.arrive_ms, path.depart_ms, strict=True))
    if time_ms < visits[0][1] or time_ms >= visits[-1][2]:
        return None
    for block, arrive, depart in visits:
        if arrive <= time_ms <= depart:
            return block
    for (here, _, depart), (there, arrive, _) in itertools.pairwise(visits):
        if depart < time_ms < arrive:
            return here if time_ms - depart < arrive - time_ms else there
    raise AssertionError("a trajectory has no gaps")


def _ways_off(flight: Flight, sighting: Sighting, grid: AirMatrix, tolerance: int) -> Iterable[str]:
    """Return in which way a position misses the path: early or late where the path passes its block at another time,
    the nearest such time deciding; in the wrong layer where it passes above or below now; else off the track.
    """
    if flight.path is None or flight.state not in OPEN:
        return {"not_accepted"}
    if sighting.block is None:
        return {"off_track"}
    time, here = sighting.time_ms, grid.block(sighting.block)
    stages = list(_stages(flight.path, grid))
    present = [stage for stage in stages if stage.begins - tolerance <= time < stage.ends + tolerance]
    missed = [
        (stage.begins - time, "early") if time < stage.begins else (time - stage.ends, "late")
        for stage in stages
        if here in stage.box and stage not in present
    ]
    if missed:
        return {way for off, way in missed if off == min(missed)[0]}
    columns = {(i, j) for stage in present if here not in stage.box for i, j, _ in stage.box}
    return {"wrong_layer"} if here[:2] in columns else {"off_track"}


def _stages(path: Path, grid: AirMatrix) -> Iterator[_Stage]:
    visits = [(grid.block(block), arrive, depart) for block, arrive, depart in zip(
        path.blocks, path.arrive_ms, path.depart_ms, strict=True
    )]  # fmt: skip
    for block, arrive, depart in visits:
        yield _Stage(frozenset({block}), arrive, depart)
    for (here, _, depart), (there, arrive, _) in itertools.pairwise(visits):
        ranges = [{one, other} for one, other in zip(here, there, strict=True)]
        yield _Stage(frozenset((i, j, k) for i, j, k in itertools.product(*ranges)), depart, arrive)


def _reservations(picture: AirPicture) -> list[tuple[int, int, int, int]]:
    held = picture.held
    columns = held.block.tolist(), held.enter_ms.tolist(), held.exit_ms.tolist(), held.sequence.tolist()
    return list(zip(*columns, strict=True))
