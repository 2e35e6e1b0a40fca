"""What the database guards by itself, whoever writes: proven on the migrated schema, without the service's code."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.ledger import create_or_upgrade
from tests.ledger.process import Hold, database, migrated_ledger

TABLES = {
    "airspace", "alembic_version", "counters", "flight_intents", "idempotency_keys", "journal", "reservations",
}  # fmt: skip
TRIGGERS = {
    "reservations_no_overlap_on_INSERT",
    "reservations_no_overlap_on_UPDATE",
    "journal_in_order",
    "journal_append_only_on_UPDATE",
    "journal_append_only_on_DELETE",
}
INDICES = {
    "flight_intents_by_operator",
    "flight_intents_by_time",
    "reservations_by_intent",
    "idempotency_keys_by_age",
}
CONSTRAINTS = {
    "airspace": {"airspace_only_one"},
    "counters": {"counters_only_one"},
    "flight_intents": {"flight_intents_departure_window", "flight_intents_plan_or_refusal", "flight_intents_id"},
    "reservations": {"reservations_not_empty", "reservations_intent"},
    "journal": {"journal_intent"},
    "idempotency_keys": {"idempotency_keys_intent"},
}

YEAR_MS = 365 * 86_400_000
TIMES = st.one_of(st.integers(0, 12), st.sampled_from([0, 5, 12, YEAR_MS, 100 * YEAR_MS]))
HOLDS = st.tuples(st.integers(0, 1), TIMES, TIMES)
CHANGES = st.lists(
    st.one_of(
        st.tuples(st.just("insert"), HOLDS),
        st.tuples(st.just("update"), st.integers(0, 20), HOLDS),
        st.tuples(st.just("delete"), st.integers(0, 20)),
    ),
    max_size=25,
)


@contextmanager
def migrated() -> Iterator[sqlite3.Connection]:
    """Open a migrated ledger in memory."""
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        connection.deserialize(_without_wal(migrated_ledger()))
        yield connection


def _without_wal(database: bytes) -> bytes:
    """Return a database file marked for the rollback journal: memory has no WAL."""
    return database[:18] + b"\x01\x01" + database[20:]


def names(connection: sqlite3.Connection, kind: str) -> set[str]:
    query = "SELECT name FROM sqlite_schema WHERE type = ? AND name NOT LIKE 'sqlite_%'"
    return {row[0] for row in connection.execute(query, [kind])}


def insert(connection: sqlite3.Connection, hold: Hold) -> None:
    connection.execute("INSERT INTO reservations VALUES (?, ?, ?, 1)", hold)


def holds(connection: sqlite3.Connection) -> set[Hold]:
    return set(connection.execute('SELECT block, enter, "exit" FROM reservations').fetchall())


def fits(hold: Hold, others: set[Hold]) -> bool:
    """Tell from the definition whether a hold is not empty and overlaps no other of its block."""
    block, enter, leave = hold
    return enter < leave and all(
        block != other_block or leave <= other_enter or other_leave <= enter
        for other_block, other_enter, other_leave in others
    )


def test_a_migrated_ledger_has_exactly_these_tables_triggers_and_indices() -> None:
    with migrated() as connection:
        assert names(connection, "table") == TABLES
        assert names(connection, "trigger") == TRIGGERS
        assert names(connection, "index") == INDICES


@pytest.mark.parametrize("table", CONSTRAINTS)
def test_every_constraint_of_a_table_has_its_name(table: str) -> None:
    with migrated() as connection:
        (ddl,) = connection.execute("SELECT sql FROM sqlite_schema WHERE name = ?", [table]).fetchone()
    words = ddl.replace("(", " ").split()
    named = {words[n + 1] for n, word in enumerate(words) if word == "CONSTRAINT"}
    assert named == CONSTRAINTS[table]


def test_upgrading_a_ledger_at_head_changes_no_definition_and_no_row(ledger_path: Path) -> None:
    create_or_upgrade(str(ledger_path))
    with database(ledger_path) as connection:
        before = list(connection.iterdump())
    assert create_or_upgrade(str(ledger_path)) == "0001"
    with database(ledger_path) as connection:
        assert list(connection.iterdump()) == before


def test_a_new_ledger_begins_at_sequence_0_and_revision_0() -> None:
    with migrated() as connection:
        assert connection.execute("SELECT sequence, revision FROM counters").fetchall() == [(0, 0)]


@settings(deadline=None, max_examples=300)
@given(CHANGES)
def test_the_database_accepts_exactly_the_changes_that_leave_no_overlap(changes: list[tuple[object, ...]]) -> None:
    model: set[Hold] = set()
    with migrated() as connection:
        for change in changes:
            match change:
                case ("insert", tuple(hold)):
                    accepted = fits(hold, model)
                    statement, values = "INSERT INTO reservations VALUES (?, ?, ?, 1)", hold
                    after = model | {hold}
                case ("update", int(which), tuple(hold)) if model:
                    old = sorted(model)[which % len(model)]
                    accepted = fits(hold, model - {old})
                    statement = 'UPDATE reservations SET block = ?, enter = ?, "exit" = ? WHERE block = ? AND enter = ?'
                    values = (*hold, *old[:2])
                    after = model - {old} | {hold}
                case ("delete", int(which)) if model:
                    old = sorted(model)[which % len(model)]
                    accepted = True
                    statement, values = "DELETE FROM reservations WHERE block = ? AND enter = ?", old[:2]
                    after = model - {old}
                case _:
                    continue
            try:
                connection.execute(statement, values)
            except sqlite3.IntegrityError:
                assert not accepted, change
            else:
                assert accepted, change
                model = after
            assert holds(connection) == model


@pytest.mark.parametrize(
    "other",
    [(10, 20), (10, 15), (15, 20), (12, 18), (5, 25), (5, 11), (19, 25), (10, 25), (5, 20)],
    ids=["same", "first half", "second half", "inside", "around", "begin", "end", "same begin", "same end"],
)
def test_every_way_to_overlap_a_reservation_is_refused_by_name(other: tuple[int, int]) -> None:
    with migrated() as connection:
        insert(connection, (7, 10, 20))
        with pytest.raises(sqlite3.IntegrityError, match="reservations_no_overlap"):
            insert(connection, (7, *other))
        assert holds(connection) == {(7, 10, 20)}


@pytest.mark.parametrize("other", [(0, 10), (20, 30)], ids=["before", "after"])
def test_reservations_may_touch(other: tuple[int, int]) -> None:
    with migrated() as connection:
        insert(connection, (7, 10, 20))
        insert(connection, (7, *other))
        assert holds(connection) == {(7, 10, 20), (7, *other)}


def test_another_block_may_be_reserved_at_the_same_time() -> None:
    with migrated() as connection:
        insert(connection, (7, 10, 20))
        insert(connection, (8, 10, 20))
        assert holds(connection) == {(7, 10, 20), (8, 10, 20)}


def test_a_hold_of_a_hundred_years_is_seen_behind_many_short_ones() -> None:
    with migrated() as connection:
        for n in range(1000):
            insert(connection, (7, 10 * n, 10 * n + 10))
        insert(connection, (7, 10_000, 100 * YEAR_MS))
        with pytest.raises(sqlite3.IntegrityError, match="reservations_no_overlap"):
            insert(connection, (7, 50 * YEAR_MS, 50 * YEAR_MS + 1))


@pytest.mark.parametrize("hold", [(7, 10, 10), (7, 10, 9)], ids=["empty", "backwards"])
def test_a_reservation_that_does_not_last_is_refused_by_name(hold: Hold) -> None:
    with migrated() as connection, pytest.raises(sqlite3.IntegrityError, match="reservations_not_empty"):
        insert(connection, hold)


@pytest.mark.parametrize("verb", ["INSERT OR REPLACE", "INSERT OR IGNORE", "REPLACE"])
def test_no_conflict_clause_gets_past_the_overlap_guard(verb: str) -> None:
    with migrated() as connection:
        insert(connection, (7, 10, 20))
        with pytest.raises(sqlite3.IntegrityError, match="reservations_no_overlap"):
            connection.execute(f"{verb} INTO reservations VALUES (7, 10, 15, 1)")
        assert holds(connection) == {(7, 10, 20)}


def test_an_update_cannot_move_a_reservation_onto_another() -> None:
    with migrated() as connection:
        insert(connection, (7, 10, 20))
        insert(connection, (7, 20, 30))
        with pytest.raises(sqlite3.IntegrityError, match="reservations_no_overlap"):
            connection.execute('UPDATE reservations SET "exit" = 21 WHERE enter = 10')
        assert holds(connection) == {(7, 10, 20), (7, 20, 30)}


def test_an_update_may_shorten_a_reservation_in_place() -> None:
    with migrated() as connection:
        insert(connection, (7, 10, 20))
        connection.execute('UPDATE reservations SET "exit" = 15 WHERE enter = 10')
        assert holds(connection) == {(7, 10, 15)}


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE journal SET kind = 'rejected'",
        "DELETE FROM journal",
        "INSERT OR REPLACE INTO journal VALUES (1, 5, 'rejected', 1, NULL)",
    ],
    ids=["update", "delete", "replace"],
)
def test_what_stands_in_the_journal_cannot_be_changed(statement: str) -> None:
    with migrated() as connection:
        connection.execute("INSERT INTO journal VALUES (1, 5, 'accepted', 1, NULL)")
        with pytest.raises(sqlite3.IntegrityError):
            connection.execute(statement)
        assert connection.execute("SELECT * FROM journal").fetchall() == [(1, 5, "accepted", 1, None)]


@pytest.mark.parametrize(
    ("values", "constraint"),
    [
        ({"earliest_departure": 2, "latest_departure": 1}, "flight_intents_departure_window"),
        ({"trajectory": None, "refusal": None}, "flight_intents_plan_or_refusal"),
        ({"trajectory": "[]", "refusal": "{}"}, "flight_intents_plan_or_refusal"),
    ],
)
def test_an_intent_that_contradicts_itself_is_refused(values: dict[str, object], constraint: str) -> None:
    row: dict[str, object] = {
        "sequence": 1, "id": "one", "version": 1, "state": "accepted", "operator": "acme", "aircraft_type": "drone",
        "priority": 0, "origin": "{}", "destination": "{}", "origin_block": 0, "destination_block": 1,
        "earliest_departure": 0, "latest_departure": 1, "received": 0, "trajectory": "[]", "refusal": None,
    }  # fmt: skip
    with migrated() as connection:
        columns = ", ".join(row)
        marks = ", ".join(f":{column}" for column in row)
        with pytest.raises(sqlite3.IntegrityError, match=constraint):
            connection.execute(f"INSERT INTO flight_intents ({columns}) VALUES ({marks})", row | values)  # noqa: S608


def test_a_ledger_belongs_to_one_airspace_only() -> None:
    with migrated() as connection:
        connection.execute("INSERT INTO airspace VALUES (1, 'a', 'A', 'f')")
        with pytest.raises(sqlite3.IntegrityError, match="airspace_only_one"):
            connection.execute("INSERT INTO airspace VALUES (2, 'b', 'B', 'g')")
