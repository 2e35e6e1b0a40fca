"""Opening a ledger: where it is, whether it is one, which schema it has, whose airspace it belongs to."""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import files

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, insert, select
from sqlalchemy.exc import DatabaseError

from app.errors import AirspaceMismatch, LedgerOutdated, StartupError
from app.ledger import tables
from app.ledger.database import Database
from app.ledger.ledger import Ledger
from app.ledger.location import Location, parse_location
from app.ledger.postgresql import PostgresqlDatabase
from app.ledger.sqlite import SqliteDatabase
from app.ledger.transaction import cause_of, touch
from planner.airspace import Airspace


def create_or_upgrade(location: str) -> str:
    """Create an absent ledger or bring a present one to the newest schema; return that schema's version.

    Raises `ForeignLedger` for what is something else, `LedgerOutdated` for a ledger newer than this program.
    """
    database = _database_at(location)
    database.create()
    with _connected(database, writes=True, migrates=True, purpose="create or upgrade") as connection:
        database.check_tables(connection, may_be_empty=True)
        if _schema(connection, database.location) != _head():
            config = _alembic()
            config.attributes["connection"] = connection
            command.upgrade(config, "head")
    return _head()


def check_exists(location: str) -> None:
    """Raise `LedgerMissing` or `ForeignLedger` unless there is a ledger, of whatever schema and airspace."""
    database = _database_at(location)
    database.check()
    with _connected(database, writes=False, purpose="open") as connection:
        database.check_tables(connection, may_be_empty=False)


def open_ledger(location: str, airspace: Airspace, *, claim: bool = False) -> Ledger:
    """Open a ledger of this airspace. With `claim`, a ledger without airspace becomes this one's.

    Raises
    ------
    LedgerMissing, ForeignLedger, LedgerOutdated, AirspaceMismatch
    """
    database = _database_at(location)
    place = database.location
    database.check()
    with _connected(database, writes=claim, migrates=claim, purpose="open") as connection:
        database.check_tables(connection, may_be_empty=False)
        schema = _schema(connection, place)
        if schema != _head():
            raise LedgerOutdated(f"ledger {place} has schema {schema}, not {_head()}; run: airmatrix db upgrade")
        owner = connection.execute(select(tables.airspace)).one_or_none()
        if owner is not None and owner.fingerprint != airspace.fingerprint:
            raise AirspaceMismatch(
                f"ledger {place} belongs to airspace {owner.id!r} ({owner.fingerprint[:12]}), not to "
                f"{airspace.id!r} ({airspace.fingerprint[:12]}); give that airspace's file, or another ledger"
            )
        if owner is None and claim:
            connection.execute(
                insert(tables.airspace).values(
                    only=1, id=airspace.id, name=airspace.name, fingerprint=airspace.fingerprint
                )
            )
        if claim:
            # A lock can be had on what cannot be written; now is the time to notice.
            touch(connection)
    return Ledger(database, airspace)


def _database_at(location: str) -> Database:
    place = parse_location(location)
    return SqliteDatabase(place) if place.is_sqlite else PostgresqlDatabase(place)


@contextmanager
def _connected(database: Database, *, writes: bool, migrates: bool = False, purpose: str) -> Iterator[Connection]:
    """Open one transaction; what the database refuses in it is a `StartupError`."""
    engine = database.engine(writes=writes, migrates=migrates)
    try:
        with engine.begin() as connection:
            yield connection
    except (DatabaseError, sqlite3.Error) as error:
        raise StartupError(f"cannot {purpose} ledger {database.location}: {cause_of(error)}") from error
    finally:
        engine.dispose()


def _schema(connection: Connection, location: Location) -> str | None:
    """Return the ledger's schema version; `LedgerOutdated` if this program does not know it."""
    schema = MigrationContext.configure(connection).get_current_revision()
    known = {script.revision for script in ScriptDirectory.from_config(_alembic()).walk_revisions()}
    if schema is not None and schema not in known:
        raise LedgerOutdated(f"ledger {location} has schema {schema}, newer than this program's {_head()}")
    return schema


def _alembic() -> Config:
    config = Config()
    config.set_main_option("script_location", str(files("migrations")))
    config.set_main_option("path_separator", "os")
    return config


def _head() -> str:
    head = ScriptDirectory.from_config(_alembic()).get_current_head()
    assert head is not None
    return head
