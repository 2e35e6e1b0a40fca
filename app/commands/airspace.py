"""`airmatrix airspace build` and `airmatrix airspace show`."""

import math
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from app.commands.terminal import progress_bar, remark
from app.commands.terminal import show as show_table
from app.service import load_airspace
from app.settings import Settings
from planner.airmatrix import AirMatrix
from planner.airspace import Airspace, OccupancyRule
from planner.buildings import BuildingData, Window, build_airspace, read_buildings
from planner.errors import AirspaceFileError

airspace_app = typer.Typer(help="Build airspace files and look at them.", no_args_is_help=True)


@airspace_app.command()
def build(
    buildings: Annotated[Path, typer.Option(help="GeoJSON FeatureCollection of footprints, WGS84.")],
    out: Annotated[Path, typer.Option(help="The airspace file to write.")],
    epsg: Annotated[int | None, typer.Option(help="Projected CRS in metres. Default: the file's window.")] = None,
    origin: Annotated[
        tuple[float, float] | None, typer.Option(help="South-west corner, metres. Default: the file's window.")
    ] = None,
    size: Annotated[
        tuple[float, float] | None, typer.Option(help="East and north, metres. Default: the file's window.")
    ] = None,
    block_side: Annotated[float, typer.Option(help="Metres.")] = 20.0,
    block_height: Annotated[float, typer.Option(help="Metres.")] = 40.0,
    ceiling: Annotated[float, typer.Option(help="Metres above ground.")] = 120.0,
    default_height: Annotated[
        float | None,
        typer.Option(help="Metres, for buildings with neither height nor building:levels (3 m x levels + 3 m)."),
    ] = None,
    rule: Annotated[OccupancyRule, typer.Option(help="When a flight holds a block.")] = OccupancyRule.CONTAINMENT,
    dwell: Annotated[float, typer.Option(help="Seconds in the first and last block, for climb-out and landing.")] = 0.0,
    ground_w84: Annotated[float | None, typer.Option(help="WGS84 ellipsoid height of the ground, metres.")] = None,
    name: Annotated[str | None, typer.Option(help="Default: the building file's.")] = None,
) -> None:
    """Turn building footprints into an airspace file."""
    if not (math.isfinite(dwell) and (ground_w84 is None or math.isfinite(ground_w84))):
        raise AirspaceFileError("--dwell and --ground-w84 must be finite numbers")
    data = read_buildings(buildings, default_height)
    if out.exists() and out.samefile(buildings):
        raise AirspaceFileError(f"--out {out} is the building file itself; choose another name")
    window = _window(data, epsg, origin, size)
    grid = AirMatrix.covering(
        epsg=window.epsg,
        origin_m=window.origin_m,
        size_m=window.size_m,
        ceiling_m=ceiling,
        block_side_m=block_side,
        block_height_m=block_height,
    )
    with progress_bar("buildings", len(data.buildings)) as advance_to:
        airspace = build_airspace(
            data,
            id=out.name.partition(".")[0],
            name=name or data.name,
            grid=grid,
            ceiling_m=ceiling,
            rule=rule,
            terminal_dwell_ms=round(dwell * 1000),
            ground_w84_m=ground_w84,
            on_progress=advance_to,
        )
    for warning, count in data.warnings.items():
        remark("warning", "yellow", f"{count} {warning}")
    try:
        airspace.write(out)
    except (OSError, ValueError) as error:
        raise AirspaceFileError(f"cannot write {out}: {error}") from error
    _describe(airspace)


@airspace_app.command()
def show(
    airspace: Annotated[Path | None, typer.Option(help="Airspace file. Default: the shipped one.")] = None,
) -> None:
    """Print what an airspace is and what buildings take of it."""
    _describe(load_airspace(Settings.given(airspace=airspace)))


def _window(
    data: BuildingData, epsg: int | None, origin: tuple[float, float] | None, size: tuple[float, float] | None
) -> Window:
    """Return the file's window with what the options say otherwise; `AirspaceFileError` names what neither says."""
    if data.window is not None:
        epsg = data.window.epsg if epsg is None else epsg
        origin = origin or data.window.origin_m
        size = size or data.window.size_m
    if epsg is None or origin is None or size is None:
        missing = [name for name, value in (("--epsg", epsg), ("--origin", origin), ("--size", size)) if value is None]
        raise AirspaceFileError(f"the building file has no metadata.window; give {', '.join(missing)}")
    return Window(epsg, origin, size)


def _describe(airspace: Airspace) -> None:
    grid = airspace.grid
    west, south, east, north = grid.bounds
    table = Table(title=f"{airspace.name} ({airspace.id})", show_header=False, title_justify="left")
    table.add_column()
    table.add_column(overflow="fold")
    table.add_row(
        "blocks", f"{' x '.join(map(str, grid.dimensions))} of {grid.block_side_m:g} x {grid.block_height_m:g} m"
    )
    table.add_row("bounds", f"lon {west:.6f} to {east:.6f}, lat {south:.6f} to {north:.6f}")
    table.add_row("projection", f"EPSG:{grid.epsg}, origin {grid.origin_x_m:.1f} {grid.origin_y_m:.1f}")
    table.add_row("ceiling", f"{airspace.ceiling_m:g} m")
    table.add_row("occupancy rule", airspace.rule.value)
    table.add_row("terminal dwell", f"{airspace.terminal_dwell_ms / 1000:g} s")
    table.add_row("buildings", str(len(airspace.buildings)))
    for layer, count in enumerate(airspace.occupied_per_layer):
        floor = layer * grid.block_height_m
        table.add_row(f"occupied {floor:g}-{floor + grid.block_height_m:g} m", str(count))
    table.add_row("data", f"{airspace.attribution} {airspace.licence}")
    table.add_row("fingerprint", airspace.fingerprint)
    show_table(table)
