"""Fixtures: processes on a ledger, one or two."""

from collections.abc import Iterator

import pytest

from tests.ledger.district import SQUARE, STREET
from tests.ledger.process import FakeClock, Process


@pytest.fixture
def street(ledger: str, clock: FakeClock) -> Iterator[Process]:
    with Process(ledger, STREET.airspace, clock) as process:
        yield process


@pytest.fixture
def square(ledger: str, clock: FakeClock) -> Iterator[Process]:
    with Process(ledger, SQUARE.airspace, clock) as process:
        yield process


@pytest.fixture
def pair(ledger: str, clock: FakeClock) -> Iterator[tuple[Process, Process]]:
    """Return two processes that plan on one street."""
    with (
        Process(ledger, STREET.airspace, clock) as one,
        Process(ledger, STREET.airspace, clock) as other,
    ):
        yield one, other
