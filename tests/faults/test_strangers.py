"""A ledger belongs to one airspace and stays where it is, whatever strangers do."""

from pathlib import Path

import pytest

from tests.faults.strangers import another_airspace, file_taken_away, two_airspaces_at_once

pytestmark = pytest.mark.compiled


def test_a_service_of_another_airspace_is_refused_and_the_first_goes_on_undisturbed(tmp_path: Path) -> None:
    verdict = another_airspace(tmp_path, 1, lambda _: None)
    assert verdict.wrong == []
    assert len(verdict.told.accepted) > 0


def test_of_two_airspaces_on_one_new_ledger_one_is_refused(tmp_path: Path) -> None:
    assert two_airspaces_at_once(tmp_path, 1, lambda _: None).wrong == []


def test_a_file_that_is_moved_under_the_service_gets_no_more_flights(tmp_path: Path) -> None:
    verdict = file_taken_away(tmp_path, 2, lambda _: None)
    assert verdict.wrong == []
    assert verdict.told.problems("ledger-unavailable") > 0
