"""Which files are taken for ledgers. Whatever is refused stays byte for byte as it was."""

import shutil
import sqlite3
import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from app.errors import AirspaceMismatch, ForeignLedger, LedgerMissing, LedgerOutdated, StartupError
from app.ledger import create_or_upgrade, open_ledger
from app.ledger.engine import APPLICATION_ID
from app.service import running
from app.settings import Settings
from planner.airspace import OccupancyRule
from tests.ledger.district import OLD_TOWN, STREET
from tests.ledger.process import FakeClock, Process, database, migrated_ledger

AIRSPACE = OLD_TOWN.airspace


def content(folder: Path) -> dict[str, bytes]:
    """Return the bytes of every file in a folder."""
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}


def some_database(path: Path, *statements: str) -> None:
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        for statement in ("CREATE TABLE songs (title TEXT)", "INSERT INTO songs VALUES ('Yesterday')", *statements):
            connection.execute(statement)


FOREIGN: dict[str, Callable[[Path], object]] = {
    "a text file": lambda path: path.write_text("Dear diary, today I planned no flight at all.\n" * 50),
    "a short file": lambda path: path.write_bytes(b"\x00"),
    "another database": some_database,
    "another application's database": lambda path: some_database(path, "PRAGMA application_id = 1196444487"),
    "another database in WAL mode": lambda path: some_database(path, "PRAGMA journal_mode = WAL"),
    "a truncated ledger": lambda path: path.write_bytes(migrated_ledger()[:50]),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_a_foreign_file_is_not_upgraded(kind: str, ledger_path: Path) -> None:
    FOREIGN[kind](ledger_path)
    before = content(ledger_path.parent)
    with pytest.raises(ForeignLedger, match=r"ledger\.sqlite"):
        create_or_upgrade(str(ledger_path))
    assert content(ledger_path.parent) == before


@pytest.mark.parametrize("kind", FOREIGN)
def test_a_foreign_file_is_not_opened(kind: str, ledger_path: Path) -> None:
    FOREIGN[kind](ledger_path)
    before = content(ledger_path.parent)
    with pytest.raises(ForeignLedger, match=r"ledger\.sqlite"):
        open_ledger(str(ledger_path), AIRSPACE, claim=True)
    assert content(ledger_path.parent) == before


def test_a_folder_is_no_ledger(tmp_path: Path) -> None:
    with pytest.raises(ForeignLedger):
        create_or_upgrade(str(tmp_path))


def test_a_ledger_of_a_newer_schema_is_not_touched(ledger_path: Path) -> None:
    ledger_path.write_bytes(migrated_ledger())
    with database(ledger_path) as connection:
        connection.execute("UPDATE alembic_version SET version_num = '9999'")
    before = content(ledger_path.parent)
    with pytest.raises(LedgerOutdated, match="has schema 9999, newer than this program's 0001"):
        create_or_upgrade(str(ledger_path))
    assert content(ledger_path.parent) == before


def test_a_ledger_of_a_newer_schema_is_not_opened(ledger_path: Path) -> None:
    ledger_path.write_bytes(migrated_ledger())
    with database(ledger_path) as connection:
        connection.execute("UPDATE alembic_version SET version_num = '9999'")
    before = content(ledger_path.parent)
    with pytest.raises(LedgerOutdated, match="has schema 9999"):
        open_ledger(str(ledger_path), AIRSPACE)
    assert content(ledger_path.parent) == before


@pytest.mark.parametrize(
    "other",
    [
        STREET.airspace,
        replace(AIRSPACE, rule=OccupancyRule.MIDPOINT),
        replace(AIRSPACE, terminal_dwell_ms=2),
        replace(AIRSPACE, grid=replace(AIRSPACE.grid, origin_x_m=AIRSPACE.grid.origin_x_m + 1)),
        replace(AIRSPACE, occupied=~AIRSPACE.occupied),
    ],
    ids=["other grid", "other rule", "other dwell", "other place", "other buildings"],
)
def test_a_ledger_of_another_airspace_is_not_opened(other: object, ledger_path: Path) -> None:
    assert isinstance(other, type(AIRSPACE))
    ledger_path.write_bytes(migrated_ledger())
    open_ledger(str(ledger_path), AIRSPACE, claim=True).close()
    before = content(ledger_path.parent)
    with pytest.raises(AirspaceMismatch, match=r"belongs to airspace 'district' .* give that airspace's file"):
        open_ledger(str(ledger_path), other, claim=True)
    assert content(ledger_path.parent) == before


def test_a_service_started_on_a_ledger_of_another_airspace_leaves_it_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "ledger.sqlite"
    path.write_bytes(migrated_ledger())
    open_ledger(str(path), STREET.airspace, claim=True).close()
    AIRSPACE.write(tmp_path / "airspace.json")
    before = content(tmp_path)
    service = running(Settings(ledger=str(path), airspace=tmp_path / "airspace.json"), FakeClock())
    with pytest.raises(AirspaceMismatch):
        service.__enter__()
    assert content(tmp_path) == before


def test_an_airspace_with_another_name_but_the_same_blocks_and_rules_may_use_the_ledger(ledger_path: Path) -> None:
    ledger_path.write_bytes(migrated_ledger())
    open_ledger(str(ledger_path), AIRSPACE, claim=True).close()
    open_ledger(str(ledger_path), replace(AIRSPACE, id="renamed", name="Renamed", buildings=())).close()


def test_a_missing_ledger_is_not_opened_and_not_created(ledger_path: Path) -> None:
    with pytest.raises(LedgerMissing, match="there is no ledger at"):
        open_ledger(str(ledger_path), AIRSPACE)
    assert not ledger_path.exists()


def test_a_ledger_is_not_created_in_a_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(LedgerMissing, match="there is no folder"):
        create_or_upgrade(str(tmp_path / "nowhere" / "ledger.sqlite"))
    assert list(tmp_path.iterdir()) == []


def test_an_empty_file_becomes_a_ledger(ledger_path: Path) -> None:
    ledger_path.touch()
    create_or_upgrade(str(ledger_path))
    with database(ledger_path) as connection:
        assert connection.execute("PRAGMA application_id").fetchone() == (APPLICATION_ID,)


def test_a_ledger_whose_creation_was_cut_short_is_completed(ledger_path: Path) -> None:
    with database(ledger_path) as connection:
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    create_or_upgrade(str(ledger_path))
    open_ledger(str(ledger_path), AIRSPACE, claim=True).close()
    with database(ledger_path) as connection:
        assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)


def test_a_damaged_ledger_is_reported_and_left_alone(ledger_path: Path) -> None:
    ledger_path.write_bytes(migrated_ledger()[:5000])
    before = ledger_path.read_bytes()
    with pytest.raises(StartupError, match="cannot create or upgrade ledger"):
        create_or_upgrade(str(ledger_path))
    assert ledger_path.read_bytes() == before


def test_opening_without_claim_leaves_an_unclaimed_ledger_to_anybody(ledger_path: Path) -> None:
    ledger_path.write_bytes(migrated_ledger())
    open_ledger(str(ledger_path), AIRSPACE).close()
    open_ledger(str(ledger_path), STREET.airspace, claim=True).close()
    with pytest.raises(AirspaceMismatch):
        open_ledger(str(ledger_path), AIRSPACE)


def test_a_url_names_the_same_file_as_a_path(ledger_path: Path) -> None:
    create_or_upgrade(f"sqlite:///{ledger_path}")
    open_ledger(str(ledger_path), AIRSPACE).close()


def test_a_database_server_is_refused_by_its_name() -> None:
    with pytest.raises(StartupError, match="ledgers on postgresql are not supported yet"):
        create_or_upgrade("postgresql://user:secret@host/airmatrix")


@pytest.mark.parametrize(
    "name", ["a b.sqlite", "100%.sqlite", "what?.sqlite", "no#1.sqlite", "a%20b.sqlite", "ä.sqlite"]
)
def test_a_ledger_may_have_any_name(name: str, tmp_path: Path) -> None:
    create_or_upgrade(str(tmp_path / name))
    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_eight_processes_may_start_on_one_new_ledger_at_once(tmp_path: Path) -> None:
    path = tmp_path / "ledger.sqlite"
    errors: list[BaseException] = []

    def start() -> None:
        try:
            barrier.wait()
            create_or_upgrade(str(path))
            open_ledger(str(path), AIRSPACE, claim=True).close()
        except BaseException as error:
            errors.append(error)

    barrier = threading.Barrier(8)
    threads = [threading.Thread(target=start) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []


def test_a_copied_ledger_is_a_ledger(tmp_path: Path) -> None:
    with Process(tmp_path / "one.sqlite", AIRSPACE, FakeClock()) as process:
        intent = process.submit(OLD_TOWN.submission("A", "B"))
    shutil.copy(tmp_path / "one.sqlite", tmp_path / "two.sqlite")
    ledger = open_ledger(str(tmp_path / "two.sqlite"), AIRSPACE)
    found = ledger.find(intent.id)
    ledger.close()
    assert found is not None
    assert found.sequence == 1
