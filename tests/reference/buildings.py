"""Static occupancy from its definition: every block against every building, one polygon at a time."""

from collections.abc import Sequence

import numpy as np
import shapely
from shapely.geometry import box, shape

from planner.airmatrix import AirMatrix
from planner.airspace import BoolArray, Building


def statically_occupied(grid: AirMatrix, buildings: Sequence[Building]) -> BoolArray:
    """Twin of `planner.buildings.statically_occupied`."""
    occupied = np.zeros(grid.block_count, dtype=np.bool_)
    footprints = [
        shapely.transform(shape(building.footprint), grid.project, interleaved=False) for building in buildings
    ]
    for index in range(grid.block_count):
        i, j, k = grid.block(index)
        west, south = grid.origin_x_m + i * grid.block_side_m, grid.origin_y_m + j * grid.block_side_m
        cell = box(west, south, west + grid.block_side_m, south + grid.block_side_m)
        occupied[index] = any(
            building.height_m > k * grid.block_height_m and footprint.intersection(cell).area > 1e-6
            for building, footprint in zip(buildings, footprints, strict=True)
        )
    return occupied
