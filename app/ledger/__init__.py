"""The ledger: the durable truth about flight intents and reservations. The only user of SQLAlchemy."""

from app.ledger.engine import create_or_upgrade, open_ledger
from app.ledger.ledger import IdempotencyRecord, JournalEntry, Ledger, Transaction

__all__ = ["IdempotencyRecord", "JournalEntry", "Ledger", "Transaction", "create_or_upgrade", "open_ledger"]
