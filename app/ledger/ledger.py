"""The ledger: every read, and the only writes.

Writes happen in one `Transaction` at a time, which holds the database's write lock from its start. Whoever opens one
sees everything committed before it, so `sequence` and `revision` are gapless and in the order of the lock.
"""

import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, fields, replace
from itertools import takewhile
from typing import Any

import numpy as np
from sqlalchemy import ColumnElement, Connection, and_, case, delete, func, insert, select, tuple_, update
from sqlalchemy.exc import DataError, DBAPIError, IntegrityError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from app.errors import LedgerUnavailable
from app.flight_intents import FlightIntent, Refusal, Reservations, State, Submission
from app.ledger.database import Database
from app.ledger.rows import HeldReservations, by_intent, columns_of, dump_columns, joined, to_held, to_intent, to_row
from app.ledger.tables import counters, flight_intents, idempotency_keys, journal, reservations
from planner.airmatrix import IntArray
from planner.airspace import Airspace
from planner.path import Trajectory

# In a connection's notes.
_SEEN = "airmatrix has seen this database"
# Databases bound how many values a statement may name.
_BOUND_AT_ONCE = 10_000


InsertReservations = Callable[[Connection, HeldReservations], None]


class ConstraintViolated(Exception):
    """The database refused rows, such as an overlapping reservation: the caller's picture of the ledger was wrong."""


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
    created_ms: int


@dataclass(frozen=True)
class Removed:
    """What retention has removed: flights that ended before a time (None: none), journal entries up to a revision."""

    before_ms: int | None
    journal_through: int


class Ledger:
    """One ledger: `transaction()` to write, everything else to read."""

    def __init__(self, database: Database, airspace: Airspace) -> None:
        self._writer = database.engine(writes=True)
        self._reader = database.engine(writes=False)
        self._database = database
        self._airspace = airspace

    def close(self) -> None:
        """Release all connections."""
        self._database.close()
        self._writer.dispose()
        self._reader.dispose()

    def checkpoint(self) -> None:
        """Spare the writer some work that can be done beside it; call it every second or so, in a thread of its own."""
        self._database.checkpoint()

    @contextmanager
    def transaction(self) -> Iterator["Transaction"]:
        """Take the write lock, and commit at the end; an exception inside undoes everything.

        Raises
        ------
        LedgerUnavailable
            A statement failed: nothing was written.
        ConstraintViolated
            The database refused rows: nothing was written.
        CommitUncertain
            The COMMIT itself failed: something may have been written.
        """
        try:
            connection = self._writer.connect()
        except (DBAPIError, PoolTimeout) as error:
            raise LedgerUnavailable(f"the ledger cannot be opened: {cause_of(error)}") from error
        try:
            try:
                connection.begin()
                transaction = Transaction(connection, self._airspace, self._database.insert_reservations)
                yield transaction
                transaction.flush()
            except DataError as error:
                connection.rollback()
                raise ConstraintViolated(cause_of(error)) from error
            except DBAPIError as error:
                connection.invalidate()
                raise LedgerUnavailable(f"the ledger cannot be written: {cause_of(error)}") from error
            except LedgerUnavailable:
                connection.invalidate()
                raise
            except BaseException:
                connection.rollback()
                raise
            began = time.perf_counter()
            try:
                connection.commit()
                transaction.commit_s = time.perf_counter() - began
            except Exception as error:
                connection.invalidate()
                if self._database.is_undone_by(error):
                    raise LedgerUnavailable(f"the ledger cannot be written: {cause_of(error)}") from error
                raise CommitUncertain(f"the commit failed: {cause_of(error)}") from error
        finally:
            # From the commit on, nothing that fails may look as if nothing had been written.
            with suppress(Exception):
                connection.close()

    @contextmanager
    def _reading(self) -> Iterator[Connection]:
        try:
            with self._reader.begin() as connection:
                yield connection
        except (DBAPIError, PoolTimeout) as error:
            raise LedgerUnavailable(f"the ledger cannot be read: {cause_of(error)}") from error

    def revision(self) -> int:
        """Return the newest revision."""
        with self._reading() as connection:
            return int(connection.execute(select(counters.c.revision)).scalar_one())

    def removed(self) -> "Removed":
        """Return what retention has removed."""
        with self._reading() as connection:
            row = connection.execute(select(counters.c.removed_before, counters.c.journal_removed)).one()
        return Removed(row.removed_before or None, row.journal_removed)

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

    def held_between(
        self, from_ms: int, to_ms: int, block: int | None = None
    ) -> tuple[HeldReservations, dict[int, str]]:
        """Return the reservations that overlap [from, to), by block and enter, and the ids of their intents."""
        query = select(reservations).where(reservations.c.enter < to_ms, reservations.c.exit > from_ms)
        if block is None:
            query = query.where(_in_the_air(from_ms, to_ms))
        else:
            query = query.where(reservations.c.block == block)
        with self._reading() as connection:
            held = to_held(connection.execute(query.order_by(reservations.c.block, reservations.c.enter)))
            return held, _ids(connection, held.sequence.tolist())

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

    def journal_after(self, revision: int, limit: int) -> list[JournalEntry]:
        """Return up to `limit` journal entries after a revision, oldest first."""
        with self._reading() as connection:
            return _journal_after(connection, revision, limit)


class Transaction:
    """Work on the ledger under the write lock.

    New rows wait in memory until `flush`, which writes those of many intents at once; what reads them sees them.
    """

    def __init__(self, connection: Connection, airspace: Airspace, insert_reservations: InsertReservations) -> None:
        self._connection = connection
        self._airspace = airspace
        self._insert_reservations = insert_reservations
        self._counters = self._written = _Counters(*connection.execute(select(*_COUNTERS)).one())
        self._forget_pending()
        self.write_s = 0.0
        self.commit_s = 0.0

    @property
    def revision(self) -> int:
        """The newest revision, with what this transaction has added."""
        return self._counters.revision

    @property
    def journal_removed(self) -> int:
        """The revision up to which the journal has been removed."""
        return self._counters.journal_removed

    @contextmanager
    def savepoint(self) -> Iterator[None]:
        """Write what happens inside, or undo it.

        Raises
        ------
        ConstraintViolated
        LedgerUnavailable
            Any other failure of the database: the whole transaction is lost.
        """
        self.flush()
        before = self._counters
        try:
            with self._connection.begin_nested():
                yield
                self.flush()
        except DataError as error:
            self._undo(before)
            raise ConstraintViolated(cause_of(error)) from error
        except DBAPIError as error:
            raise LedgerUnavailable(f"the ledger cannot be written: {cause_of(error)}") from error
        except BaseException:
            self._undo(before)
            raise

    def _undo(self, before: "_Counters") -> None:
        self._counters = self._written = before
        self._forget_pending()

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
        """Add an intent, accepted with its reservations or rejected, under the next sequence number."""
        state = State.REJECTED if trajectory is None else State.ACCEPTED
        counters = self._counters
        self._counters = replace(
            counters,
            sequence=counters.sequence + 1,
            longest_flight=max(counters.longest_flight, 0 if trajectory is None else trajectory.flight_time_ms),
        )
        revision = self._append(self._counters.sequence, intent_id, now_ms, state, released=None)
        intent = FlightIntent(
            id=intent_id,
            sequence=self._counters.sequence,
            version=revision,
            state=state,
            submission=submission,
            received_ms=now_ms,
            trajectory=trajectory,
            reservations=reservations or Reservations.none(),
            refusal=refusal,
        )
        self._new_intents[intent_id] = intent
        return intent

    def release(self, intent: FlightIntent, state: State, now_ms: int, keep: bool) -> FlightIntent:
        """Move an intent to another state; unless `keep`, delete its reservations."""
        self.flush()
        released = None if keep else intent.reservations
        if released is not None:
            self._connection.execute(delete(reservations).where(reservations.c.intent == intent.sequence))
        revision = self._append(intent.sequence, intent.id, now_ms, state, released)
        self._connection.execute(
            update(flight_intents)
            .where(flight_intents.c.sequence == intent.sequence)
            .values(state=state.value, version=revision)
        )
        return intent.changed(revision, state, intent.reservations if keep else Reservations.none())

    def find(self, intent_id: str) -> FlightIntent | None:
        """Return an intent with its reservations, None if there is none."""
        if intent_id in self._new_intents:
            self.flush()
        return _find(self._connection, self._airspace, intent_id)

    def ids(self, sequences: Iterable[int]) -> dict[int, str]:
        """Return the ids of intents by their sequence numbers."""
        wanted = set(sequences)
        new = {intent.sequence: id_ for id_, intent in self._new_intents.items() if intent.sequence in wanted}
        return new | (_ids(self._connection, wanted - new.keys()) if wanted - new.keys() else {})

    def journal_after(self, revision: int) -> list[JournalEntry]:
        """Return all journal entries after a revision, oldest first."""
        return _journal_after(self._connection, revision, None)

    def held_after(self, time_ms: int, sequences: Sequence[int] | None = None) -> HeldReservations:
        """Return the reservations that end after a time, of all intents or of some, by intent."""
        self.flush()
        query = select(reservations).where(reservations.c.exit > time_ms)
        if sequences is not None:
            query = query.where(reservations.c.intent.in_(sequences))
        else:
            # Found by their flights: the ledger may hold years of reservations.
            query = query.where(_in_the_air(time_ms, None))
        return to_held(self._connection.execute(query.order_by(reservations.c.intent)))

    def answer_to(self, operator: str, key: str, since_ms: int) -> IdempotencyRecord | None:
        """Return the first answer to an idempotency key, None if it is new; one from before `since_ms` is dropped."""
        new = self._new_answers.get((operator, key))
        if new is not None:
            return new
        found = _answer_to(self._connection, self._airspace, operator, key)
        if found is None or found.created_ms >= since_ms:
            return found
        this = (idempotency_keys.c.operator == operator) & (idempotency_keys.c.key == key)
        self._connection.execute(delete(idempotency_keys).where(this))
        return None

    def remember_answer(
        self, operator: str, key: str, body_digest: str, intent: FlightIntent, answer: bytes, now_ms: int
    ) -> None:
        """Keep the first answer to an idempotency key."""
        self._new_answers[operator, key] = IdempotencyRecord(body_digest, intent, answer, now_ms)
        self._new_keys.append(
            {
                "operator": operator, "key": key, "body_digest": body_digest,
                "intent": intent.sequence, "answer": answer.decode(), "created": now_ms,
            }
        )  # fmt: skip

    def remove_answers(self, before_ms: int, limit: int) -> int:
        """Drop up to `limit` idempotency keys first used before a time; return how many."""
        self.flush()
        name = tuple_(idempotency_keys.c.operator, idempotency_keys.c.key)
        created = idempotency_keys.c.created
        query = select(idempotency_keys.c.operator, idempotency_keys.c.key).where(created < before_ms)
        old = [tuple(row) for row in self._connection.execute(query.order_by(created).limit(limit))]
        if old:
            self._connection.execute(delete(idempotency_keys).where(name.in_(old)))
        return len(old)

    def remove_ended(self, before_ms: int, limit: int) -> int:
        """Remove up to `limit` intents that ended before a time, with all they held; return how many.

        An intent stays while an idempotency key needs it.
        """
        self.flush()
        ends = func.coalesce(flight_intents.c.arrival, flight_intents.c.latest_departure)
        has_key = select(idempotency_keys.c.key).where(idempotency_keys.c.intent == flight_intents.c.sequence).exists()
        query = select(flight_intents.c.sequence).where(ends < before_ms, ~has_key).order_by(ends).limit(limit)
        sequences = list(self._connection.execute(query).scalars())
        if sequences:
            self._connection.execute(delete(reservations).where(reservations.c.intent.in_(sequences)))
            self._connection.execute(delete(flight_intents).where(flight_intents.c.sequence.in_(sequences)))
            removed_before = max(self._counters.removed_before, before_ms)
            self._counters = replace(self._counters, removed_before=removed_before)
        return len(sequences)

    def remove_journal(self, before_ms: int, limit: int) -> int:
        """Remove up to `limit` of the oldest journal entries, if they are from before a time; return how many."""
        self.flush()
        query = select(journal.c.revision, journal.c.time).order_by(journal.c.revision).limit(limit)
        old = list(takewhile(lambda row: row.time < before_ms, self._connection.execute(query).all()))
        # The newest entry stays: its time tells how far the ledger's own time has come.
        if old and old[-1].revision == self.revision:
            old.pop()
        if old:
            self._counters = replace(self._counters, journal_removed=old[-1].revision)
            self.flush()
            self._connection.execute(delete(journal).where(journal.c.revision <= old[-1].revision))
        return len(old)

    def newest_change(self) -> int | None:
        """Return when the newest change was recorded, None if there has been none."""
        query = select(journal.c.time).order_by(journal.c.revision.desc()).limit(1)
        return self._connection.execute(query).scalar_one_or_none()

    @property
    def on_new_connection(self) -> bool:
        """Whether nobody has called `seen` on this connection: it may lead to another database than before."""
        return _SEEN not in self._connection.info

    def seen(self) -> None:
        """Take down that what this connection leads to is known."""
        self._connection.info[_SEEN] = True

    def touch(self) -> None:
        """Write something that changes nothing: a commit that succeeds proves that the ledger can be written."""
        touch(self._connection)

    def flush(self) -> None:
        """Write the rows that wait, and how far the counters have come; raises `ConstraintViolated`."""
        if self._counters == self._written:
            return
        began = time.perf_counter()
        intents = list(self._new_intents.values())
        try:
            if intents:
                self._connection.execute(insert(flight_intents), [to_row(intent) for intent in intents])
            if any(len(intent.reservations) for intent in intents):
                self._insert_reservations(self._connection, joined(intents))
            if self._new_entries:
                self._connection.execute(insert(journal), self._new_entries)
            if self._new_keys:
                self._connection.execute(insert(idempotency_keys), self._new_keys)
            self._connection.execute(update(counters).values(asdict(self._counters)))
        except IntegrityError as error:
            raise ConstraintViolated(cause_of(error)) from error
        self._written = self._counters
        self._forget_pending()
        self.write_s += time.perf_counter() - began

    def _forget_pending(self) -> None:
        self._new_intents: dict[str, FlightIntent] = {}
        self._new_entries: list[dict[str, Any]] = []
        self._new_keys: list[dict[str, Any]] = []
        self._new_answers: dict[tuple[str, str], IdempotencyRecord] = {}

    def _append(self, sequence: int, intent_id: str, now_ms: int, kind: State, released: Reservations | None) -> int:
        """Add a journal entry under the next revision, and return that."""
        self._counters = replace(self._counters, revision=self._counters.revision + 1)
        self._new_entries.append(
            {
                "revision": self.revision,
                "time": now_ms,
                "kind": kind.value,
                "intent": sequence,
                "flight_intent_id": intent_id,
                "released": None if released is None else dump_columns(*columns_of(released)),
            }
        )
        return self.revision


@dataclass(frozen=True)
class _Counters:
    """The one row of `counters`."""

    sequence: int
    revision: int
    longest_flight: int
    removed_before: int
    journal_removed: int


_COUNTERS = [counters.c[field.name] for field in fields(_Counters)]


def touch(connection: Connection) -> None:
    """Change a row and change it back: SQLite writes nothing for an update to what is there already."""
    for step in (1, -1):
        connection.execute(update(counters).values(revision=counters.c.revision + step))


def cause_of(error: BaseException) -> str:
    """Return what a database says in one line."""
    return " ".join(str(getattr(error, "orig", None) or error).split())


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
    return IdempotencyRecord(row.body_digest, intent, row.answer.encode(), row.created)


def _reservations(connection: Connection, airspace: Airspace, sequences: Sequence[int]) -> dict[int, Reservations]:
    """Return the reservations of some intents."""
    query = select(reservations).where(reservations.c.intent.in_(sequences))
    return by_intent(to_held(connection.execute(query)), sequences, airspace.grid)


def _in_the_air(from_ms: int, to_ms: int | None) -> ColumnElement[bool]:
    """Return the condition that a reservation belongs to a flight in the air within [from, to), or at any time after
    `from`; for use with others.
    """
    departure, arrival = flight_intents.c.departure, flight_intents.c.arrival
    in_time = [departure >= from_ms - select(counters.c.longest_flight).scalar_subquery(), arrival >= from_ms]
    if to_ms is not None:
        in_time.append(departure <= to_ms)
    return reservations.c.intent.in_(select(flight_intents.c.sequence).where(*in_time))


def _ids(connection: Connection, sequences: Iterable[int]) -> dict[int, str]:
    ids = {}
    unique = sorted(set(sequences))
    for start in range(0, len(unique), _BOUND_AT_ONCE):
        part = flight_intents.c.sequence.in_(unique[start : start + _BOUND_AT_ONCE])
        rows = connection.execute(select(flight_intents.c.sequence, flight_intents.c.id).where(part))
        ids.update({row.sequence: row.id for row in rows})
    return ids


def _journal_after(connection: Connection, revision: int, limit: int | None) -> list[JournalEntry]:
    query = select(journal).where(journal.c.revision > revision).order_by(journal.c.revision).limit(limit)
    return [
        JournalEntry(
            row.revision,
            row.time,
            row.kind,
            row.flight_intent_id,
            row.intent,
            np.array(json.loads(row.released or "[]"), dtype=np.int64).reshape(-1, 3),
        )
        for row in connection.execute(query)
    ]
