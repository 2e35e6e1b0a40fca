"""The ledger: every read, and the transactions in which alone it is written."""

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace

import numpy as np
from sqlalchemy import Connection, and_, case, func, select
from sqlalchemy.exc import DataError, DBAPIError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from app.constraints import Constraint
from app.errors import LedgerUnavailable
from app.flight_intents import FlightIntent, HeldReservations, Reservations, State
from app.ledger import constraints, positions, queries
from app.ledger.database import Database
from app.ledger.queries import IdempotencyRecord, JournalEntry
from app.ledger.rows import to_intent
from app.ledger.snapshot import Snapshot
from app.ledger.tables import counters, flight_intents, reservations
from app.ledger.transaction import ConstraintViolated, Transaction, cause_of
from app.ledger.webhooks import WebhookRows
from app.surveillance import AirPicture, Reach
from planner.airmatrix import IntArray
from planner.airspace import Airspace


class CommitUncertain(Exception):
    """COMMIT failed or its connection died: whether the transaction is durable has to be looked up."""


@dataclass(frozen=True)
class Removed:
    """What retention has removed: flights that ended before a time (None: none), journal entries up to a revision,
    positions that were taken before a time (None: none).
    """

    before_ms: int | None
    journal_through: int
    positions_before_ms: int | None


class Ledger:
    """One ledger: `transaction()` to write, everything else to read."""

    def __init__(self, database: Database, airspace: Airspace) -> None:
        self._writer = database.engine(writes=True)
        self._reader = database.engine(writes=False)
        self._database = database
        self._airspace = airspace
        self._known_constraints = constraints.KnownConstraints()

    def close(self) -> None:
        """Release all connections."""
        self._database.close()
        self._writer.dispose()
        self._reader.dispose()

    def checkpoint(self) -> None:
        """Spare the writer some work that can be done beside it; call it every second or so, in a thread of its own."""
        self._database.checkpoint()

    @contextmanager
    def transaction(self) -> Iterator[Transaction]:
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

    def removed(self) -> Removed:
        """Return what retention has removed."""
        with self._reading() as connection:
            row = connection.execute(select(counters)).one()
        return Removed(row.removed_before or None, row.journal_removed, row.positions_removed_before or None)

    def find(self, intent_id: str) -> FlightIntent | None:
        """Return an intent with its reservations, None if there is none."""
        with self._reading() as connection:
            return queries.find(connection, self._airspace, intent_id)

    def find_all(self, sequences: Iterable[int]) -> list[FlightIntent]:
        """Return intents with their reservations, by sequence."""
        with self._reading() as connection:
            return queries.find_all(connection, self._airspace, sequences)

    def answer_to(self, operator: str, key: str) -> IdempotencyRecord | None:
        """Return the first answer to an idempotency key, None if it is new."""
        with self._reading() as connection:
            return queries.answer_to(connection, self._airspace, operator, key)

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
            held = queries.reservations_of(connection, self._airspace, [row.sequence for row in rows])
        return [to_intent(row, self._airspace, held[row.sequence]) for row in rows]

    def everything(self) -> tuple[list[FlightIntent], dict[int, Reservations]]:
        """Return all intents by sequence, and reservations that name no intent that there is, as of one moment."""
        with self.snapshot() as snapshot:
            return snapshot.intents()

    @contextmanager
    def snapshot(self) -> Iterator[Snapshot]:
        """Read all of it, as of one moment."""
        with self._reading() as connection:
            yield Snapshot(connection, self._airspace)

    def held_between(self, from_ms: int, to_ms: int, block: int) -> tuple[HeldReservations, dict[int, str]]:
        """Return a block's reservations that overlap [from, to), by enter, and the ids of their intents."""
        with self._reading() as connection:
            held = positions.held_in(connection, [block], from_ms, to_ms)
            return held, queries.ids_of(connection, held.sequence.tolist())

    def held_in(self, blocks: IntArray, from_ms: int, to_ms: int) -> HeldReservations:
        """Return the reservations of some blocks that overlap [from, to)."""
        with self._reading() as connection:
            return positions.held_in(connection, np.unique(blocks).tolist(), from_ms, to_ms)

    def air_picture(self, at_ms: int, reach: Reach, *, is_past: bool, is_forecast: bool) -> AirPicture:
        """Return what is known of the air at a time: of the past as recorded, of the future as reserved."""
        with self._reading() as connection:
            picture = positions.air_picture(
                connection, self._airspace.grid, at_ms, reach, is_past=is_past, is_forecast=is_forecast
            )
            return replace(picture, constraints=self._known_constraints.in_force(connection, at_ms))

    def constraint(self, constraint_id: str) -> Constraint | None:
        """Return a constraint, also one that has ended or was removed; None if there is none."""
        with self._reading() as connection:
            return constraints.find(connection, constraint_id)

    def constraints_after(self, time_ms: int, *, number: int, limit: int) -> list[Constraint]:
        """Return up to `limit` constraints that are in force after a time, by number, those beyond `number`."""
        with self._reading() as connection:
            return constraints.after(connection, time_ms, number=number, limit=limit)

    def constraints_at(self, time_ms: int) -> tuple[Constraint, ...]:
        """Return the constraints in force at a time, also those that were removed since, by number."""
        with self._reading() as connection:
            return self._known_constraints.in_force(connection, time_ms)

    def unseen(self, before_ms: int, limit: int) -> int:
        """Return how many flights, up to `limit`, should have arrived before a time and were never seen."""
        with self._reading() as connection:
            return len(positions.unseen(connection, before_ms, limit))

    def sequences(self, intent_ids: Iterable[str], operator: str | None = None) -> dict[str, int]:
        """Return the sequence numbers of intents, of all or of an operator's, by those ids that there are."""
        with self._reading() as connection:
            return queries.sequences_of(connection, intent_ids, operator)

    def operator_of(self, intent_id: str) -> str | None:
        """Return whose an intent is, None if there is none."""
        query = select(flight_intents.c.operator).where(flight_intents.c.id == intent_id)
        with self._reading() as connection:
            return connection.execute(query).scalar_one_or_none()

    def ids(self, sequences: Iterable[int]) -> dict[int, str]:
        """Return the ids of intents by their sequence numbers."""
        with self._reading() as connection:
            return queries.ids_of(connection, sequences)

    def use_between(self, from_ms: int, to_ms: int) -> tuple[IntArray, IntArray]:
        """Return the blocks reserved within [from, to), and for how many ms of it: two arrays (n,)."""
        enter, leave = reservations.c.enter, reservations.c.exit
        ends = case((leave < to_ms, leave), else_=to_ms)
        begins = case((enter > from_ms, enter), else_=from_ms)
        query = (
            select(reservations.c.block, func.sum(ends - begins))
            .where(enter < to_ms, leave > from_ms, queries.in_the_air(from_ms, to_ms))
            .group_by(reservations.c.block)
            .order_by(reservations.c.block)
        )
        with self._reading() as connection:
            rows = np.array([tuple(row) for row in connection.execute(query)], dtype=np.int64).reshape(-1, 2)
        return rows[:, 0], rows[:, 1]

    @contextmanager
    def webhooks(self) -> Iterator[WebhookRows]:
        """Read webhooks, as of one moment."""
        with self._reading() as connection:
            yield WebhookRows(connection)

    def journal_after(self, revision: int, limit: int) -> list[JournalEntry]:
        """Return up to `limit` journal entries after a revision, oldest first."""
        with self._reading() as connection:
            return queries.journal_after(connection, revision, limit)
