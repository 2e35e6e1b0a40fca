"""A whole ledger as of one moment, for who checks it."""

from collections.abc import Iterable

import numpy as np
from sqlalchemy import Connection, select

from app.constraints import Constraint
from app.flight_intents import FlightIntent, Reservations
from app.ledger import constraints as closed
from app.ledger.queries import BOUND_AT_ONCE, JournalEntry, entries_of
from app.ledger.rows import by_intent, to_held, to_intent
from app.ledger.tables import constraints, counters, flight_intents, journal, reservations
from planner.airspace import Airspace


class Snapshot:
    """Reads of one moment."""

    def __init__(self, connection: Connection, airspace: Airspace) -> None:
        self._connection = connection
        self._airspace = airspace

    def intents(self) -> tuple[list[FlightIntent], dict[int, Reservations]]:
        """Return all intents by sequence, and reservations that name an intent which does not exist.

        Reservations are read for themselves, not by way of the intents that should own them.
        """
        held = to_held(self._connection.execute(select(reservations)))
        rows = self._connection.execute(select(flight_intents).order_by(flight_intents.c.sequence)).all()
        owned = by_intent(held, np.unique(held.sequence).tolist(), self._airspace.grid)
        intents = [to_intent(row, self._airspace, owned.pop(row.sequence, Reservations.none())) for row in rows]
        return intents, owned

    def constraints(self) -> list[Constraint]:
        """Return all constraints by number, also those that have ended or were removed."""
        rows = self._connection.execute(select(constraints).order_by(constraints.c.number))
        return [closed.to_constraint(row) for row in rows]

    def journal_removed(self) -> int:
        """Return the revision up to which the journal has been removed."""
        return int(self._connection.execute(select(counters.c.journal_removed)).scalar_one())

    def journal_of_constraints(self) -> list[JournalEntry]:
        """Return the journal entries that constraints began or were removed with, oldest first."""
        wanted = (journal.c.intent == 0, journal.c.kind.in_(closed.CONSTRAINT_KINDS))
        return entries_of(self._connection, select(journal).where(*wanted))

    def journal_of_intents(self, sequences: Iterable[int]) -> list[JournalEntry]:
        """Return the journal entries of some intents, of each oldest first."""
        unique = sorted(set(sequences))
        return [
            entry
            for start in range(0, len(unique), BOUND_AT_ONCE)
            for entry in entries_of(
                self._connection,
                select(journal).where(journal.c.intent.in_(unique[start : start + BOUND_AT_ONCE])),
            )
        ]

    def journal_at(self, revision: int) -> list[JournalEntry]:
        """Return all journal entries of one revision, in their order."""
        return entries_of(self._connection, select(journal).where(journal.c.revision == revision))
