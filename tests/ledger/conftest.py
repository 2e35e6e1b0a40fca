"""Fixtures: two processes on one ledger."""

from collections.abc import Iterator

import pytest

from tests.ledger.district import STREET
from tests.ledger.process import FakeClock, Process


@pytest.fixture
def pair(ledger: str, clock: FakeClock) -> Iterator[tuple[Process, Process]]:
    """Return two processes that plan on one street."""
    with (
        Process(ledger, STREET.airspace, clock) as one,
        Process(ledger, STREET.airspace, clock) as other,
    ):
        yield one, other
