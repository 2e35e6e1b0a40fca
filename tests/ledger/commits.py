"""Commits that fail: before they happen, after they have, or for want of a database."""

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from sqlalchemy import Connection, Engine, event
from sqlalchemy.exc import OperationalError


@contextmanager
def on_commit(handler: Callable[[Connection], object]) -> Iterator[None]:
    """Call a handler with each writing connection that is about to commit."""

    def listener(connection: Connection) -> None:
        is_sqlite = connection.dialect.name == "sqlite"
        query = "PRAGMA query_only" if is_sqlite else "SELECT current_setting('transaction_read_only')::bool::int"
        if connection.exec_driver_sql(query).scalar() == 0:
            handler(connection)

    event.listen(Engine, "commit", listener)
    try:
        yield
    finally:
        event.remove(Engine, "commit", listener)


@contextmanager
def on_next_commit(handler: Callable[[Connection], object]) -> Iterator[None]:
    """Call a handler with the writing connection that commits next; commits after that are left alone."""
    handlers = [handler]
    with on_commit(lambda connection: handlers.pop()(connection) if handlers else None):
        yield
    assert not handlers


@contextmanager
def unwritable() -> Iterator[None]:
    """Fail all transactions that write, from their beginning."""

    def listener(connection: Connection) -> None:
        if connection.engine.pool.size() == 1:  # type: ignore[attr-defined]
            raise OperationalError("BEGIN", {}, sqlite3.OperationalError("unable to open database file"))

    event.listen(Engine, "begin", listener)
    try:
        yield
    finally:
        event.remove(Engine, "begin", listener)


def fail(connection: Connection) -> None:
    """Fail instead of committing."""
    del connection
    raise OperationalError("COMMIT", {}, Exception("the connection was lost"))


def commit_and_fail(connection: Connection) -> None:
    """Commit, and then lose the connection."""
    connection.connection.commit()
    fail(connection)
