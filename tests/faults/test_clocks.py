"""A clock that is set forward or back books nothing twice and stops nothing."""

import pytest

from tests.faults.clocks import clock_steps
from tests.ledger.locations import Ledgers


@pytest.mark.compiled
def test_clocks_may_be_set_forward_and_back(ledgers: Ledgers) -> None:
    verdict = clock_steps(ledgers, 4, lambda _: None)
    assert verdict.wrong == []
    assert len(verdict.told.accepted) > 100
