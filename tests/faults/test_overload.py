"""Too many operators are refused, and not served worse afterwards."""

from pathlib import Path

import pytest

from tests.faults.overload import overload


@pytest.mark.compiled
def test_too_many_operators_are_told_to_wait_and_cost_nothing_afterwards(tmp_path: Path) -> None:
    verdict = overload(tmp_path, 1, lambda _: None, seconds=1.0, timed=False)
    assert verdict.wrong == []
    assert verdict.told.problems("queue-full") > 0
    assert len(verdict.told.accepted) > 0
