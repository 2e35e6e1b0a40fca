/** The form that closes airspace: an area drawn on the map or typed, altitudes, times; and whom it moved. */

import { post } from "/console/api.js";
import { FEWEST_CORNERS, crossesItself, polygonOf, readCorners, sizeOf, writeCorners } from "/console/area.js";
import { byId, element, setText } from "/console/dom.js";
import { failure, unsent } from "/console/outcome.js";
import { moment, readTime, relative, writeTime } from "/console/time.js";
import { arrivalWords, refusalWords } from "/console/words.js";

/** So many flights are named of each kind. */
const NAMED = 50;
const BUTTONS = ["closing-submit", "closing-draw", "closing-undo", "closing-clear", "closing-cancel"];
const CROSSES = "The outline crosses itself. Set the corners in the order in which they follow one another.";
const UNKNOWN = "Nobody knows whether it was closed. The map lists what is closed: look there before you repeat it.";

export class Closing {
  /** Whether the next click on the map sets a corner. */
  isDrawing = false;
  #grid;
  #actions;
  #before = "";
  #pointer = null;

  /**
   * `actions`: `now()`, `draw(hint)`, null where no more corners are set; `show(area)`, null for none;
   * `closed()`, `name(id)` of a flight, `choose(selection)`.
   */
  constructor(grid, actions) {
    this.#grid = grid;
    this.#actions = actions;
    byId("closing-open").addEventListener("click", () => this.open());
    byId("closing-cancel").addEventListener("click", () => this.#leave());
    byId("closing-draw").addEventListener("click", () => (this.isDrawing ? this.finish() : this.#draw()));
    byId("closing-undo").addEventListener("click", () => this.undo());
    byId("closing-clear").addEventListener("click", () => this.#write(""));
    for (const id of ["closing-corners", "closing-base", "closing-top"]) {
      byId(id).addEventListener("input", () => this.#preview());
    }
    for (const end of ["from", "until"]) {
      // Written out as soon as it is typed: 10:00 is not to become tomorrow's because the form was sent after ten.
      byId(`closing-${end}`).addEventListener("change", () => this.#settle(end));
      byId(`closing-${end}`).addEventListener("input", () => this.refresh());
    }
    byId("closing").addEventListener("submit", (event) => {
      event.preventDefault();
      this.#send();
    });
  }

  /** Show the form; what was in it is still there. */
  open() {
    byId("closing").hidden = false;
    byId("closures").hidden = true;
    byId("closing-outcome").replaceChildren();
    this.#preview();
    this.refresh();
    byId("closing-name").focus();
  }

  /** Write anew what depends on the time. */
  refresh() {
    if (byId("closing").hidden) return;
    const { from, until, wrong } = this.#times();
    const now = this.#actions.now();
    if (now === null) return;
    const at = (ms) => `${moment(ms, now)}, ${relative(ms, now)}`;
    const begin = from === null ? "now" : at(from);
    const end = until === null ? "stays closed until reopened" : `opens ${at(until)}`;
    setText(byId("closing-times"), wrong?.text ?? `Closes ${begin}; ${end}.`);
  }

  // ---- the area

  /** Take a point of the map as the next corner; `isNear` tells of a corner whether it is the one that is meant. */
  place(lon, lat, isNear) {
    const { corners } = this.#corners();
    const meant = [corners.at(0), corners.at(-1)].filter(Boolean).some(isNear);
    if (meant) this.finish();
    else this.#write(writeCorners([...corners, [lon, lat]]));
  }

  /** Show how the outline would go on to a position of the pointer; null for none. */
  point(position) {
    this.#pointer = position;
    this.#showArea();
  }

  /** Take back the last corner. */
  undo() {
    const lines = byId("closing-corners").value.trimEnd().split("\n").slice(0, -1);
    this.#write(lines.map((line) => `${line}\n`).join(""));
  }

  /** Set no more corners, if there are enough. */
  finish() {
    if (this.#corners().corners.length >= FEWEST_CORNERS) this.#stop();
  }

  /** Set no more corners, and have those again that there were. */
  abandon() {
    byId("closing-corners").value = this.#before;
    this.#stop();
  }

  #draw() {
    const { wrong } = this.#corners();
    if (wrong !== null) {
      this.#say(unsent(wrong), "closing-corners");
      return;
    }
    byId("closing-outcome").replaceChildren();
    this.#before = byId("closing-corners").value;
    this.isDrawing = true;
    this.#preview();
  }

  #stop() {
    this.isDrawing = false;
    this.#pointer = null;
    this.#preview();
    this.#actions.draw(null);
    byId("closing-draw").focus();
  }

  #write(text) {
    byId("closing-corners").value = text;
    this.#preview();
  }

  #corners() {
    return readCorners(byId("closing-corners").value);
  }

  /** Show the area as it is now, on the map and in words. */
  #preview() {
    const { corners, wrong } = this.#corners();
    const enough = corners.length >= FEWEST_CORNERS;
    const draw = byId("closing-draw");
    setText(draw, this.isDrawing ? "Finish" : corners.length ? "Add corners" : "Draw on the map");
    draw.setAttribute("aria-pressed", String(this.isDrawing));
    draw.disabled = this.isDrawing && !enough;
    for (const id of ["closing-undo", "closing-clear"]) byId(id).disabled = byId("closing-corners").value.trim() === "";
    setText(byId("closing-size"), wrong ?? areaWords(corners));
    const { base, top, wrong: wrongAltitude } = this.#altitudes();
    setText(byId("closing-layers"), wrongAltitude?.text ?? this.#layerWords(base, top));
    if (this.isDrawing) this.#actions.draw(drawingWords(corners.length));
    this.#showArea();
  }

  #showArea() {
    if (byId("closing").hidden) {
      this.#actions.show(null);
      return;
    }
    const { corners } = this.#corners();
    const { ceiling } = this.#grid;
    const { base, top } = this.#altitudes();
    this.#actions.show({
      corners,
      polygon: corners.length < FEWEST_CORNERS ? null : polygonOf(corners),
      base: Math.max(0, Math.min(base ?? 0, ceiling)),
      top: Math.max(0, Math.min(top ?? ceiling, ceiling)),
      end: this.isDrawing ? this.#pointer : null,
    });
  }

  /** Return how high the blocks reach that will be closed: always whole ones. */
  #layerWords(base, top) {
    const { height, ceiling } = this.#grid;
    const from = Math.max(0, Math.floor(base / height) * height);
    const to = top === null ? ceiling : Math.min(ceiling, Math.ceil(top / height) * height);
    if (from >= to) return `The airspace reaches from 0 to ${ceiling} m.`;
    return `Closes whole blocks: ${from}–${to} m.`;
  }

  // ---- what is in the form

  /** Return `{base, top, wrong}`; a top of null is none. `wrong` names the field, and says what is wrong with it. */
  #altitudes() {
    const [base, top] = ["base", "top"].map((end) => byId(`closing-${end}`));
    if (base.validity.badInput || base.value === "") return wrongField(base, "Say from which altitude, in metres.");
    // What is no number reads as empty, and empty is no top.
    if (top.validity.badInput) return wrongField(top, "The upper altitude is no number of metres.");
    const found = { base: Number(base.value), top: top.value === "" ? null : Number(top.value), wrong: null };
    const isUpsideDown = found.top !== null && found.top <= found.base;
    if (isUpsideDown) return wrongField(top, "The area must end above where it begins.");
    return found;
  }

  /** Return `{from, until, wrong}`: times in ms, null for now and for good. */
  #times() {
    const [from, until] = ["from", "until"].map((end) => this.#time(end));
    for (const [end, time] of [["from", from], ["until", until]]) {
      const field = byId(`closing-${end}`);
      const how = "Write 10:00, +30 (minutes), or 2026-11-22 10:00.";
      if (Number.isNaN(time)) return wrongField(field, `“${field.value.trim()}” is not a time. ${how}`);
    }
    if (until !== null && until <= Math.max(from ?? 0, this.#actions.now())) {
      return wrongField(byId("closing-until"), "It must open later than it closes, and later than now.");
    }
    return { from, until, wrong: null };
  }

  /** Return the time of a field in ms; null where it is empty, NaN where it is no time. */
  #time(end) {
    const text = byId(`closing-${end}`).value.trim();
    if (text === "") return null;
    const now = this.#actions.now();
    const from = end === "until" ? this.#time("from") : null;
    return readTime(text, Math.max(now, from || now)) ?? NaN;
  }

  #settle(end) {
    const time = this.#time(end);
    if (time !== null && !Number.isNaN(time)) byId(`closing-${end}`).value = writeTime(time);
    this.refresh();
  }

  /** Return the first thing that is still to be put right, or null. */
  #missing() {
    const name = byId("closing-name");
    if (name.value.trim() === "") return { field: name, text: "Give the closed airspace a name." };
    const area = byId("closing-corners");
    const { corners, wrong } = this.#corners();
    if (wrong !== null) return { field: area, text: wrong };
    if (corners.length < FEWEST_CORNERS) return { field: area, text: "Draw or type at least three corners." };
    if (crossesItself(corners)) return { field: area, text: CROSSES };
    return this.#altitudes().wrong ?? this.#times().wrong;
  }

  // ---- sending it

  async #send() {
    const missing = this.#missing();
    for (const field of byId("closing").querySelectorAll("[aria-invalid]")) field.removeAttribute("aria-invalid");
    if (missing !== null) {
      missing.field.setAttribute("aria-invalid", "true");
      this.#say(unsent(missing.text), missing.field.id);
      return;
    }
    if (this.isDrawing) this.#stop();
    const { base, top } = this.#altitudes();
    const { from, until } = this.#times();
    const written = (ms) => (ms === null ? null : new Date(ms).toISOString());
    for (const id of BUTTONS) byId(id).disabled = true;
    try {
      const made = await post("/v1/constraints", {
        name: byId("closing-name").value.trim(),
        polygon: polygonOf(this.#corners().corners),
        base_m: base,
        top_m: top,
        from: written(from),
        until: written(until),
      });
      byId("closing").reset();
      this.#leave();
      this.#say(this.#closed(made), "closing-outcome");
    } catch (error) {
      this.#say(failure(error, { "outcome-unknown": UNKNOWN }), "closing-submit");
    } finally {
      for (const id of BUTTONS) byId(id).disabled = false;
      this.#preview();
    }
    this.#actions.closed();
  }

  #leave() {
    if (this.isDrawing) this.abandon();
    byId("closing").hidden = true;
    byId("closures").hidden = false;
    byId("closing-outcome").replaceChildren();
    this.#showArea();
    byId("closing-open").focus();
  }

  /** Show what became of it, and move the focus to a field. */
  #say(box, id) {
    byId("closing-outcome").replaceChildren(box);
    byId(id).focus({ preventScroll: true });
    box.scrollIntoView({ block: "nearest" });
  }

  #closed({ name, from, created, blocks, displaced, unmoved }) {
    const [begins, now] = [Date.parse(from), Date.parse(created)];
    const gone = displaced.filter(({ state }) => state === "displaced");
    const moved = displaced.filter(({ state }) => state !== "displaced");
    const kinds = [
      ["unmoved", "can no longer move and will fly through it", unmoved.map((id) => ({ id, words: "" }))],
      ["gone", "displaced: no plan is left", gone.map((each) => this.#sentence(each, refusalWords(each.reason)))],
      ["moved", "made way", moved.map((each) => this.#sentence(each, arrivalWords(each.arrival_moved_s)))],
    ].filter(([, , flights]) => flights.length > 0);
    const nobody = kinds.length ? "" : " No flight had to make way.";
    return element("div", { class: unmoved.length || gone.length ? "outcome warn" : "outcome good" },
      element("strong", { text: `${name}: ${begins > now ? `closes ${moment(begins, now)}` : "closed"}` }),
      element("p", { class: "hint", text: `${count(blocks, "block")}.${nobody}` }),
      ...kinds.map(([kind, words, flights]) => this.#flights(kind, words, flights)));
  }

  #sentence({ flight_intent_id: id, sequence }, words) {
    return { id, sequence, words };
  }

  #flights(kind, words, flights) {
    const more = flights.length - NAMED;
    return element("section", { "data-kind": kind },
      element("h3", { text: `${count(flights.length, "flight")} ${words}` }),
      element("ul", { class: "flights" }, ...flights.slice(0, NAMED).map(({ id, sequence, words: became }) =>
        element("li", {},
          element("button", {
            type: "button", class: "link",
            text: this.#actions.name(id) ?? (sequence ? `#${sequence}` : `flight ${id.slice(-8)}`),
            onclick: () => this.#actions.choose({ kind: "flight", id }),
          }), became ? ` ${became}` : ""))),
      more > 0 ? element("p", { class: "hint", text: `${more} more` }) : null);
  }
}

function areaWords(corners) {
  if (corners.length < FEWEST_CORNERS) return `${count(corners.length, "corner")}; an area has three at least.`;
  if (crossesItself(corners)) return CROSSES;
  const { hectares, east, north } = sizeOf(corners);
  const across = [east, north].map((metres) => Math.round(metres)).join(" × ");
  const extent = `${hectares.toFixed(hectares < 10 ? 2 : 0)} ha, ${across} m (east × north)`;
  return `${count(corners.length, "corner")}, ${extent}`;
}

function drawingWords(corners) {
  const next = corners < FEWEST_CORNERS ? "Click the next" : "Click the next, or the last again to finish";
  return `${count(corners, "corner")}. ${next}. Enter takes the map's centre, Backspace the last back, Esc gives up.`;
}

function count(number, what) {
  return `${number.toLocaleString("en")} ${what}${number === 1 ? "" : "s"}`;
}

function wrongField(field, text) {
  return { wrong: { field, text } };
}
