"""Fixtures: a clock that stands still, a small airspace's file, a service on a temporary ledger."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import structlog

from app.main import create_app
from app.settings import Settings
from tests.api.serving import Client, served
from tests.ledger.district import OLD_TOWN
from tests.ledger.process import FakeClock


@pytest.fixture(scope="session", autouse=True)
def plain_logs() -> None:
    """Log tracebacks as plain text: drawing them nicely takes seconds each."""
    structlog.configure(processors=[structlog.processors.format_exc_info, structlog.processors.KeyValueRenderer()])


@pytest.fixture
def clock() -> FakeClock:
    return FakeClock()


@pytest.fixture
def ledger_path(tmp_path: Path) -> Path:
    return tmp_path / "ledger.sqlite"


@pytest.fixture
def settings(tmp_path: Path, ledger_path: Path) -> Settings:
    """Return settings for the old town and a ledger that does not exist yet."""
    OLD_TOWN.airspace.write(tmp_path / "airspace.json")
    return Settings(ledger=str(ledger_path), airspace=tmp_path / "airspace.json")


@pytest.fixture
def client(settings: Settings, clock: FakeClock) -> Iterator[Client]:
    """Return a client of a running service over the old town."""
    with served(create_app(settings, clock)) as client:
        yield client
