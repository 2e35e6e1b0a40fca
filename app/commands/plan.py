"""`airmatrix plan`: one path, offline, in an airspace without traffic."""

from pathlib import Path
from typing import Annotated

import numpy as np
import orjson
import typer
from rich import box
from rich.table import Table

from app.commands.terminal import show, write
from app.errors import UnknownAircraftType
from app.service import load_aircraft_types, load_airspace
from app.settings import Settings
from app.times import format_times, now_ms, parse_time
from planner.airmatrix import AirMatrix
from planner.cfa_star import Performance, Planner, PlanRequest, Search
from planner.errors import DestinationBlocked, OriginBlocked
from planner.path import Plan

Place = tuple[float, float, float]


def plan(
    from_: Annotated[Place, typer.Option("--from", help="Longitude, latitude (degrees), altitude (m above ground).")],
    to: Annotated[Place, typer.Option("--to", help="Longitude, latitude (degrees), altitude (m above ground).")],
    aircraft: Annotated[str, typer.Option(help="Aircraft type.")] = "dji-matrice-600-pro",
    departure: Annotated[str | None, typer.Option(help="RFC 3339. Default: now.")] = None,
    airspace: Annotated[Path | None, typer.Option(help="Airspace file. Default: the shipped one.")] = None,
    aircraft_types: Annotated[Path | None, typer.Option(help="TOML file of further aircraft types.")] = None,
    search: Annotated[Search, typer.Option(help="Kind of CFA*.")] = Search.SAFE_INTERVAL,
    geojson: Annotated[Path | None, typer.Option(help="Write the path as GeoJSON to this file; - for stdout.")] = None,
) -> None:
    """Plan one flight in an airspace without traffic; print its path as a table, or write it as GeoJSON."""
    settings = Settings.given(airspace=airspace, aircraft_types=aircraft_types)
    field = load_airspace(settings)
    types = load_aircraft_types(settings)
    if aircraft not in types:
        raise UnknownAircraftType(f"unknown aircraft type {aircraft!r}; known: {', '.join(sorted(types))}")
    try:
        departure_ms = now_ms() if departure is None else parse_time(departure)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--departure") from error
    request = PlanRequest(
        field.free_block_at(*from_, OriginBlocked),
        field.free_block_at(*to, DestinationBlocked),
        Performance.of(types[aircraft], field.grid),
        departure_ms,
        departure_ms,
    )
    path = Planner(field, search).plan(request)
    if geojson is not None:
        document = orjson.dumps(_feature(field.grid, path, aircraft), option=orjson.OPT_INDENT_2)
        if str(geojson) == "-":
            typer.echo(document)
            return
        write(geojson, document + b"\n")
    _print(field.grid, path, aircraft)


def _print(grid: AirMatrix, path: Plan, aircraft: str) -> None:
    title = f"{aircraft}: {path.flight_time_ms / 1000:.3f} s, {len(path.hold_block)} reservations"
    table = Table(title=title, box=box.SIMPLE)
    for column in ("block", "lon", "lat", "alt m", "arrive UTC", "depart UTC"):
        table.add_column(column, no_wrap=True)
    for block, (lon, lat, alt_m), arrive, depart in zip(
        grid.ijk(path.block).tolist(),
        _coordinates(grid, path),
        format_times(path.arrive_ms),
        format_times(path.depart_ms),
        strict=True,
    ):
        table.add_row(str(block), f"{lon:.7f}", f"{lat:.7f}", f"{alt_m:g}", arrive[11:-1], depart[11:-1])
    show(table)


def _coordinates(grid: AirMatrix, path: Plan) -> list[list[float]]:
    x, y, alt_m = grid.centres(path.block).T
    lon, lat = grid.unproject(x, y)
    rounded: list[list[float]] = np.column_stack([np.round(lon, 10), np.round(lat, 10), alt_m]).tolist()
    return rounded


def _feature(grid: AirMatrix, path: Plan, aircraft: str) -> dict[str, object]:
    return {
        "type": "Feature",
        "geometry": {"type": "LineString", "coordinates": _coordinates(grid, path)},
        "properties": {
            "aircraft_type": aircraft,
            "flight_time_s": path.flight_time_ms / 1000,
            "hover_s": path.hover_ms / 1000,
            "blocks": grid.ijk(path.block).tolist(),
            "arrive": format_times(path.arrive_ms),
            "depart": format_times(path.depart_ms),
        },
    }
