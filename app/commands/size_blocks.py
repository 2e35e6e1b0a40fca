"""`airmatrix size-blocks`: block side and height from navigation errors (paper 4.1)."""

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from app.commands.terminal import show
from planner.experiments.block_sizing import (
    PAPER_HEIGHT_M,
    PAPER_SIDE_M,
    PAPER_TABLE_1,
    BlockCheck,
    BlockSize,
    Containment,
    NavigationStatistics,
    Percentiles,
    check_block,
    containment,
    read_errors,
    size_block,
    statistics_of,
)

Pair = tuple[float, float]

_PERCENTILES = "Lower and upper percentile of the error {}, in metres."


def size_blocks(
    errors: Annotated[
        Path | None,
        typer.Option(help="CSV file of position errors: columns east_m, north_m and up_m, metres, a row an error."),
    ] = None,
    east_error: Annotated[Pair | None, typer.Option(help=_PERCENTILES.format("to the east"))] = None,
    north_error: Annotated[Pair | None, typer.Option(help=_PERCENTILES.format("to the north"))] = None,
    vertical_error: Annotated[Pair | None, typer.Option(help=_PERCENTILES.format("upwards"))] = None,
    paper: Annotated[
        bool, typer.Option("--paper", help="Take the paper's table 1, and judge its 20 m x 40 m.")
    ] = False,
    confidence: Annotated[
        float | None,
        typer.Option(
            help="Share of each axis's errors to hold, for --errors: 0.99 is the 0.5 to 99.5 percentiles.  "
            "[default: 0.99]"
        ),
    ] = None,
    round_to: Annotated[float, typer.Option(help="Round side and height up to multiples of this, in metres.")] = 1.0,
) -> None:
    """Size blocks so that aircraft stay within them.

    An aircraft planned through a block's centre misses it by its navigation
    error. Along each axis the block must reach as far to both sides as the
    worse of the error's two percentiles: side >= 2 max(|lower|, |upper|) over
    east and north, height likewise from the vertical error. Both are then
    rounded up.

    Give the errors themselves, or the percentiles of each axis, or --paper.
    The confidence is each axis's own. How often an aircraft is inside along
    all axes at once is counted where --errors gives something to count.
    """
    given = (east_error, north_error, vertical_error)
    sources = (errors is not None, any(pair is not None for pair in given), paper)
    if sum(sources) != 1:
        raise typer.BadParameter("give --errors, or --east-error, --north-error and --vertical-error, or --paper")
    if confidence is not None and errors is None:
        raise typer.BadParameter("percentiles have their confidence already", param_hint="--confidence")
    if errors is not None:
        samples = read_errors(errors)
        statistics = statistics_of(samples, 0.99 if confidence is None else confidence)
        size = _size(statistics, round_to)
        _print_statistics(statistics, f"{errors.name}: {len(samples)} errors")
        _print_size(size, containment(samples, size.side_m, size.height_m))
    elif paper:
        size = _size(PAPER_TABLE_1, round_to)
        _print_statistics(PAPER_TABLE_1, "The paper's table 1")
        _print_size(size, None)
        _print_check(check_block(PAPER_TABLE_1, PAPER_SIDE_M, PAPER_HEIGHT_M))
    else:
        if east_error is None or north_error is None or vertical_error is None:
            raise typer.BadParameter("--east-error, --north-error and --vertical-error go together")
        east, north, vertical = Percentiles(*east_error), Percentiles(*north_error), Percentiles(*vertical_error)
        _print_size(size_block(east, north, vertical, round_to), None)


def _size(statistics: NavigationStatistics, round_to_m: float) -> BlockSize:
    east, north, vertical = statistics.east, statistics.north, statistics.vertical
    return size_block(east.percentiles, north.percentiles, vertical.percentiles, round_to_m)


def _print_statistics(statistics: NavigationStatistics, title: str) -> None:
    tail = 50 * (1 - statistics.confidence)
    table = Table("error", "mean m", "deviation m", f"{tail:g} % m", f"{100 - tail:g} % m", title=title)
    table.title_justify = "left"
    for name in ("east", "north", "horizontal", "vertical"):
        error = getattr(statistics, name)
        numbers = (error.mean_m, error.standard_deviation_m, error.percentiles.lower_m, error.percentiles.upper_m)
        table.add_row(name, *(f"{number:.3f}" for number in numbers))
    show(table)


def _print_size(size: BlockSize, held: Containment | None) -> None:
    table = Table(show_header=False)
    table.add_row("block side", f"{size.side_m:g} m ({size.needed_side_m:.3f} m before rounding up)")
    table.add_row("block height", f"{size.height_m:g} m ({size.needed_height_m:.3f} m before rounding up)")
    if held is not None:
        axes = (("east", held.east), ("north", held.north), ("vertically", held.vertical))
        table.add_row("errors within it", ", ".join(f"{name} {100 * share:.3f} %" for name, share in axes))
        table.add_row("within its square", f"{100 * held.square:.3f} %")
        table.add_row("within all of it", f"{100 * held.box:.3f} %")
    show(table)


def _print_check(check: BlockCheck) -> None:
    table = Table(title=f"The paper's {check.side_m:g} m x {check.height_m:g} m", show_header=False)
    table.title_justify = "left"
    for finding in check.findings:
        table.add_row(finding.error, str(finding))
    show(table)
