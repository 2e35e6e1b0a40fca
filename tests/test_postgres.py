"""The tests' own PostgreSQL servers: separate, clean, and gone whatever happens."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psycopg
import pytest

from tests.postgres import VARIABLE, NoPostgres, Server, cluster, server

pytestmark = pytest.mark.postgres

NOWHERE = "postgresql://somebody:secret@127.0.0.1:1/postgres"

RUNS_UNTIL_KILLED = """
import sys, time
from tests.postgres import cluster
with cluster() as server:
    with server.connect() as connection:
        (folder,) = connection.execute("SHOW data_directory").fetchone()
    print(folder, flush=True)
    time.sleep(60)
"""

NEEDS_A_LEDGER = """
def test_something(postgres_template):
    pass
"""


def databases(server: Server) -> set[str]:
    with server.connect() as connection:
        return {name for (name,) in connection.execute("SELECT datname FROM pg_database")}


def until(reached: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 10
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_database_made_from_another_has_its_rows_and_is_its_own(postgres: Server) -> None:
    one = postgres.database()
    with psycopg.connect(one) as connection:
        connection.execute("CREATE TABLE songs AS SELECT 'Yesterday' AS title")
    other = postgres.database(one)
    with psycopg.connect(one) as connection:
        connection.execute("DELETE FROM songs")
    with psycopg.connect(other) as connection:
        assert connection.execute("SELECT title FROM songs").fetchall() == [("Yesterday",)]
    postgres.drop(one)
    postgres.drop(other)
    assert databases(postgres).isdisjoint({one.split("/")[-1], other.split("/")[-1]})


def test_a_server_that_was_crashed_comes_back_where_it_was(postgres: Server) -> None:
    del postgres  # It says whether there can be another.
    with cluster(durable=True) as private:
        location = private.database()
        with psycopg.connect(location) as connection:
            assert connection.execute("SHOW fsync").fetchone() == ("on",)
            connection.execute("CREATE TABLE songs AS SELECT 'Yesterday' AS title")
        private.restart("immediate")
        with psycopg.connect(location) as connection:
            assert connection.execute("SELECT title FROM songs").fetchall() == [("Yesterday",)]
        private.stop()
        with pytest.raises(psycopg.OperationalError):
            private.connect()


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL], ids=lambda end: end.name)
def test_nothing_of_a_server_survives_its_process_however_that_ends(end: signal.Signals, postgres: Server) -> None:
    del postgres
    process = subprocess.Popen(
        [sys.executable, "-c", RUNS_UNTIL_KILLED], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None
    folder = Path(process.stdout.readline().decode().strip())
    postmaster = int((folder / "postmaster.pid").read_text().split()[0])
    process.send_signal(end)
    process.communicate()
    until(lambda: not folder.parent.exists() and not Path(f"/proc/{postmaster}").exists())


def test_what_was_made_on_an_existing_server_is_dropped_at_the_end(
    postgres: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = databases(postgres)
    monkeypatch.setenv(VARIABLE, postgres.url("postgres"))
    with server() as existing:
        existing.database()
        assert len(databases(postgres)) == len(before) + 1
    assert databases(postgres) == before


def test_a_server_that_is_named_but_cannot_be_reached_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, NOWHERE)
    with pytest.raises(NoPostgres, match=rf"{VARIABLE} names a server that cannot be reached"), server():
        pass


@pytest.mark.parametrize(("ci", "outcome"), [("false", "1 skipped"), ("true", "1 error")])
def test_without_a_server_tests_are_skipped_but_on_ci_they_fail(ci: str, outcome: str, tmp_path: Path) -> None:
    (tmp_path / "test_something.py").write_text(NEEDS_A_LEDGER)
    environment = os.environ | {VARIABLE: NOWHERE, "CI": ci}
    command = [sys.executable, "-m", "pytest", "-p", "tests.conftest", "-p", "no:cacheprovider", "-rs", str(tmp_path)]
    said = subprocess.run(command, env=environment, capture_output=True, text=True, check=False).stdout
    assert outcome in said
    assert f"{VARIABLE} names a server that cannot be reached" in said
