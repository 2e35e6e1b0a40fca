"""`airmatrix db backup`: a whole ledger as of one moment, into a file that appears whole or not at all."""

import shutil
import signal
import sqlite3
import subprocess
import threading
import time
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from app.client import Client
from app.ledger.backup import back_up
from app.times import now_ms
from tests.cli.conftest import History, Run
from tests.cli.serving import AIRMATRIX, environment, serving
from tests.cli.test_serve import contents, foreign_database, names
from tests.cli.town import along_row
from tests.ledger.locations import HEAD, PostgresqlLedgers, database, migrated_file, on_postgresql
from tests.ledger.process import assert_gapless, assert_no_overlaps


def test_a_backup_holds_what_the_ledger_held_and_nothing_stays_beside_it(airmatrix: Run, ledger: Path) -> None:
    before = names(ledger.parent)
    outcome = airmatrix("db", "backup", "--ledger", ledger, "--out", "copy.sqlite")
    copy = ledger.parent / "copy.sqlite"
    assert (outcome.status, outcome.err) == (0, "")
    assert outcome.out == f"copy.sqlite is a copy of {ledger}: {copy.stat().st_size:,} bytes\n"
    assert names(ledger.parent) == sorted([*before, "copy.sqlite"])
    assert contents(copy) == contents(ledger)


def test_a_backup_of_a_service_under_load_is_one_moment_of_it_and_serves(
    airmatrix: Run, tmp_path: Path, town_file: Path
) -> None:
    options = ("--airspace", str(town_file))
    answered: list[str] = []
    enough = threading.Event()

    def submit() -> None:
        with Client(server.url) as client:
            for number in range(5_000):
                answered.append(client.submit(along_row(number % 4, 1, now_ms() + 600_000 + 10_000 * number)).id)
                if enough.is_set():
                    return

    with serving(tmp_path, *options) as server:
        load = threading.Thread(target=submit)
        load.start()
        try:
            for number in range(3):
                while len(answered) < 20 * (number + 1):
                    time.sleep(0.01)
                before = list(answered)
                assert airmatrix("db", "backup", "--out", f"copy-{number}.sqlite").status == 0
                # One more may be in the ledger whose answer was still on its way.
                after = len(answered) + 1
                copy = tmp_path / f"copy-{number}.sqlite"
                with database(copy) as connection:
                    held = [row[0] for row in connection.rows("SELECT id FROM flight_intents ORDER BY sequence")]
                assert held[: len(before)] == before
                assert len(held) <= after
                assert_gapless(copy)
                assert_no_overlaps(copy)
        finally:
            enough.set()
            load.join()
        assert [name for name in names(tmp_path) if name.startswith(".")] == []
    with serving(tmp_path, *options, "--ledger", "copy-2.sqlite") as server, Client(server.url) as client:
        assert [intent.id for intent in client.flight_intents()] == held
        assert client.submit(along_row(0, 0, now_ms() + 600_000)).sequence == len(held) + 1
    assert airmatrix("verify", "--ledger", "copy-2.sqlite", "--airspace", town_file).status == 0


def test_commits_meanwhile_neither_get_into_a_backup_nor_make_it_begin_anew(tmp_path: Path) -> None:
    ledger, copy = tmp_path / "ledger.sqlite", tmp_path / "copy.sqlite"
    ledger.write_bytes(migrated_file())
    steps: list[float] = []
    with closing(sqlite3.connect(ledger, isolation_level=None)) as writer:
        # Enough for several steps.
        filler = [(number, "x" * 4000) for number in range(5_000)]
        writer.execute("CREATE TABLE filler (id INTEGER PRIMARY KEY, text TEXT)")
        writer.executemany("INSERT INTO filler VALUES (?, ?)", filler)

        def write_meanwhile(copied: float) -> None:
            steps.append(copied)
            if len(steps) < 100:
                writer.execute("INSERT INTO filler (text) VALUES ('meanwhile')")

        back_up(str(ledger), copy, advance=write_meanwhile)
    assert steps == sorted(steps)
    assert len(steps) >= 5
    assert steps[-1] == 1.0
    with database(copy) as connection:
        assert connection.rows("SELECT * FROM filler") == filler


# What is refused


def test_a_file_that_is_there_is_replaced_only_on_request(airmatrix: Run, ledger: Path, tmp_path: Path) -> None:
    (tmp_path / "copy.sqlite").write_text("something dear")
    airmatrix("db", "backup", "--ledger", ledger, "--out", "copy.sqlite").assert_refused(
        "copy.sqlite exists", "--force"
    )
    assert (tmp_path / "copy.sqlite").read_text() == "something dear"
    assert airmatrix("db", "backup", "--ledger", ledger, "--out", "copy.sqlite", "--force").status == 0
    assert contents(tmp_path / "copy.sqlite") == contents(ledger)


def test_a_ledger_is_not_backed_up_onto_itself(airmatrix: Run, ledger: Path, tmp_path: Path) -> None:
    (tmp_path / "alias").symlink_to(ledger)
    before = ledger.read_bytes()
    for out in (ledger, "alias"):
        airmatrix("db", "backup", "--ledger", ledger, "--out", out, "--force").assert_refused("onto itself")
    assert ledger.read_bytes() == before


def test_a_database_in_use_is_not_replaced(airmatrix: Run, ledger: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.sqlite"
    other.write_bytes(migrated_file())
    with database(other) as connection:
        connection.execute("UPDATE counters SET sequence = 5")
        airmatrix("db", "backup", "--ledger", ledger, "--out", other, "--force").assert_refused("is a database in use")
        assert connection.rows("SELECT sequence FROM counters") == [(5,)]


@pytest.mark.parametrize(
    ("out", "word"), [(".", "it is a folder"), ("nowhere/copy.sqlite", "No such file or directory")]
)
def test_a_place_that_cannot_be_written_is_refused(airmatrix: Run, ledger: Path, out: str, word: str) -> None:
    airmatrix("db", "backup", "--ledger", ledger, "--out", out).assert_refused(f"cannot write {out}", word)


def test_what_is_no_ledger_is_not_backed_up(airmatrix: Run, tmp_path: Path) -> None:
    airmatrix("db", "backup", "--out", "copy.sqlite").assert_refused("there is no ledger at airmatrix.sqlite")
    foreign_database(tmp_path / "recipes.sqlite")
    airmatrix("db", "backup", "--ledger", "recipes.sqlite", "--out", "copy.sqlite").assert_refused(
        "not an AirMatrix ledger"
    )
    assert names(tmp_path) == ["recipes.sqlite"]


def test_a_damaged_ledger_is_reported_and_no_copy_kept(airmatrix: Run, ledger: Path) -> None:
    with database(ledger) as connection:
        # Pages that belong to nothing any more: not in the way of copying.
        connection.execute("CREATE TABLE filler (text TEXT)")
        connection.execute("PRAGMA writable_schema = ON")
        connection.execute("DELETE FROM sqlite_schema WHERE name = 'filler'")
    before = names(ledger.parent)
    airmatrix("db", "backup", "--ledger", ledger, "--out", "copy.sqlite").assert_refused(
        f"ledger {ledger} is damaged, so no copy was kept", "never used"
    )
    assert names(ledger.parent) == before


def test_a_ledger_that_cannot_be_read_is_reported(airmatrix: Run, history: History, tmp_path: Path) -> None:
    damaged = bytearray(history.ledger.read_bytes())
    # The first page, after the header: the schema.
    damaged[100:4096] = bytes(4096 - 100)
    (tmp_path / "damaged.sqlite").write_bytes(damaged)
    airmatrix("db", "backup", "--ledger", "damaged.sqlite", "--out", "copy.sqlite").assert_refused("damaged.sqlite")
    assert names(tmp_path) == ["damaged.sqlite"]


def test_a_stray_row_is_reported_and_no_copy_kept(airmatrix: Run, ledger: Path) -> None:
    with database(ledger) as connection:
        connection.execute('INSERT INTO reservations (block, enter, "exit", intent) VALUES (1, 10, 20, 999)')
    before = names(ledger.parent)
    airmatrix("db", "backup", "--ledger", ledger, "--out", "copy.sqlite").assert_refused(
        "is damaged, so no copy was kept: reservations refers to flight_intents that does not exist"
    )
    assert names(ledger.parent) == before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_backup_leaves_nothing(tmp_path: Path, number: signal.Signals) -> None:
    ledger = tmp_path / "ledger.sqlite"
    ledger.write_bytes(migrated_file())
    with closing(sqlite3.connect(ledger)) as writer, writer:
        writer.execute("CREATE TABLE filler (text TEXT)")
        writer.executemany("INSERT INTO filler VALUES (?)", (("x" * 4000,) for _ in range(50_000)))
    process = subprocess.Popen(
        [AIRMATRIX, "db", "backup", "--ledger", ledger.name, "--out", "copy.sqlite"],
        cwd=tmp_path, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    while process.poll() is None and names(tmp_path) == ["ledger.sqlite"]:
        time.sleep(0.001)
    process.send_signal(number)
    process.communicate(timeout=30)
    assert process.returncode == 128 + number
    assert [name for name in names(tmp_path) if "copy" in name] == []


# PostgreSQL


DUMP = """#!/bin/sh
echo "$@" > {folder}/arguments
echo "$PGPASSWORD" > {folder}/password
for argument in "$@"; do case $argument in --file=*) echo dump > "${{argument#--file=}}";; esac; done
"""


def pretend(monkeypatch: pytest.MonkeyPatch, folder: Path, script: str | None) -> None:
    """Let there be no other programs than a `pg_dump` of this script."""
    programs = folder / "programs"
    programs.mkdir()
    if script is not None:
        (programs / "pg_dump").write_text(script)
        (programs / "pg_dump").chmod(0o755)
    monkeypatch.setenv("PATH", str(programs))


@on_postgresql
def test_a_backup_of_a_database_is_restored_by_pg_restore(
    airmatrix: Run, tmp_path: Path, town_file: Path, ledgers: PostgresqlLedgers
) -> None:
    location, restored = ledgers.migrated(), ledgers.vacant()
    options = ("--airspace", str(town_file))
    with serving(tmp_path, *options, "--ledger", location) as server, Client(server.url) as client:
        flights = [client.submit(along_row(row, 1, now_ms() + 600_000)) for row in range(4)]
        outcome = airmatrix("db", "backup", "--ledger", location, "--out", "ledger.dump")
    assert (outcome.status, outcome.err) == (0, "")
    assert names(tmp_path) == ["ledger.dump", "serve.log"]
    pg_restore = shutil.which("pg_restore")
    assert pg_restore is not None
    subprocess.run([pg_restore, f"--dbname={restored}", "--exit-on-error", "ledger.dump"], check=True)
    with serving(tmp_path, *options, "--ledger", restored) as server, Client(server.url) as client:
        assert list(client.flight_intents()) == flights
        again = along_row(0, 1, now_ms() + 600_000)
        assert client.submit(again).sequence == 5
    assert_no_overlaps(restored)
    assert airmatrix("verify", "--ledger", restored, "--airspace", town_file).status == 0


@on_postgresql
def test_the_password_is_passed_on_but_not_shown(
    airmatrix: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, ledgers: PostgresqlLedgers
) -> None:
    location = ledgers.migrated()
    password = urlsplit(location).password
    assert password
    pretend(monkeypatch, tmp_path, DUMP.format(folder=tmp_path))
    outcome = airmatrix("db", "backup", "--ledger", location, "--out", "ledger.dump")
    assert outcome.status == 0
    assert (tmp_path / "password").read_text() == f"{password}\n"
    shown = (tmp_path / "arguments").read_text() + outcome.out + outcome.err
    assert urlsplit(location).path.removeprefix("/") in shown
    assert password not in shown


@on_postgresql
@pytest.mark.parametrize(
    ("script", "words"),
    [
        (None, ("pg_dump", "install PostgreSQL's client programs")),
        (
            "#!/bin/sh\necho 'pg_dump: error: server\nversion mismatch' >&2\nexit 1\n",
            ("error: server version mismatch",),
        ),
    ],
    ids=["no pg_dump", "pg_dump fails"],
)
def test_a_database_that_cannot_be_dumped_is_reported_in_one_line(
    airmatrix: Run,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    ledgers: PostgresqlLedgers,
    script: str | None,
    words: tuple[str, ...],
) -> None:
    location = ledgers.migrated()
    pretend(monkeypatch, tmp_path, script)
    airmatrix("db", "backup", "--ledger", location, "--out", "ledger.dump").assert_refused(*words)
    assert names(tmp_path) == ["programs"]


@on_postgresql
def test_a_database_is_upgraded_without_showing_its_password(airmatrix: Run, ledgers: PostgresqlLedgers) -> None:
    location = ledgers.migrated()
    password = urlsplit(location).password
    outcome = airmatrix("db", "upgrade", "--ledger", location)
    assert (outcome.status, outcome.err) == (0, "")
    assert outcome.out == f"{location.replace(str(password), '***')} has schema {HEAD}\n"


@on_postgresql
def test_a_database_without_ledger_is_neither_backed_up_nor_upgraded(
    airmatrix: Run, tmp_path: Path, ledgers: PostgresqlLedgers
) -> None:
    location = ledgers.vacant()
    airmatrix("db", "backup", "--ledger", location, "--out", "ledger.dump").assert_refused("there is no ledger at")
    airmatrix("db", "upgrade", "--ledger", location).assert_refused("there is no ledger at")
    assert names(tmp_path) == []
