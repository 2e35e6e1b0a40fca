/** The map: ground, grid, buildings, blocks, heat. It knows MapLibre; what it shows comes from outside. */

import { keyOf } from "/console/grid.js";
import { palette } from "/console/palette.js";

/** Drawn in this order: what matters most is not hidden behind what matters less. */
const STATUSES = ["red", "yellow", "green"];
const OPACITY = { red: 0.72, yellow: 0.6, green: 0.34 };
const CLOSED = "closed";
const DRAFT = "draft";
const HATCH_PX = 32;
/** Tiles this deep are precise to decimetres, and so few that thousands of blocks are cut up in no time. */
const DEEPEST_TILE = 14;
/** Dark blue to yellow: Cividis, made to look alike with and without colour vision deficiencies. */
export const HEAT_RAMP = ["#00224e", "#31446b", "#666870", "#958f78", "#cbba69", "#fee838"];

export class CityMap {
  #map;
  #grid;
  #rings = new Map();
  #outline;
  #bounds;

  /** Resolves when the map is drawn for the first time. */
  static async open(container, grid, bounds, buildings) {
    const made = new CityMap(container, grid, bounds, buildings);
    await made.#map.once("load");
    return made;
  }

  constructor(container, grid, bounds, buildings) {
    this.#grid = grid;
    this.#outline = grid.outline();
    this.#map = new maplibregl.Map({
      container,
      attributionControl: false,
      maxPitch: 75,
      minZoom: 9,
      maxZoom: 20,
      style: this.#style(buildings),
      fadeDuration: 0,
    });
    this.#bounds = bounds;
    this.#map.jumpTo(this.#home());
    this.#map.addControl(new maplibregl.NavigationControl({ visualizePitch: true }), "top-right");
    this.#map.addControl(new maplibregl.ScaleControl({ maxWidth: 120 }), "bottom-right");
    this.#map.on("load", () => this.setTheme());
  }

  get map() {
    return this.#map;
  }

  /** Draw in the present theme's colours. */
  setTheme() {
    const colours = palette();
    const map = this.#map;
    map.setPaintProperty("outside", "background-color", colours.outside);
    map.setPaintProperty("ground", "fill-color", colours.ground);
    map.setPaintProperty("grid", "line-color", colours.grid);
    map.setPaintProperty("edge", "line-color", colours.accent);
    map.setPaintProperty("footprints", "fill-color", colours["building-high"]);
    map.setPaintProperty("buildings", "fill-extrusion-color", [
      "interpolate", ["linear"], ["get", "height"], 0, colours.building, 90, colours["building-high"],
    ]);
    map.setPaintProperty("green", "fill-extrusion-color", colours.green);
    for (const status of ["yellow", "red"]) {
      this.#setImage(status, hatch(status, colours[status]));
    }
    this.#setImage(CLOSED, stripes(colours.red));
    map.setPaintProperty("closed-edge", "line-color", colours.red);
    this.#setImage(DRAFT, stripes(colours.accent));
    map.setPaintProperty("draft-corners", "circle-color", colours.accent);
    map.setPaintProperty("draft-corners", "circle-stroke-color", colours.outline);
  }

  /** Show these blocks, entries of a status answer. */
  showBlocks(entries) {
    this.#map.getSource("blocks").setData({
      type: "FeatureCollection",
      features: entries.map(({ block, status }) => ({
        type: "Feature",
        properties: {
          status,
          key: keyOf(block),
          base: block[2] * this.#grid.height + 1,
          top: (block[2] + 1) * this.#grid.height - 1,
        },
        geometry: { type: "Polygon", coordinates: [this.#ring(block)] },
      })),
    });
  }

  /** Show closed airspace: constraints, up to the ceiling where they have no top. */
  showConstraints(constraints) {
    const { ceiling } = this.#grid;
    this.#map.getSource(CLOSED).setData({
      type: "FeatureCollection",
      features: constraints.map(({ name, polygon, base_m: base, top_m: top }) => ({
        type: "Feature",
        properties: { name, base: Math.max(base, 0), top: Math.min(top ?? ceiling, ceiling) },
        geometry: polygon,
      })),
    });
  }

  /** Show an area that may be closed: its corners, and hatched what they enclose, null for nothing. */
  showDraft(corners, polygon, base, top) {
    const features = corners.map((coordinates) => ({
      type: "Feature", properties: {}, geometry: { type: "Point", coordinates },
    }));
    if (polygon) features.push({ type: "Feature", properties: { base, top }, geometry: polygon });
    this.#map.getSource(DRAFT).setData({ type: "FeatureCollection", features });
  }

  /** Return how many pixels of the canvas lie between two positions on the ground, `[lon, lat]`. */
  pixelsBetween(one, other) {
    return this.#map.project(one).dist(this.#map.project(other));
  }

  /** Return the names of the constraints at a point of the canvas. */
  constraintsAtPoint(point) {
    const found = this.#map.queryRenderedFeatures([point.x, point.y], { layers: [CLOSED] });
    return [...new Set(found.map(({ properties }) => properties.name))];
  }

  /** Show seconds of use of columns of blocks, `[i, j, seconds]`, and return the most. */
  showHeat(columns) {
    const most = columns.reduce((most, [, , seconds]) => Math.max(most, seconds), 0);
    this.#map.getSource("heat").setData({
      type: "FeatureCollection",
      features: columns.map(([i, j, seconds]) => ({
        type: "Feature",
        properties: { share: seconds / most },
        geometry: { type: "Polygon", coordinates: [this.#grid.ring([i, j])] },
      })),
    });
    return most;
  }

  /** Return the shown block that a click at a point of the canvas means, as indices, or null. */
  blockAtPoint(point) {
    const [nearest] = this.#map.queryRenderedFeatures([point.x, point.y], { layers: STATUSES });
    return nearest ? nearest.properties.key.split("/").map(Number) : null;
  }

  /** Fly back to where the whole airspace is seen. */
  goHome() {
    this.#map.flyTo({ ...this.#home(), duration: flightMs() });
  }

  /** Fly to a position, close enough to see blocks. */
  flyTo({ lon, lat }) {
    this.#map.flyTo({
      center: [lon, lat],
      zoom: Math.max(this.#map.getZoom(), 16.2),
      duration: flightMs(),
    });
  }

  /** Return the camera that sees the whole airspace. MapLibre fits bounds as if seen from above, which leaves room. */
  #home() {
    // Room for the cards at the left, and in front, where the tilted view is nearer.
    const above = this.#map.cameraForBounds(this.#bounds, { padding: { left: 110, top: 0, right: 0, bottom: 80 } });
    return { center: above.center, zoom: above.zoom + 0.08, pitch: 50, bearing: -14 };
  }

  #setImage(name, image) {
    if (this.#map.hasImage(name)) this.#map.updateImage(name, image);
    else this.#map.addImage(name, image, { pixelRatio: 2 });
  }

  #ring(block) {
    const key = block[0] * this.#grid.dimensions[1] + block[1];
    if (!this.#rings.has(key)) this.#rings.set(key, this.#grid.ring(block, 0.03));
    return this.#rings.get(key);
  }

  #style(buildings) {
    const area = { type: "Feature", properties: {}, geometry: { type: "Polygon", coordinates: [this.#outline] } };
    const empty = { type: "FeatureCollection", features: [] };
    const shapes = (data, maxzoom = DEEPEST_TILE) => ({ type: "geojson", data, maxzoom, tolerance: 0.05 });
    return {
      version: 8,
      light: { anchor: "viewport", position: [1.2, 200, 35], intensity: 0.3 },
      sources: {
        area: shapes(area),
        lines: shapes(this.#gridLines()),
        heat: shapes(empty),
        buildings: shapes(buildings, 15),
        blocks: shapes(empty),
        [CLOSED]: shapes(empty),
        // Corners are to be where they were set, however close the camera is.
        [DRAFT]: shapes(empty, 20),
      },
      layers: [
        { id: "outside", type: "background" },
        { id: "ground", type: "fill", source: "area" },
        { id: "grid", type: "line", source: "lines", paint: { "line-width": 1 } },
        {
          id: "heat", type: "fill", source: "heat",
          paint: {
            "fill-color": [
              "interpolate", ["linear"], ["get", "share"],
              ...HEAT_RAMP.flatMap((colour, step) => [step / (HEAT_RAMP.length - 1), colour]),
            ],
            "fill-antialias": false,
          },
        },
        { id: "edge", type: "line", source: "area", paint: { "line-width": 1.5, "line-opacity": 0.7 } },
        { id: "footprints", type: "fill", source: "buildings", paint: { "fill-opacity": 0.5 } },
        {
          id: "buildings", type: "fill-extrusion", source: "buildings",
          paint: { "fill-extrusion-height": ["get", "height"], "fill-extrusion-vertical-gradient": true },
        },
        ...STATUSES.map((status) => ({
          id: status, type: "fill-extrusion", source: "blocks",
          filter: ["==", ["get", "status"], status],
          paint: {
            ...(status === "green" ? {} : { "fill-extrusion-pattern": status }),
            "fill-extrusion-base": ["get", "base"],
            "fill-extrusion-height": ["get", "top"],
            "fill-extrusion-opacity": OPACITY[status],
            "fill-extrusion-vertical-gradient": false,
          },
        })),
        { id: "closed-edge", type: "line", source: CLOSED, paint: { "line-width": 1.5 } },
        {
          id: CLOSED, type: "fill-extrusion", source: CLOSED,
          paint: {
            "fill-extrusion-pattern": CLOSED,
            "fill-extrusion-base": ["get", "base"],
            "fill-extrusion-height": ["get", "top"],
            "fill-extrusion-opacity": 0.45,
            "fill-extrusion-vertical-gradient": false,
          },
        },
        {
          id: DRAFT, type: "fill-extrusion", source: DRAFT, filter: ["==", ["geometry-type"], "Polygon"],
          paint: {
            "fill-extrusion-pattern": DRAFT,
            "fill-extrusion-base": ["get", "base"],
            "fill-extrusion-height": ["get", "top"],
            "fill-extrusion-opacity": 0.5,
            "fill-extrusion-vertical-gradient": false,
          },
        },
        {
          id: "draft-corners", type: "circle", source: DRAFT, filter: ["==", ["geometry-type"], "Point"],
          paint: { "circle-radius": 5, "circle-stroke-width": 1.5 },
        },
      ],
    };
  }

  /** Lines of the grid, every tenth. */
  #gridLines() {
    const [count_i, count_j] = this.#grid.dimensions;
    const parts = [0, 0.25, 0.5, 0.75, 1];
    const lines = [];
    for (let i = 10; i < count_i; i += 10) lines.push(parts.map((part) => this.#grid.position(i, part * count_j)));
    for (let j = 10; j < count_j; j += 10) lines.push(parts.map((part) => this.#grid.position(part * count_i, j)));
    return { type: "Feature", properties: {}, geometry: { type: "MultiLineString", coordinates: lines } };
  }
}

function flightMs() {
  return matchMedia("(prefers-reduced-motion: reduce)").matches ? 0 : 900;
}

/** Return the fill of closed airspace: stripes with nothing between them, for what is inside is to be seen. */
function stripes(colour) {
  const canvas = new OffscreenCanvas(HATCH_PX, HATCH_PX);
  const context = canvas.getContext("2d");
  context.strokeStyle = colour;
  context.lineWidth = 6;
  for (const shift of [-1, 0, 1]) {
    context.beginPath();
    context.moveTo(shift * HATCH_PX, 0);
    context.lineTo((shift + 1) * HATCH_PX, HATCH_PX);
    context.stroke();
  }
  return context.getImageData(0, 0, HATCH_PX, HATCH_PX);
}

/** Return a status's fill: hatched one way for yellow and both ways for red; green is plain. */
function hatch(status, colour) {
  const canvas = new OffscreenCanvas(HATCH_PX, HATCH_PX);
  const context = canvas.getContext("2d");
  context.fillStyle = colour;
  context.fillRect(0, 0, HATCH_PX, HATCH_PX);
  context.strokeStyle = "rgb(0 0 0 / 55%)";
  context.lineWidth = 5;
  for (const slope of status === "red" ? [1, -1] : [1]) {
    for (const shift of [-1, 0, 1]) {
      context.beginPath();
      context.moveTo(shift * HATCH_PX, slope > 0 ? 0 : HATCH_PX);
      context.lineTo((shift + 1) * HATCH_PX, slope > 0 ? HATCH_PX : 0);
      context.stroke();
    }
  }
  return context.getImageData(0, 0, HATCH_PX, HATCH_PX);
}
