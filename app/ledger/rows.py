"""Between the ledger's rows and flight intents."""

import json
from collections.abc import Sequence
from dataclasses import asdict, fields
from itertools import chain
from typing import Any

import numpy as np
import orjson
from sqlalchemy import CursorResult, Row

from app.errors import LedgerDamaged
from app.flight_intents import FlightIntent, HeldReservations, Position, Refusal, Reservations, State, Submission
from planner.airmatrix import AirMatrix, IntArray
from planner.airspace import Airspace
from planner.path import Trajectory

_ROWS_AT_ONCE = 10_000


def to_row(intent: FlightIntent) -> dict[str, object]:
    """Return an intent as a row of `flight_intents`."""
    submission, trajectory = intent.submission, intent.trajectory
    return {
        "sequence": intent.sequence,
        "id": intent.id,
        "version": intent.version,
        "state": intent.state.value,
        "operator": submission.operator,
        "reference": submission.reference,
        "aircraft_type": submission.aircraft_type,
        "priority": submission.priority,
        "origin": json.dumps(asdict(submission.origin)),
        "destination": json.dumps(asdict(submission.destination)),
        "origin_block": submission.origin_block,
        "destination_block": submission.destination_block,
        "earliest_departure": submission.earliest_departure_ms,
        "latest_departure": submission.latest_departure_ms,
        "received": intent.received_ms,
        "departure": None if trajectory is None else trajectory.departure_ms,
        "arrival": None if trajectory is None else trajectory.arrival_ms,
        "unconstrained": None if trajectory is None else trajectory.unconstrained_ms,
        "trajectory": None if trajectory is None else _dump_trajectory(trajectory),
        "submitted": trajectory is not None and trajectory.is_submitted,
        "refusal": None if intent.refusal is None else _dump_refusal(intent.refusal),
        "activated": intent.activated_ms,
    }


def to_intent(row: Row[Any], airspace: Airspace, held: Reservations) -> FlightIntent:
    """Return a row of `flight_intents` as an intent with these reservations; `LedgerDamaged` if it makes no sense."""
    try:
        return _parsed(row, airspace, held)
    except (ValueError, TypeError, KeyError) as error:
        raise LedgerDamaged(
            f"the ledger is damaged: flight intent {row.id}, sequence {row.sequence}, is unreadable: {error!r}"
        ) from error


def _parsed(row: Row[Any], airspace: Airspace, held: Reservations) -> FlightIntent:
    trajectory = refusal = None
    if row.trajectory is not None:
        trajectory = _load_trajectory(row.trajectory, row.unconstrained, airspace.terminal_dwell_ms, row.submitted)
    if row.refusal is not None:
        parts = json.loads(row.refusal)
        conflicts = {name: tuple(parts.get(name, ())) for name in ("conflicting_intents", "conflicting_constraints")}
        refusal = Refusal(**{**parts, **conflicts})
    return FlightIntent(
        id=row.id,
        sequence=row.sequence,
        version=row.version,
        state=State(row.state),
        submission=Submission(
            operator=row.operator,
            reference=row.reference,
            aircraft_type=row.aircraft_type,
            priority=row.priority,
            origin=Position(**json.loads(row.origin)),
            destination=Position(**json.loads(row.destination)),
            origin_block=row.origin_block,
            destination_block=row.destination_block,
            earliest_departure_ms=row.earliest_departure,
            latest_departure_ms=row.latest_departure,
        ),
        received_ms=row.received,
        trajectory=trajectory,
        reservations=held,
        refusal=refusal,
        activated_ms=row.activated,
    )


def to_held(result: CursorResult[Any]) -> HeldReservations:
    """Return rows of `reservations` as columns, in parts and past SQLAlchemy's rows: there may be millions."""
    parts = [np.empty(0, dtype=np.int64)]
    while rows := result.cursor.fetchmany(_ROWS_AT_ONCE):
        parts.append(np.fromiter(chain.from_iterable(rows), dtype=np.int64, count=4 * len(rows)))
    result.close()
    columns = np.concatenate(parts).reshape(-1, 4)
    return HeldReservations(columns[:, 0], columns[:, 1], columns[:, 2], columns[:, 3])


def joined(intents: Sequence[FlightIntent]) -> HeldReservations:
    """Return the reservations of one or more intents as columns."""
    held = [intent.reservations for intent in intents]
    sequences = np.array([intent.sequence for intent in intents], dtype=np.int64)
    return HeldReservations(
        np.concatenate([each.block for each in held]),
        np.concatenate([each.enter_ms for each in held]),
        np.concatenate([each.exit_ms for each in held]),
        np.repeat(sequences, [len(each) for each in held]),
    )


def joined_held(parts: Sequence[HeldReservations]) -> HeldReservations:
    """Return several sets of columns, or none, as one."""
    none = np.empty(0, dtype=np.int64)
    return HeldReservations(
        np.concatenate([none, *(part.block for part in parts)]),
        np.concatenate([none, *(part.enter_ms for part in parts)]),
        np.concatenate([none, *(part.exit_ms for part in parts)]),
        np.concatenate([none, *(part.sequence for part in parts)]),
    )


def by_intent(held: HeldReservations, sequences: Sequence[int], grid: AirMatrix) -> dict[int, Reservations]:
    """Return the reservations of each of these intents, sorted by enter, then i, j, k; none for who holds none."""
    i, j, k = grid.ijk(held.block).T
    order = np.lexsort((k, j, i, held.enter_ms, held.sequence))
    owner = held.sequence[order]
    parts = zip(
        sequences, np.searchsorted(owner, sequences), np.searchsorted(owner, sequences, side="right"), strict=True
    )
    return {
        sequence: Reservations(
            held.block[order[start:end]], held.enter_ms[order[start:end]], held.exit_ms[order[start:end]]
        )
        for sequence, start, end in parts
    }


def columns_of(held: Reservations) -> tuple[IntArray, IntArray, IntArray]:
    """Return block, enter and exit."""
    return held.block, held.enter_ms, held.exit_ms


def dump_columns(*columns: IntArray) -> str:
    """Return columns as a JSON list of rows."""
    return orjson.dumps(np.column_stack(columns), option=orjson.OPT_SERIALIZE_NUMPY).decode()


def _dump_trajectory(trajectory: Trajectory) -> str:
    return dump_columns(trajectory.block, trajectory.arrive_ms, trajectory.depart_ms)


def _load_trajectory(text: str, unconstrained_ms: int, terminal_dwell_ms: int, is_submitted: bool) -> Trajectory:
    block, arrive, depart = np.array(orjson.loads(text), dtype=np.int64).T.copy()
    return Trajectory(block, arrive, depart, unconstrained_ms, terminal_dwell_ms, is_submitted=is_submitted)


def _dump_refusal(refusal: Refusal) -> str:
    """Return a refusal as JSON, without what only its first answer says."""
    return json.dumps({field.name: getattr(refusal, field.name) for field in fields(Refusal)})
