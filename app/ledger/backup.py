"""Copying a whole ledger, as of one moment, while it is served and written."""

import os
import shutil
import sqlite3
import subprocess
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from psycopg.conninfo import make_conninfo

from app.errors import StartupError
from app.ledger.engine import check_exists
from app.ledger.location import Location, parse_location

_WAIT_S = 10.0
# Between steps of so many pages the copying shows its progress and can be interrupted.
_STEP_PAGES = 1_000
# What SQLite keeps beside a database that is open, or was not closed.
_BESIDE = ("-wal", "-shm", "-journal")


def back_up(
    location: str, out: Path, *, replace: bool = False, advance: Callable[[float], None] = lambda _: None
) -> int:
    """Copy a ledger to a file, which appears whole or not at all; return its size in bytes.

    From SQLite the copy is a ledger; from PostgreSQL it is an archive for `pg_restore`. `advance` is told the copied
    fraction from time to time, where it is known.

    Raises
    ------
    LedgerMissing, ForeignLedger
        There is no ledger at the location.
    StartupError
        The ledger is damaged or cannot be read, or the file is there already (unless `replace`) or cannot be written.
    """
    check_exists(location)
    place = parse_location(location)
    _check_free(out, place, replace)
    # A folder beside the file, for a copy that is under way has files beside itself.
    folder = out.with_name(f".{out.name}.{os.getpid()}")
    copy = folder / "copy"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        if place.is_sqlite:
            _copy_sqlite(place.path, copy, advance)
        else:
            _dump_postgresql(place, copy)
        _sync(copy)
        size = copy.stat().st_size
        _check_free(out, place, replace)
        copy.replace(out)
        _sync(out.parent)
    except OSError as error:
        raise StartupError(f"cannot write {out}: {error.strerror}") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return size


def _check_free(out: Path, place: Location, replace: bool) -> None:
    """Refuse a file that must not be replaced: one that is there, is the ledger itself, or is a database in use."""
    if out.is_dir():
        raise StartupError(f"cannot write {out}: it is a folder")
    if place.is_sqlite and out.exists() and out.samefile(place.path):
        raise StartupError(f"cannot back up ledger {place} onto itself; choose another file")
    if out.exists() and not replace:
        raise StartupError(f"{out} exists; choose another file, or replace it with --force")
    for suffix in _BESIDE:
        if out.with_name(out.name + suffix).exists():
            raise StartupError(f"{out}{suffix} exists, so {out} is a database in use; choose another file")


def _copy_sqlite(path: Path, copy: Path, advance: Callable[[float], None]) -> None:
    def copied(_status: int, remaining: int, total: int) -> None:
        advance(1.0 - remaining / max(total, 1))

    try:
        with (
            closing(_connected(path, "mode=rw")) as source,
            closing(_connected(copy, "mode=rwc")) as target,
        ):
            # Nobody else sees the copy, and it is synced as a whole.
            target.execute("PRAGMA synchronous = OFF")
            target.execute("PRAGMA journal_mode = OFF")
            # One snapshot for all steps: without it, every commit meanwhile would make the copying begin again.
            source.execute("BEGIN")
            source.execute("SELECT count(*) FROM sqlite_schema").fetchone()
            source.backup(target, pages=_STEP_PAGES, progress=copied)
        with closing(_connected(copy, "immutable=1")) as target:
            (found,) = target.execute("PRAGMA integrity_check(1)").fetchone()
            strays = target.execute("PRAGMA foreign_key_check").fetchall()
    except sqlite3.Error as error:
        raise StartupError(f"cannot copy ledger {path}: {error}") from error
    if found != "ok" or strays:
        fault = found if found != "ok" else f"{strays[0][0]} refers to {strays[0][2]} that does not exist"
        raise StartupError(f"ledger {path} is damaged, so no copy was kept: {' '.join(fault.split())}")
    check_exists(str(copy))


def _connected(path: Path, mode: str) -> sqlite3.Connection:
    return sqlite3.connect(f"{path.absolute().as_uri()}?{mode}", uri=True, timeout=_WAIT_S, isolation_level=None)


def _dump_postgresql(place: Location, copy: Path) -> None:
    program = shutil.which("pg_dump")
    if program is None:
        raise StartupError("backing up a PostgreSQL ledger takes pg_dump; install PostgreSQL's client programs")
    _, parameters = place.url.get_dialect()().create_connect_args(place.url)
    # Not among the arguments, which every user of this machine can read.
    password = parameters.pop("password", None)
    secret = {} if password is None else {"PGPASSWORD": str(password)}
    done = subprocess.run(  # noqa: S603
        [program, "--format=custom", f"--file={copy}", f"--dbname={make_conninfo(**parameters)}"],
        env={**os.environ, **secret}, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode != 0:
        raise StartupError(f"cannot copy ledger {place}: {' '.join(done.stderr.split())}")


def _sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
