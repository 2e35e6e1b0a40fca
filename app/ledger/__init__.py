"""The ledger: the durable truth about flight intents and reservations. The only user of SQLAlchemy."""

from app.ledger.engine import check_exists, create_or_upgrade, open_ledger
from app.ledger.ledger import IdempotencyRecord, JournalEntry, Ledger, Transaction
from app.ledger.location import Location, parse_location

__all__ = [
    "IdempotencyRecord",
    "JournalEntry",
    "Ledger",
    "Location",
    "Transaction",
    "check_exists",
    "create_or_upgrade",
    "open_ledger",
    "parse_location",
]
