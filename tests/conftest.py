"""Fixtures: a clock that stands still, a small airspace's file, ledgers on both databases, a service on one."""

import os
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
import structlog

from app.ledger import create_or_upgrade
from app.main import create_app
from app.settings import Settings
from tests.api.serving import Client, served, settings_for
from tests.ledger.district import OLD_TOWN
from tests.ledger.locations import Ledgers, PostgresqlLedgers, SqliteLedgers
from tests.ledger.process import FakeClock
from tests.postgres import NoPostgres, Server, server


@pytest.fixture(scope="session", autouse=True)
def plain_logs() -> None:
    """Log tracebacks as plain text: drawing them nicely takes seconds each."""
    structlog.configure(processors=[structlog.processors.format_exc_info, structlog.processors.KeyValueRenderer()])


@pytest.fixture
def clock() -> FakeClock:
    return FakeClock()


@pytest.fixture(scope="session")
def postgres() -> Iterator[Server]:
    """Return a PostgreSQL server; without one the test is skipped, but on CI it fails."""
    with ExitStack() as stack:
        try:
            running = stack.enter_context(server())
        except NoPostgres as error:
            if os.environ.get("CI") == "true":
                raise
            pytest.skip(str(error))
        yield running


@pytest.fixture(scope="session")
def postgres_template(postgres: Server) -> str:
    """Return a migrated ledger that nobody is connected to, so that tests need not migrate one each."""
    template = postgres.database()
    create_or_upgrade(template)
    return template


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def ledgers(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Ledgers]:
    """Return where to keep ledgers; who asks for it runs on both databases."""
    if request.param == "sqlite":
        yield SqliteLedgers(tmp_path)
        return
    postgres, template = request.getfixturevalue("postgres"), request.getfixturevalue("postgres_template")
    with closing(PostgresqlLedgers(postgres, template)) as databases:
        yield databases


@pytest.fixture
def ledger(ledgers: Ledgers) -> str:
    """Return the location of a new ledger."""
    return ledgers.migrated()


@pytest.fixture
def ledger_path(tmp_path: Path) -> Path:
    """Return where a SQLite ledger may be made."""
    return tmp_path / "ledger.sqlite"


@pytest.fixture
def settings(tmp_path: Path, ledger: str) -> Settings:
    """Return settings for the old town and a new ledger."""
    return settings_for(OLD_TOWN, ledger, tmp_path)


@pytest.fixture
def client(settings: Settings, clock: FakeClock) -> Iterator[Client]:
    """Return a client of a running service over the old town."""
    with served(create_app(settings, clock, elapsed_ms=clock)) as client:
        yield client
