"""Ledgers of earlier versions become ledgers of this one, and lose nothing."""

import asyncio
import json
from typing import Any

import pytest
from alembic import command
from alembic.config import Config
from sqlalchemy import create_engine

from app.flight_intents import State
from app.ledger import create_or_upgrade, open_ledger, parse_location
from app.ledger.sqlite import APPLICATION_ID
from tests.ledger.district import AIRCRAFT, SQUARE, START_MS, STREET
from tests.ledger.locations import HEAD, REFUSED, Ledgers, database
from tests.ledger.process import FakeClock, Process

INTENT = (
    "INSERT INTO flight_intents VALUES (1, 'one', 2, 'cancelled', 'acme', NULL, 'dji-phantom-4', 0, ?, ?, 0, 1,"
    " 1000, 2000, 500, 1000, 4000, 3000, '[[0, 1000, 1000], [1, 4000, 4000]]', NULL)"
)
PATH = f"[[0, {START_MS + 1_000}, {START_MS + 1_000}], [1, {START_MS + 2_668}, {START_MS + 2_668}]]"
REFUSAL = json.dumps(
    {"reason": "no_departure_slot", "detail": "why", "conflicting_intents": [], "earliest_feasible_departure_ms": None}
)
POSITION = '{"lon": 71.4, "lat": 51.1, "alt_m": 20.0}'


def migrated_to(version: str, location: str) -> str:
    """Make a ledger of an earlier schema at a location, and return that."""
    engine = create_engine(parse_location(location).url)
    config = Config()
    config.set_main_option("script_location", "migrations")
    config.set_main_option("path_separator", "os")
    with engine.begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, version)
    engine.dispose()
    with database(location) as connection:
        if connection.is_sqlite:
            connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    return location


@pytest.fixture
def first_version(ledgers: Ledgers) -> str:
    """Return a ledger of the first schema, with one flight that was cancelled."""
    location = migrated_to("0001", ledgers.vacant())
    with database(location) as connection:
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


# What a ledger held before there was monitoring: three flights of the street, one of them refused and one cancelled.
TABLES = ("airspace", "counters", "flight_intents", "idempotency_keys", "journal", "reservations")
DEPARTED_MS = START_MS + 1_000


@pytest.fixture
def second_version(ledgers: Ledgers) -> str:
    """Return a ledger of the second schema with something in each of its tables."""
    location = migrated_to("0002", ledgers.vacant())
    rows: list[tuple[str, tuple[Any, ...]]] = [
        ("airspace", (1, STREET.airspace.id, STREET.airspace.name, STREET.airspace.fingerprint)),
        *(
            (
                "flight_intents",
                (
                    sequence, f"flight-{sequence}", sequence + (state == "cancelled"), state, "acme", None, AIRCRAFT, 0,
                    POSITION, POSITION, 0, 1, START_MS, START_MS + 9_000, START_MS, *plan,
                ),
            )
            for sequence, state, plan in [
                (1, "accepted", (DEPARTED_MS, DEPARTED_MS + 1_668, 1_668, PATH, None)),
                (2, "rejected", (None, None, None, None, REFUSAL)),
                (3, "cancelled", (DEPARTED_MS, DEPARTED_MS + 1_668, 1_668, PATH, None)),
            ]
        ),
        *(("reservations", (block, DEPARTED_MS, DEPARTED_MS + 1_669, 1)) for block in (0, 1)),
        ("journal", (1, START_MS, "accepted", 1, "flight-1", None)),
        ("journal", (2, START_MS, "rejected", 2, "flight-2", None)),
        ("journal", (3, START_MS, "accepted", 3, "flight-3", None)),
        ("journal", (4, START_MS + 1, "cancelled", 3, "flight-3", f"[[0, {DEPARTED_MS}, {DEPARTED_MS + 1_669}]]")),
        ("idempotency_keys", ("acme", "key", "digest", 1, "{}", START_MS)),
    ]  # fmt: skip
    with database(location) as connection:
        for table, values in rows:
            connection.execute(f"INSERT INTO {table} VALUES ({', '.join('?' * len(values))})", values)  # noqa: S608
        connection.execute("UPDATE counters SET sequence = 3, revision = 4, longest_flight = 1668, removed_before = 7")
    return location


def content_of(location: str) -> dict[str, list[tuple[Any, ...]]]:
    """Return all rows of all tables of the second schema."""
    with database(location) as connection:
        return {table: connection.rows(f"SELECT * FROM {table} ORDER BY 1, 2") for table in TABLES}  # noqa: S608


def test_a_ledger_of_the_second_version_keeps_every_row(second_version: str) -> None:
    before = content_of(second_version)
    assert create_or_upgrade(second_version) == HEAD
    after = content_of(second_version)
    # Since then: positions removed, the lowest priority; activated, submitted; track, reasons and details.
    new = {"counters": (0, 0), "flight_intents": (None, False), "journal": (None, None, None)}
    expected = {table: [(*row, *new.get(table, ())) for row in rows] for table, rows in before.items()}
    # Each entry of the journal is its revision's first.
    expected["journal"] = [(revision, 0, *rest) for revision, *rest in expected["journal"]]
    assert after == expected
    assert sum(len(rows) for rows in after.values()) == 12
    with database(second_version) as connection:
        for table in ("newest_positions", "position_history", "remarks", "constraints", "webhooks", "webhook_events"):
            assert connection.rows(f"SELECT * FROM {table}") == []  # noqa: S608


def test_what_an_upgraded_ledger_held_is_monitored(second_version: str, clock: FakeClock) -> None:
    create_or_upgrade(second_version)
    with Process(second_version, STREET.airspace, clock) as process:
        (accepted, rejected, cancelled), strays = process.ledger.everything()
        assert (len(accepted.reservations), len(rejected.reservations), len(cancelled.reservations)) == (2, 0, 0)
        assert (accepted.activated_ms, strays) == (None, {})
        assert process.ledger.unseen(START_MS + 3_600_000, 10) == 1
        intent = asyncio.run(process.deconfliction.activate(accepted.id))
        assert (intent.state, intent.version, intent.activated_ms) == (State.ACTIVATED, 5, START_MS)
        assert process.submit(STREET.submission("W", "E")).sequence == 4
