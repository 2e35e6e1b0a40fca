"""The campaign's command: what it runs, what it shows, and its exit status."""

import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import structlog

from tests.faults import campaign
from tests.faults.isolation import Unavailable
from tests.faults.verdict import Report, Verdict


def harmless(folder: Path, rounds: int, report: Report) -> Verdict:
    """Break nothing."""
    assert list(folder.iterdir()) == []
    report(rounds)
    return Verdict("harmless", rounds, back_s=[0.5, 0.25, 4.0], verifications=1, remarks=["all is well"])


def harmful(folder: Path, rounds: int, _: Report) -> Verdict:
    """Lose a flight."""
    verdict = Verdict("harmful", rounds)
    (folder / "evidence").touch()
    verdict.damage.lost.add("flight 1: it is not there")
    return verdict


def failing(*_: object) -> Verdict:
    """Fail, which is no fault of the service's, but nothing is known either."""
    raise AssertionError("the service did not become ready")


def impossible(*_: object) -> Verdict:
    """Ask for what this system has not."""
    raise Unavailable("no disks here")


Run = Callable[..., int]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Run]:
    """Run the campaign with these arguments and faults of ours; return its exit status."""
    parts = {"safe": [(harmless, 7)], "bad": [(harmful, 1)], "broken": [(failing, 1)], "absent": [(impossible, 1)]}
    monkeypatch.setattr(campaign, "PARTS", parts)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    logging = structlog.get_config()

    def run(*arguments: str) -> int:
        monkeypatch.setattr(sys, "argv", ["faults", *arguments])
        with pytest.raises(SystemExit) as end:
            campaign.main()
        return int(end.value.code or 0)

    yield run
    structlog.configure(**logging)


def line(out: str, fault: str) -> list[str]:
    """Return the cells of a fault's line."""
    (found,) = (text for text in out.splitlines() if text.startswith(f"│ {fault} "))
    return [cell.strip() for cell in found.strip("│").split("│")]


def test_a_campaign_in_which_nothing_is_wrong_succeeds_and_leaves_nothing(
    run: Run, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert run("safe") == 0
    out = capsys.readouterr().out
    assert line(out, "harmless") == ["harmless", "7", *"00000000"[:7], "0.50, 4.00", "1 x ok", "ok"]
    assert "harmless: all is well" in out
    assert list(tmp_path.iterdir()) == []


def test_damage_fails_the_campaign_and_its_evidence_is_kept(
    run: Run, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert run() == 1
    out = capsys.readouterr().out
    assert line(out, "harmful")[5:] == ["1", "0", "0", "0", "", "", "WRONG"]
    assert "WRONG: harmful: flight 1: it is not there" in out
    assert [path.name for path in tmp_path.glob("airmatrix-bad-*/*")] == ["evidence"]


def test_a_fault_that_cannot_be_watched_to_its_end_fails_the_campaign(
    run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("broken") == 1
    assert "WRONG: broken: the campaign could not go on: the service did not" in capsys.readouterr().out


def test_a_fault_that_cannot_be_made_here_is_skipped_with_its_reason(
    run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("absent") == 0
    assert "skipped: absent: no disks here" in capsys.readouterr().out


def test_the_number_of_rounds_can_be_chosen(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("safe", "--rounds", "3") == 0
    assert line(capsys.readouterr().out, "harmless")[1] == "3"


@pytest.mark.parametrize("arguments", [["earthquake"], ["--rounds", "0"], ["--rounds", "many"]])
def test_what_does_not_exist_is_refused(run: Run, arguments: list[str]) -> None:
    assert run(*arguments) == 2
