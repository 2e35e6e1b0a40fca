/** Metres around a point: where the scene is computed, since 32 bits are too few for positions on the globe. */

const EQUATOR_M = 2 * Math.PI * 6_371_008.8;

export class LocalFrame {
  #x;
  #y;
  #unit;

  constructor(lon, lat) {
    [this.#x, this.#y] = mercator(lon, lat);
    // A metre at this latitude, in the unit of Web Mercator: the side of its square.
    this.#unit = 1 / (EQUATOR_M * Math.cos((lat * Math.PI) / 180));
  }

  /** Return metres east, north and up of a position. */
  local({ lon, lat, alt_m }) {
    const [x, y] = mercator(lon, lat);
    return [(x - this.#x) / this.#unit, (this.#y - y) / this.#unit, alt_m];
  }

  /** Return the matrix that takes local metres to clip space, given the one that takes Web Mercator there. */
  matrix(mercatorToClip) {
    const m = mercatorToClip;
    const unit = this.#unit;
    const local = new Float64Array(16);
    for (let row = 0; row < 4; row += 1) {
      local[row] = m[row] * unit;
      local[4 + row] = -m[4 + row] * unit;
      local[8 + row] = m[8 + row] * unit;
      local[12 + row] = m[row] * this.#x + m[4 + row] * this.#y + m[12 + row];
    }
    return local;
  }
}

/** Return where a local position is on a canvas of this size in pixels, or null behind the camera. */
export function toScreen(matrix, [east, north, up], width, height) {
  const clip = (row) => matrix[row] * east + matrix[4 + row] * north + matrix[8 + row] * up + matrix[12 + row];
  const [x, y, w] = [clip(0), clip(1), clip(3)];
  return w > 0 ? [(1 + x / w) * (width / 2), (1 - y / w) * (height / 2)] : null;
}

function mercator(lon, lat) {
  const y = Math.log(Math.tan(Math.PI / 4 + (lat * Math.PI) / 360));
  return [(180 + lon) / 360, (180 - (180 / Math.PI) * y) / 360];
}
