"""Ledgers made wrong by hand."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path


@contextmanager
def tampering(ledger: str | Path) -> Iterator[sqlite3.Connection]:
    """Open a ledger without the triggers that guard it."""
    with closing(sqlite3.connect(ledger)) as connection, connection:
        for (trigger,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
            connection.execute(f"DROP TRIGGER {trigger}")
        yield connection
