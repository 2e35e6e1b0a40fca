"""Ledgers of earlier versions become ledgers of this one, and lose nothing."""

import pytest
from alembic import command
from alembic.config import Config
from sqlalchemy import create_engine

from app.ledger import create_or_upgrade, open_ledger, parse_location
from app.ledger.sqlite import APPLICATION_ID
from tests.ledger.district import SQUARE
from tests.ledger.locations import REFUSED, Ledgers, database
from tests.ledger.process import FakeClock, Process

INTENT = (
    "INSERT INTO flight_intents VALUES (1, 'one', 2, 'cancelled', 'acme', NULL, 'dji-phantom-4', 0, ?, ?, 0, 1,"
    " 1000, 2000, 500, 1000, 4000, 3000, '[[0, 1000, 1000], [1, 4000, 4000]]', NULL)"
)
POSITION = '{"lon": 71.4, "lat": 51.1, "alt_m": 20.0}'


@pytest.fixture
def first_version(ledgers: Ledgers) -> str:
    """Return a ledger of the first schema, with one flight that was cancelled."""
    location = ledgers.vacant()
    engine = create_engine(parse_location(location).url)
    config = Config()
    config.set_main_option("script_location", "migrations")
    config.set_main_option("path_separator", "os")
    with engine.begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, "0001")
    engine.dispose()
    with database(location) as connection:
        if connection.is_sqlite:
            connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute(INTENT, [POSITION, POSITION])
        connection.execute("INSERT INTO journal VALUES (1, 500, 'accepted', 1, NULL)")
        connection.execute("INSERT INTO journal VALUES (2, 600, 'cancelled', 1, '[[0, 1000, 1001]]')")
        connection.execute("UPDATE counters SET sequence = 1, revision = 2, longest_flight = 3000")
    return location


def test_a_ledger_of_the_first_version_keeps_its_intents_and_its_journal(first_version: str, clock: FakeClock) -> None:
    create_or_upgrade(first_version)
    with Process(first_version, SQUARE.airspace, clock) as process:
        entries = process.ledger.journal_after(0, 10)
        intent = process.submit(SQUARE.submission("N", "S"))
    assert [(entry.revision, entry.kind, entry.intent_id, entry.sequence) for entry in entries] == [
        (1, "accepted", "one", 1),
        (2, "cancelled", "one", 1),
    ]
    assert entries[1].released.tolist() == [[0, 1000, 1001]]
    assert (intent.sequence, intent.version) == (2, 3)


def test_the_upgraded_journal_is_guarded_as_before(first_version: str) -> None:
    create_or_upgrade(first_version)
    open_ledger(first_version, SQUARE.airspace, claim=True).close()
    for statement in ("DELETE FROM journal", "UPDATE journal SET kind = 'rejected'"):
        with database(first_version) as connection, pytest.raises(REFUSED, match="journal_append_only"):
            connection.execute(statement)
