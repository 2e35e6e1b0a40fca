"""Block side and height from the errors of an aircraft's navigation (paper 4.1).

An aircraft is planned through block centres and is elsewhere by its navigation error. A block holds it along one axis
when half the block's extent reaches at least as far as the error does: half-extent >= max(|lower|, |upper|), where
lower and upper are the percentiles (1 - c) / 2 and (1 + c) / 2 of that error, c being the wanted confidence: for 0.99
the 0.5 and 99.5 percentiles. Blocks are square, so the side follows from the worse of east and north. Both lengths are
then rounded up to a step.

Such a confidence holds for each axis by itself. How often an aircraft is inside its block along all axes at once
depends on how the errors go together; only samples tell (`containment`).
"""

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist

import numpy as np
import numpy.typing as npt

from planner.errors import PlannerError

Errors = npt.NDArray[np.float64]

COLUMNS = ("east_m", "north_m", "up_m")
PAPER_SIDE_M = 20.0
PAPER_HEIGHT_M = 40.0

# Far beyond any position error, and near enough that nothing computed from it overflows.
_LARGEST_M = 100_000.0
_LARGEST_PERCENTILE_M = 10 * _LARGEST_M
# What misses a whole number of steps or of samples by so little has reached it.
_ROUNDING = 1e-9


class NavigationErrorData(PlannerError):
    """Navigation errors, or what is asked of them, from which no block can be sized."""


@dataclass(frozen=True)
class Percentiles:
    """Between which two values, in metres, an error lies with the wanted confidence; raises `NavigationErrorData`."""

    lower_m: float
    upper_m: float

    def __post_init__(self) -> None:
        if not -_LARGEST_PERCENTILE_M <= self.lower_m <= self.upper_m <= _LARGEST_PERCENTILE_M:
            raise NavigationErrorData(
                f"the percentiles {self.lower_m:g} and {self.upper_m:g} m must be numbers within "
                f"{_LARGEST_PERCENTILE_M / 1000:g} km, the lower one first"
            )

    @property
    def extent_m(self) -> float:
        """The shortest extent around a planned position that contains both: 2 max(|lower|, |upper|)."""
        return 2 * max(abs(self.lower_m), abs(self.upper_m))

    @property
    def span_m(self) -> float:
        """The distance between both: the shortest extent anywhere, if the planned position need not be its centre."""
        return self.upper_m - self.lower_m


@dataclass(frozen=True)
class ErrorStatistics:
    """One row of the paper's table 1, in metres."""

    mean_m: float
    standard_deviation_m: float
    percentiles: Percentiles


@dataclass(frozen=True)
class NavigationStatistics:
    """The paper's table 1: errors along three axes, and the horizontal one, hypot(east, north).

    `confidence` is the two-sided one of all percentiles, between 0 and 1.
    """

    confidence: float
    east: ErrorStatistics
    north: ErrorStatistics
    horizontal: ErrorStatistics
    vertical: ErrorStatistics


# 65 flights, 3.83 hours: the position of a PixHawk 4 against RTK.
PAPER_TABLE_1 = NavigationStatistics(
    confidence=0.99,
    east=ErrorStatistics(-0.289, 2.137, Percentiles(-6.137, 7.844)),
    north=ErrorStatistics(-0.578, 2.299, Percentiles(-7.843, 4.885)),
    horizontal=ErrorStatistics(2.650, 1.802, Percentiles(0.079, 10.130)),
    vertical=ErrorStatistics(0.831, 7.353, Percentiles(-16.206, 24.432)),
)


@dataclass(frozen=True)
class BlockSize:
    """A block's side and height in metres, rounded up, and what was needed before."""

    side_m: float
    height_m: float
    needed_side_m: float
    needed_height_m: float


@dataclass(frozen=True)
class Containment:
    """Which fractions of samples lie within a block around the planned position: along each axis, and jointly."""

    samples: int
    east: float
    north: float
    vertical: float
    square: float
    box: float


@dataclass(frozen=True)
class Finding:
    """What one error says about an extent, a block's side or height, in metres.

    `needed_m` is the extent that reaches the error's percentiles, `confidence` how much of the errors that holds at
    least. `span_m` is what the percentiles would need if the planned position were not the block's centre but the best
    place. `outside_at_least` is the share of errors that the percentiles prove to lie outside. `normal_confidence`
    is the share inside if errors were normal with the same mean and standard deviation, `normal_percentiles` what
    their percentiles would be then: real errors have longer tails, which makes the share too good.

    The horizontal error is a distance from the planned position. It needs a square around the circle of its upper
    percentile alone, so its confidence is the higher one of that (0.995 for 0.99), it has no span nor normal
    percentiles, and its normal confidence is that of independent normal errors east and north.
    """

    error: str
    extent_m: float
    needed_m: float
    confidence: float
    outside_at_least: float
    normal_confidence: float
    span_m: float | None = None
    normal_percentiles: Percentiles | None = None

    @property
    def is_enough(self) -> bool:
        """Tell whether the extent reaches the percentiles."""
        return self.extent_m >= self.needed_m

    def __str__(self) -> str:
        verdict = "is enough" if self.is_enough else "is not enough"
        parts = [f"{self.extent_m:g} m {verdict} for {_percent(self.confidence)}, which needs {self.needed_m:.3f} m"]
        if not self.is_enough and self.span_m is not None:
            parts.append(f"{self.span_m:.3f} m if planned off the block's centre")
        if self.outside_at_least > 0:
            parts.append(f"at least {_percent(self.outside_at_least)} of the errors lie outside")
        normal = f"normal errors would lie inside with {_percent(self.normal_confidence)}"
        if self.normal_percentiles is not None:
            lower_m, upper_m = self.normal_percentiles.lower_m, self.normal_percentiles.upper_m
            normal += f" (but would have the percentiles {lower_m:.3f} and {upper_m:.3f} m)"
        return "; ".join([*parts, normal])


@dataclass(frozen=True)
class BlockCheck:
    """What navigation statistics say about a block of a given side and height."""

    side_m: float
    height_m: float
    east: Finding
    north: Finding
    horizontal: Finding
    vertical: Finding

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All four, in the order of the paper's table."""
        return self.east, self.north, self.horizontal, self.vertical


def size_block(east: Percentiles, north: Percentiles, vertical: Percentiles, round_to_m: float = 1.0) -> BlockSize:
    """Return the block that reaches the percentiles of every axis, its lengths rounded up to multiples of a step.

    Raises
    ------
    NavigationErrorData
        The step is not a positive number, or the errors are all zero and need no block.
    """
    if not 0 < round_to_m <= _LARGEST_M:
        raise NavigationErrorData(f"cannot round up to multiples of {round_to_m:g} m")
    side = max(east.extent_m, north.extent_m)
    height = vertical.extent_m
    if side == 0 or height == 0:
        raise NavigationErrorData("errors of exactly zero need no block; are the columns or percentiles filled in?")
    return BlockSize(_round_up(side, round_to_m), _round_up(height, round_to_m), side, height)


def check_block(statistics: NavigationStatistics, side_m: float, height_m: float) -> BlockCheck:
    """Return what the statistics say about a block, error by error."""
    tail = (1 - statistics.confidence) / 2

    def along(error: str, axis: ErrorStatistics, extent_m: float) -> Finding:
        percentiles = axis.percentiles
        beyond = (percentiles.lower_m < -extent_m / 2) + (percentiles.upper_m > extent_m / 2)
        return Finding(
            error,
            extent_m,
            percentiles.extent_m,
            statistics.confidence,
            outside_at_least=beyond * tail,
            normal_confidence=normal_confidence(axis, extent_m),
            span_m=percentiles.span_m,
            normal_percentiles=normal_percentiles(axis, statistics.confidence),
        )

    # An error beyond the circle may still lie in one of the square's corners, so it proves nothing to lie outside,
    # unless it is beyond these too.
    upper_m = statistics.horizontal.percentiles.upper_m
    horizontal = Finding(
        "horizontal",
        side_m,
        2 * upper_m,
        1 - tail,
        outside_at_least=tail if upper_m > math.sqrt(2) * side_m / 2 else 0.0,
        normal_confidence=normal_confidence(statistics.east, side_m) * normal_confidence(statistics.north, side_m),
    )
    return BlockCheck(
        side_m,
        height_m,
        along("east", statistics.east, side_m),
        along("north", statistics.north, side_m),
        horizontal,
        along("vertical", statistics.vertical, height_m),
    )


def normal_confidence(error: ErrorStatistics, extent_m: float) -> float:
    """Return how probable an error within ± half the extent is, if it is normal with its mean and deviation."""
    half = extent_m / 2
    if error.standard_deviation_m == 0:
        return float(abs(error.mean_m) <= half)
    distribution = NormalDist(error.mean_m, error.standard_deviation_m)
    return distribution.cdf(half) - distribution.cdf(-half)


def normal_percentiles(error: ErrorStatistics, confidence: float) -> Percentiles:
    """Return the percentiles that an error would have, were it normal with its mean and deviation."""
    reach = NormalDist().inv_cdf((1 + confidence) / 2) * error.standard_deviation_m
    return Percentiles(error.mean_m - reach, error.mean_m + reach)


def statistics_of(errors: Errors, confidence: float = 0.99) -> NavigationStatistics:
    """Return the statistics of error samples, an array (n, 3) of east, north and up in metres.

    Percentiles are samples, the next one outwards, so that at least the wanted share of them lies between. The standard
    deviation is that of a sample (n - 1). Errors that follow each other closely in time are alike: a
    confidence rests on fewer independent samples than there are rows.

    Raises
    ------
    NavigationErrorData
        The confidence does not lie between 0 and 1, or there are so few samples that the percentiles would be the
        extremes, whatever they are: fewer than 2 / (1 - confidence).
    """
    if not 0 < confidence < 1:
        raise NavigationErrorData(f"a confidence must lie between 0 and 1, not be {confidence:g}")
    tail = (1 - confidence) / 2
    needed = math.ceil(1 / tail - _ROUNDING)
    if len(errors) < needed:
        raise NavigationErrorData(
            f"too few errors for a confidence of {confidence:g}: {needed} are needed at least, not {len(errors)}"
        )
    east, north, up = errors.T
    return NavigationStatistics(
        confidence, *(_statistics(error, tail) for error in (east, north, np.hypot(east, north), up))
    )


def containment(errors: Errors, side_m: float, height_m: float) -> Containment:
    """Return which fractions of error samples, an array (n, 3) in metres, lie within a block."""
    inside = np.abs(errors) <= np.array([side_m, side_m, height_m]) / 2
    east, north, vertical = inside.mean(axis=0).tolist()
    square, box = inside[:, :2].all(axis=1).mean(), inside.all(axis=1).mean()
    return Containment(len(errors), east, north, vertical, float(square), float(box))


def read_errors(path: Path) -> Errors:
    """Read position errors from a CSV file: a header with east_m, north_m and up_m, then a row an error, in metres.

    Other columns are ignored. Returns an array (n, 3).

    Raises
    ------
    NavigationErrorData
        The file cannot be read, lacks a column or holds no error, or a value is missing or no number; names the line.
    """
    rows: list[list[float]] = []
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = csv.DictReader(file, skipinitialspace=True, strict=True)
            header = list(lines.fieldnames or [])
            if wrong := [name for name in COLUMNS if header.count(name) != 1]:
                raise NavigationErrorData(
                    f"{path}: the header must name {', '.join(COLUMNS)}, each once; look at {wrong[0]}"
                )
            for line in lines:
                where = f"{path}, line {lines.line_num}"
                if None in line:
                    raise NavigationErrorData(f"{where}: more values than the header has columns")
                rows.append([_metres(line[name], f"{where}: {name}") for name in COLUMNS])
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise NavigationErrorData(f"cannot read navigation errors from {path}: {error}") from error
    if not rows:
        raise NavigationErrorData(f"{path} holds no errors below its header")
    return np.array(rows, dtype=np.float64)


def _metres(text: str | None, where: str) -> float:
    if text is None or not text.strip():
        raise NavigationErrorData(f"{where} is missing")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= _LARGEST_M:
        raise NavigationErrorData(f"{where} must be a number of metres within {_LARGEST_M / 1000:g} km, not {text!r}")
    return value


def _statistics(errors: npt.NDArray[np.float64], tail: float) -> ErrorStatistics:
    beyond = int(tail * (len(errors) - 1) + _ROUNDING)
    lower, upper = np.sort(errors)[[beyond, -1 - beyond]].tolist()
    return ErrorStatistics(float(errors.mean()), float(errors.std(ddof=1)), Percentiles(lower, upper))


def _round_up(length_m: float, step_m: float) -> float:
    # Twelve digits of a multiple are exact for any step that a person writes down, such as 0.1.
    return float(f"{math.ceil(length_m / step_m - _ROUNDING) * step_m:.12g}")


def _percent(share: float) -> str:
    return f"{100 * share:.6g} %"
