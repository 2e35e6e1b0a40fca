"""A ledger in a SQLite file."""

import os
import sqlite3
import time
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
from sqlalchemy import Connection, Engine, create_engine, event

from app.errors import ForeignLedger, LedgerMissing, LedgerUnavailable, StartupError
from app.flight_intents import HeldReservations
from app.ledger.location import Location

# "AMTX": marks a SQLite file as a ledger of ours.
APPLICATION_ID = 0x414D5458
# In a SQLite header: where it stands whether the database is in WAL mode, and how.
_WRITE_VERSION, _WAL = 18, 2
_WAIT_S = 10.0
# SQLite's own way of waiting sleeps up to a tenth of a second, and so lets the same process win the lock over and over.
_POLL_S = 0.001
# As many as there are threads for plain `def` routes: none waits for a connection while another holds its thread.
_READERS = 40
# A flight's reservations lie all over the table, each on a page of its own. So pages are small (bytes; new ledgers
# only) and stay in memory (KiB). `checkpoint` copies them from the log to the file; the writer itself finishes that,
# and begins the log anew, only when it has grown this long (pages).
_PAGE_BYTES = 2048
_WRITER_CACHE_KIB = 64 * 1024
_LOG_PAGES = 50_000


class SqliteDatabase:
    """One SQLite file in WAL mode: readers never wait for the writer, nor the writer for them."""

    def __init__(self, location: Location) -> None:
        self.location = location
        self._path = location.path
        self._file: tuple[int, int] | None = None
        self._checkpoints: sqlite3.Connection | None = None

    def create(self) -> None:
        """Make a ledger, as yet without tables, of an absent or empty file.

        Raises
        ------
        LedgerMissing, ForeignLedger, StartupError
        """
        path = self._path
        if not path.parent.is_dir():
            raise LedgerMissing(f"cannot create ledger {path}: there is no folder {path.parent}")
        absent = not path.exists() or path.stat().st_size == 0
        log = path.with_name(f"{path.name}-wal")
        if absent and log.exists() and log.stat().st_size > 0:
            # SQLite would delete it.
            raise ForeignLedger(
                f"{log} belongs to a ledger that is gone from {path}; put it back, or move this file too"
            )
        if not absent and not os.access(path, os.W_OK):
            raise StartupError(f"cannot write ledger {path}: no permission; --read-only serves it to readers")
        if absent or _check_is_ledger(path)[_WRITE_VERSION] != _WAL:
            _mark(path)

    def check(self) -> None:
        """Raise `LedgerMissing` or `ForeignLedger` unless there is a ledger of ours."""
        if not self._path.exists() or self._path.stat().st_size == 0:
            raise LedgerMissing(f"there is no ledger at {self._path}; `airmatrix serve` creates one")
        _check_is_ledger(self._path)

    def check_tables(self, connection: Connection, *, may_be_empty: bool) -> None:
        """Do nothing: the file's header has said what it is."""

    def engine(self, *, writes: bool, migrates: bool = False) -> Engine:
        """Return an engine whose transactions hold the write lock from the start, or cannot write at all."""
        del migrates  # There is one lock only.
        engine = create_engine(
            self.location.url,
            pool_size=1 if writes else _READERS,
            max_overflow=0,
            connect_args={"timeout": _WAIT_S, "check_same_thread": False, "isolation_level": None},
        )

        @event.listens_for(engine, "do_connect")
        def look_first(*_: object) -> None:
            self._check_is_same()

        @event.listens_for(engine, "connect")
        def configure(connection: sqlite3.Connection, _record: object) -> None:
            connection.execute("PRAGMA synchronous = FULL")
            connection.execute("PRAGMA foreign_keys = ON")
            connection.execute(f"PRAGMA query_only = {'OFF' if writes else 'ON'}")
            if writes:
                connection.execute(f"PRAGMA cache_size = -{_WRITER_CACHE_KIB}")
                connection.execute(f"PRAGMA wal_autocheckpoint = {_LOG_PAGES}")
                # From here on `_begin_immediate` waits instead.
                connection.execute("PRAGMA busy_timeout = 0")

        @event.listens_for(engine, "begin")
        def begin(connection: Connection) -> None:
            self._check_is_same()
            if writes:
                _begin_immediate(connection)
            else:
                connection.exec_driver_sql("BEGIN")

        return engine

    def _check_is_same(self) -> None:
        """Raise `LedgerUnavailable` if another file stands where this one stood, or none: SQLite would not notice, and
        what it wrote would be gone with the process.
        """
        try:
            found = self._path.stat()
        except OSError as error:
            raise LedgerUnavailable(f"the ledger {self._path} is gone: {error.strerror}") from error
        if self._file not in (None, (found.st_dev, found.st_ino)):
            raise LedgerUnavailable(f"the ledger {self._path} was moved or replaced; put it back, and then restart")
        self._file = (found.st_dev, found.st_ino)

    def is_undone_by(self, error: Exception) -> bool:
        """Tell whether a COMMIT failed on a full disk: then its last frame, which makes it one, was not written."""
        cause = getattr(error, "orig", None)
        return isinstance(cause, sqlite3.Error) and cause.sqlite_errorcode & 0xFF == sqlite3.SQLITE_FULL

    def checkpoint(self) -> None:
        """Copy pages from the log to the file, as far as that is possible without anybody's waiting.

        On one connection, which stays with its file: a new one to a name whose file was moved would make another file,
        and delete the log that stands beside it.
        """
        with suppress(sqlite3.Error, LedgerUnavailable):
            self._check_is_same()
            if self._checkpoints is None:
                location = f"{self._path.absolute().as_uri()}?mode=rw"
                self._checkpoints = sqlite3.connect(location, uri=True, isolation_level=None, check_same_thread=False)
                self._checkpoints.execute("PRAGMA synchronous = FULL")
            self._checkpoints.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()

    def close(self) -> None:
        """Release what `checkpoint` holds; not while it runs."""
        if self._checkpoints is not None:
            self._checkpoints.close()

    def insert_reservations(self, connection: Connection, held: HeldReservations) -> None:
        """Insert reservations, by driver: a hundred rows an intent are the hot path."""
        rows = np.column_stack([held.block, held.enter_ms, held.exit_ms, held.sequence]).tolist()
        connection.exec_driver_sql(
            'INSERT INTO reservations (block, enter, "exit", intent) VALUES (?, ?, ?, ?)', [tuple(row) for row in rows]
        )


def _begin_immediate(connection: Connection) -> None:
    give_up = time.monotonic() + _WAIT_S
    driver = connection.connection.driver_connection
    assert isinstance(driver, sqlite3.Connection)
    while True:
        try:
            driver.execute("BEGIN IMMEDIATE")
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY or time.monotonic() > give_up:
                # Once more through SQLAlchemy, for an exception of its own.
                connection.exec_driver_sql("BEGIN IMMEDIATE")
                return
        else:
            return
        time.sleep(_POLL_S)


def _mark(path: Path) -> None:
    """Make an empty file a ledger; the mark comes first, so that one whose creation was cut short is still one."""
    give_up = time.monotonic() + _WAIT_S
    while True:
        try:
            with closing(sqlite3.connect(path, timeout=_WAIT_S, isolation_level=None)) as connection:
                connection.execute(f"PRAGMA page_size = {_PAGE_BYTES}")
                connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
                connection.execute("PRAGMA journal_mode = WAL")
                return
        except sqlite3.Error as error:
            # SQLite does not wait for others by itself when it changes the journal mode.
            if getattr(error, "sqlite_errorcode", None) != sqlite3.SQLITE_BUSY or time.monotonic() > give_up:
                raise StartupError(f"cannot create ledger {path}: {error}") from error
        time.sleep(_POLL_S)


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
