"""Opening a ledger: where it is, whether it is one, which schema it has, whose airspace it belongs to."""

import sqlite3
import time
from contextlib import closing
from importlib.resources import files
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import URL, Connection, Engine, create_engine, event, insert, select
from sqlalchemy.exc import DatabaseError

from app.errors import AirspaceMismatch, ForeignLedger, LedgerMissing, LedgerOutdated, StartupError
from app.ledger import tables
from app.ledger.ledger import Ledger
from planner.airspace import Airspace

# "AMTX": marks a SQLite file as a ledger of ours.
APPLICATION_ID = 0x414D5458
# In a SQLite header: where it stands whether the database is in WAL mode, and how.
_WRITE_VERSION, _WAL = 18, 2
_BUSY_TIMEOUT_S = 10
# As many as there are threads for plain `def` routes: none waits for a connection while another holds its thread.
_READERS = 40


def sqlite_path(location: str) -> Path:
    """Return the file of a ledger given as a path or a ``sqlite:///`` URL; `StartupError` for any other URL."""
    if location.startswith("sqlite:///"):
        return Path(location.removeprefix("sqlite:///"))
    if "://" in location:
        scheme = location.split("://")[0]
        raise StartupError(f"ledgers on {scheme} are not supported yet; give a file path or a sqlite:/// URL")
    return Path(location)


def create_or_upgrade(location: str) -> str:
    """Create an absent ledger or bring a present one to the newest schema; return that schema's version.

    Raises `ForeignLedger` for a file that is something else, `LedgerOutdated` for one newer than this program.
    """
    path = sqlite_path(location)
    if not path.parent.is_dir():
        raise LedgerMissing(f"cannot create ledger {path}: there is no folder {path.parent}")
    if not (path.exists() and path.stat().st_size > 0) or _check_is_ledger(path)[_WRITE_VERSION] != _WAL:
        _mark(path)
    engine = _engine(path, writes=True)
    try:
        with engine.begin() as connection:
            if _schema(connection, path) != _head():
                config = _alembic()
                config.attributes["connection"] = connection
                command.upgrade(config, "head")
    except (DatabaseError, sqlite3.Error) as error:
        raise StartupError(f"cannot create or upgrade ledger {path}: {_cause(error)}") from error
    finally:
        engine.dispose()
    return _head()


def open_ledger(location: str, airspace: Airspace, *, claim: bool = False) -> Ledger:
    """Open a ledger of this airspace. With `claim`, a ledger without airspace becomes this one's.

    Raises
    ------
    LedgerMissing, ForeignLedger, LedgerOutdated, AirspaceMismatch
    """
    path = sqlite_path(location)
    if not path.exists():
        raise LedgerMissing(f"there is no ledger at {path}; `airmatrix serve` creates one")
    _check_is_ledger(path)
    engine = _engine(path, writes=claim)
    try:
        with engine.begin() as connection:
            schema = _schema(connection, path)
            if schema != _head():
                raise LedgerOutdated(f"ledger {path} has schema {schema}, not {_head()}; run: airmatrix db upgrade")
            owner = connection.execute(select(tables.airspace)).one_or_none()
            if owner is not None and owner.fingerprint != airspace.fingerprint:
                raise AirspaceMismatch(
                    f"ledger {path} belongs to airspace {owner.id!r} ({owner.fingerprint[:12]}), not to "
                    f"{airspace.id!r} ({airspace.fingerprint[:12]}); give that airspace's file, or another ledger"
                )
            if owner is None and claim:
                connection.execute(
                    insert(tables.airspace).values(
                        only=1, id=airspace.id, name=airspace.name, fingerprint=airspace.fingerprint
                    )
                )
    except DatabaseError as error:
        raise StartupError(f"cannot open ledger {path}: {_cause(error)}") from error
    finally:
        engine.dispose()
    return Ledger(_engine(path, writes=True), _engine(path, writes=False), airspace)


def _engine(path: Path, *, writes: bool) -> Engine:
    """Return an engine whose transactions hold the write lock from the start, or cannot write at all."""
    engine = create_engine(
        URL.create("sqlite", database=str(path)),
        pool_size=1 if writes else _READERS,
        max_overflow=0,
        connect_args={"timeout": _BUSY_TIMEOUT_S, "check_same_thread": False, "isolation_level": None},
    )

    @event.listens_for(engine, "connect")
    def configure(connection: sqlite3.Connection, _record: object) -> None:
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute(f"PRAGMA query_only = {'OFF' if writes else 'ON'}")

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")

    return engine


def _mark(path: Path) -> None:
    """Make an empty file a ledger; the mark comes first, so that one whose creation was cut short is still one."""
    give_up = time.monotonic() + _BUSY_TIMEOUT_S
    while True:
        try:
            with closing(sqlite3.connect(path, timeout=_BUSY_TIMEOUT_S, isolation_level=None)) as connection:
                connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
                connection.execute("PRAGMA journal_mode = WAL")
                return
        except sqlite3.Error as error:
            # SQLite does not wait for others by itself when it changes the journal mode.
            if getattr(error, "sqlite_errorcode", None) != sqlite3.SQLITE_BUSY or time.monotonic() > give_up:
                raise StartupError(f"cannot create ledger {path}: {error}") from error
        time.sleep(0.01)


def _check_is_ledger(path: Path) -> bytes:
    """Return the file's header, read without SQLite, which may write beside a database that it merely opens."""
    try:
        with path.open("rb") as file:
            header = file.read(100)
    except OSError as error:
        raise ForeignLedger(f"cannot read ledger {path}: {error.strerror}") from error
    if not header.startswith(b"SQLite format 3\0"):
        raise ForeignLedger(f"{path} is not an AirMatrix ledger; nothing was changed in it")
    if int.from_bytes(header[68:72]) != APPLICATION_ID:
        raise ForeignLedger(f"{path} is a SQLite database, but not an AirMatrix ledger; nothing was changed in it")
    return header


def _schema(connection: Connection, path: Path) -> str | None:
    """Return the ledger's schema version; `LedgerOutdated` if this program does not know it."""
    schema = MigrationContext.configure(connection).get_current_revision()
    known = {script.revision for script in ScriptDirectory.from_config(_alembic()).walk_revisions()}
    if schema is not None and schema not in known:
        raise LedgerOutdated(f"ledger {path} has schema {schema}, newer than this program's {_head()}")
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


def _cause(error: BaseException) -> BaseException:
    return getattr(error, "orig", None) or error
