"""Which ledgers are opened, on either database. Whatever is refused stays as it was."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import replace

import pytest

from app.errors import AirspaceMismatch, LedgerMissing, LedgerOutdated
from app.ledger import check_exists, create_or_upgrade, open_ledger
from app.service import running
from app.settings import Settings
from planner.airspace import Airspace, OccupancyRule
from tests.ledger.district import OLD_TOWN, STREET
from tests.ledger.locations import HEAD, Ledgers, content, database
from tests.ledger.process import FakeClock, Process
from tests.ledger.test_racing import at_once

AIRSPACE = OLD_TOWN.airspace


def test_a_ledger_of_a_newer_schema_is_not_touched(ledger: str) -> None:
    with database(ledger) as connection:
        connection.execute("UPDATE alembic_version SET version_num = '9999'")
    before = content(ledger)
    with pytest.raises(LedgerOutdated, match=f"has schema 9999, newer than this program's {HEAD}"):
        create_or_upgrade(ledger)
    assert content(ledger) == before


def test_a_ledger_of_a_newer_schema_is_not_opened(ledger: str) -> None:
    with database(ledger) as connection:
        connection.execute("UPDATE alembic_version SET version_num = '9999'")
    before = content(ledger)
    with pytest.raises(LedgerOutdated, match="has schema 9999"):
        open_ledger(ledger, AIRSPACE)
    assert content(ledger) == before


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
def test_a_ledger_of_another_airspace_is_not_opened(other: Airspace, ledger: str) -> None:
    open_ledger(ledger, AIRSPACE, claim=True).close()
    before = content(ledger)
    with pytest.raises(AirspaceMismatch, match=r"belongs to airspace 'district' .* give that airspace's file"):
        open_ledger(ledger, other, claim=True)
    assert content(ledger) == before


def test_a_service_started_on_a_ledger_of_another_airspace_leaves_it_as_it_was(settings: Settings) -> None:
    open_ledger(settings.ledger, STREET.airspace, claim=True).close()
    before = content(settings.ledger)
    with pytest.raises(AirspaceMismatch), running(settings, FakeClock()):
        pass
    assert content(settings.ledger) == before


def test_an_airspace_with_another_name_but_the_same_blocks_and_rules_may_use_the_ledger(ledger: str) -> None:
    open_ledger(ledger, AIRSPACE, claim=True).close()
    open_ledger(ledger, replace(AIRSPACE, id="renamed", name="Renamed", buildings=())).close()


def test_opening_without_claim_leaves_an_unclaimed_ledger_to_anybody(ledger: str) -> None:
    open_ledger(ledger, AIRSPACE).close()
    open_ledger(ledger, STREET.airspace, claim=True).close()
    with pytest.raises(AirspaceMismatch):
        open_ledger(ledger, AIRSPACE)


def test_a_place_without_a_ledger_is_not_opened_and_nothing_is_made_there(ledgers: Ledgers) -> None:
    place = ledgers.vacant()
    before = content(place)
    with pytest.raises(LedgerMissing, match=r"there is no ledger at .*; `airmatrix serve` creates one"):
        open_ledger(place, AIRSPACE, claim=True)
    with pytest.raises(LedgerMissing):
        check_exists(place)
    assert content(place) == before


def test_a_ledger_is_made_where_there_is_none(ledgers: Ledgers) -> None:
    place = ledgers.vacant()
    create_or_upgrade(place)
    with Process(place, AIRSPACE, FakeClock()) as process:
        assert process.submit(OLD_TOWN.submission("A", "B")).sequence == 1


def test_eight_processes_may_start_on_one_new_ledger_at_once(ledgers: Ledgers) -> None:
    place = ledgers.vacant()

    def start() -> None:
        create_or_upgrade(place)
        open_ledger(place, AIRSPACE, claim=True).close()

    at_once(*[start] * 8)
    with database(place) as connection:
        assert connection.rows("SELECT id FROM airspace") == [("district",)]
        assert connection.rows("SELECT sequence, revision FROM counters") == [(0, 0)]


def test_of_processes_with_different_airspaces_that_start_at_once_one_gets_the_new_ledger(ledgers: Ledgers) -> None:
    place = ledgers.vacant()
    refused: list[AirspaceMismatch] = []

    def starting(airspace: Airspace) -> Callable[[], None]:
        def start() -> None:
            create_or_upgrade(place)
            try:
                open_ledger(place, airspace, claim=True).close()
            except AirspaceMismatch as error:
                refused.append(error)

        return start

    at_once(*[starting(airspace) for airspace in (AIRSPACE, STREET.airspace) * 2])
    assert len(refused) == 2


def test_a_copied_ledger_is_a_ledger(ledgers: Ledgers) -> None:
    with Process(ledgers.migrated(), AIRSPACE, FakeClock()) as process:
        intent = process.submit(OLD_TOWN.submission("A", "B"))
    with closing(open_ledger(ledgers.copy(process.location), AIRSPACE)) as ledger:
        found = ledger.find(intent.id)
    assert found is not None
    assert found.sequence == 1
