/** What is known of the selected flight, track or block. */

import { get, aborted } from "/console/api.js";
import { element, facts, navigable, statusChip } from "/console/dom.js";
import { keyOf } from "/console/grid.js";
import { symbolCanvas, symbolOf } from "/console/symbols.js";
import { clockTime, relative, span } from "/console/time.js";
import { CONFORMANCE_WORDS, STATUS_WORDS, blockReason, flightName, flightReason, standing } from "/console/words.js";

const HINT = "Click a block, an aircraft or an alert to see its status, the reasons, its path and its reservations.";
const SHOWN = 60;

export class Details {
  #place;
  #actions;
  #grid;
  #colours;
  #live;
  #request = null;

  /**
   * `actions`: `choose(selection)`, `showPath(intent)`, `fail(error)`, `flight(id)`, `entry(key)`, `now()`, and
   * `constraint(id)`, which returns its name.
   */
  constructor(place, grid, colours, actions) {
    this.#place = place;
    this.#grid = grid;
    this.#colours = colours;
    this.#actions = actions;
    this.clear();
  }

  /** Show nothing. */
  clear() {
    this.#request?.abort();
    this.#live = () => {};
    this.#place.replaceChildren(element("p", { class: "hint", text: HINT }));
  }

  /** Draw symbols in other colours from now on. */
  setColours(colours) {
    this.#colours = colours;
  }

  /** Write anew what changes with every tick. */
  refresh() {
    this.#live();
  }

  /** Show a flight: what is reported of it at once, its plan when it has been read. */
  async showFlight(id) {
    const report = element("div");
    const plan = element("div", {}, element("p", { class: "hint", text: "Reading its plan…" }));
    const title = element("h2", { text: "Flight" });
    this.#place.replaceChildren(this.#head(title), report, plan);
    this.#live = () => this.#report(report, title, this.#actions.flight(id));
    this.#live();
    const intent = await this.#read(`/v1/flight-intents/${encodeURIComponent(id)}`, plan);
    if (intent === null) return;
    title.textContent = flightName(intent);
    plan.replaceChildren(...this.#plan(intent));
    navigable(plan);
    this.#actions.showPath(intent);
  }

  /** Show an aircraft that is known from surveillance only. */
  showTrack(id) {
    const report = element("div");
    const title = element("h2", { text: `track ${id}` });
    this.#place.replaceChildren(this.#head(title), report,
      element("p", { class: "hint", text: "Known from surveillance only: no flight intent belongs to it." }));
    this.#live = () => this.#report(report, title, this.#actions.flight(id));
    this.#live();
  }

  /** Show a block: its status and reasons, and who has reserved it when. */
  async showBlock(block) {
    const status = element("div");
    const schedule = element("div", {}, element("p", { class: "hint", text: "Reading its schedule…" }));
    const title = element("h2", { text: `Block [${block.join(", ")}]` });
    this.#place.replaceChildren(this.#head(title), status, schedule);
    let before = null;
    this.#live = () => {
      const entry = this.#actions.entry(keyOf(block));
      const now = JSON.stringify(entry);
      if (now === before) return;
      before = now;
      status.replaceChildren(...this.#blockStatus(block, entry));
    };
    this.#live();
    const answer = await this.#read(`/v1/airspace/blocks/${block.join("/")}`, schedule);
    if (answer === null) return;
    schedule.replaceChildren(...this.#schedule(answer));
    navigable(schedule);
  }

  async #read(path, place) {
    this.#request?.abort();
    this.#request = new AbortController();
    try {
      return await get(path, {}, this.#request.signal);
    } catch (error) {
      if (!aborted(error)) {
        place.replaceChildren(element("p", { class: "hint", text: `Not to be read: ${error.message}.` }));
        this.#actions.fail(error);
      }
      return null;
    }
  }

  #head(title) {
    return element("header", { class: "details-head" }, title,
      element("button", { type: "button", class: "quiet", text: "Close", onclick: () => this.#actions.choose(null) }));
  }

  #report(place, title, flight) {
    if (flight === null) {
      place.replaceChildren(element("p", { class: "hint", text: "Not in the air now, nor about to depart." }));
      return;
    }
    title.textContent = flightName(flight);
    const { position, velocity_mps: velocity } = flight;
    const stands = standing(flight);
    const reasons = element("ul", { class: "reasons" },
      ...flight.reasons.map((slug) => element("li", { "data-reason": slug, text: flightReason(slug) })));
    place.replaceChildren(
      element("p", { class: "conformance", "data-conformance": stands },
        symbolCanvas(symbolOf(flight), this.#colours, 26),
        element("strong", { text: CONFORMANCE_WORDS[stands] }),
        flight.since && flight.reasons.length ? ` since ${clockTime(Date.parse(flight.since))} UTC` : ""),
      reasons,
      facts([
        ["Altitude", position && `${position.alt_m.toFixed(0)} m`],
        ["Speed", velocity && `${Math.hypot(velocity.east, velocity.north).toFixed(1)} m/s, ${climb(velocity.up)}`],
        ["Block", position?.block ? `[${position.block.join(", ")}]` : null],
        ["Last position", position === null ? "never reported" : `${age(position.age_s)} old`],
        ["Airborne", position?.airborne === true ? "yes" : position?.airborne === false ? "no, on the ground" : null],
        ["Jump", position?.flagged ? "the last position is an implausible jump" : null],
      ]));
  }

  #plan(intent) {
    const now = this.#actions.now();
    const time = (text) => `${clockTime(Date.parse(text))} UTC, ${relative(Date.parse(text), now)}`;
    const refused = intent.state === "rejected" ? "Refused" : "Displaced";
    const found = intent.refusal ? [[refused, intent.refusal.detail]] : [
      ["Departure", time(intent.departure)],
      ["Arrival", time(intent.arrival)],
      ["Flight time", span(intent.flight_time_s)],
      ["Delay", delayWords(intent)],
    ];
    return [
      facts([
        ["State", intent.state], ["Operator", intent.operator], ["Number", `#${intent.sequence}`],
        ["Aircraft", intent.aircraft_type], ...found,
      ]),
      element("h3", { text: `Reservations (${intent.reservations.length})` }),
      this.#table(["Block", "From", "To"], intent.reservations, ({ block, enter, exit }) => [
        this.#blockLink(block), clockTime(Date.parse(enter)), clockTime(Date.parse(exit)),
      ]),
    ];
  }

  #blockStatus(block, entry) {
    const status = entry?.status ?? "idle";
    const reasons = entry?.reasons ?? [];
    const users = [
      ...(entry?.flight_intents ?? []).map((id) => ({ kind: "flight", id })),
      ...(entry?.track_ids ?? []).map((id) => ({ kind: "track", id })),
    ];
    return [
      element("p", {}, statusChip(status, `${status}: ${STATUS_WORDS[status]}`)),
      element("ul", { class: "reasons" },
        ...reasons.map((slug) => element("li", { "data-reason": slug, text: blockReason(slug) }))),
      facts([["Layer", this.#grid.layerName(block[2])]]),
      users.length ? element("p", { class: "users" }, ...users.map((user) => this.#userLink(user))) : null,
    ].filter(Boolean);
  }

  #schedule({ schedule, statically_occupied: occupied, constraints }) {
    const hint = (text) => element("p", { class: "hint", text });
    const closed = constraints.map((id) => hint(`Closed: ${this.#actions.constraint(id)}.`));
    if (occupied) return [...closed, hint("A building stands here: nothing can be reserved.")];
    if (schedule.length === 0) return [...closed, hint("Nothing is reserved from now on.")];
    return [
      ...closed,
      element("h3", { text: `Reserved from now on (${schedule.length})` }),
      this.#table(["Flight", "From", "To"], schedule, ({ flight_intent_id: id, enter, exit }) => [
        this.#userLink({ kind: "flight", id }), clockTime(Date.parse(enter)), clockTime(Date.parse(exit)),
      ]),
    ];
  }

  #table(heads, rows, cells) {
    const shown = rows.slice(0, SHOWN);
    const head = element("tr", {}, ...heads.map((text) => element("th", { scope: "col", text })));
    const body = shown.map((row) => element("tr", {}, ...cells(row).map((cell) => element("td", {}, cell))));
    const table = element("table", {}, element("thead", {}, head), element("tbody", {}, ...body));
    const more = rows.length - shown.length;
    return element("div", {}, table, more ? element("p", { class: "hint", text: `${more} more` }) : null);
  }

  #blockLink(block) {
    return this.#link(`[${block.join(", ")}]`, { kind: "block", block });
  }

  #userLink({ kind, id }) {
    const flight = this.#actions.flight(id);
    const unnamed = kind === "track" ? `track ${id}` : `flight ${id.slice(-8)}`;
    return this.#link(flight ? flightName(flight) : unnamed, { kind, id });
  }

  #link(text, selection) {
    return element("button", { type: "button", class: "link", text, onclick: () => this.#actions.choose(selection) });
  }
}

function age(seconds) {
  return seconds < 10 ? `${seconds.toFixed(1)} s` : span(seconds);
}

function delayWords({ delay_s: delay, ground_hold_s: hold, hover_s: hover }) {
  return `${delay.toFixed(1)} s (held on the ground ${hold.toFixed(1)} s, hovering ${hover.toFixed(1)} s)`;
}

function climb(up) {
  if (Math.abs(up) < 0.1) return "level";
  return `${up > 0 ? "climbing" : "descending"} ${Math.abs(up).toFixed(1)} m/s`;
}
