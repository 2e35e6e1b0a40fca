"""A crash loses nothing that was answered, and leaves nothing half done."""

from pathlib import Path

import pytest

from tests.faults.kills import kill


@pytest.mark.compiled
def test_a_service_that_is_killed_again_and_again_keeps_what_it_answered(tmp_path: Path) -> None:
    verdict = kill(tmp_path, 2, lambda _: None, reservations=3_000)
    assert verdict.wrong == []
    assert (verdict.rounds, verdict.verifications) == (2, 1)
    assert len(verdict.told.accepted) > 20
