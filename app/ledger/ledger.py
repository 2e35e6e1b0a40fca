"""The ledger: every read, and the only writes.

Writes happen in one `Transaction` at a time, which holds the database's write lock from its start. Whoever opens one
sees everything committed before it, so `sequence` and `revision` are gapless and in the order of the lock.
"""

import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from sqlalchemy import ColumnElement, Connection, Engine, and_, case, delete, func, insert, select, update
from sqlalchemy.exc import DBAPIError, IntegrityError

from app.errors import LedgerUnavailable
from app.flight_intents import FlightIntent, Refusal, Reservations, State, Submission
from app.ledger.rows import HeldReservations, by_intent, columns_of, dump_columns, to_held, to_intent, to_row
from app.ledger.tables import counters, flight_intents, idempotency_keys, journal, reservations
from planner.airmatrix import IntArray
from planner.airspace import Airspace
from planner.path import Trajectory

# Databases bound how many values a statement may name.
_BOUND_AT_ONCE = 10_000


class ReservationOverlap(Exception):
    """The database refused a reservation because it overlaps another: the caller's picture of the ledger was wrong."""


class CommitUncertain(Exception):
    """COMMIT failed or its connection died: whether the transaction is durable has to be looked up."""


@dataclass(frozen=True)
class JournalEntry:
    """One line of the append-only journal. `released` (n, 3): block, enter, exit of what the change took away."""

    revision: int
    time_ms: int
    kind: str
    intent_id: str
    sequence: int
    released: IntArray


@dataclass(frozen=True)
class IdempotencyRecord:
    """The first answer to a key: the digest of the body it came with, the intent it made, and the answer's body."""

    body_digest: str
    intent: FlightIntent
    answer: bytes


class Ledger:
    """One ledger: `transaction()` to write, everything else to read."""

    def __init__(self, writer: Engine, reader: Engine, airspace: Airspace) -> None:
        self._writer = writer
        self._reader = reader
        self._airspace = airspace

    def close(self) -> None:
        """Release all connections."""
        self._writer.dispose()
        self._reader.dispose()

    @contextmanager
    def transaction(self) -> Iterator["Transaction"]:
        """Take the write lock, and commit at the end; an exception inside undoes everything.

        Raises
        ------
        LedgerUnavailable
            A statement failed: nothing was written.
        CommitUncertain
            The COMMIT itself failed: something may have been written.
        """
        try:
            connection = self._writer.connect()
        except DBAPIError as error:
            raise LedgerUnavailable(f"the ledger cannot be opened: {error.orig}") from error
        try:
            try:
                connection.begin()
                transaction = Transaction(connection, self._airspace)
                yield transaction
                transaction.write_counters()
            except DBAPIError as error:
                connection.invalidate()
                raise LedgerUnavailable(f"the ledger cannot be written: {error.orig}") from error
            except LedgerUnavailable:
                connection.invalidate()
                raise
            except BaseException:
                connection.rollback()
                raise
            try:
                connection.commit()
            except DBAPIError as error:
                connection.invalidate()
                raise CommitUncertain(str(error.orig)) from error
        finally:
            connection.close()

    @contextmanager
    def _reading(self) -> Iterator[Connection]:
        try:
            with self._reader.begin() as connection:
                yield connection
        except DBAPIError as error:
            raise LedgerUnavailable(f"the ledger cannot be read: {error.orig}") from error

    def revision(self) -> int:
        """Return the newest revision."""
        with self._reading() as connection:
            return int(connection.execute(select(counters.c.revision)).scalar_one())

    def find(self, intent_id: str) -> FlightIntent | None:
        """Return an intent with its reservations, None if there is none."""
        with self._reading() as connection:
            return _find(connection, self._airspace, intent_id)

    def answer_to(self, operator: str, key: str) -> IdempotencyRecord | None:
        """Return the first answer to an idempotency key, None if it is new."""
        with self._reading() as connection:
            return _answer_to(connection, self._airspace, operator, key)

    def page(
        self,
        *,
        after_sequence: int,
        limit: int,
        operator: str | None = None,
        state: State | None = None,
        from_ms: int | None = None,
        to_ms: int | None = None,
    ) -> list[FlightIntent]:
        """Return up to `limit` intents by sequence; `from_ms` and `to_ms` bound flights, or their requests."""
        begins = func.coalesce(flight_intents.c.departure, flight_intents.c.earliest_departure)
        ends = func.coalesce(flight_intents.c.arrival, flight_intents.c.latest_departure)
        wanted = [
            flight_intents.c.sequence > after_sequence,
            *([flight_intents.c.operator == operator] if operator is not None else []),
            *([flight_intents.c.state == state.value] if state is not None else []),
            *([ends >= from_ms] if from_ms is not None else []),
            *([begins < to_ms] if to_ms is not None else []),
        ]
        query = select(flight_intents).where(and_(*wanted)).order_by(flight_intents.c.sequence).limit(limit)
        with self._reading() as connection:
            rows = connection.execute(query).all()
            held = _reservations(connection, self._airspace, [row.sequence for row in rows])
        return [to_intent(row, self._airspace, held[row.sequence]) for row in rows]

    def everything(self) -> tuple[list[FlightIntent], dict[int, Reservations]]:
        """Return all intents by sequence, and reservations that name an intent which does not exist, as of one moment.

        Reservations are read for themselves, not by way of the intents that should own them.
        """
        with self._reading() as connection:
            held = to_held(connection.execute(select(reservations)))
            rows = connection.execute(select(flight_intents).order_by(flight_intents.c.sequence)).all()
        owned = by_intent(held, np.unique(held.sequence).tolist(), self._airspace.grid)
        intents = [to_intent(row, self._airspace, owned.pop(row.sequence, Reservations.none())) for row in rows]
        return intents, owned

    def held_between(self, from_ms: int, to_ms: int, block: int | None = None) -> HeldReservations:
        """Return the reservations that overlap [from, to), by block and enter."""
        query = select(reservations).where(reservations.c.enter < to_ms, reservations.c.exit > from_ms)
        if block is None:
            query = query.where(_in_the_air(from_ms, to_ms))
        else:
            query = query.where(reservations.c.block == block)
        with self._reading() as connection:
            return to_held(connection.execute(query.order_by(reservations.c.block, reservations.c.enter)))

    def use_between(self, from_ms: int, to_ms: int) -> tuple[IntArray, IntArray]:
        """Return the blocks reserved within [from, to), and for how many ms of it: two arrays (n,)."""
        enter, leave = reservations.c.enter, reservations.c.exit
        ends = case((leave < to_ms, leave), else_=to_ms)
        begins = case((enter > from_ms, enter), else_=from_ms)
        query = (
            select(reservations.c.block, func.sum(ends - begins))
            .where(enter < to_ms, leave > from_ms, _in_the_air(from_ms, to_ms))
            .group_by(reservations.c.block)
            .order_by(reservations.c.block)
        )
        with self._reading() as connection:
            rows = np.array([tuple(row) for row in connection.execute(query)], dtype=np.int64).reshape(-1, 2)
        return rows[:, 0], rows[:, 1]

    def ids(self, sequences: Iterable[int]) -> dict[int, str]:
        """Return the ids of intents by their sequence numbers."""
        with self._reading() as connection:
            return _ids(connection, sequences)

    def journal_after(self, revision: int, limit: int) -> list[JournalEntry]:
        """Return up to `limit` journal entries after a revision, oldest first."""
        with self._reading() as connection:
            return _journal_after(connection, revision, limit)


class Transaction:
    """Work on the ledger under the write lock."""

    def __init__(self, connection: Connection, airspace: Airspace) -> None:
        self._connection = connection
        self._airspace = airspace
        self._sequence, self.revision, self._longest_flight_ms = connection.execute(
            select(counters.c.sequence, counters.c.revision, counters.c.longest_flight)
        ).one()
        self._begun_at = self.revision

    @contextmanager
    def savepoint(self) -> Iterator[None]:
        """Undo what happens inside if the database refuses it.

        Raises
        ------
        ReservationOverlap
        LedgerUnavailable
            Any other failure of the database: the whole transaction is lost.
        """
        before = self._sequence, self.revision, self._longest_flight_ms
        try:
            with self._connection.begin_nested():
                yield
        except IntegrityError as error:
            self._sequence, self.revision, self._longest_flight_ms = before
            raise ReservationOverlap(str(error.orig)) from error
        except DBAPIError as error:
            raise LedgerUnavailable(f"the ledger cannot be written: {error.orig}") from error
        except BaseException:
            self._sequence, self.revision, self._longest_flight_ms = before
            raise

    def record(
        self,
        *,
        intent_id: str,
        submission: Submission,
        now_ms: int,
        trajectory: Trajectory | None = None,
        reservations: Reservations | None = None,
        refusal: Refusal | None = None,
    ) -> FlightIntent:
        """Insert an intent, accepted with its reservations or rejected, under the next sequence number."""
        state = State.REJECTED if trajectory is None else State.ACCEPTED
        if trajectory is not None:
            flight_ms = trajectory.flight_time_ms
            self._longest_flight_ms = max(self._longest_flight_ms, flight_ms)
        self._advance(sequence=True)
        intent = FlightIntent(
            id=intent_id,
            sequence=self._sequence,
            version=self.revision,
            state=state,
            submission=submission,
            received_ms=now_ms,
            trajectory=trajectory,
            reservations=reservations or Reservations.none(),
            refusal=refusal,
        )
        self._connection.execute(insert(flight_intents), to_row(intent))
        self._reserve(intent.sequence, intent.reservations)
        self._append(intent, now_ms, state.value, released=None)
        return intent

    def release(self, intent: FlightIntent, state: State, now_ms: int, keep: bool) -> FlightIntent:
        """Move an intent to another state; unless `keep`, delete its reservations."""
        self._advance(sequence=False)
        released = None if keep else intent.reservations
        if released is not None:
            self._connection.execute(delete(reservations).where(reservations.c.intent == intent.sequence))
        changed = intent.changed(self.revision, state, intent.reservations if keep else Reservations.none())
        self._connection.execute(
            update(flight_intents)
            .where(flight_intents.c.sequence == intent.sequence)
            .values(state=state.value, version=self.revision)
        )
        self._append(changed, now_ms, state.value, released)
        return changed

    def find(self, intent_id: str) -> FlightIntent | None:
        """Return an intent with its reservations, None if there is none."""
        return _find(self._connection, self._airspace, intent_id)

    def ids(self, sequences: Iterable[int]) -> dict[int, str]:
        """Return the ids of intents by their sequence numbers."""
        return _ids(self._connection, sequences)

    def journal_after(self, revision: int) -> list[JournalEntry]:
        """Return all journal entries after a revision, oldest first."""
        return _journal_after(self._connection, revision, None)

    def held_after(self, time_ms: int, sequences: Sequence[int] | None = None) -> HeldReservations:
        """Return the reservations that end after a time, of all intents or of some, by intent."""
        query = select(reservations).where(reservations.c.exit > time_ms)
        if sequences is not None:
            query = query.where(reservations.c.intent.in_(sequences))
        return to_held(self._connection.execute(query.order_by(reservations.c.intent)))

    def answer_to(self, operator: str, key: str) -> IdempotencyRecord | None:
        """Return the first answer to an idempotency key, None if it is new."""
        return _answer_to(self._connection, self._airspace, operator, key)

    def remember_answer(
        self, operator: str, key: str, body_digest: str, intent: FlightIntent, answer: bytes, now_ms: int
    ) -> None:
        """Keep the first answer to an idempotency key."""
        self._connection.execute(
            insert(idempotency_keys).values(
                operator=operator, key=key, body_digest=body_digest,
                intent=intent.sequence, answer=answer.decode(), created=now_ms,
            )
        )  # fmt: skip

    def forget_answers(self, before_ms: int) -> None:
        """Drop idempotency keys first used before a time."""
        self._connection.execute(delete(idempotency_keys).where(idempotency_keys.c.created < before_ms))

    def write_counters(self) -> None:
        """Write down how far the counters have come: once, before the commit, and not where nothing has changed."""
        if self.revision == self._begun_at:
            return
        self._connection.execute(
            update(counters).values(
                sequence=self._sequence, revision=self.revision, longest_flight=self._longest_flight_ms
            )
        )

    def _advance(self, *, sequence: bool) -> None:
        self._sequence += sequence
        self.revision += 1

    def _append(self, intent: FlightIntent, now_ms: int, kind: str, released: Reservations | None) -> None:
        self._connection.execute(
            insert(journal).values(
                revision=self.revision,
                time=now_ms,
                kind=kind,
                intent=intent.sequence,
                released=None if released is None else dump_columns(*columns_of(released)),
            )
        )

    def _reserve(self, sequence: int, held: Reservations) -> None:
        """Insert reservations: the only place that does. By driver, since a hundred rows an intent are the hot path."""
        if len(held):
            block, enter, leave = (column.tolist() for column in columns_of(held))
            rows = list(zip(block, enter, leave, [sequence] * len(block), strict=True))
            self._connection.exec_driver_sql(
                'INSERT INTO reservations (block, enter, "exit", intent) VALUES (?, ?, ?, ?)', rows
            )


def _find(connection: Connection, airspace: Airspace, intent_id: str) -> FlightIntent | None:
    row = connection.execute(select(flight_intents).where(flight_intents.c.id == intent_id)).one_or_none()
    if row is None:
        return None
    return to_intent(row, airspace, _reservations(connection, airspace, [row.sequence])[row.sequence])


def _answer_to(connection: Connection, airspace: Airspace, operator: str, key: str) -> IdempotencyRecord | None:
    query = (
        select(idempotency_keys, flight_intents.c.id)
        .join(flight_intents, flight_intents.c.sequence == idempotency_keys.c.intent)
        .where(idempotency_keys.c.operator == operator, idempotency_keys.c.key == key)
    )
    row = connection.execute(query).one_or_none()
    if row is None:
        return None
    intent = _find(connection, airspace, row.id)
    assert intent is not None
    return IdempotencyRecord(row.body_digest, intent, row.answer.encode())


def _reservations(connection: Connection, airspace: Airspace, sequences: Sequence[int]) -> dict[int, Reservations]:
    """Return the reservations of some intents."""
    query = select(reservations).where(reservations.c.intent.in_(sequences))
    return by_intent(to_held(connection.execute(query)), sequences, airspace.grid)


def _in_the_air(from_ms: int, to_ms: int) -> ColumnElement[bool]:
    """Return the condition that a reservation belongs to a flight in the air within [from, to), for use with others."""
    earliest = from_ms - select(counters.c.longest_flight).scalar_subquery()
    return reservations.c.intent.in_(
        select(flight_intents.c.sequence).where(
            flight_intents.c.departure.between(earliest, to_ms), flight_intents.c.arrival >= from_ms
        )
    )


def _ids(connection: Connection, sequences: Iterable[int]) -> dict[int, str]:
    ids = {}
    unique = sorted(set(sequences))
    for start in range(0, len(unique), _BOUND_AT_ONCE):
        part = flight_intents.c.sequence.in_(unique[start : start + _BOUND_AT_ONCE])
        rows = connection.execute(select(flight_intents.c.sequence, flight_intents.c.id).where(part))
        ids.update({row.sequence: row.id for row in rows})
    return ids


def _journal_after(connection: Connection, revision: int, limit: int | None) -> list[JournalEntry]:
    query = (
        select(journal, flight_intents.c.id)
        .join(flight_intents, flight_intents.c.sequence == journal.c.intent)
        .where(journal.c.revision > revision)
        .order_by(journal.c.revision)
        .limit(limit)
    )
    return [
        JournalEntry(
            row.revision,
            row.time,
            row.kind,
            row.id,
            row.intent,
            np.array(json.loads(row.released or "[]"), dtype=np.int64).reshape(-1, 3),
        )
        for row in connection.execute(query)
    ]
