"""Block side and height from navigation errors (paper 4.1, table 1)."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from planner.experiments.block_sizing import (
    PAPER_HEIGHT_M,
    PAPER_SIDE_M,
    PAPER_TABLE_1,
    Containment,
    Errors,
    ErrorStatistics,
    NavigationErrorData,
    Percentiles,
    check_block,
    containment,
    normal_confidence,
    normal_percentiles,
    read_errors,
    size_block,
    statistics_of,
)

PAPER_AXES = (
    PAPER_TABLE_1.east.percentiles,
    PAPER_TABLE_1.north.percentiles,
    PAPER_TABLE_1.vertical.percentiles,
)
STANDARD_NORMAL = ErrorStatistics(0.0, 1.0, Percentiles(-2.576, 2.576))


def in_columns(*columns: list[float]) -> Errors:
    return np.array(columns, dtype=np.float64).T


# Sizing


def test_a_side_reaches_the_worst_of_the_four_horizontal_percentiles() -> None:
    near, far = Percentiles(-1.0, 2.0), Percentiles(-5.0, 3.0)
    height = Percentiles(-1.0, 1.0)
    assert size_block(near, far, height).needed_side_m == 10.0
    assert size_block(far, near, height).needed_side_m == 10.0
    assert size_block(near, near, height).needed_side_m == 4.0


def test_a_height_reaches_the_worse_of_the_two_vertical_percentiles() -> None:
    axis = Percentiles(-1.0, 1.0)
    assert size_block(axis, axis, Percentiles(-7.0, 6.0)).needed_height_m == 14.0
    assert size_block(axis, axis, Percentiles(-6.0, 7.5)).needed_height_m == 15.0


@pytest.mark.parametrize(
    ("reach", "step", "rounded"),
    [(5.0, 1.0, 10.0), (5.01, 1.0, 11.0), (7.844, 0.1, 15.7), (7.844, 0.001, 15.688), (1.05, 0.3, 2.1), (3.0, 20, 20)],
)
def test_lengths_are_rounded_up_to_the_step_and_stay_where_they_reach_it(
    reach: float, step: float, rounded: float
) -> None:
    axis = Percentiles(-reach, 0.0)
    size = size_block(axis, axis, axis, step)
    assert (size.side_m, size.height_m) == (rounded, rounded)
    assert size.needed_side_m == 2 * reach


@pytest.mark.parametrize("step", [0.0, -1.0, math.nan, math.inf])
def test_a_step_that_is_no_length_is_refused(step: float) -> None:
    with pytest.raises(NavigationErrorData, match="cannot round up"):
        size_block(*PAPER_AXES, round_to_m=step)


def test_errors_of_zero_size_no_block() -> None:
    zero, some = Percentiles(0.0, 0.0), Percentiles(-1.0, 1.0)
    with pytest.raises(NavigationErrorData, match="need no block"):
        size_block(zero, zero, some)
    with pytest.raises(NavigationErrorData, match="need no block"):
        size_block(some, some, zero)


@pytest.mark.parametrize("pair", [(2.0, 1.0), (math.nan, 1.0), (0.0, math.inf), (-1e7, 0.0)])
def test_percentiles_out_of_order_or_out_of_this_world_are_refused(pair: tuple[float, float]) -> None:
    with pytest.raises(NavigationErrorData, match="the lower one first"):
        Percentiles(*pair)


# The paper's table 1


def test_the_papers_percentiles_need_a_side_of_15_688_m_and_a_height_of_48_864_m() -> None:
    size = size_block(*PAPER_AXES)
    assert size.needed_side_m == pytest.approx(15.688)
    assert size.needed_height_m == pytest.approx(48.864)
    assert (size.side_m, size.height_m) == (16.0, 49.0)


def test_the_papers_20_m_hold_each_horizontal_axis_but_not_quite_the_horizontal_error() -> None:
    check = check_block(PAPER_TABLE_1, PAPER_SIDE_M, PAPER_HEIGHT_M)
    assert check.east.is_enough
    assert check.north.is_enough
    assert not check.horizontal.is_enough
    assert check.horizontal.needed_m == pytest.approx(20.26)
    assert check.horizontal.confidence == pytest.approx(0.995)
    assert [finding.outside_at_least for finding in (check.east, check.north, check.horizontal)] == [0.0, 0.0, 0.0]


def test_the_papers_40_m_do_not_reach_the_vertical_percentiles_although_normal_errors_would_stay_within() -> None:
    vertical = check_block(PAPER_TABLE_1, PAPER_SIDE_M, PAPER_HEIGHT_M).vertical
    assert not vertical.is_enough
    assert vertical.needed_m == pytest.approx(48.864)
    assert vertical.span_m == pytest.approx(40.638)
    assert vertical.outside_at_least == pytest.approx(0.005)
    assert vertical.normal_confidence == pytest.approx(0.993127, abs=1e-6)
    assert vertical.normal_percentiles is not None
    assert vertical.normal_percentiles.lower_m == pytest.approx(-18.109, abs=1e-3)
    assert vertical.normal_percentiles.upper_m == pytest.approx(19.771, abs=1e-3)


def test_findings_are_sentences() -> None:
    check = check_block(PAPER_TABLE_1, PAPER_SIDE_M, PAPER_HEIGHT_M)
    assert str(check.vertical) == (
        "40 m is not enough for 99 %, which needs 48.864 m; 40.638 m if planned off the block's centre; at least 0.5 % "
        "of the errors lie outside; normal errors would lie inside with 99.3127 % (but would have the percentiles "
        "-18.109 and 19.771 m)"
    )
    assert str(check.horizontal) == (
        "20 m is not enough for 99.5 %, which needs 20.260 m; normal errors would lie inside with 99.9974 %"
    )
    assert [finding.error for finding in check.findings] == ["east", "north", "horizontal", "vertical"]


def test_each_percentile_beyond_a_block_proves_its_tail_to_lie_outside() -> None:
    assert check_block(PAPER_TABLE_1, 20.0, 30.0).vertical.outside_at_least == pytest.approx(0.01)
    assert check_block(PAPER_TABLE_1, 20.0, 48.0).vertical.outside_at_least == pytest.approx(0.005)
    assert check_block(PAPER_TABLE_1, 20.0, 49.0).vertical.outside_at_least == 0.0


def test_a_horizontal_error_beyond_the_squares_corners_lies_outside_for_certain() -> None:
    assert check_block(PAPER_TABLE_1, 14.4, 40.0).horizontal.outside_at_least == 0.0
    assert check_block(PAPER_TABLE_1, 14.2, 40.0).horizontal.outside_at_least == pytest.approx(0.005)


def test_a_block_that_reaches_a_percentile_exactly_is_enough() -> None:
    check = check_block(PAPER_TABLE_1, 2 * 7.844, 2 * 24.432)
    assert check.east.is_enough
    assert check.vertical.is_enough
    assert check.vertical.outside_at_least == 0.0


# Normal errors


@pytest.mark.parametrize(("extent", "probability"), [(2.0, 0.682689), (4.0, 0.954500), (6.0, 0.997300)])
def test_normal_errors_lie_within_one_two_and_three_deviations_as_tables_say(extent: float, probability: float) -> None:
    assert normal_confidence(STANDARD_NORMAL, extent) == pytest.approx(probability, abs=1e-6)


def test_a_mean_off_centre_costs_normal_errors_confidence() -> None:
    aside = replace(STANDARD_NORMAL, mean_m=1.0)
    assert normal_confidence(aside, 2.0) == pytest.approx(0.477250, abs=1e-6)


def test_errors_without_any_deviation_are_inside_or_not() -> None:
    constant = ErrorStatistics(3.0, 0.0, Percentiles(3.0, 3.0))
    assert normal_confidence(constant, 6.0) == 1.0
    assert normal_confidence(constant, 5.9) == 0.0


def test_normal_percentiles_lie_2_576_deviations_from_the_mean_for_99_percent() -> None:
    percentiles = normal_percentiles(replace(STANDARD_NORMAL, mean_m=10.0, standard_deviation_m=2.0), 0.99)
    assert percentiles.lower_m == pytest.approx(10 - 5.1517, abs=1e-4)
    assert percentiles.upper_m == pytest.approx(10 + 5.1517, abs=1e-4)


# Samples


def test_statistics_of_samples_are_those_of_each_column_and_of_the_distance() -> None:
    errors = in_columns([3.0, -3.0, 3.0, 0.0], [4.0, 4.0, -4.0, 0.0], [1.0, 2.0, 3.0, 6.0])
    statistics = statistics_of(errors, confidence=0.5)
    assert statistics.confidence == 0.5
    assert statistics.east == ErrorStatistics(0.75, math.sqrt(24.75 / 3), Percentiles(-3.0, 3.0))
    assert statistics.north == ErrorStatistics(1.0, math.sqrt(44 / 3), Percentiles(-4.0, 4.0))
    assert statistics.horizontal == ErrorStatistics(3.75, 2.5, Percentiles(0.0, 5.0))
    assert statistics.vertical == ErrorStatistics(3.0, math.sqrt(14 / 3), Percentiles(1.0, 6.0))


def test_percentiles_are_the_next_samples_outwards() -> None:
    ramp = np.arange(1001, dtype=np.float64)
    errors = in_columns(ramp.tolist(), (-ramp).tolist(), ramp[::-1].tolist())
    statistics = statistics_of(errors, confidence=0.99)
    assert statistics.east.percentiles == Percentiles(5.0, 995.0)
    assert statistics.north.percentiles == Percentiles(-995.0, -5.0)
    assert statistics_of(errors[:-1], confidence=0.99).east.percentiles == Percentiles(4.0, 995.0)


@given(
    arrays(np.float64, st.tuples(st.integers(40, 90), st.just(3)), elements=st.floats(-100, 100)),
    st.sampled_from([0.5, 0.8, 0.9, 0.95]),
)
@settings(deadline=None)
def test_a_block_sized_from_samples_holds_the_wanted_share_of_them_along_each_axis(
    errors: Errors, confidence: float
) -> None:
    statistics = statistics_of(errors, confidence)
    axes = (statistics.east.percentiles, statistics.north.percentiles, statistics.vertical.percentiles)
    side, height = max(axes[0].extent_m, axes[1].extent_m), axes[2].extent_m
    held = containment(errors, side, height)
    assert min(held.east, held.north, held.vertical) >= confidence
    assert held.box <= held.square <= min(held.east, held.north)


def test_samples_are_counted_along_each_axis_within_the_square_and_within_the_box() -> None:
    errors = in_columns([0, 10, 11, 0, 11, 0, 0, 0], [0, -10, 0, 11, 11, 0, 0, 0], [0, 20, 0, 0, 0, 21, -21, -20])
    assert containment(errors, 20.0, 40.0) == Containment(
        samples=8, east=0.75, north=0.75, vertical=0.75, square=0.625, box=0.375
    )


@pytest.mark.parametrize(("confidence", "needed"), [(0.99, 200), (0.9, 20), (0.5, 4)])
def test_too_few_samples_for_a_confidence_are_refused(confidence: float, needed: int) -> None:
    errors = np.ones((needed, 3))
    statistics_of(errors, confidence)
    with pytest.raises(NavigationErrorData, match=f"{needed} are needed at least, not {needed - 1}$"):
        statistics_of(errors[1:], confidence)


@pytest.mark.parametrize("confidence", [0.0, 1.0, -0.5, 99.0, math.nan])
def test_a_confidence_that_is_no_share_is_refused(confidence: float) -> None:
    with pytest.raises(NavigationErrorData, match="must lie between 0 and 1"):
        statistics_of(np.ones((1000, 3)), confidence)


# Files


def written(folder: Path, text: str) -> Path:
    path = folder / "errors.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_file_of_errors_is_read_whatever_its_columns_order(tmp_path: Path) -> None:
    text = '\ufeffup_m,time, north_m,"east_m"\r\n3,0.1,2.5,1\r\n\r\n -3e0 ,0.2,-2,-1\r\n'
    assert read_errors(written(tmp_path, text)).tolist() == [[1.0, 2.5, 3.0], [-1.0, -2.0, -3.0]]


@pytest.mark.parametrize(
    ("text", "refusal"),
    [
        ("", "must name east_m, north_m, up_m, each once; look at east_m"),
        ("1,2,3\n4,5,6\n", "must name east_m"),
        ("east_m,north_m\n1,2\n", "look at up_m"),
        ("east_m,north_m,up_m,up_m\n1,2,3,4\n", "look at up_m"),
        ("east_m,north_m,up_m\n", "holds no errors"),
        ("east_m,north_m,up_m\n1,2,3\n1,,3\n", "line 3: north_m is missing"),
        ("east_m,north_m,up_m\n1,2,3\n1,2, \n", "line 3: up_m is missing"),
        ("east_m,north_m,up_m\n1,2\n", "line 2: up_m is missing"),
        ("east_m,north_m,up_m\n1,2,3,4\n", "line 2: more values than"),
        ("east_m,north_m,up_m\n\n1,2,nan\n", "line 3: up_m must be a number of metres within 100 km, not 'nan'"),
        ("east_m,north_m,up_m\n1,2,3\n-inf,2,3\n", "line 3: east_m must be a number"),
        ("east_m,north_m,up_m\n1,1e300,3\n", "line 2: north_m must be a number"),
        ("east_m,north_m,up_m\n1,2,three\n", "line 2: up_m must be a number of metres within 100 km, not 'three'"),
        ('east_m,north_m,up_m\n1,2,"3\n', "cannot read navigation errors from"),
    ],
)
def test_a_file_that_cannot_be_trusted_is_refused(tmp_path: Path, text: str, refusal: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(NavigationErrorData) as refused:
        read_errors(path)
    assert refusal in str(refused.value)
    assert str(path) in str(refused.value)


def test_a_file_that_is_no_text_or_not_there_is_refused(tmp_path: Path) -> None:
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"east_m,north_m,up_m\n\xff\xfe\n")
    for path in (binary, tmp_path / "absent.csv", tmp_path):
        with pytest.raises(NavigationErrorData, match="cannot read navigation errors"):
            read_errors(path)
