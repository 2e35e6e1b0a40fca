"""Where tests keep ledgers, SQLite files and PostgreSQL databases, and how a stranger to the service opens them."""

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import psycopg
import pytest
from alembic.script import ScriptDirectory

from app.ledger import create_or_upgrade
from tests.postgres import Server

# What the newest schema is called.
HEAD = ScriptDirectory("migrations").get_current_head()

# How a database says that it refuses rows; the text names the guard.
REFUSED = (sqlite3.IntegrityError, psycopg.IntegrityError)

# For tests of what only one of them has, or of what has nothing to do with the kind of database.
on_sqlite = pytest.mark.parametrize("ledgers", ["sqlite"], indirect=True)
on_postgresql = pytest.mark.parametrize(
    "ledgers", [pytest.param("postgresql", marks=pytest.mark.postgres)], indirect=True
)

# The writers' lock on PostgreSQL. Processes of all versions have to agree on it.
_ADVISORY_LOCK = f"SELECT pg_advisory_xact_lock({0x414D5458}, 'counters'::regclass::oid::int4)"


class Ledgers(Protocol):
    """A kind of places for ledgers."""

    def vacant(self) -> str:
        """Return a place where there is no ledger yet."""

    def migrated(self) -> str:
        """Return a place with a new ledger at the newest schema."""

    def copy(self, location: str) -> str:
        """Return a place with a copy of a ledger, which nobody writes meanwhile."""


class SqliteLedgers:
    """Files in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._made = 0

    def vacant(self) -> str:
        self._made += 1
        return str(self._folder / f"ledger-{self._made}.sqlite")

    def migrated(self) -> str:
        location = self.vacant()
        Path(location).write_bytes(migrated_file())
        return location

    def copy(self, location: str) -> str:
        target = self.vacant()
        with closing(sqlite3.connect(location)) as source, closing(sqlite3.connect(target)) as copy:
            source.backup(copy)
            copy.execute("PRAGMA journal_mode = WAL")
        return target


class PostgresqlLedgers:
    """Databases of a server, copied from one at the newest schema; all are dropped by `close`."""

    def __init__(self, server: Server, template: str) -> None:
        self._server = server
        self._template = template
        self._made: list[str] = []

    def vacant(self) -> str:
        return self._kept(self._server.database())

    def migrated(self) -> str:
        return self.copy(self._template)

    def copy(self, location: str) -> str:
        return self._kept(self._server.database(location))

    def close(self) -> None:
        """Drop them."""
        while self._made:
            self._server.drop(self._made.pop())

    def _kept(self, location: str) -> str:
        self._made.append(location)
        return location


class Stranger:
    """A connection to a ledger that knows only SQL, with `?` for a value; each statement commits by itself."""

    def __init__(self, connection: sqlite3.Connection | psycopg.Connection[Any]) -> None:
        self._connection = connection

    @property
    def is_sqlite(self) -> bool:
        """Whether SQLite's dialect is spoken."""
        return isinstance(self._connection, sqlite3.Connection)

    def execute(self, statement: str, values: Sequence[object] = ()) -> None:
        """Execute a statement."""
        self._cursor(statement, values)

    def rows(self, query: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """Return the rows of a query."""
        return self._cursor(query, values).fetchall()

    def _cursor(self, statement: str, values: Sequence[object]) -> sqlite3.Cursor | psycopg.Cursor[Any]:
        if isinstance(self._connection, sqlite3.Connection):
            return self._connection.execute(statement, values)
        return self._connection.execute(statement.replace("%", "%%").replace("?", "%s").encode(), values)


@contextmanager
def database(location: str | Path | Stranger) -> Iterator[Stranger]:
    """Open a ledger as a stranger, or go on as one; SQLite does not enforce foreign keys then."""
    if isinstance(location, Stranger):
        yield location
        return
    with closing(_connection(str(location))) as connection:
        yield Stranger(connection)


@contextmanager
def write_lock(location: str | Path) -> Iterator[None]:
    """Hold the write lock of a ledger."""
    with database(location) as connection:
        if connection.is_sqlite:
            connection.execute("BEGIN IMMEDIATE")
        else:
            connection.execute("BEGIN")
            connection.execute(_ADVISORY_LOCK)
        yield
        connection.execute("COMMIT")


def content(location: str | Path) -> object:
    """Return all that is at a location, equal to what it was only if nobody has changed anything.

    That is every file in a SQLite ledger's folder; of a PostgreSQL database, which rows each of its tables has, the
    catalog's included, and which transaction has written each.
    """
    if "://" not in str(location):
        return {file.name: file.read_bytes() for file in Path(location).parent.iterdir() if file.is_file()}
    tables = (
        "SELECT oid::regclass::text FROM pg_class"
        " WHERE relkind = 'r' AND NOT relisshared AND relname <> ? AND has_table_privilege(oid, 'SELECT')"
    )
    rows = "SELECT md5(string_agg(ctid::text || xmin::text, ' ' ORDER BY ctid)) FROM "
    with database(location) as connection:
        # The server writes statistics by itself.
        return {name: connection.rows(rows + name) for (name,) in connection.rows(tables, ["pg_statistic"])}


@cache
def migrated_file() -> bytes:
    """Return the bytes of a new SQLite ledger at the newest schema, so that tests need not migrate one each."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "ledger.sqlite"
        create_or_upgrade(str(path))
        return path.read_bytes()


def _connection(location: str) -> sqlite3.Connection | psycopg.Connection[Any]:
    if "://" in location:
        return psycopg.connect(location, autocommit=True)
    return sqlite3.connect(location, isolation_level=None, timeout=10)
