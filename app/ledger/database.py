"""What differs between the databases that a ledger can be in."""

from typing import Protocol

from sqlalchemy import Connection, Engine

from app.flight_intents import HeldReservations
from app.ledger.location import Location


class Database(Protocol):
    """One database: where it is, how to connect to it, and what its dialect does not share with others."""

    location: Location

    def create(self) -> None:
        """Make a place for a ledger where there is none."""

    def check(self) -> None:
        """Raise `LedgerMissing` or `ForeignLedger` where that shows without a connection."""

    def check_tables(self, connection: Connection, *, may_be_empty: bool) -> None:
        """Raise `LedgerMissing` or `ForeignLedger` where only a connection shows that."""

    def engine(self, *, writes: bool, migrates: bool = False) -> Engine:
        """Return an engine whose transactions hold the write lock from the start, or cannot write at all."""

    def is_undone_by(self, error: Exception) -> bool:
        """Tell whether a COMMIT that failed like this has surely not happened."""

    def checkpoint(self) -> None:
        """Spare the writer some work that can be done beside it."""

    def close(self) -> None:
        """Release what `checkpoint` holds; not while it runs."""

    def insert_reservations(self, connection: Connection, held: HeldReservations) -> None:
        """Insert reservations; the database refuses an overlap."""
