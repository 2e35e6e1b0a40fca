"""The only writes: one transaction at a time, which holds the database's write lock from its start.

Whoever opens one sees everything committed before it, so `sequence` and `revision` are gapless and in the order of the
lock.
"""

import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from itertools import takewhile
from typing import Any, NamedTuple

import numpy as np
from sqlalchemy import Connection, bindparam, delete, func, insert, select, tuple_, update
from sqlalchemy.exc import DataError, DBAPIError, IntegrityError

from app.constraints import MOST_CONSTRAINTS, UNMOVED, Constraint
from app.errors import LedgerUnavailable, TooManyConstraints
from app.flight_intents import OPEN_STATES, FlightIntent, HeldReservations, Refusal, Reservations, State, Submission
from app.ledger import constraints as closed
from app.ledger import positions, queries
from app.ledger.queries import IdempotencyRecord, JournalEntry
from app.ledger.rows import columns_of, dump_columns, joined, joined_held, to_held, to_row
from app.ledger.tables import counters, flight_intents, idempotency_keys, journal, reservations
from app.ledger.webhooks import WebhookRows
from app.surveillance import Aircraft, Remark, Sighting
from planner.airmatrix import IntArray
from planner.airspace import Airspace
from planner.kernels.intervals import FAR_FUTURE
from planner.path import Trajectory

# The name for the sequence number in an update, where a column's own name is not free.
_REWRITTEN = "rewritten"
# In a connection's notes.
_SEEN = "airmatrix has seen this database"

InsertReservations = Callable[[Connection, HeldReservations], None]


class ConstraintViolated(Exception):
    """The database refused rows, such as an overlapping reservation: the caller's picture of the ledger was wrong."""


class Rewriting(NamedTuple):
    """An intent before and after it was planned again, and the details for its journal entry."""

    before: FlightIntent
    after: FlightIntent
    details: Mapping[str, object]


@contextmanager
def _asking() -> Iterator[None]:
    """Where the database fails, rather than refuses rows, the whole transaction is lost: raise `LedgerUnavailable`."""
    try:
        yield
    except (IntegrityError, DataError):
        raise
    except DBAPIError as error:
        raise LedgerUnavailable(f"the ledger cannot be written: {cause_of(error)}") from error


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
        # Where the next entry stands in the revision that several share; None where each has one of its own.
        self._place: int | None = None
        self.write_s = 0.0
        self.commit_s = 0.0

    @property
    def sequence(self) -> int:
        """The newest sequence number, with what this transaction has added."""
        return self._counters.sequence

    @property
    def revision(self) -> int:
        """The newest revision, with what this transaction has added."""
        return self._counters.revision

    @property
    def journal_removed(self) -> int:
        """The revision up to which the journal has been removed."""
        return self._counters.journal_removed

    @property
    def lowest_priority(self) -> int:
        """A priority that no accepted flight's is below: a flight of no more than that displaces nobody."""
        return self._counters.lowest_priority

    @contextmanager
    def one_revision(self) -> Iterator[None]:
        """Let all changes inside share one revision: whoever reads the journal sees all of them or none."""
        self._place = 0
        try:
            yield
        finally:
            self._place = None

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
            lowest_priority=min(counters.lowest_priority, 0 if trajectory is None else submission.priority),
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

    @_asking()
    def change(
        self, intent: FlightIntent, state: State, now_ms: int, *, is_free: bool = False, is_activated: bool = False
    ) -> FlightIntent:
        """Move an intent to another state. If it `is_free`, its reservations end now: those of the future go."""
        self.flush()
        end_ms = now_ms + 1
        released = intent.reservations.beyond(end_ms) if is_free else None
        if released is not None:
            mine = reservations.c.intent == intent.sequence
            self._connection.execute(delete(reservations).where(mine, reservations.c.enter >= end_ms))
            cut = update(reservations).where(mine, reservations.c.exit > end_ms).values(exit=end_ms)
            self._connection.execute(cut)
        revision = self._append(intent.sequence, intent.id, now_ms, state, released)
        activated_ms = now_ms if is_activated and intent.activated_ms is None else intent.activated_ms
        self._connection.execute(
            update(flight_intents)
            .where(flight_intents.c.sequence == intent.sequence)
            .values(state=state.value, version=revision, activated=activated_ms)
        )
        held = intent.reservations.until(end_ms) if is_free else intent.reservations
        return intent.changed(revision, state, held, activated_ms)

    @_asking()
    def vacate(self, intents: Sequence[FlightIntent]) -> None:
        """Take away all reservations of flights that are about to be rewritten."""
        self.flush()
        for start in range(0, len(intents), queries.BOUND_AT_ONCE):
            part = [intent.sequence for intent in intents[start : start + queries.BOUND_AT_ONCE]]
            self._connection.execute(delete(reservations).where(reservations.c.intent.in_(part)))

    @_asking()
    def rewrite(self, changes: Sequence[Rewriting], now_ms: int) -> list[FlightIntent]:
        """Replace vacated intents by what they are now under their old sequence numbers; return them with new versions.

        Raises
        ------
        ConstraintViolated
        """
        if not changes:
            return []
        self.flush()
        rewritten = []
        for before, after, details in changes:
            counters, arrives = self._counters, after.trajectory
            self._counters = replace(
                counters,
                longest_flight=max(counters.longest_flight, 0 if arrives is None else arrives.flight_time_ms),
                lowest_priority=min(counters.lowest_priority, after.submission.priority),
            )
            released = before.reservations.beyond(now_ms)
            revision = self._append(before.sequence, before.id, now_ms, after.state, released, details=details)
            rewritten.append(replace(after, version=revision))
        rows = [to_row(intent) for intent in rewritten]
        for row in rows:
            row[_REWRITTEN] = row.pop("sequence")
        try:
            columns: dict[str, Any] = {name: bindparam(name) for name in rows[0] if name != _REWRITTEN}
            is_rewritten = flight_intents.c.sequence == bindparam(_REWRITTEN)
            self._connection.execute(update(flight_intents).where(is_rewritten).values(columns), rows)
            if any(len(intent.reservations) for intent in rewritten):
                self._insert_reservations(self._connection, joined(rewritten))
        except IntegrityError as error:
            raise ConstraintViolated(cause_of(error)) from error
        return rewritten

    @_asking()
    def movable(self, priority_below: int | None, from_ms: int, until_ms: int = FAR_FUTURE) -> IntArray:
        """Return the sequence numbers of accepted flights that depart within [from, until) and have not been activated;
        of a lower priority only, where one is given.
        """
        self.flush()
        flight = flight_intents.c
        wanted = [flight.departure >= from_ms, flight.departure < until_ms, flight.activated.is_(None)]
        if priority_below is not None:
            wanted.append(flight.priority < priority_below)
        query = select(flight.sequence).where(queries.ACCEPTED, *wanted)
        return np.array(list(self._connection.execute(query).scalars()), dtype=np.int64)

    @_asking()
    def refresh_lowest_priority(self) -> None:
        """Find out anew which priority no accepted flight's is below: the lowest ones may be over by now."""
        self.flush()
        lowest = self._connection.execute(select(func.min(flight_intents.c.priority)).where(queries.ACCEPTED)).scalar()
        self._counters = replace(self._counters, lowest_priority=min(0, lowest or 0))

    @_asking()
    def find_all(self, sequences: Iterable[int]) -> list[FlightIntent]:
        """Return intents with their reservations, by sequence."""
        self.flush()
        return queries.find_all(self._connection, self._airspace, sequences)

    @_asking()
    def end_unseen(self, before_ms: int, limit: int, now_ms: int) -> list[tuple[int, str]]:
        """End up to `limit` flights that should have arrived before a time and were never seen; return sequences and
        ids.
        """
        self.flush()
        passed = positions.unseen(self._connection, before_ms, limit)
        if passed:
            changed = [
                {"ended": sequence, "revision": self._append(sequence, intent_id, now_ms, State.ENDED, None)}
                for sequence, intent_id in passed
            ]
            self._connection.execute(
                update(flight_intents)
                .where(flight_intents.c.sequence == bindparam("ended"))
                .values(state=State.ENDED.value, version=bindparam("revision")),
                changed,
            )
        return passed

    @_asking()
    def newest_positions(self, aircraft: Iterable[Aircraft]) -> dict[Aircraft, Sighting]:
        """Return where some aircraft were last seen, without the blocks."""
        return positions.newest(self._connection, aircraft)

    @_asking()
    def store_positions(self, reports: Sequence[tuple[Aircraft, Sighting]]) -> None:
        """Write positions, each newer than those before it of the same aircraft."""
        positions.store(self._connection, reports)

    @_asking()
    def remarks(self, aircraft: Iterable[Aircraft]) -> dict[Aircraft, Remark]:
        """Return what is recorded of some aircraft, those that do not simply conform."""
        return positions.remarked(self._connection, aircraft)

    @_asking()
    def forget_remarks(self, aircraft: Iterable[Aircraft]) -> None:
        """Drop what is recorded of aircraft that are gone."""
        positions.remark(self._connection, dict.fromkeys(aircraft))

    @_asking()
    def remark(self, changes: Mapping[Aircraft, Remark | None], now_ms: int) -> None:
        """Record what is remarked of aircraft, in the journal too; None: they conform again."""
        self.flush()
        ids = self.ids(aircraft.sequence for aircraft in changes if aircraft.sequence)
        for aircraft, remark in changes.items():
            self._append(
                aircraft.sequence,
                ids.get(aircraft.sequence, ""),
                now_ms,
                "conforming" if remark is None else remark.conformance,
                None,
                aircraft.track_id or None,
                () if remark is None else remark.reasons,
            )
        positions.remark(self._connection, changes)

    @_asking()
    def record_constraint(self, constraint: Constraint, now_ms: int) -> Constraint:
        """Write a constraint, and return it as it is written: made now, under the next number.

        Raises
        ------
        TooManyConstraints
        """
        self.flush()
        if closed.count_after(self._connection, now_ms) >= MOST_CONSTRAINTS:
            raise TooManyConstraints(f"{MOST_CONSTRAINTS} constraints are in force, or will be: there may be no more")
        recorded = closed.record(self._connection, replace(constraint, created_ms=now_ms))
        self._append_constraint(recorded, now_ms, closed.CREATED)
        return recorded

    @_asking()
    def remove_constraint(self, constraint: Constraint, now_ms: int) -> Constraint:
        """Mark a constraint as removed, and return it so."""
        self.flush()
        self._append_constraint(constraint, now_ms, closed.REMOVED)
        return closed.remove(self._connection, constraint, now_ms)

    def tell_unmoved(self, ids: Mapping[int, str], cause: Mapping[str, str], now_ms: int) -> None:
        """Take down in the journal, of flights by sequence number, that they could not make way; nothing changes."""
        for sequence, intent_id in ids.items():
            self._append(sequence, intent_id, now_ms, UNMOVED, released=None, details={"cause": cause})

    @_asking()
    def constraint(self, constraint_id: str) -> Constraint | None:
        """Return a constraint, also one that has ended or was removed; None if there is none."""
        return closed.find(self._connection, constraint_id)

    @_asking()
    def constraints_after(self, time_ms: int) -> list[Constraint]:
        """Return the constraints that are in force after a time, by number."""
        return closed.after(self._connection, time_ms)

    @_asking()
    def constraint_ids(self, numbers: Iterable[int]) -> tuple[str, ...]:
        """Return the ids of constraints by their numbers, in the order of these."""
        return closed.ids_of(self._connection, numbers)

    @_asking()
    def find(self, intent_id: str) -> FlightIntent | None:
        """Return an intent with its reservations, None if there is none."""
        if intent_id in self._new_intents:
            self.flush()
        return queries.find(self._connection, self._airspace, intent_id)

    @_asking()
    def count_open(self, operator: str, limit: int, now_ms: int) -> int:
        """Return how many flights of an operator are not over, or still hold something; counted until there are so
        many.
        """
        flight = flight_intents.c
        mine = select(flight.sequence).where(flight.operator == operator)
        # Each that arrives after now is asked, however late it departs: it may have left early, and keeps all it holds
        # then. Where something was cut off, it ends with the next millisecond.
        holds = (reservations.c.intent == flight.sequence) & (reservations.c.exit > now_ms + 1)
        kept = flight.arrival > now_ms, select(reservations.c.intent).where(holds).exists()
        found = 0
        for some in (mine.where(positions.IS_OPEN), mine.where(positions.IS_OVER, *kept)):
            count = select(func.count()).select_from(some.limit(limit).subquery())
            found += int(self._connection.execute(count).scalar_one())
        new = self._new_intents.values()
        return found + sum(each.submission.operator == operator and each.state in OPEN_STATES for each in new)

    @_asking()
    def ids(self, sequences: Iterable[int]) -> dict[int, str]:
        """Return the ids of intents by their sequence numbers."""
        wanted = set(sequences)
        new = {intent.sequence: id_ for id_, intent in self._new_intents.items() if intent.sequence in wanted}
        return new | (queries.ids_of(self._connection, wanted - new.keys()) if wanted - new.keys() else {})

    @contextmanager
    def webhooks(self) -> Iterator[WebhookRows]:
        """Read and write webhooks."""
        with _asking():
            yield WebhookRows(self._connection)

    def journal_after(self, revision: int) -> list[JournalEntry]:
        """Return all journal entries after a revision, oldest first."""
        return queries.journal_after(self._connection, revision, None)

    def held_after(self, time_ms: int, sequences: Sequence[int] | None = None) -> HeldReservations:
        """Return the reservations that end after a time, of all intents or of some, by intent."""
        self.flush()
        query = select(reservations).where(reservations.c.exit > time_ms).order_by(reservations.c.intent)
        if sequences is None:
            # Found by their flights: the ledger may hold years of reservations.
            return to_held(self._connection.execute(query.where(queries.in_the_air(time_ms, None))))
        parts = (
            reservations.c.intent.in_(sequences[start : start + queries.BOUND_AT_ONCE])
            for start in range(0, len(sequences), queries.BOUND_AT_ONCE)
        )
        return joined_held([to_held(self._connection.execute(query.where(part))) for part in parts])

    @_asking()
    def answer_to(self, operator: str, key: str, since_ms: int) -> IdempotencyRecord | None:
        """Return the first answer to an idempotency key, None if it is new; one from before `since_ms` is dropped."""
        new = self._new_answers.get((operator, key))
        if new is not None:
            return new
        found = queries.answer_to(self._connection, self._airspace, operator, key)
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
            positions.remove_of(self._connection, sequences)
            self._connection.execute(delete(flight_intents).where(flight_intents.c.sequence.in_(sequences)))
            removed_before = max(self._counters.removed_before, before_ms)
            self._counters = replace(self._counters, removed_before=removed_before)
        return len(sequences)

    def forget_constraints(self, before_ms: int, limit: int) -> int:
        """Delete up to `limit` constraints that ended or were removed before a time; return how many."""
        return closed.forget(self._connection, before_ms, limit)

    def remove_journal(self, before_ms: int, limit: int) -> int:
        """Remove up to `limit` of the oldest journal entries, if they are from before a time; return how many."""
        self.flush()
        query = select(journal.c.revision, journal.c.time).order_by(journal.c.revision).limit(limit)
        # The newest revision stays: its time tells how far the ledger's own time has come.
        rows = self._connection.execute(query).all()
        old = list(takewhile(lambda row: row.time < before_ms and row.revision < self.revision, rows))
        if old:
            self._counters = replace(self._counters, journal_removed=old[-1].revision)
            self.flush()
            self._connection.execute(delete(journal).where(journal.c.revision <= old[-1].revision))
        return len(old)

    def remove_positions(self, before_ms: int, limit: int) -> int:
        """Remove some `limit` positions from before a time; return how many."""
        removed = positions.remove(self._connection, before_ms, limit)
        if removed:
            before_ms = max(self._counters.positions_removed_before, before_ms)
            self._counters = replace(self._counters, positions_removed_before=before_ms)
        return removed

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
        if self._counters == self._written and not self._new_entries and not self._new_keys:
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

    def _append_constraint(self, constraint: Constraint, now_ms: int, kind: str) -> None:
        self._append(0, "", now_ms, kind, released=None, details={"constraint_id": constraint.id})

    def _append(
        self,
        sequence: int,
        intent_id: str,
        now_ms: int,
        kind: str,
        released: Reservations | None,
        track_id: str | None = None,
        reasons: Sequence[str] = (),
        details: Mapping[str, object] | None = None,
    ) -> int:
        """Add a journal entry under the next revision, or the one that is shared, and return that."""
        place = self._place or 0
        if place == 0:
            self._counters = replace(self._counters, revision=self._counters.revision + 1)
        if self._place is not None:
            self._place += 1
        self._new_entries.append(
            {
                "revision": self.revision,
                "place": place,
                "time": now_ms,
                "kind": str(kind),
                "intent": sequence,
                "flight_intent_id": intent_id,
                "released": None if released is None else dump_columns(*columns_of(released)),
                "track_id": track_id,
                "reasons": json.dumps(reasons) if reasons else None,
                "details": json.dumps(details) if details else None,
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
    positions_removed_before: int
    lowest_priority: int


_COUNTERS = [counters.c[field.name] for field in fields(_Counters)]


def touch(connection: Connection) -> None:
    """Change a row and change it back: SQLite writes nothing for an update to what is there already."""
    for step in (1, -1):
        connection.execute(update(counters).values(revision=counters.c.revision + step))


def cause_of(error: BaseException) -> str:
    """Return what a database says in one line."""
    return " ".join(str(getattr(error, "orig", None) or error).split())
