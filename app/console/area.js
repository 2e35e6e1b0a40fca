/** An area by its corners: read from text, measured, drawn. A corner is `[lon, lat]` in degrees. */

const METRES_OF_DEGREE = 111_195;
export const FEWEST_CORNERS = 3;

/**
 * Read corners, one a line: longitude and latitude with a comma between them. Returns `{corners, wrong}`; `wrong` says
 * what is wrong with the first line that is no corner, null where all are. A ring may be closed by its first corner.
 */
export function readCorners(text) {
  const corners = [];
  for (const [index, line] of text.split("\n").entries()) {
    if (line.trim() === "") continue;
    const parts = line.trim().split(/\s*[,;\s]\s*/);
    const [lon, lat] = parts.map(Number);
    const what = `Line ${index + 1} of the corners`;
    if (parts.length !== 2 || parts.includes("") || !Number.isFinite(lon) || !Number.isFinite(lat)) {
      return { corners, wrong: `${what} is not “longitude, latitude” in degrees, as in 71.43012, 51.12210.` };
    }
    if (Math.abs(lon) > 180 || Math.abs(lat) > 90) {
      return { corners, wrong: `${what} is not on the globe: longitude is first, up to 180; latitude up to 90.` };
    }
    corners.push([lon, lat]);
  }
  if (corners.length > FEWEST_CORNERS && isSame(corners[0], corners.at(-1))) corners.pop();
  return { corners, wrong: null };
}

/** Write corners as `readCorners` reads them, to a decimetre. */
export function writeCorners(corners) {
  return corners.map(([lon, lat]) => `${lon.toFixed(6)}, ${lat.toFixed(6)}\n`).join("");
}

/** Return corners as a GeoJSON polygon. */
export function polygonOf(corners) {
  return { type: "Polygon", coordinates: [[...corners, corners[0]]] };
}

/** Return how large an area is: `{hectares, east, north}`, the latter the metres that it spans. */
export function sizeOf(corners) {
  const [[lon, lat]] = corners;
  const scale = METRES_OF_DEGREE * Math.cos((lat * Math.PI) / 180);
  const points = corners.map((corner) => [(corner[0] - lon) * scale, (corner[1] - lat) * METRES_OF_DEGREE]);
  const doubled = points.reduce((sum, [x, y], index) => {
    const [nextX, nextY] = points[(index + 1) % points.length];
    return sum + x * nextY - nextX * y;
  }, 0);
  const reach = (axis) => {
    const along = points.map((point) => point[axis]);
    return Math.max(...along) - Math.min(...along);
  };
  return { hectares: Math.abs(doubled) / 20_000, east: reach(0), north: reach(1) };
}

/** Tell whether two sides of an outline cross each other: such a polygon closes another area than was meant. */
export function crossesItself(corners) {
  const sides = corners.map((corner, index) => [corner, corners[(index + 1) % corners.length]]);
  return sides.some(([a, b], one) => sides.some(([c, d], other) =>
    other > one && turn(a, b, c) * turn(a, b, d) < 0 && turn(c, d, a) * turn(c, d, b) < 0));
}

/** Return the sign of the turn at the second of three corners, 0 where they are in line. */
function turn([ax, ay], [bx, by], [cx, cy]) {
  return Math.sign((bx - ax) * (cy - ay) - (by - ay) * (cx - ax));
}

function isSame([lon, lat], [otherLon, otherLat]) {
  return lon === otherLon && lat === otherLat;
}
