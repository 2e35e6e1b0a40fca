"""`airmatrix serve --read-only`: reads of a ledger that others write."""

import os
import shutil
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import httpx
import pytest

from app.client import Client, ProblemAnswer
from app.flight_intents import State
from app.times import now_ms
from tests.cli.conftest import History
from tests.cli.serving import AIRMATRIX, Server, serving
from tests.cli.standby import on_port, standby
from tests.cli.test_serve import foreign_database, serve
from tests.cli.town import along_row
from tests.ledger.locations import Ledgers, content, database, migrated_file
from tests.postgres import Cluster, NoPostgres, cluster


@pytest.fixture(scope="module")
def archive(
    tmp_path_factory: pytest.TempPathFactory, town_file: Path, history: History
) -> Iterator[tuple[Server, Path]]:
    """A read-only service on a ledger with every kind of intent."""
    folder = tmp_path_factory.mktemp("archive")
    ledger = Path(shutil.copy(history.ledger, folder / "history.sqlite"))
    with serving(folder, "--airspace", str(town_file), "--ledger", str(ledger), "--read-only") as server:
        yield server, ledger


def test_every_read_is_answered(archive: tuple[Server, Path], history: History) -> None:
    server, _ = archive
    flight = history.rows[0]
    with Client(server.url) as client:
        intents = list(client.flight_intents())
        assert len(intents) == 11
        assert client.flight_intent(flight.id) == flight
        assert len(client.events().items) == 13
        assert client.airspace().id == "town"
        assert "dji-mavic-air" in {aircraft.id for aircraft in client.aircraft_types()}
        in_flight = client.status(flight.reservations[4].enter)
        assert flight.id in {id_ for block in in_flight.blocks for id_ in block.flight_intents}
    assert httpx.get(f"{server.url}/metrics").status_code == 200


def test_it_says_that_it_only_reads(archive: tuple[Server, Path]) -> None:
    server, _ = archive
    assert httpx.get(f"{server.url}/health/ready").json()["mode"] == "read-only"
    assert httpx.get(f"{server.url}/version").json()["mode"] == "read-only"
    assert "mode=read-only" in server.log.read_text()


WRITES: dict[str, Callable[[Client, str], object]] = {
    "submit": lambda client, _: client.submit(along_row(0, 0, now_ms() + 3_600_000)),
    "preview": lambda client, _: client.preview(along_row(0, 0, now_ms() + 3_600_000)),
    "cancel": lambda client, known: client.cancel(known),
}


@pytest.mark.parametrize("write", WRITES)
def test_writes_are_refused(archive: tuple[Server, Path], history: History, write: str) -> None:
    server, ledger = archive
    with Client(server.url) as client, pytest.raises(ProblemAnswer, match="only answers reads") as refusal:
        WRITES[write](client, history.rows[0].id)
    assert refusal.value.status == 421
    assert refusal.value.members["type"] == "/problems/read-only"
    with database(ledger) as connection:
        assert connection.rows("SELECT sequence, revision FROM counters") == [(11, 13)]


def test_a_ledger_is_neither_claimed_nor_changed_and_no_kernel_is_compiled(tmp_path: Path, town_file: Path) -> None:
    ledger = tmp_path / "kept" / "new.sqlite"
    ledger.parent.mkdir()
    ledger.write_bytes(migrated_file())
    before = content(ledger)
    options = ("--airspace", str(town_file), "--ledger", str(ledger), "--read-only")
    with serving(tmp_path, *options, NUMBA_CACHE_DIR=str(tmp_path / "kernels")) as server:
        with Client(server.url) as client:
            assert list(client.flight_intents()) == []
        assert server.stop() == 0
    assert content(ledger) == before
    assert list((tmp_path / "kernels").rglob("*.nb?")) == []


def older(path: Path) -> None:
    path.write_bytes(migrated_file())
    with database(path) as connection:
        connection.execute("UPDATE alembic_version SET version_num = '0001'")


def elsewhere(path: Path) -> None:
    path.write_bytes(migrated_file())
    with database(path) as connection:
        connection.execute("INSERT INTO airspace (only, id, name, fingerprint) VALUES (1, 'tarn', 'Tarn', 'abc')")


def absent(_: Path) -> None:
    """Leave nothing there."""


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (absent, ("there is no ledger at kept/ledger.sqlite",)),
        (foreign_database, ("not an AirMatrix ledger",)),
        (elsewhere, ("belongs to airspace 'tarn'", "not to 'town'")),
        (older, ("has schema 0001", "run: airmatrix db upgrade")),
    ],
)
def test_what_is_no_ledger_of_this_airspace_and_schema_is_refused_and_left_as_it_was(
    tmp_path: Path, town_file: Path, make: Callable[[Path], object], words: tuple[str, ...]
) -> None:
    (tmp_path / "kept").mkdir()
    make(tmp_path / "kept" / "ledger.sqlite")
    before = content(tmp_path / "kept" / "ledger.sqlite")
    options = ("--port", 0, "--airspace", town_file, "--ledger", "kept/ledger.sqlite")
    serve(tmp_path, *options, AIRMATRIX_READ_ONLY="true").assert_refused(*words)
    assert content(tmp_path / "kept" / "ledger.sqlite") == before


def test_what_others_write_is_read_at_once(ledgers: Ledgers, tmp_path: Path, town_file: Path) -> None:
    options = ("--airspace", str(town_file), "--ledger", ledgers.vacant())
    with (
        serving(tmp_path, *options) as writing,
        serving(tmp_path, *options, "--read-only", "--workers", "2", log="reading.log") as reading,
        Client(writing.url) as writer,
    ):
        for number in range(8):
            intent = writer.submit(along_row(number % 4, 1, now_ms() + 600_000 + 60_000 * number))
            # A connection of its own each time, so that any worker may answer.
            with Client(reading.url) as reader:
                assert reader.flight_intent(intent.id) == intent
                cancelled = writer.cancel(intent.id)
                assert cancelled.state == State.CANCELLED
                assert reader.flight_intent(intent.id) == cancelled
                assert reader.events(2 * number).items == writer.events(2 * number).items
                assert reader.readiness().revision == 2 * number + 2


@pytest.fixture
def primary() -> Iterator[Cluster]:
    """Return a PostgreSQL server that may have a standby."""
    with ExitStack() as stack:
        try:
            private = stack.enter_context(cluster())
        except NoPostgres as error:
            if os.environ.get("CI") == "true":
                raise
            pytest.skip(str(error))
        yield private


@pytest.mark.postgres
def test_a_hot_standby_is_read_and_cannot_be_served_otherwise(
    primary: Cluster, tmp_path: Path, town_file: Path
) -> None:
    location, options = primary.database(), ("--airspace", str(town_file))
    with (
        serving(tmp_path, *options, "--ledger", location, log="writing.log") as writing,
        Client(writing.url) as writer,
        standby(primary) as port,
    ):
        copy = on_port(location, port)
        serve(tmp_path, *options, "--port", 0, "--ledger", copy).assert_refused("read-only transaction")
        with (
            serving(tmp_path, *options, "--ledger", copy, "--read-only") as reading,
            Client(reading.url) as reader,
        ):
            flights = [writer.submit(along_row(row, 1, now_ms() + 600_000)) for row in range(4)]
            # It follows, a moment behind.
            until = time.monotonic() + 30
            while reader.readiness().revision < 4 and time.monotonic() < until:
                time.sleep(0.01)
            assert list(reader.flight_intents()) == flights
            with pytest.raises(ProblemAnswer, match="only answers reads"):
                reader.cancel(flights[0].id)


# Without permission to write


def without_privileges() -> list[str]:
    """Return what to put before a command so that the modes of files bind it, also for root."""
    if os.geteuid() != 0:
        return []
    setpriv = shutil.which("setpriv")
    if setpriv is None:
        pytest.skip("files' modes do not bind root, and there is no setpriv")
    return [setpriv, "--bounding-set=-dac_override,-dac_read_search", "--"]


@pytest.fixture
def locked(tmp_path: Path, history: History) -> Iterator[Path]:
    """A ledger in a folder, both without permission to write."""
    folder = tmp_path / "locked"
    folder.mkdir()
    ledger = Path(shutil.copy(history.ledger, folder / "ledger.sqlite"))
    ledger.chmod(0o444)
    yield ledger
    folder.chmod(0o755)


def test_a_file_without_write_permission_can_be_read_beside_a_writer(
    tmp_path: Path, town_file: Path, locked: Path
) -> None:
    with closing(sqlite3.connect(locked)) as writer:
        # What the writer's process keeps beside the file is there as long as it runs.
        writer.execute("BEGIN IMMEDIATE")
        locked.parent.chmod(0o555)
        options = ("--airspace", str(town_file), "--ledger", str(locked), "--read-only")
        with (
            serving(tmp_path, *options, program=[*without_privileges(), str(AIRMATRIX)]) as server,
            Client(server.url) as client,
        ):
            assert len(list(client.flight_intents())) == 11


def test_a_file_that_cannot_be_read_without_writing_is_refused_in_one_line(
    tmp_path: Path, town_file: Path, locked: Path
) -> None:
    locked.parent.chmod(0o555)
    before = content(locked)
    options = ("--port", 0, "--airspace", town_file, "--ledger", locked, "--read-only")
    serve(tmp_path, *options, program=[*without_privileges(), str(AIRMATRIX)]).assert_refused(
        f"cannot open ledger {locked}"
    )
    assert content(locked) == before
