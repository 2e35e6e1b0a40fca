"""Fixtures: a service over two lanes."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from app.main import create_app
from app.settings import Settings
from tests.api.serving import Client, served, settings_for
from tests.ledger.district import LANES
from tests.ledger.process import FakeClock


@pytest.fixture
def on_lanes(ledger: str, tmp_path: Path) -> Settings:
    return settings_for(LANES, ledger, tmp_path)


@pytest.fixture
def lanes(on_lanes: Settings, clock: FakeClock) -> Iterator[Client]:
    """Return a client of a service over two lanes."""
    with served(create_app(on_lanes, clock, elapsed_ms=clock)) as client:
        yield client
