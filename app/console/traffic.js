/** Everything in the air: aircraft with stems to the ground and vectors ahead, paths, outlines, and name tags. */

import { element, setText } from "/console/dom.js";
import { toScreen } from "/console/frame.js";
import { idOf } from "/console/flights.js";
import { Motion } from "/console/motion.js";
import { rgba } from "/console/palette.js";
import { Scene, segmentArray, spriteArray } from "/console/scene.js";
import { symbolOf } from "/console/symbols.js";
import { flightName, flightReason } from "/console/words.js";

/** How far ahead a vector shows where an aircraft will be, as on a radar screen. */
const VECTOR_S = 10;
const REACH_PX = 16;
const MOST_TAGS = 24;
const TAG_PX = { width: 210, height: 38 };
const RANK = { violating: 0, deviating: 1, lost: 2, unseen: 3 };

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

  constructor(map, frame, grid, colours, tags) {
    this.#map = map;
    this.#frame = frame;
    this.#grid = grid;
    this.#colours = colours;
    this.#tags = tags;
    this.#scene = new Scene(map, frame, colours, (matrix) => this.#compose(matrix));
  }

  /** Take the flights of a tick. */
  take(flights, rate) {
    this.#motion.take(flights, performance.now(), rate);
  }

  /** Show aircraft of another moment, `{flight, lon, lat, alt_m, heading}`, instead of the present ones; null ends that. */
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

  /** Return the flight or track drawn nearest to a point of the canvas, null where none is. */
  at({ x, y }) {
    const near = this.#drawn
      .map(({ flight, screen }) => ({ flight, px: screen === null ? Infinity : Math.hypot(screen[0] - x, screen[1] - y) }))
      .filter(({ px }) => px < REACH_PX)
      .sort((one, other) => one.px - other.px);
    return near[0]?.flight ?? null;
  }

  /** Return where an aircraft is drawn on the canvas, null where it is not. */
  screenOf(id) {
    return this.#drawn.find(({ flight }) => idOf(flight) === id)?.screen ?? null;
  }

  #compose(matrix) {
    const aircraft = this.#planned ?? this.#motion.positions(performance.now());
    const { clientWidth: width, clientHeight: height } = this.#map.getCanvas();
    const sprites = [];
    const segments = [];
    this.#drawn = aircraft.map(({ flight, heading, ...position }) => {
      const at = this.#frame.local(position);
      const symbol = this.#planned ? "planned" : symbolOf(flight);
      const marked = idOf(flight) === this.selected || idOf(flight) === this.hovered;
      const alarmed = symbol in RANK;
      sprites.push({ at, heading, symbol, scale: (marked ? 1.35 : 1) * (symbol === "violating" ? 1.2 : 1), alarmed });
      const colour = alarmed ? this.#colours[symbol === "violating" ? "red" : "yellow"] : this.#colours.aircraft;
      segments.push({ from: [at[0], at[1], 0], to: at, colour: rgba(colour, marked || alarmed ? 0.7 : 0.28), width: 1 });
      const velocity = flight.velocity_mps;
      if (velocity && symbol !== "grounded" && symbol !== "planned" && symbol !== "lost") {
        const ahead = [at[0] + velocity.east * VECTOR_S, at[1] + velocity.north * VECTOR_S, at[2] + velocity.up * VECTOR_S];
        segments.push({ from: at, to: ahead, colour: rgba(colour, marked || alarmed ? 0.9 : 0.35), width: alarmed ? 2 : 1.2 });
      }
      return { flight, at, symbol, screen: toScreen(matrix, at, width, height) };
    });
    sprites.sort((one, other) => one.alarmed - other.alarmed);
    this.#placeTags(width, height);
    return { sprites: spriteArray(sprites), segments: segmentArray(segments) };
  }

  /** Write names beside the aircraft that want attention, where there is room. */
  #placeTags(width, height) {
    const wanted = this.#drawn
      .filter(({ flight, symbol, screen }) => screen !== null && screen[0] > 0 && screen[1] > 0 && screen[0] < width && screen[1] < height
        && (symbol in RANK || [this.selected, this.hovered].includes(idOf(flight))))
      .sort((one, other) => this.#rank(one) - this.#rank(other));
    const taken = [];
    let used = 0;
    for (const { flight, symbol, screen } of wanted) {
      const right = Math.round(screen[0]) + 16;
      const [x, y] = [right + TAG_PX.width < width ? right : right - 32 - TAG_PX.width, Math.round(screen[1]) - 34];
      const covered = taken.some(([left, top]) => Math.abs(left - x) < TAG_PX.width && Math.abs(top - y) < TAG_PX.height);
      if (covered || used === MOST_TAGS) continue;
      taken.push([x, y]);
      const tag = this.#tags.children[used] ?? this.#tags.appendChild(element("div", { class: "tag" }, element("b"), element("span")));
      used += 1;
      tag.hidden = false;
      tag.dataset.symbol = symbol;
      tag.style.transform = `translate(${x}px, ${y}px)`;
      setText(tag.firstChild, flightName(flight));
      setText(tag.lastChild, tagWords(flight));
    }
    for (const spare of [...this.#tags.children].slice(used)) spare.hidden = true;
  }

  #rank({ flight, symbol }) {
    return [this.hovered, this.selected].includes(idOf(flight)) ? -1 : RANK[symbol];
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

function tagWords(flight) {
  const { position, velocity_mps: velocity, reasons } = flight;
  const speed = velocity ? `${Math.hypot(velocity.east, velocity.north).toFixed(0)} m/s` : null;
  return [position && `${Math.round(position.alt_m)} m`, speed, reasons.map(flightReason).join(", ")].filter(Boolean).join(" · ");
}
