"""A ledger belongs to one airspace, whoever else tries to use it."""

from pathlib import Path

import pytest

from tests.faults.strangers import another_airspace, two_airspaces_at_once

pytestmark = pytest.mark.compiled


def test_a_service_of_another_airspace_is_refused_and_the_first_goes_on_undisturbed(tmp_path: Path) -> None:
    verdict = another_airspace(tmp_path, 1, lambda _: None)
    assert verdict.wrong == []
    assert len(verdict.told.accepted) > 0


def test_of_two_airspaces_on_one_new_ledger_one_is_refused(tmp_path: Path) -> None:
    assert two_airspaces_at_once(tmp_path, 1, lambda _: None).wrong == []
