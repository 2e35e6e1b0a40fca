"""Reads that the ledger and its transactions share."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from sqlalchemy import ColumnElement, Connection, Row, Select, select, text

from app.flight_intents import FlightIntent, Reservations
from app.ledger.rows import by_intent, to_held, to_intent
from app.ledger.tables import counters, flight_intents, idempotency_keys, journal, reservations
from planner.airmatrix import IntArray
from planner.airspace import Airspace

# Databases bound how many values a statement may name.
BOUND_AT_ONCE = 10_000

# As the index of flights that can be moved says it: SQLite compares conditions by their text.
ACCEPTED = text("flight_intents.state = 'accepted'")


@dataclass(frozen=True)
class JournalEntry:
    """One line of the append-only journal: a flight intent's new state, or that it is unmoved; what was remarked of an
    aircraft and why; a constraint's beginning or removal.

    Entries of one revision happened at once; `place` orders them. `released` (n, 3): block, enter, exit of what the
    change took away. Tracks and constraints have sequence 0 and no intent id. `details` says more of some kinds.
    """

    revision: int
    time_ms: int
    kind: str
    intent_id: str
    sequence: int
    released: IntArray
    track_id: str | None = None
    reasons: tuple[str, ...] = ()
    place: int = 0
    details: Mapping[str, Any] = field(default_factory=dict)


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


def find_all(connection: Connection, airspace: Airspace, sequences: Iterable[int]) -> list[FlightIntent]:
    """Return intents with their reservations, by sequence."""
    wanted = sorted(set(sequences))
    found = []
    for start in range(0, len(wanted), BOUND_AT_ONCE):
        part = wanted[start : start + BOUND_AT_ONCE]
        held = reservations_of(connection, airspace, part)
        query = select(flight_intents).where(flight_intents.c.sequence.in_(part)).order_by(flight_intents.c.sequence)
        found += [to_intent(row, airspace, held[row.sequence]) for row in connection.execute(query)]
    return found


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


def sequences_of(connection: Connection, intent_ids: Iterable[str], operator: str | None = None) -> dict[str, int]:
    """Return the sequence numbers of intents, of all or of an operator's, by those ids that there are."""
    sequences = {}
    unique = sorted(set(intent_ids))
    for start in range(0, len(unique), BOUND_AT_ONCE):
        query = select(flight_intents.c.id, flight_intents.c.sequence)
        query = query.where(flight_intents.c.id.in_(unique[start : start + BOUND_AT_ONCE]))
        rows = connection.execute(query if operator is None else query.where(flight_intents.c.operator == operator))
        sequences.update({row.id: row.sequence for row in rows})
    return sequences


def journal_after(connection: Connection, revision: int, limit: int | None) -> list[JournalEntry]:
    """Return the journal entries after a revision, oldest first: up to `limit` of them and, where that would part
    entries of one revision, those that belong to the last.
    """
    entry = journal.c
    query = select(journal).where(entry.revision > revision).order_by(entry.revision, entry.place).limit(limit)
    rows = list(connection.execute(query))
    if rows and len(rows) == limit:
        last = rows[-1]
        rest = select(journal).where(entry.revision == last.revision, entry.place > last.place).order_by(entry.place)
        rows += connection.execute(rest)
    return [_entry(row) for row in rows]


def entries_of(connection: Connection, query: Select[Any]) -> list[JournalEntry]:
    """Return the journal entries that a query asks for, oldest first."""
    rows = connection.execute(query.order_by(journal.c.revision, journal.c.place))
    return [_entry(row) for row in rows]


def _entry(row: Row[Any]) -> JournalEntry:
    return JournalEntry(
        row.revision,
        row.time,
        row.kind,
        row.flight_intent_id,
        row.intent,
        np.array(json.loads(row.released or "[]"), dtype=np.int64).reshape(-1, 3),
        row.track_id,
        tuple(json.loads(row.reasons or "[]")),
        row.place,
        json.loads(row.details or "{}"),
    )
