"""Closed airspace: a polygon and altitudes -> the blocks that belong to it (beyond the paper)."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import shapely

from planner.airmatrix import AirMatrix, IntArray
from planner.buildings import local_shapes, overlapped_cells, parsed
from planner.errors import VolumeError

MAX_VERTICES = 1_000
_NO_AREA = "the polygon encloses no area"


def volume_blocks(grid: AirMatrix, polygon: Mapping[str, Any], base_m: float, top_m: float | None) -> IntArray:
    """Return the flat indices of the blocks that a volume overlaps, ascending: shape (n,).

    A block belongs to the volume when its cell shares more than 1e-6 m² with the polygon and its layer some height
    with [`base_m`, `top_m`], as with buildings.

    Parameters
    ----------
    polygon : mapping
        A GeoJSON Polygon or MultiPolygon in WGS84 degrees, with or without holes, of up to `MAX_VERTICES` vertices.
    base_m, top_m : float
        Metres above the ground datum; without a top it ends nowhere.

    Raises
    ------
    VolumeError
        The polygon is malformed, invalid or too large, the top lies no higher than the base, or no block belongs to it.
    """
    if top_m is not None and top_m <= base_m:
        raise VolumeError(f"the top, {top_m:g} m, must lie above the base, {base_m:g} m")
    (footprint,) = local_shapes(grid, np.array([_shape(polygon)], dtype=object))
    if footprint is None:
        raise VolumeError(f"the polygon lies where EPSG:{grid.epsg} is undefined")
    if footprint.is_empty:
        raise VolumeError(_NO_AREA)
    j, i = overlapped_cells(grid, footprint)
    count_i, count_j, count_k = grid.dimensions
    floor_m = np.arange(count_k) * grid.block_height_m
    layers = np.flatnonzero((base_m < floor_m + grid.block_height_m) & (floor_m < (np.inf if top_m is None else top_m)))
    blocks: IntArray = np.sort((layers[:, np.newaxis] * count_j + j) * count_i + i, axis=None)
    if not len(blocks):
        west, south, east, north = grid.bounds
        raise VolumeError(
            f"the volume lies outside the airspace (lon {west:.5f} to {east:.5f}, lat {south:.5f} to {north:.5f}, "
            f"0 to {count_k * grid.block_height_m:g} m)"
        )
    return blocks


def _shape(polygon: Mapping[str, Any]) -> shapely.Geometry:
    """Return a polygon as a shape in degrees, if it is one."""
    if polygon.get("type") not in ("Polygon", "MultiPolygon"):
        raise VolumeError("the geometry must be a GeoJSON Polygon or MultiPolygon")
    (shape,) = parsed([polygon])
    if shape is None:
        raise VolumeError("the polygon is malformed: rings are closed lists of at least four [longitude, latitude]")
    if shapely.get_num_coordinates(shape) > MAX_VERTICES:
        raise VolumeError(f"a polygon can have {MAX_VERTICES} vertices at most")
    if (np.abs(shapely.bounds(shape)) > (180, 90, 180, 90)).any():
        raise VolumeError("the polygon is not in degrees of longitude and latitude (WGS84)")
    if not shapely.is_valid(shape):
        raise VolumeError(f"the polygon is not valid: {shapely.is_valid_reason(shape)}")
    if not shapely.area(shape) > 0:
        raise VolumeError(_NO_AREA)
    return shape
