"""A crash loses nothing that was answered, and leaves nothing half done."""

from pathlib import Path

import pytest

from tests.faults.kills import kill, kill_workers

pytestmark = pytest.mark.compiled


def test_a_service_that_is_killed_again_and_again_keeps_what_it_answered(tmp_path: Path) -> None:
    verdict = kill(tmp_path, 3, lambda _: None, reservations=3_000)
    assert verdict.wrong == []
    assert (verdict.rounds, verdict.verifications) == (3, 1)
    assert len(verdict.told.accepted) > 20


def test_when_a_worker_is_killed_the_others_go_on_and_it_is_replaced(tmp_path: Path) -> None:
    verdict = kill_workers(tmp_path, 1, lambda _: None, workers=2)
    assert verdict.wrong == []
    assert (verdict.rounds, verdict.verifications, len(verdict.back_s)) == (1, 1, 1)
