/** The AirMatrix on the globe: blocks (i east, j north, k up, zero-based) to longitude and latitude, and back. */

const NEWTON_STEPS = 4;

export class Grid {
  #lattice;

  /** Take the answer of `GET /v1/airspace`. */
  constructor(airspace) {
    this.dimensions = airspace.dimensions;
    this.side = airspace.block_side_m;
    this.height = airspace.block_height_m;
    this.#lattice = airspace.lattice;
  }

  /** Where the highest layer ends, in metres. */
  get ceiling() {
    return this.dimensions[2] * this.height;
  }

  /** Return longitude and latitude of a point of the grid, in block sides east and north of its south-west corner. */
  position(east, north) {
    const across = quadratic(east / this.dimensions[0]);
    const along = quadratic(north / this.dimensions[1]);
    let lon = 0;
    let lat = 0;
    for (let row = 0; row < 3; row += 1) {
      for (let column = 0; column < 3; column += 1) {
        const weight = along[row] * across[column];
        lon += weight * this.#lattice[row][column][0];
        lat += weight * this.#lattice[row][column][1];
      }
    }
    return [lon, lat];
  }

  /** Return where a position lies, in block sides east and north of the south-west corner: `position` undone. */
  offsets(lon, lat) {
    let [east, north] = [this.dimensions[0] / 2, this.dimensions[1] / 2];
    for (let step = 0; step < NEWTON_STEPS; step += 1) {
      const here = this.position(east, north);
      const e = this.position(east + 0.5, north).map((degrees, axis) => 2 * (degrees - here[axis]));
      const n = this.position(east, north + 0.5).map((degrees, axis) => 2 * (degrees - here[axis]));
      const [dx, dy] = [lon - here[0], lat - here[1]];
      const determinant = e[0] * n[1] - e[1] * n[0];
      east += (dx * n[1] - dy * n[0]) / determinant;
      north += (dy * e[0] - dx * e[1]) / determinant;
    }
    return [east, north];
  }

  /** Return the block of a layer at a position, or null outside of the grid. */
  blockAt(lon, lat, layer) {
    const [i, j] = this.offsets(lon, lat).map(Math.floor);
    const inside = i >= 0 && j >= 0 && i < this.dimensions[0] && j < this.dimensions[1];
    return inside ? [i, j, layer] : null;
  }

  /** Return a block's footprint as a closed ring, drawn in from its faces by a share of its side. */
  ring([i, j], inset = 0) {
    const [west, east, south, north] = [i + inset, i + 1 - inset, j + inset, j + 1 - inset];
    return [[west, south], [east, south], [east, north], [west, north], [west, south]].map((corner) =>
      this.position(...corner));
  }

  /** Return the outline of the whole grid, with enough points to follow its curved sides. */
  outline() {
    const [count_i, count_j] = this.dimensions;
    const steps = Array.from({ length: 16 }, (_, step) => step / 16);
    return [
      ...steps.map((part) => this.position(part * count_i, 0)),
      ...steps.map((part) => this.position(count_i, part * count_j)),
      ...steps.map((part) => this.position((1 - part) * count_i, count_j)),
      ...steps.map((part) => this.position(0, (1 - part) * count_j)),
      this.position(0, 0),
    ];
  }

  /** Return the position of a block's centre. */
  centre([i, j, k]) {
    const [lon, lat] = this.position(i + 0.5, j + 0.5);
    return { lon, lat, alt_m: this.altitude(k) };
  }

  /** Return the altitude of a layer's middle in metres. */
  altitude(layer) {
    return (layer + 0.5) * this.height;
  }

  /** Return a layer's altitudes in words. */
  layerName(layer) {
    return `${layer * this.height}–${(layer + 1) * this.height} m`;
  }
}

/** Return the weights of the points at 0, 1/2 and 1. */
function quadratic(t) {
  return [(1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)];
}

/** Return a block as a key of maps. */
export const keyOf = (block) => block.join("/");
