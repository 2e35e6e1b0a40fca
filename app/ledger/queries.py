"""Reads that the ledger and its transactions share."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from sqlalchemy import ColumnElement, Connection, select

from app.flight_intents import FlightIntent, Reservations
from app.ledger.rows import by_intent, to_held, to_intent
from app.ledger.tables import counters, flight_intents, idempotency_keys, journal, reservations
from planner.airmatrix import IntArray
from planner.airspace import Airspace

# Databases bound how many values a statement may name.
BOUND_AT_ONCE = 10_000


@dataclass(frozen=True)
class JournalEntry:
    """One line of the append-only journal: a flight intent's new state, or what was remarked of an aircraft and why.

    `released` (n, 3): block, enter, exit of what the change took away. A track has sequence 0 and no intent id.
    """

    revision: int
    time_ms: int
    kind: str
    intent_id: str
    sequence: int
    released: IntArray
    track_id: str | None = None
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True)
class IdempotencyRecord:
    """The first answer to a key: the digest of the body it came with, the intent it made, and the answer's body."""

    body_digest: str
    intent: FlightIntent
    answer: bytes
    created_ms: int


def find(connection: Connection, airspace: Airspace, intent_id: str) -> FlightIntent | None:
    """Return an intent with its reservations, None if there is none."""
    row = connection.execute(select(flight_intents).where(flight_intents.c.id == intent_id)).one_or_none()
    if row is None:
        return None
    return to_intent(row, airspace, reservations_of(connection, airspace, [row.sequence])[row.sequence])


def answer_to(connection: Connection, airspace: Airspace, operator: str, key: str) -> IdempotencyRecord | None:
    """Return the first answer to an idempotency key, None if it is new."""
    query = (
        select(idempotency_keys, flight_intents.c.id)
        .join(flight_intents, flight_intents.c.sequence == idempotency_keys.c.intent)
        .where(idempotency_keys.c.operator == operator, idempotency_keys.c.key == key)
    )
    row = connection.execute(query).one_or_none()
    if row is None:
        return None
    intent = find(connection, airspace, row.id)
    assert intent is not None
    return IdempotencyRecord(row.body_digest, intent, row.answer.encode(), row.created)


def reservations_of(connection: Connection, airspace: Airspace, sequences: Sequence[int]) -> dict[int, Reservations]:
    """Return the reservations of some intents."""
    query = select(reservations).where(reservations.c.intent.in_(sequences))
    return by_intent(to_held(connection.execute(query)), sequences, airspace.grid)


def in_the_air(from_ms: int, to_ms: int | None) -> ColumnElement[bool]:
    """Return the condition that a reservation belongs to a flight in the air within [from, to), or at any time after
    `from`; for use with others.
    """
    departure, arrival = flight_intents.c.departure, flight_intents.c.arrival
    in_time = [departure >= from_ms - select(counters.c.longest_flight).scalar_subquery(), arrival >= from_ms]
    if to_ms is not None:
        in_time.append(departure <= to_ms)
    return reservations.c.intent.in_(select(flight_intents.c.sequence).where(*in_time))


def ids_of(connection: Connection, sequences: Iterable[int]) -> dict[int, str]:
    """Return the ids of intents by their sequence numbers."""
    ids = {}
    unique = sorted(set(sequences))
    for start in range(0, len(unique), BOUND_AT_ONCE):
        part = flight_intents.c.sequence.in_(unique[start : start + BOUND_AT_ONCE])
        rows = connection.execute(select(flight_intents.c.sequence, flight_intents.c.id).where(part))
        ids.update({row.sequence: row.id for row in rows})
    return ids


def sequences_of(connection: Connection, intent_ids: Iterable[str]) -> dict[str, int]:
    """Return the sequence numbers of intents by their ids, without those that there are not."""
    sequences = {}
    unique = sorted(set(intent_ids))
    for start in range(0, len(unique), BOUND_AT_ONCE):
        part = flight_intents.c.id.in_(unique[start : start + BOUND_AT_ONCE])
        rows = connection.execute(select(flight_intents.c.id, flight_intents.c.sequence).where(part))
        sequences.update({row.id: row.sequence for row in rows})
    return sequences


def journal_after(connection: Connection, revision: int, limit: int | None) -> list[JournalEntry]:
    """Return up to `limit` journal entries after a revision, oldest first."""
    query = select(journal).where(journal.c.revision > revision).order_by(journal.c.revision).limit(limit)
    return [
        JournalEntry(
            row.revision,
            row.time,
            row.kind,
            row.flight_intent_id,
            row.intent,
            np.array(json.loads(row.released or "[]"), dtype=np.int64).reshape(-1, 3),
            row.track_id,
            tuple(json.loads(row.reasons or "[]")),
        )
        for row in connection.execute(query)
    ]
