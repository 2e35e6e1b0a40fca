"""Green, yellow or red: a block's reservation against the aircraft in it (paper 2.1). Pure.

Red beats yellow beats green; blocks with neither reservation nor aircraft are idle and not listed.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from app.conformance import Assessment
from app.flight_intents import State
from app.surveillance import Aircraft, AirPicture
from planner.airspace import BoolArray


class Status(StrEnum):
    """A block's status."""

    GREEN = "green"
    YELLOW = "yellow"
    RED = "red"


class Alarm(StrEnum):
    """Why a block is red."""

    SEVERAL_AIRCRAFT = "several_aircraft"
    RESERVED_BY_ANOTHER = "reserved_by_another"
    IN_BUILDING = "in_building"
    IN_CONSTRAINT = "in_constraint"


UNPLANNED_USE = "unplanned_use"


@dataclass(frozen=True, slots=True)
class BlockStatus:
    """One block in use: its status, all reasons for it, the aircraft concerned, who has reserved it first, and the ids
    of the constraints that close it.
    """

    block: int
    status: Status
    reasons: tuple[str, ...]
    aircraft: tuple[Aircraft, ...]
    constraints: tuple[str, ...] = ()


def statuses(
    picture: AirPicture, assessed: Mapping[Aircraft, Assessment], occupied: BoolArray
) -> tuple[list[BlockStatus], dict[Aircraft, Assessment]]:
    """Return the blocks in use at the picture's time, by block, and the assessments with the alarms of red blocks."""
    reserved_by = _reserved_by(picture)
    present: dict[int, list[Aircraft]] = defaultdict(list)
    for aircraft, assessment in assessed.items():
        if assessment.place is not None:
            present[assessment.place].append(aircraft)
    blocks, alarms = [], {}
    in_use = sorted(reserved_by.keys() | present.keys())
    closed_by = _closed_by(picture, in_use)
    for block in in_use:
        holder, here, closed = reserved_by.get(block), present.get(block, ()), tuple(closed_by.get(block, ()))
        red = _alarms(holder, here, is_occupied=bool(occupied[block]), is_closed=bool(closed))
        # A forecast speaks of reservations alone, whatever state a flight is in now.
        yellow = () if picture.is_forecast else _deviations(holder, here, assessed)
        status = Status.RED if red else Status.YELLOW if yellow else Status.GREEN
        concerned = dict.fromkeys([*([] if holder is None else [holder]), *here])
        blocks.append(BlockStatus(block, status, (*red, *yellow), tuple(concerned), closed))
        if red:
            alarms.update(dict.fromkeys(here, red))
    return blocks, {
        aircraft: replace(assessment, alarms=alarms[aircraft]) if aircraft in alarms else assessment
        for aircraft, assessment in assessed.items()
    }


def _reserved_by(picture: AirPicture) -> dict[int, Aircraft]:
    """Return who holds each block at the picture's time; at most one does."""
    held = picture.held
    covers = (held.enter_ms <= picture.at_ms) & (held.exit_ms > picture.at_ms)
    return {
        block: Aircraft(sequence)
        for block, sequence in zip(held.block[covers].tolist(), held.sequence[covers].tolist(), strict=True)
    }


def _closed_by(picture: AirPicture, blocks: Sequence[int]) -> dict[int, list[str]]:
    """Return the ids of the constraints that close some of these blocks, by block."""
    closed_by: dict[int, list[str]] = defaultdict(list)
    asked = np.array(blocks, dtype=np.int64)
    for constraint in picture.constraints:
        for block in asked[constraint.covers(asked)].tolist():
            closed_by[block].append(constraint.id)
    return closed_by


def _alarms(
    holder: Aircraft | None, here: Sequence[Aircraft], *, is_occupied: bool, is_closed: bool
) -> tuple[str, ...]:
    if not here:
        return ()
    return (
        *([Alarm.SEVERAL_AIRCRAFT] if len(here) > 1 else []),
        *([Alarm.RESERVED_BY_ANOTHER] if holder is not None and any(each != holder for each in here) else []),
        *([Alarm.IN_BUILDING] if is_occupied else []),
        *([Alarm.IN_CONSTRAINT] if is_closed else []),
    )


def _deviations(
    holder: Aircraft | None, here: Sequence[Aircraft], assessed: Mapping[Aircraft, Assessment]
) -> tuple[str, ...]:
    if holder is None:
        return (UNPLANNED_USE,) if here else ()
    assessment = assessed[holder]
    assert assessment.flight is not None
    contingent = (State.CONTINGENT.value,) if assessment.flight.state is State.CONTINGENT else ()
    return (*(assessment.reasons if assessment.deviates else ()), *contingent)
