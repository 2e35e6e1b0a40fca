"""`airmatrix size-blocks`: from errors, from percentiles, from the paper's table."""

from pathlib import Path

import pytest

from tests.cli.conftest import Run

PERCENTILES = {
    "--east-error": (-6.137, 7.844),
    "--north-error": (-7.843, 4.885),
    "--vertical-error": (-16.206, 24.432),
}
OPTIONS = [part for option, pair in PERCENTILES.items() for part in (option, *pair)]


@pytest.fixture
def ramp(tmp_path: Path) -> Path:
    """201 errors: -10 to 10 m east, all that downwards, and twice as much north but for the two extremes."""
    rows = [(n / 10, 0.0 if abs(n) == 100 else n / 5, -n / 10) for n in range(-100, 101)]
    path = tmp_path / "errors.csv"
    path.write_text("east_m,north_m,up_m\n" + "".join(f"{east},{north},{up}\n" for east, north, up in rows))
    return path


def test_percentiles_give_side_and_height(airmatrix: Run) -> None:
    outcome = airmatrix("size-blocks", *OPTIONS)
    assert outcome.status == 0
    assert outcome.table == {
        "block side": "16 m (15.688 m before rounding up)",
        "block height": "49 m (48.864 m before rounding up)",
    }


def test_lengths_are_rounded_up_to_the_chosen_step(airmatrix: Run) -> None:
    assert airmatrix("size-blocks", *OPTIONS, "--round-to", 5).table == {
        "block side": "20 m (15.688 m before rounding up)",
        "block height": "50 m (48.864 m before rounding up)",
    }


def test_errors_give_statistics_side_height_and_how_many_the_block_holds(airmatrix: Run, ramp: Path) -> None:
    outcome = airmatrix("size-blocks", "--errors", ramp, "--round-to", 0.1)
    assert outcome.status == 0
    assert outcome.rows == [
        ["east", "0.000", "5.817", "-9.900", "9.900"],
        ["north", "0.000", "11.460", "-19.600", "19.600"],
        ["horizontal", "11.113", "6.408", "0.224", "22.137"],
        ["vertical", "0.000", "5.817", "-9.900", "9.900"],
        ["block side", "39.2 m (39.200 m before rounding up)"],
        ["block height", "19.8 m (19.800 m before rounding up)"],
        ["errors within it", "east 100.000 %, north 99.005 %, vertically 99.005 %"],
        ["within its square", "99.005 %"],
        ["within all of it", "98.010 %"],
    ]
    assert "errors.csv: 201 errors" in outcome.out
    assert "│ 0.5 % m │ 99.5 % m │" in outcome.out.replace("┃", "│")


def test_a_lower_confidence_needs_a_smaller_block(airmatrix: Run, ramp: Path) -> None:
    outcome = airmatrix("size-blocks", "--errors", ramp, "--confidence", 0.9)
    assert outcome.rows[4:6] == [
        ["block side", "36 m (35.600 m before rounding up)"],
        ["block height", "18 m (18.000 m before rounding up)"],
    ]
    assert "5 % m" in outcome.out


def test_the_papers_table_is_shown_with_what_it_says_of_the_papers_block(airmatrix: Run) -> None:
    outcome = airmatrix("size-blocks", "--paper")
    assert outcome.status == 0
    assert outcome.rows[3] == ["vertical", "0.831", "7.353", "-16.206", "24.432"]
    assert outcome.rows[4] == ["block side", "16 m (15.688 m before rounding up)"]
    findings = {row[0]: row[1] for row in outcome.rows[6:]}
    assert findings["east"].startswith("20 m is enough for 99 %, which needs 15.688 m")
    assert findings["horizontal"].startswith("20 m is not enough for 99.5 %, which needs 20.260 m")
    assert findings["vertical"].startswith("40 m is not enough for 99 %, which needs 48.864 m")
    assert "normal errors would lie inside with 99.3127 %" in findings["vertical"]


@pytest.mark.parametrize(
    "options",
    [
        (),
        ("--paper", *OPTIONS),
        ("--paper", "--errors", "errors.csv"),
        ("--errors", "errors.csv", *OPTIONS[:3]),
    ],
)
def test_one_source_of_errors_must_be_given_and_no_more(airmatrix: Run, options: tuple[object, ...]) -> None:
    airmatrix("size-blocks", *options).assert_misused("--vertical-error, or --paper")


def test_percentiles_of_every_axis_are_needed(airmatrix: Run) -> None:
    airmatrix("size-blocks", *OPTIONS[:6]).assert_misused("--vertical-error go together")


@pytest.mark.parametrize("source", [["--paper"], OPTIONS])
def test_percentiles_have_their_confidence_already(airmatrix: Run, source: list[object]) -> None:
    airmatrix("size-blocks", *source, "--confidence", 0.9).assert_misused("--confidence")


def test_errors_that_cannot_be_read_are_refused_with_their_line(airmatrix: Run, tmp_path: Path) -> None:
    path = tmp_path / "errors.csv"
    path.write_text("east_m,north_m,up_m\n1,2,3\n1,2,\n")
    airmatrix("size-blocks", "--errors", path).assert_refused(str(path), "line 3", "up_m is missing")


def test_too_few_errors_are_refused(airmatrix: Run, tmp_path: Path) -> None:
    path = tmp_path / "errors.csv"
    path.write_text("east_m,north_m,up_m\n1,2,3\n")
    airmatrix("size-blocks", "--errors", path).assert_refused("200 are needed at least, not 1")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (["--east-error", 1, -1], ["the percentiles 1 and -1 m", "the lower one first"]),
        (["--east-error", "nan", 1], ["the percentiles nan and 1 m"]),
        (["--round-to", 0], ["cannot round up to multiples of 0 m"]),
    ],
)
def test_nonsense_is_refused(airmatrix: Run, changes: list[object], words: list[str]) -> None:
    airmatrix("size-blocks", *OPTIONS, *changes).assert_refused(*words)
