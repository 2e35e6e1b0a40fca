"""The ledger: the durable truth about flight intents and reservations. The only user of SQLAlchemy."""

from app.ledger.engine import check_exists, create_or_upgrade, open_ledger
from app.ledger.ledger import CommitUncertain, Ledger
from app.ledger.location import Location, parse_location
from app.ledger.queries import IdempotencyRecord, JournalEntry
from app.ledger.snapshot import Snapshot
from app.ledger.transaction import ConstraintViolated, Rewriting, Transaction

__all__ = [
    "CommitUncertain",
    "ConstraintViolated",
    "IdempotencyRecord",
    "JournalEntry",
    "Ledger",
    "Location",
    "Rewriting",
    "Snapshot",
    "Transaction",
    "check_exists",
    "create_or_upgrade",
    "open_ledger",
    "parse_location",
]
