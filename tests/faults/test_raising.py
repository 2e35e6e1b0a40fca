"""Whatever raises in the writer, answers are right and it goes on."""

import pytest

from tests.faults.raising import raising
from tests.ledger.locations import Ledgers


@pytest.mark.compiled
def test_a_part_of_the_writer_that_raises_loses_nothing(ledgers: Ledgers) -> None:
    verdict = raising(ledgers, 20, lambda _: None)
    assert verdict.wrong == []
    assert len(verdict.told.unrecorded) > 0
