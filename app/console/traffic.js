/** Everything in the air: aircraft with stems to the ground and vectors ahead, paths, outlines, and name tags. */

import { toScreen } from "/console/frame.js";
import { idOf } from "/console/flights.js";
import { Motion } from "/console/motion.js";
import { rgba } from "/console/palette.js";
import { Scene, segmentArray, spriteArray } from "/console/scene.js";
import { symbolOf } from "/console/symbols.js";
import { Tags, isAlarming } from "/console/tags.js";

/** How far ahead a vector shows where an aircraft will be, as on a radar screen. */
const VECTOR_S = 10;
const REACH_PX = 16;
/** Symbols of aircraft whose velocity says where they go. */
const MOVING = ["conforming", "deviating", "violating"];

export class Traffic {
  /** The flight or track that is selected, and the one under the pointer: ids or null. */
  selected = null;
  hovered = null;
  #frame;
  #grid;
  #motion = new Motion();
  /** Aircraft at a moment other than the present, null while live. */
  #planned = null;
  #colours;
  #tags;
  #drawn = [];
  #map;
  #scene;
  /** What the still lines show; they are made anew from it when the colours change. */
  #path = { trajectory: [], reservations: [], preview: false };
  #block = null;
  #alarms = [];
  #ends = { origin: null, destination: null };
  #area = null;

  constructor(map, frame, grid, colours, tags) {
    this.#map = map;
    this.#frame = frame;
    this.#grid = grid;
    this.#colours = colours;
    this.#tags = new Tags(tags);
    this.#scene = new Scene(map, frame, colours, (matrix) => this.#compose(matrix));
  }

  /** Take the flights of a tick. */
  take(flights, rate) {
    this.#motion.take(flights, performance.now(), rate);
  }

  /** Show aircraft of another moment, `{flight, lon, lat, alt_m, heading}`, not the present ones; null ends that. */
  showPlanned(aircraft) {
    this.#planned = aircraft;
    this.draw();
  }

  /** Draw a frame. */
  draw() {
    this.#scene.draw();
  }

  /** Draw in other colours from now on. */
  setColours(colours) {
    this.#colours = colours;
    this.#scene.setColours(colours);
    this.#drawStill();
  }

  /** Show a trajectory and the blocks reserved for it; empty lists hide them. A preview is dashed. */
  showPath(trajectory, reservations, { preview = false } = {}) {
    this.#path = { trajectory, reservations, preview };
    this.#drawStill();
  }

  /** Draw a box around a block; null removes it. */
  showBlock(block) {
    this.#block = block;
    this.#drawStill();
  }

  /** Draw boxes around those of these blocks that are not green. */
  showAlarms(entries) {
    this.#alarms = entries.filter(({ status }) => status !== "green");
    this.#drawStill();
  }

  /** Draw poles from the ground to the chosen origin and destination, positions or null. */
  showEnds(ends) {
    this.#ends = ends;
    this.#drawStill();
  }

  /** Draw the edges of an area, `{corners, base, top, end}`, `end` the next corner to be or null; null removes it. */
  showArea(area) {
    this.#area = area;
    this.#drawStill();
  }

  /** Return the flight or track drawn nearest to a point of the canvas, null where none is. */
  at({ x, y }) {
    const near = this.#drawn
      .filter(({ screen }) => screen !== null)
      .map(({ flight, screen }) => ({ flight, px: Math.hypot(screen[0] - x, screen[1] - y) }))
      .filter(({ px }) => px < REACH_PX)
      .sort((one, other) => one.px - other.px);
    return near[0]?.flight ?? null;
  }

  #compose(matrix) {
    const aircraft = this.#planned ?? this.#motion.positions(performance.now());
    const { clientWidth: width, clientHeight: height } = this.#map.getCanvas();
    this.#drawn = aircraft.map(({ flight, heading, ...position }) => {
      const at = this.#frame.local(position);
      const symbol = this.#planned ? "planned" : symbolOf(flight);
      const marked = [this.selected, this.hovered].includes(idOf(flight));
      return { flight, heading, at, symbol, marked, screen: toScreen(matrix, at, width, height) };
    });
    // Those that want attention are drawn over the others.
    this.#drawn.sort((one, other) => isAlarming(one.symbol) - isAlarming(other.symbol));
    this.#tags.show(this.#drawn, width, height);
    return {
      sprites: spriteArray(this.#drawn.map((drawn) => ({ ...drawn, scale: scaleOf(drawn) }))),
      segments: segmentArray(this.#drawn.flatMap((drawn) => this.#linesOf(drawn))),
    };
  }

  /** Return an aircraft's pole to the ground, and its vector where it moves. */
  #linesOf({ flight, at, symbol, marked }) {
    const { aircraft, red, yellow } = this.#colours;
    const plain = isAlarming(symbol) ? yellow : aircraft;
    const colour = symbol === "violating" ? red : plain;
    const strong = marked || isAlarming(symbol);
    const pole = this.#pole(at, { colour: rgba(colour, strong ? 0.7 : 0.28), width: 1 });
    const velocity = flight.velocity_mps;
    if (velocity === null || !MOVING.includes(symbol)) return [pole];
    const ahead = [velocity.east, velocity.north, velocity.up].map((speed, axis) => at[axis] + speed * VECTOR_S);
    return [pole, { from: at, to: ahead, colour: rgba(colour, strong ? 0.9 : 0.35), width: strong ? 2 : 1.2 }];
  }

  #drawStill() {
    const colours = this.#colours;
    const pale = rgba(colours.accent, 0.35);
    this.#scene.setStill([
      ...this.#alarms.flatMap(({ block, status }) =>
        this.#box(block, rgba(colours[status], 0.9), status === "red" ? 2.2 : 1.2)),
      ...this.#path.reservations.flatMap(({ block }) => this.#floor(block, pale)),
      ...this.#pathLines(),
      ...Object.entries(this.#ends).flatMap(([end, position]) =>
        position === null ? [] : [this.#pole(this.#frame.local(position), { colour: rgba(colours[end]), width: 3 })]),
      ...(this.#area === null ? [] : this.#areaLines(this.#area)),
      ...(this.#block === null ? [] : this.#box(this.#block, rgba(colours.accent), 3)),
    ]);
    this.draw();
  }

  #pathLines() {
    const colour = rgba(this.#colours.accent);
    const points = this.#path.trajectory.map((waypoint) => this.#frame.local(waypoint));
    const dash = this.#path.preview ? 7 : 0;
    return [
      ...points.slice(1).map((to, index) => ({ from: points[index], to, colour, width: 4, dash })),
      ...[points.at(0), points.at(-1)].filter(Boolean).map((end) => this.#pole(end, { colour, width: 2, dash: 3 })),
    ];
  }

  /** Return an area's edges: its outline low and high, a pole at each corner; dashed where it is not drawn yet. */
  #areaLines({ corners, base, top, end }) {
    const colour = rgba(this.#colours.accent);
    const all = end === null ? corners : [...corners, end];
    const foot = all.map(([lon, lat]) => this.#frame.local({ lon, lat, alt_m: base }));
    const raised = ([x, y]) => [x, y, top];
    return foot.flatMap((from, index) => {
      const to = foot[(index + 1) % foot.length];
      const dash = end !== null && index >= corners.length - 1 ? 5 : 0;
      return [
        { from, to, colour, width: 2.5, dash },
        { from: raised(from), to: raised(to), colour, width: 1.2, dash },
        { from, to: raised(from), colour, width: 1.2, dash },
      ];
    });
  }

  /** Return a line from the ground to a point. */
  #pole(top, look) {
    return { from: [top[0], top[1], 0], to: top, ...look };
  }

  /** Return the lines of a block's floor. */
  #floor(block, colour, inset = 0.06) {
    const base = block[2] * this.#grid.height + 1;
    const ring = this.#grid.ring(block, inset).map(([lon, lat]) => this.#frame.local({ lon, lat, alt_m: base }));
    return ring.slice(1).map((to, index) => ({ from: ring[index], to, colour, width: 1.2 }));
  }

  /** Return the twelve edges of a block. */
  #box(block, colour, width) {
    const [base, top] = [block[2] * this.#grid.height + 1, (block[2] + 1) * this.#grid.height - 1];
    const ring = this.#grid.ring(block, 0.03).map(([lon, lat]) => this.#frame.local({ lon, lat, alt_m: 0 }));
    const at = ([x, y], z) => [x, y, z];
    return ring.slice(1).flatMap((corner, index) => [
      { from: at(ring[index], base), to: at(corner, base), colour, width },
      { from: at(ring[index], top), to: at(corner, top), colour, width },
      { from: at(corner, base), to: at(corner, top), colour, width },
    ]);
  }
}

function scaleOf({ symbol, marked }) {
  return (marked ? 1.35 : 1) * (symbol === "violating" ? 1.2 : 1);
}
