"""A full disk is survived, and an unwritable ledger is refused."""

from pathlib import Path

import pytest

from tests.faults.disks import full_disk, unwritable_ledger
from tests.faults.isolation import Unavailable

pytestmark = pytest.mark.compiled


def test_a_full_disk_is_told_and_survived(tmp_path: Path) -> None:
    try:
        verdict = full_disk(tmp_path, 1, lambda _: None)
    except Unavailable as error:
        pytest.skip(str(error))
    assert verdict.wrong == []
    assert verdict.told.problems("ledger-unavailable") > 0
    assert len(verdict.back_s) == 1


def test_a_service_refuses_to_start_on_a_ledger_that_it_cannot_write(tmp_path: Path) -> None:
    try:
        verdict = unwritable_ledger(tmp_path, 3, lambda _: None)
    except Unavailable as error:
        pytest.skip(str(error))
    assert verdict.wrong == []
    assert verdict.rounds == 3
