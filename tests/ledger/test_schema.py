"""What the database guards by itself, whoever writes: proven on the migrated schema, without the service's code."""

import threading
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from app.ledger import create_or_upgrade
from tests.ledger.locations import HEAD, REFUSED, Ledgers, Stranger, content, database, on_postgresql, on_sqlite
from tests.ledger.process import Hold

TABLES = {
    "airspace", "alembic_version", "constraints", "counters", "flight_intents", "idempotency_keys", "journal",
    "newest_positions", "position_history", "remarks", "reservations", "webhook_desk", "webhook_events", "webhooks",
}  # fmt: skip
INDICES = {
    "flight_intents_by_operator",
    "flight_intents_by_time",
    "flight_intents_by_end",
    "flight_intents_open",
    "flight_intents_open_by_operator",
    "flight_intents_over_by_operator",
    "flight_intents_movable",
    "reservations_by_intent",
    "idempotency_keys_by_age",
    "idempotency_keys_by_intent",
    "journal_by_intent",
    "newest_positions_by_time",
    "position_history_by_time",
    "webhook_events_first",
}
CONSTRAINTS = {
    "airspace": {"airspace_only_one"},
    "counters": {"counters_only_one"},
    "flight_intents": {"flight_intents_departure_window", "flight_intents_plan_or_refusal", "flight_intents_id"},
    "reservations": {"reservations_not_empty", "reservations_intent"},
    "journal": set[str](),
    "idempotency_keys": {"idempotency_keys_intent"},
    "newest_positions": set[str](),
    "position_history": set[str](),
    "remarks": set[str](),
    "constraints": {"constraints_not_empty", "constraints_id"},
    "webhooks": {"webhooks_id"},
    "webhook_events": set[str](),
    "webhook_desk": {"webhook_desk_only_one"},
}
# What holds reservations apart, and the journal as it is: SQLite has no exclusion constraints, and no TRUNCATE.
SQLITE_TRIGGERS = {
    "reservations_no_overlap_on_INSERT",
    "reservations_no_overlap_on_UPDATE",
    "journal_in_order",
    "journal_append_only_on_UPDATE",
    "journal_append_only_on_DELETE",
}
POSTGRESQL_TRIGGERS = {"journal_in_order", "journal_append_only", "journal_append_only_as_a_whole"}
POSTGRESQL_EXCLUSIONS = {"reservations": {"reservations_no_overlap"}}

INTENT: dict[str, object] = {
    "sequence": 1, "id": "one", "version": 1, "state": "accepted", "operator": "acme", "aircraft_type": "drone",
    "priority": 0, "origin": "{}", "destination": "{}", "origin_block": 0, "destination_block": 1,
    "earliest_departure": 0, "latest_departure": 1, "received": 0, "trajectory": "[]", "refusal": None,
}  # fmt: skip

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


@pytest.fixture
def migrated(ledger: str) -> Iterator[Stranger]:
    """Open a new ledger, with one flight intent."""
    with database(ledger) as connection:
        if connection.is_sqlite:
            connection.execute("PRAGMA synchronous = OFF")  # Nobody cuts the power here.
        insert_intent(connection, INTENT)
        yield connection


def names(connection: Stranger, kind: str) -> set[str]:
    """Return the names of tables, triggers or indices, but not of indices that belong to a constraint."""
    queries = {
        "table": "SELECT relname FROM pg_class WHERE relkind = 'r' AND relnamespace = 'public'::regnamespace",
        "trigger": "SELECT tgname FROM pg_trigger WHERE NOT tgisinternal",
        "index": "SELECT relname FROM pg_class WHERE relkind = 'i' AND relnamespace = 'public'::regnamespace"
        " AND NOT EXISTS (SELECT FROM pg_constraint WHERE conindid = pg_class.oid)",
    }
    if connection.is_sqlite:
        rows = connection.rows("SELECT name FROM sqlite_schema WHERE type = ? AND name NOT LIKE 'sqlite_%'", [kind])
    else:
        rows = connection.rows(queries[kind])
    return {name for (name,) in rows}


def constraints(connection: Stranger, table: str) -> set[str]:
    """Return the names of a table's constraints, but for its primary key."""
    if not connection.is_sqlite:
        query = "SELECT conname FROM pg_constraint WHERE conrelid = ?::regclass AND contype IN ('c', 'f', 'u', 'x')"
        return {name for (name,) in connection.rows(query, [table])}
    ((ddl,),) = connection.rows("SELECT sql FROM sqlite_schema WHERE name = ?", [table])
    words = ddl.replace("(", " ").split()
    return {words[n + 1] for n, word in enumerate(words) if word == "CONSTRAINT"}


def insert(connection: Stranger, hold: Hold) -> None:
    connection.execute("INSERT INTO reservations VALUES (?, ?, ?, 1)", hold)


def insert_intent(connection: Stranger, row: dict[str, object]) -> None:
    columns, marks = ", ".join(row), ", ".join("?" for _ in row)
    connection.execute(f"INSERT INTO flight_intents ({columns}) VALUES ({marks})", list(row.values()))  # noqa: S608


def holds(connection: Stranger) -> set[Hold]:
    return {
        (block, enter, leave)
        for block, enter, leave in connection.rows('SELECT block, enter, "exit" FROM reservations')
    }


def fits(hold: Hold, others: set[Hold]) -> bool:
    """Tell from the definition whether a hold is not empty and overlaps no other of its block."""
    block, enter, leave = hold
    return enter < leave and all(
        block != other_block or leave <= other_enter or other_leave <= enter
        for other_block, other_enter, other_leave in others
    )


def test_a_migrated_ledger_has_exactly_these_tables_triggers_and_indices(migrated: Stranger) -> None:
    assert names(migrated, "table") == TABLES
    assert names(migrated, "trigger") == (SQLITE_TRIGGERS if migrated.is_sqlite else POSTGRESQL_TRIGGERS)
    assert names(migrated, "index") == INDICES


@pytest.mark.parametrize("table", CONSTRAINTS)
def test_every_constraint_of_a_table_has_its_name(table: str, migrated: Stranger) -> None:
    exclusions = set() if migrated.is_sqlite else POSTGRESQL_EXCLUSIONS.get(table, set())
    assert constraints(migrated, table) == CONSTRAINTS[table] | exclusions


def test_upgrading_a_ledger_at_head_changes_no_definition_and_no_row(ledgers: Ledgers) -> None:
    ledger = ledgers.vacant()
    create_or_upgrade(ledger)
    before = content(ledger)
    assert create_or_upgrade(ledger) == HEAD
    assert content(ledger) == before


def test_a_new_ledger_begins_at_sequence_0_and_revision_0(migrated: Stranger) -> None:
    assert migrated.rows("SELECT sequence, revision FROM counters") == [(0, 0)]


@settings(deadline=None, max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(changes=CHANGES)
def test_the_database_accepts_exactly_the_changes_that_leave_no_overlap(
    migrated: Stranger, changes: list[tuple[object, ...]]
) -> None:
    migrated.execute("DELETE FROM reservations")
    model: set[Hold] = set()
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
            migrated.execute(statement, values)
        except REFUSED:
            assert not accepted, change
        else:
            assert accepted, change
            model = after
        assert holds(migrated) == model


@pytest.mark.parametrize(
    "other",
    [(10, 20), (10, 15), (15, 20), (12, 18), (5, 25), (5, 11), (19, 25), (10, 25), (5, 20)],
    ids=["same", "first half", "second half", "inside", "around", "begin", "end", "same begin", "same end"],
)
def test_every_way_to_overlap_a_reservation_is_refused_by_name(other: tuple[int, int], migrated: Stranger) -> None:
    insert(migrated, (7, 10, 20))
    with pytest.raises(REFUSED, match="reservations_no_overlap"):
        insert(migrated, (7, *other))
    assert holds(migrated) == {(7, 10, 20)}


@pytest.mark.parametrize("other", [(0, 10), (20, 30)], ids=["before", "after"])
def test_reservations_may_touch(other: tuple[int, int], migrated: Stranger) -> None:
    insert(migrated, (7, 10, 20))
    insert(migrated, (7, *other))
    assert holds(migrated) == {(7, 10, 20), (7, *other)}


def test_another_block_may_be_reserved_at_the_same_time(migrated: Stranger) -> None:
    insert(migrated, (7, 10, 20))
    insert(migrated, (8, 10, 20))
    assert holds(migrated) == {(7, 10, 20), (8, 10, 20)}


def test_a_hold_of_a_hundred_years_is_seen_behind_many_short_ones(migrated: Stranger) -> None:
    for n in range(1000):
        insert(migrated, (7, 10 * n, 10 * n + 10))
    insert(migrated, (7, 10_000, 100 * YEAR_MS))
    with pytest.raises(REFUSED, match="reservations_no_overlap"):
        insert(migrated, (7, 50 * YEAR_MS, 50 * YEAR_MS + 1))


@pytest.mark.parametrize("hold", [(7, 10, 10), (7, 10, 9)], ids=["empty", "backwards"])
def test_a_reservation_that_does_not_last_is_refused_by_name(hold: Hold, migrated: Stranger) -> None:
    with pytest.raises(REFUSED, match="reservations_not_empty"):
        insert(migrated, hold)


@on_sqlite
@pytest.mark.parametrize("verb", ["INSERT OR REPLACE", "INSERT OR IGNORE", "REPLACE"])
def test_no_conflict_clause_gets_past_the_overlap_guard(verb: str, migrated: Stranger) -> None:
    insert(migrated, (7, 10, 20))
    with pytest.raises(REFUSED, match="reservations_no_overlap"):
        migrated.execute(f"{verb} INTO reservations VALUES (7, 10, 15, 1)")
    assert holds(migrated) == {(7, 10, 20)}


def test_an_update_cannot_move_a_reservation_onto_another(migrated: Stranger) -> None:
    insert(migrated, (7, 10, 20))
    insert(migrated, (7, 20, 30))
    with pytest.raises(REFUSED, match="reservations_no_overlap"):
        migrated.execute('UPDATE reservations SET "exit" = 21 WHERE enter = 10')
    assert holds(migrated) == {(7, 10, 20), (7, 20, 30)}


def test_an_update_may_shorten_a_reservation_in_place(migrated: Stranger) -> None:
    insert(migrated, (7, 10, 20))
    migrated.execute('UPDATE reservations SET "exit" = 15 WHERE enter = 10')
    assert holds(migrated) == {(7, 10, 15)}


@on_postgresql
def test_what_is_inserted_unless_there_is_a_conflict_is_not_inserted_over_another(migrated: Stranger) -> None:
    insert(migrated, (7, 10, 20))
    migrated.execute("INSERT INTO reservations VALUES (7, 15, 25, 1) ON CONFLICT DO NOTHING")
    assert holds(migrated) == {(7, 10, 20)}


def test_of_two_strangers_who_reserve_a_block_at_once_the_second_is_refused(ledger: str, migrated: Stranger) -> None:
    refused: list[str] = []

    def reserve() -> None:
        with database(ledger) as other:
            try:
                insert(other, (7, 15, 25))
            except REFUSED as error:
                refused.append(str(error))

    migrated.execute("BEGIN")
    insert(migrated, (7, 10, 20))
    thread = threading.Thread(target=reserve)
    thread.start()
    thread.join(0.05)
    assert thread.is_alive()
    migrated.execute("COMMIT")
    thread.join()
    assert ["reservations_no_overlap" in text for text in refused] == [True]
    assert holds(migrated) == {(7, 10, 20)}


INSERT_ENTRY = "INSERT INTO journal VALUES (?, ?, 5, ?, 1, 'one', NULL, NULL, NULL, NULL)"
ENTRY = (1, 0, 5, "accepted", 1, "one", None, None, None, None)


@pytest.mark.parametrize(
    "statement", ["UPDATE journal SET kind = 'rejected'", "DELETE FROM journal"], ids=["update", "delete"]
)
def test_what_stands_in_the_journal_cannot_be_changed(statement: str, migrated: Stranger) -> None:
    migrated.execute(INSERT_ENTRY, (1, 0, "accepted"))
    with pytest.raises(REFUSED, match="journal_append_only"):
        migrated.execute(statement)
    assert migrated.rows("SELECT * FROM journal") == [ENTRY]


@on_sqlite
def test_what_stands_in_the_journal_cannot_be_replaced(migrated: Stranger) -> None:
    migrated.execute(INSERT_ENTRY, (1, 0, "accepted"))
    with pytest.raises(REFUSED, match="journal_in_order"):
        migrated.execute(INSERT_ENTRY.replace("INSERT", "INSERT OR REPLACE"), (1, 0, "rejected"))
    assert migrated.rows("SELECT * FROM journal") == [ENTRY]


@on_postgresql
@pytest.mark.parametrize(
    ("statement", "guard"),
    [
        ("TRUNCATE journal", "journal_append_only"),
        (
            "INSERT INTO journal VALUES (1, 0, 5, 'rejected', 1, 'one', NULL, NULL, NULL, NULL) "
            "ON CONFLICT (revision, place) DO UPDATE SET kind = 'rejected'",
            "journal_in_order",
        ),
    ],
    ids=["truncate", "upsert"],
)
def test_the_journal_can_be_neither_emptied_nor_overwritten(statement: str, guard: str, migrated: Stranger) -> None:
    migrated.execute(INSERT_ENTRY, (1, 0, "accepted"))
    with pytest.raises(REFUSED, match=guard):
        migrated.execute(statement)
    assert migrated.rows("SELECT * FROM journal") == [ENTRY]


@pytest.mark.parametrize("behind", [(2, 0), (2, 9), (3, 0), (3, 1)])
def test_nothing_is_added_behind_the_newest_entry_of_the_journal(behind: tuple[int, int], migrated: Stranger) -> None:
    migrated.execute(INSERT_ENTRY, (3, 1, "accepted"))
    with pytest.raises(REFUSED, match="journal_in_order"):
        migrated.execute(INSERT_ENTRY, (*behind, "cancelled"))


def test_several_entries_may_be_one_revision(migrated: Stranger) -> None:
    for key in ((3, 0), (3, 1), (3, 2), (4, 0)):
        migrated.execute(INSERT_ENTRY, (*key, "accepted"))
    assert migrated.rows("SELECT revision, place FROM journal") == [(3, 0), (3, 1), (3, 2), (4, 0)]


def test_the_journal_gives_up_what_the_ledger_says_has_been_removed_and_nothing_newer(migrated: Stranger) -> None:
    for revision in (1, 2, 3):
        migrated.execute(INSERT_ENTRY, (revision, 0, "accepted"))
    migrated.execute("UPDATE counters SET journal_removed = 2")
    migrated.execute("DELETE FROM journal WHERE revision <= 2")
    with pytest.raises(REFUSED, match="journal_append_only"):
        migrated.execute("DELETE FROM journal")
    assert migrated.rows("SELECT revision FROM journal") == [(3,)]


@pytest.mark.parametrize(
    ("values", "constraint"),
    [
        ({"earliest_departure": 2, "latest_departure": 1}, "flight_intents_departure_window"),
        ({"trajectory": None, "refusal": None}, "flight_intents_plan_or_refusal"),
        ({"trajectory": "[]", "refusal": "{}"}, "flight_intents_plan_or_refusal"),
    ],
)
def test_an_intent_that_contradicts_itself_is_refused(
    values: dict[str, object], constraint: str, migrated: Stranger
) -> None:
    with pytest.raises(REFUSED, match=constraint):
        insert_intent(migrated, INTENT | {"sequence": 2, "id": "two"} | values)


def test_a_ledger_belongs_to_one_airspace_only(migrated: Stranger) -> None:
    migrated.execute("INSERT INTO airspace VALUES (1, 'a', 'A', 'f')")
    with pytest.raises(REFUSED, match="airspace_only_one"):
        migrated.execute("INSERT INTO airspace VALUES (2, 'b', 'B', 'g')")
