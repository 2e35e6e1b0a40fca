"""A few blocks of city near Astana, drawn in ASCII, and what the tests ask to fly there."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from app.flight_intents import Position, Submission
from planner.airspace import Airspace, Building, OccupancyRule
from planner.errors import Block
from tests.planner.drawing import Drawing, drawn

START_MS = 1_795_334_400_000  # 2026-11-22T08:00:00Z
DEPARTURE_MS = START_MS + 60_000  # 08:01:00, so that there is time to change one's mind
EPSG, ORIGIN_X_M, ORIGIN_Y_M = 32642, 668_920.0, 5_665_220.0
AIRCRAFT = "dji-phantom-4"


@dataclass(frozen=True)
class District:
    """A drawn airspace on the map; signs and blocks become positions."""

    drawing: Drawing

    @cached_property
    def airspace(self) -> Airspace:
        """Return the airspace, with a footprint for every statically occupied column."""
        tiny = self.drawing.airspace
        grid = replace(tiny.grid, epsg=EPSG, origin_x_m=ORIGIN_X_M, origin_y_m=ORIGIN_Y_M)
        layers = tiny.occupied.reshape(grid.dimensions[::-1])
        return replace(
            tiny,
            id="district",
            name="A district",
            grid=grid,
            attribution="drawn by hand",
            licence="CC0",
            buildings=tuple(
                _building(replace(tiny, grid=grid), int(i), int(j), int(layers[:, j, i].sum()))
                for j, i in np.argwhere(layers[0])
            ),
        )

    def block(self, place: str | Block) -> int:
        """Return the flat index of a block given by its sign or its indices."""
        return self.drawing[place] if isinstance(place, str) else self.airspace.grid.index(place)

    def centre(self, place: str | Block) -> Position:
        """Return the centre of a block."""
        x, y, alt_m = self.airspace.grid.centres(np.array([self.block(place)]))[0]
        lon, lat = self.airspace.grid.unproject(x, y)
        return Position(float(lon), float(lat), float(alt_m))

    def point(self, i: float, j: float, alt_m: float = 20.0) -> Position:
        """Return a point given in blocks from the south-west corner."""
        grid = self.airspace.grid
        lon, lat = grid.unproject(grid.origin_x_m + i * grid.block_side_m, grid.origin_y_m + j * grid.block_side_m)
        return Position(float(lon), float(lat), alt_m)

    def submission(
        self,
        origin: str | Block,
        destination: str | Block,
        *,
        earliest_ms: int = DEPARTURE_MS,
        window_ms: int = 300_000,
        operator: str = "acme-air",
    ) -> Submission:
        """Return a request to fly from one block's centre to another's."""
        return Submission(
            operator=operator,
            reference=None,
            aircraft_type=AIRCRAFT,
            priority=0,
            origin=self.centre(origin),
            destination=self.centre(destination),
            origin_block=self.block(origin),
            destination_block=self.block(destination),
            earliest_departure_ms=earliest_ms,
            latest_departure_ms=earliest_ms + window_ms,
        )


def district(*layers: str, rule: OccupancyRule = OccupancyRule.CONTAINMENT, terminal_dwell_ms: int = 0) -> District:
    """Return a district with these layers, the lowest first; rows are words, the northernmost first."""
    return District(drawn(*layers, rule=rule, terminal_dwell_ms=terminal_dwell_ms))


def _building(airspace: Airspace, i: int, j: int, layers: int) -> Building:
    """Return a building that fills a column of blocks but for a margin of 2 m."""
    grid = airspace.grid
    side = grid.block_side_m
    west, south = grid.origin_x_m + i * side + 2, grid.origin_y_m + j * side + 2
    x = [west, west + side - 4, west + side - 4, west, west]
    y = [south, south, south + side - 4, south + side - 4, south]
    lon, lat = grid.unproject(x, y)
    return Building(
        id=f"building-{i}-{j}",
        height_m=layers * grid.block_height_m - 2,
        height_source="height",
        footprint={"type": "Polygon", "coordinates": [np.column_stack([lon, lat]).tolist()]},
    )


# Two layers; one house reaches the lower one, and `Y` is a yard without any way in or out.
OLD_TOWN = district(
    """
    A......B
    ........
    ...#....
    ......##
    C.....#Y
    """,
    """
    ........
    ........
    ........
    ......##
    ......##
    """,
)

# One street, one lane: whoever flies holds it for everybody.
STREET = district("W......E")

# An open square in two layers.
SQUARE = district("N...\n....\n...S", "....\n....\n....")

# Two lanes, and one between them that nobody has asked for.
LANES = district(
    """
    W......E
    ........
    V......F
    """,
    "........\n........\n........",
)
