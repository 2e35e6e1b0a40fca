"""Which PostgreSQL databases are taken for ledgers, and what is said of a server that gives none."""

from collections.abc import Callable
from urllib.parse import urlsplit

import pytest

from app.errors import ForeignLedger, StartupError
from app.ledger import check_exists, create_or_upgrade, open_ledger
from app.ledger.location import parse_location
from tests.ledger.district import OLD_TOWN, STREET
from tests.ledger.locations import Ledgers, content, database, on_postgresql
from tests.ledger.process import FakeClock, Process

AIRSPACE = OLD_TOWN.airspace

FOREIGN = {
    "a table": ["CREATE TABLE songs (title text)", "INSERT INTO songs VALUES ('Yesterday')"],
    "a view": ["CREATE VIEW songs AS SELECT 'Yesterday' AS title"],
    "a partitioned table": ["CREATE TABLE songs (title text) PARTITION BY LIST (title)"],
    "another application's migrations": [
        "CREATE TABLE alembic_version (version_num varchar(32) PRIMARY KEY)",
        "INSERT INTO alembic_version VALUES ('0001')",
    ],
    "a table with the name of one of ours": ["CREATE TABLE counters (visits bigint)"],
}
OPENING: dict[str, Callable[[str], object]] = {
    "upgraded": create_or_upgrade,
    "opened": lambda location: open_ledger(location, AIRSPACE, claim=True),
    "found": check_exists,
}


@on_postgresql
@pytest.mark.parametrize("kind", FOREIGN)
def test_a_foreign_database_is_refused_and_left_as_it_was(kind: str, ledgers: Ledgers) -> None:
    place = ledgers.vacant()
    with database(place) as connection:
        for statement in FOREIGN[kind]:
            connection.execute(statement)
    before = content(place)
    for open_ in OPENING.values():
        with pytest.raises(ForeignLedger, match="has tables, but is no AirMatrix ledger; nothing was changed in it"):
            open_(place)
    assert content(place) == before


@on_postgresql
@pytest.mark.parametrize("encoding", ["SQL_ASCII", "LATIN1"])
def test_a_database_in_which_not_every_name_can_be_written_is_refused(encoding: str, ledgers: Ledgers) -> None:
    place = ledgers.vacant()
    name = urlsplit(place).path.removeprefix("/")
    with database(place.replace(name, "postgres")) as admin:
        admin.execute(f"DROP DATABASE {name}")
        admin.execute(f"CREATE DATABASE {name} ENCODING {encoding} LOCALE 'C' TEMPLATE template0")
    for open_ in OPENING.values():
        with pytest.raises(ForeignLedger, match=f"is encoded in {encoding}, .* createdb --encoding UTF8"):
            open_(place)


@on_postgresql
def test_tables_that_an_extension_brought_are_no_obstacle(ledgers: Ledgers) -> None:
    place = ledgers.vacant()
    with database(place) as connection:
        connection.execute("CREATE TABLE settings (name text)")
        connection.execute("CREATE EXTENSION btree_gist")
        connection.execute("ALTER EXTENSION btree_gist ADD TABLE settings")
    create_or_upgrade(place)
    open_ledger(place, AIRSPACE, claim=True).close()


@on_postgresql
def test_a_database_may_hold_a_ledger_in_each_of_its_schemas(ledgers: Ledgers) -> None:
    place = ledgers.vacant()
    cities = {name: f"{place}?options=-csearch_path%3D{name}" for name in ("astana", "singapore")}
    for name, location in cities.items():
        with database(place) as connection:
            connection.execute(f"CREATE SCHEMA {name}")
        create_or_upgrade(location)
    with (
        Process(cities["astana"], AIRSPACE, FakeClock()) as astana,
        Process(cities["singapore"], STREET.airspace, FakeClock()) as singapore,
    ):
        assert astana.submit(OLD_TOWN.submission("A", "B")).sequence == 1
        assert singapore.submit(STREET.submission("W", "E")).sequence == 1


UNREACHABLE: dict[str, tuple[Callable[[str], str], str]] = {
    "wrong password": (lambda url: _with(url, password="not-the-secret"), "password authentication failed"),  # noqa: S106
    "missing database": (lambda url: f"{url}_gone", r'database "airmatrix_\w+_gone" does not exist'),
    "no server": (lambda url: _with(url, port=1), "Connection refused"),
    "no host": (lambda url: _with(url, host="nowhere.invalid"), "nowhere.invalid"),
    "unknown option": (lambda url: f"{url}?colour=green", 'invalid connection option "colour"'),
}


def _with(url: str, password: str | None = None, host: str | None = None, port: int | None = None) -> str:
    """Return a URL with some of its parts replaced."""
    parts = urlsplit(url)
    netloc = f"{parts.username}:{password or parts.password}@{host or parts.hostname}:{port or parts.port}"
    return parts._replace(netloc=netloc).geturl()


@on_postgresql
@pytest.mark.parametrize("how", OPENING)
@pytest.mark.parametrize("why", UNREACHABLE)
def test_a_database_that_cannot_be_reached_is_refused_in_one_line_that_shows_no_password(
    why: str, how: str, ledgers: Ledgers
) -> None:
    change, reason = UNREACHABLE[why]
    place = change(ledgers.vacant())
    with pytest.raises(StartupError, match=reason) as refusal:
        OPENING[how](place)
    assert "\n" not in str(refusal.value)
    assert str(urlsplit(place).password) not in str(refusal.value)
    assert ":***@" in str(refusal.value)


@pytest.mark.parametrize(
    ("location", "reason"),
    [
        ("mysql://user:secret@host/airmatrix", "ledgers on mysql are not supported; give a file path, a sqlite"),
        ("postgresql://user:secret@host", r"the ledger's URL postgresql://user:\*\*\*@host names no database"),
        ("postgresql://user@host?password=secret", "names no database; add /NAME to it"),
        ("postgresql://user:secret@host:port/airmatrix", "the ledger's postgresql:// URL cannot be read; give a file"),
    ],
)
def test_what_names_no_place_for_a_ledger_is_refused(location: str, reason: str) -> None:
    with pytest.raises(StartupError, match=reason) as refusal:
        create_or_upgrade(location)
    assert "secret" not in str(refusal.value)


def test_a_location_shows_where_it_is_but_no_password() -> None:
    shown = "postgresql://user:***@host:5433/airmatrix?sslmode=require"
    for scheme in ("postgresql", "postgres"):
        assert str(parse_location(f"{scheme}://user:secret@host:5433/airmatrix?sslmode=require")) == shown
    assert "secret" not in str(parse_location("postgresql://user@host/airmatrix?password=secret"))
