"""Which files are taken for ledgers. Whatever is refused stays byte for byte as it was."""

import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from app.errors import ForeignLedger, LedgerMissing, StartupError
from app.ledger import create_or_upgrade, open_ledger
from app.ledger.sqlite import APPLICATION_ID
from tests.ledger.district import OLD_TOWN
from tests.ledger.locations import content, database, migrated_file
from tests.ledger.process import FakeClock, Process

AIRSPACE = OLD_TOWN.airspace


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
    "a truncated ledger": lambda path: path.write_bytes(migrated_file()[:50]),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_a_foreign_file_is_not_upgraded(kind: str, ledger_path: Path) -> None:
    FOREIGN[kind](ledger_path)
    before = content(ledger_path)
    with pytest.raises(ForeignLedger, match=r"ledger\.sqlite"):
        create_or_upgrade(str(ledger_path))
    assert content(ledger_path) == before


@pytest.mark.parametrize("kind", FOREIGN)
def test_a_foreign_file_is_not_opened(kind: str, ledger_path: Path) -> None:
    FOREIGN[kind](ledger_path)
    before = content(ledger_path)
    with pytest.raises(ForeignLedger, match=r"ledger\.sqlite"):
        open_ledger(str(ledger_path), AIRSPACE, claim=True)
    assert content(ledger_path) == before


def test_a_folder_is_no_ledger(tmp_path: Path) -> None:
    with pytest.raises(ForeignLedger):
        create_or_upgrade(str(tmp_path))


def test_a_ledger_is_not_created_in_a_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(LedgerMissing, match="there is no folder"):
        create_or_upgrade(str(tmp_path / "nowhere" / "ledger.sqlite"))
    assert list(tmp_path.iterdir()) == []


def test_an_empty_file_becomes_a_ledger(ledger_path: Path) -> None:
    ledger_path.touch()
    create_or_upgrade(str(ledger_path))
    with database(ledger_path) as connection:
        assert connection.rows("PRAGMA application_id") == [(APPLICATION_ID,)]


def test_a_ledger_whose_creation_was_cut_short_is_completed(ledger_path: Path) -> None:
    with database(ledger_path) as connection:
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    create_or_upgrade(str(ledger_path))
    open_ledger(str(ledger_path), AIRSPACE, claim=True).close()
    with database(ledger_path) as connection:
        assert connection.rows("PRAGMA journal_mode") == [("wal",)]


def test_a_damaged_ledger_is_reported_and_left_alone(ledger_path: Path) -> None:
    ledger_path.write_bytes(migrated_file()[:5000])
    before = ledger_path.read_bytes()
    with pytest.raises(StartupError, match="cannot create or upgrade ledger"):
        create_or_upgrade(str(ledger_path))
    assert ledger_path.read_bytes() == before


def test_a_url_names_the_same_file_as_a_path(ledger_path: Path) -> None:
    create_or_upgrade(f"sqlite:///{ledger_path}")
    open_ledger(str(ledger_path), AIRSPACE).close()


@pytest.mark.parametrize(
    "name", ["a b.sqlite", "100%.sqlite", "what?.sqlite", "no#1.sqlite", "a%20b.sqlite", "ä.sqlite"]
)
def test_a_ledger_may_have_any_name(name: str, tmp_path: Path) -> None:
    create_or_upgrade(str(tmp_path / name))
    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_a_copied_file_is_a_ledger(tmp_path: Path) -> None:
    (tmp_path / "one.sqlite").write_bytes(migrated_file())
    with Process(str(tmp_path / "one.sqlite"), AIRSPACE, FakeClock()) as process:
        intent = process.submit(OLD_TOWN.submission("A", "B"))
    shutil.copy(tmp_path / "one.sqlite", tmp_path / "two.sqlite")
    ledger = open_ledger(str(tmp_path / "two.sqlite"), AIRSPACE)
    found = ledger.find(intent.id)
    ledger.close()
    assert found is not None
    assert found.sequence == 1


def test_a_new_ledger_is_not_made_beside_the_log_of_one_that_is_gone(tmp_path: Path) -> None:
    path = tmp_path / "ledger.sqlite"
    log = tmp_path / "ledger.sqlite-wal"
    log.write_bytes(b"what somebody committed")
    with pytest.raises(ForeignLedger, match="belongs to a ledger that is gone"):
        create_or_upgrade(str(path))
    assert not path.exists()
    assert log.read_bytes() == b"what somebody committed"


def test_checkpoints_leave_the_log_of_a_ledger_that_was_moved_away(tmp_path: Path) -> None:
    path = tmp_path / "ledger.sqlite"
    path.write_bytes(migrated_file())
    ledger = open_ledger(str(path), AIRSPACE, claim=True)
    ledger.checkpoint()
    with ledger.transaction() as transaction:
        transaction.touch()
    path.rename(tmp_path / "away.sqlite")
    ledger.checkpoint()
    assert not path.exists()
    assert (tmp_path / "ledger.sqlite-wal").stat().st_size > 0
    (tmp_path / "away.sqlite").rename(path)
    ledger.close()
