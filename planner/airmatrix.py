"""The AirMatrix: a regular grid of blocks over a projected plane (paper 2.1).

Blocks are addressed as ``(i, j, k)``, zero-based, i east, j north, k up, or by one flat index
``n = (k * J + j) * I + i``. Kernels, the ledger and files use the flat index.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from planner.errors import AirspaceFileError, Block, OutsideAirspace

IntArray = npt.NDArray[np.int64]
Int32Array = npt.NDArray[np.int32]
FloatArray = npt.NDArray[np.float64]

# Counts are floors of a quotient of metres; this keeps 2000 / 20 from being 99.
_ROUNDING = 1e-9

# 50 km x 50 km in three layers of 20 m blocks; searches keep some hundred bytes a block.
MAX_BLOCKS = 20_000_000


@dataclass(frozen=True)
class AirMatrix:
    """Grid geometry: `epsg` projects to metres, the origin is the grid's lower south-west corner."""

    epsg: int
    origin_x_m: float
    origin_y_m: float
    block_side_m: float
    block_height_m: float
    dimensions: Block

    def __post_init__(self) -> None:
        lengths = (self.origin_x_m, self.origin_y_m, self.block_side_m, self.block_height_m)
        if not all(np.isfinite(lengths)) or self.block_side_m <= 0 or self.block_height_m <= 0:
            raise AirspaceFileError("block side and height must be positive, the origin finite (metres)")
        if min(self.dimensions) < 1:
            raise AirspaceFileError(
                f"an airspace needs at least one block in every direction, not {self.dimensions}; "
                "check size, ceiling and block side and height"
            )
        if math.prod(self.dimensions) > MAX_BLOCKS:
            raise AirspaceFileError(
                f"an airspace can have {MAX_BLOCKS} blocks at most; take larger blocks or a smaller window"
            )

    @classmethod
    def covering(
        cls,
        *,
        epsg: int,
        origin_m: tuple[float, float],
        size_m: tuple[float, float],
        ceiling_m: float,
        block_side_m: float,
        block_height_m: float,
    ) -> "AirMatrix":
        """Return the largest grid of whole blocks within `size_m` (east, north) and `ceiling_m`."""
        if not (block_side_m > 0 and block_height_m > 0):
            raise AirspaceFileError("block side and height must be positive (metres)")
        if not all(np.isfinite((*size_m, ceiling_m))):
            raise AirspaceFileError("size and ceiling must be finite (metres)")
        return cls(
            epsg=epsg,
            origin_x_m=origin_m[0],
            origin_y_m=origin_m[1],
            block_side_m=block_side_m,
            block_height_m=block_height_m,
            dimensions=(
                _whole(size_m[0] / block_side_m),
                _whole(size_m[1] / block_side_m),
                _whole(ceiling_m / block_height_m),
            ),
        )

    @property
    def block_count(self) -> int:
        """Number of blocks in the grid."""
        count_i, count_j, count_k = self.dimensions
        return count_i * count_j * count_k

    def index(self, block: Block) -> int:
        """Return the flat index of a block inside the grid."""
        i, j, k = block
        count_i, count_j, _ = self.dimensions
        return (k * count_j + j) * count_i + i

    def block(self, index: int) -> Block:
        """Return the block with this flat index."""
        count_i, count_j, _ = self.dimensions
        rest, i = divmod(int(index), count_i)
        k, j = divmod(rest, count_j)
        return i, j, k

    def ijk(self, indices: IntArray) -> IntArray:
        """Return blocks for flat indices: shape (n,) -> (n, 3)."""
        count_i, count_j, _ = self.dimensions
        rest, i = np.divmod(indices, count_i)
        k, j = np.divmod(rest, count_j)
        return np.stack([i, j, k], axis=-1)

    def contains(self, block: Block) -> bool:
        """Tell whether the block lies inside the grid."""
        return all(0 <= part < count for part, count in zip(block, self.dimensions, strict=True))

    def centres(self, indices: IntArray) -> FloatArray:
        """Return projected block centres in metres (x, y, height above ground): shape (n,) -> (n, 3)."""
        lengths = np.array([self.block_side_m, self.block_side_m, self.block_height_m])
        origin = np.array([self.origin_x_m, self.origin_y_m, 0.0])
        centres: FloatArray = origin + (self.ijk(indices) + 0.5) * lengths
        return centres

    @cached_property
    def _to_projected(self) -> Transformer:
        return Transformer.from_crs("EPSG:4326", self.crs, always_xy=True)

    @cached_property
    def _to_geodetic(self) -> Transformer:
        return Transformer.from_crs(self.crs, "EPSG:4326", always_xy=True)

    @cached_property
    def crs(self) -> CRS:
        """The projected CRS; raises `AirspaceFileError` unless it is one in metres."""
        try:
            crs = CRS.from_epsg(self.epsg)
        except CRSError as error:
            raise AirspaceFileError(f"EPSG:{self.epsg} is not a known coordinate reference system") from error
        if not crs.is_projected or crs.axis_info[0].unit_name != "metre":
            raise AirspaceFileError(f"EPSG:{self.epsg} ({crs.name}) is not a projected CRS in metres")
        return crs

    def project(self, lon: npt.ArrayLike, lat: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Project WGS84 degrees to metres; infinite where the projection is undefined."""
        x, y = self._to_projected.transform(lon, lat)
        return np.asarray(x), np.asarray(y)

    def unproject(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Turn projected metres into WGS84 degrees (lon, lat)."""
        lon, lat = self._to_geodetic.transform(x, y)
        return np.asarray(lon), np.asarray(lat)

    def block_at(self, lon: float, lat: float, alt_m: float) -> Block:
        """Return the block that contains a position (paper's B_start and B_end).

        Cells are half-open; the grid's upper faces belong to its last blocks.

        Raises
        ------
        OutsideAirspace
        """
        index = int(self.blocks_at(lon, lat, alt_m)[0])
        if index < 0:
            west, south, east, north = self.bounds
            raise OutsideAirspace(
                f"position lon {lon:.7f}, lat {lat:.7f}, {alt_m:g} m lies outside the airspace "
                f"(lon {west:.5f} to {east:.5f}, lat {south:.5f} to {north:.5f}, "
                f"0 to {self.dimensions[2] * self.block_height_m:g} m)"
            )
        return self.block(index)

    def blocks_at(self, lon: npt.ArrayLike, lat: npt.ArrayLike, alt_m: npt.ArrayLike) -> IntArray:
        """Return the flat indices of the blocks that contain positions, -1 outside the grid: shape (n,) each."""
        x, y = self.project(lon, lat)
        origin = np.array([self.origin_x_m, self.origin_y_m, 0.0])
        lengths = np.array([self.block_side_m, self.block_side_m, self.block_height_m])
        offsets = (np.column_stack([x, y, np.asarray(alt_m, dtype=np.float64)]) - origin) / lengths
        counts = np.array(self.dimensions)
        # The projection is infinite where it is undefined.
        inside = ((offsets >= 0) & (offsets <= counts)).all(axis=1)
        i, j, k = np.minimum(np.where(inside[:, None], offsets, 0).astype(np.int64), counts - 1).T
        return np.where(inside, (k * counts[1] + j) * counts[0] + i, -1)

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """Projected bounds of the grid: x and y of the south-west, x and y of the north-east corner."""
        east = self.origin_x_m + self.dimensions[0] * self.block_side_m
        north = self.origin_y_m + self.dimensions[1] * self.block_side_m
        return self.origin_x_m, self.origin_y_m, east, north

    @cached_property
    def bounds(self) -> tuple[float, float, float, float]:
        """Geodetic bounds of the grid: west, south, east, north in degrees."""
        x0, y0, x1, y1 = self.extent_m
        west, south, east, north = self._to_geodetic.transform_bounds(x0, y0, x1, y1)
        return west, south, east, north

    @cached_property
    def corners(self) -> tuple[FloatArray, FloatArray]:
        """WGS84 degrees of all cell corners (lon, lat), each of shape (J + 1, I + 1)."""
        count_i, count_j, _ = self.dimensions
        x = self.origin_x_m + np.arange(count_i + 1) * self.block_side_m
        y = self.origin_y_m + np.arange(count_j + 1) * self.block_side_m
        return self.unproject(*np.meshgrid(x, y))


def _whole(quotient: float) -> int:
    """Return the whole part of a count; one too large for any grid stays too large, also where it overflows."""
    return int(min(quotient, 2.0 * MAX_BLOCKS) + _ROUNDING)
