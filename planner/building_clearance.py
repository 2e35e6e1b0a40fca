"""The horizontal distance of flights from buildings they are not safely above, exactly.

A building matters to the part of a leg that is lower than half a block above its roof. Footprints are
projected vertex by vertex, with straight edges, as for static occupancy.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import shapely
from shapely.geometry import shape

from planner.airmatrix import AirMatrix, FloatArray, IntArray
from planner.airspace import Airspace, Building
from planner.closest_approach import TOLERANCE_M, Legs
from planner.errors import Block

Geometries = npt.NDArray[np.object_]

# Static occupancy overlooks overlaps of up to 1e-6 m², so that the corner of a building may reach into a free
# block: a right angle by 1 mm, a sharp one of 2 degrees by less than 1 cm.
OVERLOOKED_M = 0.01

# Legs looked up at once: bounds memory.
_CHUNK = 2_000


@dataclass(frozen=True)
class Clearance:
    """A flight's horizontal distance from a building, on the leg that starts in `block` at `time_ms`."""

    flight: str
    building: str
    block: Block
    time_ms: int
    distance_m: float


@dataclass(frozen=True)
class Clearances:
    """What flights and buildings came to.

    `smallest` is None where no leg is ever low enough to matter; `too_near` holds the smallest clearance of
    each flight and building that are nearer than half a block side (by more than `OVERLOOKED_M`).
    """

    smallest: Clearance | None
    too_near: tuple[Clearance, ...]


@dataclass(frozen=True, eq=False)
class _Distances:
    """Distances of n pairs of leg number and building number, nearest first, all arrays (n,)."""

    leg: IntArray
    building: IntArray
    distance_m: FloatArray


def building_clearances(airspace: Airspace, legs: Legs, on_progress: Callable[[float], None]) -> Clearances:
    """Return the clearances of legs from an airspace's buildings.

    `on_progress` is called with the fraction done; it starts again when the search radius has to grow.
    """
    if not airspace.buildings or not len(legs):
        return Clearances(None, ())
    routes, route_of_leg = _routes(airspace.grid, legs)
    distances = _nearest(airspace, legs, routes, on_progress)

    def clearance(leg: int, pair: int) -> Clearance:
        return Clearance(
            flight=legs.ids[legs.flight[leg]],
            building=airspace.buildings[distances.building[pair]].id,
            block=airspace.grid.block(legs.first_block[leg]),
            time_ms=int(legs.start_ms[leg]),
            distance_m=float(distances.distance_m[pair]),
        )

    by_route = np.argsort(route_of_leg, kind="stable")
    bounds = np.searchsorted(route_of_leg[by_route], np.arange(len(routes) + 1))
    worst: dict[tuple[int, int], Clearance] = {}
    for pair in np.flatnonzero(distances.distance_m < airspace.grid.block_side_m / 2 - OVERLOOKED_M).tolist():
        route = route_of_leg[distances.leg[pair]]
        for leg in by_route[bounds[route] : bounds[route + 1]].tolist():
            worst.setdefault((int(legs.flight[leg]), int(distances.building[pair])), clearance(leg, pair))
    return Clearances(
        smallest=clearance(int(distances.leg[0]), 0) if distances.leg.size else None,
        too_near=tuple(worst.values()),
    )


def _routes(grid: AirMatrix, legs: Legs) -> tuple[IntArray, IntArray]:
    """Return one leg for each distinct way through the air, and the number of that way for every leg (n,).

    Flights share most links; a link's two directions are one way. A part of a link is a way of its own.
    """
    low = np.minimum(legs.first_block, legs.last_block)
    high = np.maximum(legs.first_block, legs.last_block)
    way = np.where(legs.whole, low * grid.block_count + high, -1 - np.arange(len(legs)))
    _, routes, route_of_leg = np.unique(way, return_index=True, return_inverse=True)
    return routes, route_of_leg


def _nearest(airspace: Airspace, legs: Legs, routes: IntArray, on_progress: Callable[[float], None]) -> _Distances:
    """Return the distances that are within half a block side, and the smallest of all."""
    footprints = _footprints(airspace.grid, airspace.buildings)
    roofs_m = np.array([building.height_m for building in airspace.buildings])
    ceilings_m = roofs_m + airspace.grid.block_height_m / 2 - TOLERANCE_M
    tree = shapely.STRtree(footprints)
    corners = shapely.bounds(footprints).reshape(-1, 2)
    everywhere = _diagonal(np.concatenate([corners, legs.position_m[:, :2], legs.end_position_m[:, :2]]))
    radius = airspace.grid.block_side_m
    while True:
        parts = []
        for begin in range(0, len(routes), _CHUNK):
            nearby = _near(legs, routes[begin : begin + _CHUNK], tree, radius)
            parts.append(_distances(legs, *nearby, footprints, ceilings_m))
            on_progress(min(1.0, (begin + _CHUNK) / len(routes)))
        found = _sorted(parts)
        if radius >= everywhere or (found.leg.size and found.distance_m[0] <= radius):
            return found
        radius = float(found.distance_m[0]) * (1 + 1e-9) if found.leg.size else 2 * radius


def _footprints(grid: AirMatrix, buildings: tuple[Building, ...]) -> Geometries:
    """Return the footprints in metres east and north of the grid's corner."""

    def to_local(degrees: FloatArray) -> FloatArray:
        x, y = grid.project(degrees[:, 0], degrees[:, 1])
        return np.column_stack([x - grid.origin_x_m, y - grid.origin_y_m])

    footprints = np.array([shape(building.footprint) for building in buildings])
    local: Geometries = shapely.transform(footprints, to_local)
    return local


def _diagonal(points: FloatArray) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def _near(legs: Legs, chosen: IntArray, tree: shapely.STRtree, radius: float) -> tuple[IntArray, IntArray]:
    """Return legs and buildings whose bounding boxes are within `radius` metres: (n,) each."""
    ends = np.stack([legs.position_m[chosen, :2], legs.end_position_m[chosen, :2]])
    reach = shapely.box(*(ends.min(axis=0) - radius).T, *(ends.max(axis=0) + radius).T)
    number, building = tree.query(reach)
    return chosen[number], building


def _distances(
    legs: Legs, leg: IntArray, building: IntArray, footprints: Geometries, ceilings_m: FloatArray
) -> _Distances:
    """Return the distances from buildings of the parts of legs that are below the buildings' ceilings."""
    start, end = legs.position_m[leg], legs.end_position_m[leg]
    climb = end[:, 2] - start[:, 2]
    room = ceilings_m[building] - start[:, 2]
    # The leg passes the ceiling after this fraction of it.
    passing = np.clip(np.divide(room, climb, out=np.zeros_like(climb), where=climb != 0), 0, 1)
    begin_low = np.where(climb < 0, passing, 0.0)[:, None]
    end_low = np.where(climb > 0, passing, 1.0)[:, None]
    low = np.flatnonzero(np.minimum(start[:, 2], end[:, 2]) <= ceilings_m[building])
    ways = _ways((start + begin_low * (end - start))[low, :2], (start + end_low * (end - start))[low, :2])
    return _Distances(leg[low], building[low], shapely.distance(ways, footprints[building[low]]))


def _ways(starts: FloatArray, ends: FloatArray) -> Geometries:
    """Return straight lines, and points where a line has no length: (n, 2) each -> (n,)."""
    ways: Geometries = shapely.points(starts)
    moved = (starts != ends).any(axis=1)
    ways[moved] = shapely.linestrings(np.stack([starts, ends], axis=1)[moved])
    return ways


def _sorted(parts: list[_Distances]) -> _Distances:
    distance_m = np.concatenate([part.distance_m for part in parts])
    order = np.argsort(distance_m, kind="stable")
    return _Distances(
        leg=np.concatenate([part.leg for part in parts])[order],
        building=np.concatenate([part.building for part in parts])[order],
        distance_m=distance_m[order],
    )
