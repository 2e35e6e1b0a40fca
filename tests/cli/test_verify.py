"""`airmatrix verify`: finds what is wrong with a ledger, names it, and changes nothing."""

import sqlite3
from pathlib import Path

import pytest

from app.times import format_time
from tests.cli.conftest import History, Run
from tests.cli.serving import Server
from tests.cli.town import LINK_MS
from tests.ledger.locations import HEAD
from tests.ledger.tampering import tampering

SUMMARY = {
    "flight intents": "8 accepted, 1 rejected, 2 cancelled",
    "judged": "9 flights, 90 reservations (1 released)",
    "overlaps": "0",
    "separation violations": "0",
    "building violations": "0",
    "containment violations": "0",
    "constraint violations": "0",
    "closest building": "12.000 m, hall",
}


def test_a_ledger_with_every_kind_of_intent_is_found_in_order(
    airmatrix: Run, history: History, ledger: Path, town_file: Path
) -> None:
    outcome = airmatrix("verify", "--ledger", ledger, "--airspace", town_file)
    assert outcome.status == 0
    table = outcome.table
    departure = format_time(history.rows[0].departure or 0)
    assert table.pop("closest approach").startswith("20.000 m horizontally, 0.000 m vertically, at " + departure[:14])
    assert table == SUMMARY
    assert "violation:" not in outcome.err


def test_an_empty_ledger_is_found_in_order(airmatrix: Run, ledger: Path, town_file: Path) -> None:
    with tampering(ledger) as book:
        for table in ("reservations", "journal", "idempotency_keys", "flight_intents"):
            book.execute(f"DELETE FROM {table}")  # noqa: S608
    outcome = airmatrix("verify", "--ledger", ledger, "--airspace", town_file)
    assert outcome.status == 0
    assert outcome.table["flight intents"] == "none"
    assert outcome.table["judged"] == "0 flights, 0 reservations"


def test_verifying_changes_no_byte_and_leaves_no_file(airmatrix: Run, ledger: Path, town_file: Path) -> None:
    before = ledger.read_bytes()
    assert airmatrix("verify", "--ledger", ledger, "--airspace", town_file).status == 0
    assert ledger.read_bytes() == before
    assert list(ledger.parent.iterdir()) == [ledger]


def test_a_ledger_can_be_verified_while_it_is_served(airmatrix: Run, town: Server, town_file: Path) -> None:
    options = ("--flights", 5, "--operator", "meanwhile", "--url", town.url)
    assert airmatrix("simulate", *options).status == 0
    assert airmatrix("verify", "--ledger", town.ledger, "--airspace", town_file).status == 0


def close_row_five(book: sqlite3.Connection, revision: int, created_ms: int) -> None:
    """Have a constraint over the fifth column of blocks from a time on, recorded with a revision."""
    book.execute(
        "INSERT INTO constraints (number, id, name, polygon, blocks, base_m, begins, created) "
        "VALUES (1, 'c-1', 'a parade', '{}', '[5, 15, 25]', 0, ?, ?)",
        (created_ms, created_ms),
    )
    book.execute(
        "INSERT INTO journal (revision, place, time, kind, intent, flight_intent_id, details) "
        "VALUES (?, 0, ?, 'constraint_created', 0, '', '{\"constraint_id\": \"c-1\"}')",
        (revision, created_ms),
    )


def test_flights_in_airspace_that_was_closed_before_they_were_planned_are_named(
    airmatrix: Run, history: History, ledger: Path, town_file: Path
) -> None:
    first = history.rows[0]
    with tampering(ledger) as book:
        close_row_five(book, 0, (first.departure or 0) - 3_600_000)
    outcome = airmatrix("verify", "--ledger", ledger, "--airspace", town_file)
    assert outcome.status == 1
    assert outcome.table["constraint violations"] == "3"
    # It enters a millisecond before the fifth link is over.
    held = next(hold for hold in first.reservations if hold.block == (5, 0, 0))
    assert (
        f"violation: reservation in closed airspace ({first.id}), block [5, 0, 0], {format_time(held.enter)} to "
        f"{format_time(held.exit)}: it was planned after the constraint, c-1 (a parade)"
    ) in outcome.err.splitlines()
    assert not any(history.rows[3].id in line for line in outcome.err.splitlines())


def test_flights_in_airspace_that_was_closed_later_may_have_been_too_late_to_make_way(
    airmatrix: Run, history: History, ledger: Path, town_file: Path
) -> None:
    with tampering(ledger) as book:
        close_row_five(book, 1_000, (history.rows[0].departure or 0) - 3_600_000)
    outcome = airmatrix("verify", "--ledger", ledger, "--airspace", town_file)
    assert (outcome.status, outcome.table["constraint violations"]) == (0, "0")


def test_overlapping_reservations_are_named(airmatrix: Run, history: History, ledger: Path, town_file: Path) -> None:
    first, second = history.rows[0], history.rows[1]
    departure = first.departure or 0
    with tampering(ledger) as book:
        overlap = 'INSERT INTO reservations (block, enter, "exit", intent) VALUES (0, ?, ?, ?)'
        book.execute(overlap, (departure + 1000, departure + 9000, second.sequence))
    outcome = airmatrix("verify", "--ledger", ledger, "--airspace", town_file)
    assert outcome.status == 1
    assert outcome.table["overlaps"] == "1"
    assert outcome.table["containment violations"] == "0"
    span = f"{format_time(departure + 1000)} to {format_time(departure + LINK_MS + 1)}"
    assert (
        f"violation: overlapping reservations of a block ({first.id}, {second.id}), block [0, 0, 0], {span}"
        in outcome.err.splitlines()
    )


def test_a_reservation_that_was_taken_away_is_named(
    airmatrix: Run, history: History, ledger: Path, town_file: Path
) -> None:
    intent = history.rows[2]
    gone = intent.reservations[4]
    with tampering(ledger) as book:
        assert book.execute("DELETE FROM reservations WHERE block = 24 AND enter = ?", (gone.enter,)).rowcount == 1
    outcome = airmatrix("verify", "--ledger", ledger, "--airspace", town_file)
    assert outcome.status == 1
    assert outcome.table["containment violations"] == "1"
    span = f"{format_time(gone.enter)} to {format_time(gone.exit)}"
    sentence = f"violation: trajectory without a reservation ({intent.id}), block [4, 2, 0], {span}"
    assert sentence in outcome.err.splitlines()


def test_a_trajectory_moved_into_a_building_is_named(
    airmatrix: Run, history: History, ledger: Path, town_file: Path
) -> None:
    intent = history.rows[3]
    with tampering(ledger) as book:
        move(book, intent.sequence, 10)
    outcome = airmatrix("verify", "--ledger", ledger, "--airspace", town_file)
    assert outcome.status == 1
    # Ten blocks without their reservation, of which the other rows' flights hold none.
    assert outcome.table["containment violations"] == "10"
    assert outcome.table["trajectory through a block with a building"] == "1"
    assert outcome.table["overlaps"] == "0"
    assert int(outcome.table["building violations"]) >= 1
    assert outcome.table["closest building"] == "0.000 m, hall"
    assert f"violation: trajectory through a block with a building ({intent.id}), block [4, 4, 0]" in outcome.err
    assert f"violation: building nearer than half a block ({intent.id}), block [" in outcome.err
    assert "m from building hall" in outcome.err


def test_a_reservation_moved_into_a_building_is_named(
    airmatrix: Run, history: History, ledger: Path, town_file: Path
) -> None:
    intent = history.rows[3]
    with tampering(ledger) as book:
        book.execute("UPDATE reservations SET block = block + 10 WHERE intent = ?", (intent.sequence,))
    outcome = airmatrix("verify", "--ledger", ledger, "--airspace", town_file)
    assert outcome.status == 1
    assert outcome.table["reservation of a block with a building"] == "1"
    assert outcome.table["containment violations"] == "10"
    assert f"violation: reservation of a block with a building ({intent.id}), block [4, 4, 0]" in outcome.err


def test_a_trajectory_moved_beside_another_is_named(
    airmatrix: Run, history: History, ledger: Path, town_file: Path
) -> None:
    first, second = history.rows[0], history.rows[1]
    with tampering(ledger) as book:
        move(book, second.sequence, -10)
    outcome = airmatrix("verify", "--ledger", ledger, "--airspace", town_file)
    assert outcome.status == 1
    assert int(outcome.table["separation violations"]) >= 1
    assert outcome.table["closest approach"].startswith("0.000 m horizontally, 0.000 m vertically")
    assert f"violation: flights nearer than a block ({first.id}, {second.id}), block [" in outcome.err


def test_an_accepted_flight_without_any_reservation_is_a_violation(
    airmatrix: Run, history: History, ledger: Path, town_file: Path
) -> None:
    intent = history.rows[5]
    with tampering(ledger) as book:
        book.execute("DELETE FROM reservations WHERE intent = ?", (intent.sequence,))
    outcome = airmatrix("verify", "--ledger", ledger, "--airspace", town_file)
    assert outcome.status == 1
    assert intent.id in outcome.err


def test_a_reservation_of_a_refused_flight_is_a_violation(
    airmatrix: Run, history: History, ledger: Path, town_file: Path
) -> None:
    departure = history.rows[0].departure or 0
    with tampering(ledger) as book:
        book.execute(
            'INSERT INTO reservations (block, enter, "exit", intent) '
            "SELECT 0, ?, ?, sequence FROM flight_intents WHERE id = ?",
            (departure + 1, departure + 9000, history.rejected_id),
        )
    outcome = airmatrix("verify", "--ledger", ledger, "--airspace", town_file)
    assert outcome.status == 1
    assert history.rejected_id in outcome.err


def test_a_reservation_that_belongs_to_no_flight_is_a_violation(
    airmatrix: Run, history: History, ledger: Path, town_file: Path
) -> None:
    departure = history.rows[0].departure or 0
    with tampering(ledger) as book:
        overlap = 'INSERT INTO reservations (block, enter, "exit", intent) VALUES (0, ?, ?, 4711)'
        book.execute(overlap, (departure + 1, departure + 9000))
    assert airmatrix("verify", "--ledger", ledger, "--airspace", town_file).status == 1


def test_more_than_twenty_violations_are_counted_and_the_first_twenty_named(
    airmatrix: Run, ledger: Path, town_file: Path
) -> None:
    with tampering(ledger) as book:
        book.execute("UPDATE reservations SET enter = enter + 1")
    outcome = airmatrix("verify", "--ledger", ledger, "--airspace", town_file)
    assert outcome.status == 1
    assert outcome.table["containment violations"] == "90"
    *named, more = (line for line in outcome.err.splitlines() if line.startswith("violation: "))
    assert len(named) == 20
    assert all(" without a reservation (" in line for line in named)
    assert more == "violation: … and 70 more"


@pytest.mark.parametrize(
    ("column", "nonsense"), [("trajectory", "nonsense"), ("trajectory", "[]"), ("state", "flying"), ("origin", "{}")]
)
def test_an_intent_that_cannot_be_read_is_refused(
    airmatrix: Run, ledger: Path, town_file: Path, column: str, nonsense: str
) -> None:
    with tampering(ledger) as book:
        book.execute(f"UPDATE flight_intents SET {column} = ? WHERE sequence = 1", (nonsense,))  # noqa: S608
    airmatrix("verify", "--ledger", ledger, "--airspace", town_file).assert_refused("ledger")


def test_a_ledger_without_a_table_is_refused(airmatrix: Run, ledger: Path, town_file: Path) -> None:
    with tampering(ledger) as book:
        book.execute("DROP TABLE reservations")
    airmatrix("verify", "--ledger", ledger, "--airspace", town_file).assert_refused("no such table: reservations")


def test_a_missing_ledger_is_refused_and_not_made(airmatrix: Run, tmp_path: Path) -> None:
    airmatrix("verify").assert_refused("there is no ledger at airmatrix.sqlite", "airmatrix serve")
    assert list(tmp_path.iterdir()) == []


def test_a_ledger_of_another_airspace_is_refused(airmatrix: Run, ledger: Path) -> None:
    airmatrix("verify", "--ledger", ledger).assert_refused("belongs to airspace 'town'", "not to 'astana-2km'")


def test_a_ledger_of_a_newer_schema_is_refused(airmatrix: Run, ledger: Path, town_file: Path) -> None:
    with tampering(ledger) as book:
        book.execute("UPDATE alembic_version SET version_num = '9999'")
    refusal = ("schema 9999", f"newer than this program's {HEAD}")
    airmatrix("verify", "--ledger", ledger, "--airspace", town_file).assert_refused(*refusal)


def test_a_file_that_is_no_database_is_refused(airmatrix: Run, tmp_path: Path) -> None:
    diary = tmp_path / "diary.txt"
    diary.write_text("Dear diary, " * 50)
    airmatrix("verify", "--ledger", diary).assert_refused("diary.txt is not an AirMatrix ledger")


def test_a_folder_is_no_ledger(airmatrix: Run, tmp_path: Path) -> None:
    airmatrix("verify", "--ledger", tmp_path).assert_refused(str(tmp_path), "Is a directory")


def test_a_ledger_on_another_database_is_refused(airmatrix: Run) -> None:
    airmatrix("verify", "--ledger", "mysql://somewhere/db").assert_refused("ledgers on mysql are not supported")


def test_a_ledger_may_be_given_as_a_url(airmatrix: Run, ledger: Path, town_file: Path) -> None:
    assert airmatrix("verify", "--ledger", f"sqlite:///{ledger}", "--airspace", town_file).status == 0


def test_a_file_name_in_square_brackets_is_named_as_it_is(airmatrix: Run) -> None:
    airmatrix("verify", "--ledger", "[/b].sqlite").assert_refused("there is no ledger at [/b].sqlite")


def test_a_building_named_in_square_brackets_is_named_as_it_is(
    airmatrix: Run, ledger: Path, town_file: Path, tmp_path: Path
) -> None:
    renamed = tmp_path / "renamed.geojson"
    renamed.write_text(town_file.read_text().replace('"hall"', '"way[/7]"'))
    outcome = airmatrix("verify", "--ledger", ledger, "--airspace", renamed)
    assert outcome.status == 0
    assert outcome.table["closest building"] == "12.000 m, way[/7]"


def move(book: sqlite3.Connection, sequence: int, blocks: int) -> None:
    """Add a number of blocks to every stop of a trajectory, and leave its reservations."""
    book.execute(
        "UPDATE flight_intents SET trajectory = (SELECT json_group_array(json_array("
        "json_extract(stop.value, '$[0]') + ?, json_extract(stop.value, '$[1]'), json_extract(stop.value, '$[2]')"
        ")) FROM json_each(trajectory) AS stop) WHERE sequence = ?",
        (blocks, sequence),
    )
