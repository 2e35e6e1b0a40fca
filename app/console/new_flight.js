/** The form for a new flight: ends chosen on the map, and the answer explained. */

import { get, post } from "/console/api.js";
import { byId, element, facts, setText } from "/console/dom.js";
import { failure, unsent } from "/console/outcome.js";
import { token } from "/console/session.js";
import { clockTime, relative, span } from "/console/time.js";

const ENDS = ["origin", "destination"];

export class NewFlight {
  /** Which end the next click on the map sets, null for none. */
  picking = null;
  /** The chosen positions, null where none is chosen. */
  ends = { origin: null, destination: null };
  #grid;
  #actions;

  /** `actions`: `now()`, `pick(end)`, `showEnds(ends)`, `showPath(intent, preview)`, `choose(selection)`. */
  constructor(grid, actions) {
    this.#grid = grid;
    this.#actions = actions;
    for (const end of ENDS) {
      const layer = byId(`${end}-layer`);
      for (let k = 0; k < grid.dimensions[2]; k += 1) {
        layer.append(element("option", { value: k, text: `${grid.altitude(k)} m` }));
      }
      layer.addEventListener("change", () => this.#take(end, this.ends[end]));
      byId(`pick-${end}`).addEventListener("click", () => this.pick(end));
    }
    byId("new-flight").addEventListener("submit", (event) => {
      event.preventDefault();
      this.#send("/v1/flight-intents");
    });
    byId("new-preview").addEventListener("click", () => this.#send("/v1/flight-intents/preview"));
  }

  /** Fill the list of aircraft. */
  async load() {
    const { items } = await get("/v1/aircraft-types");
    byId("new-aircraft").append(...items.map(({ id, name }) => element("option", { value: id, text: name })));
  }

  /** Let the next click on the map set an end; null ends that. */
  pick(end) {
    this.picking = end;
    for (const each of ENDS) byId(`pick-${each}`).setAttribute("aria-pressed", String(each === end));
    this.#actions.pick(end);
  }

  /** Take a point of the ground as the end that is being chosen; the other is next if it is missing. */
  place(lon, lat) {
    const end = this.picking;
    this.#take(end, { lon, lat });
    const other = ENDS.find((each) => each !== end);
    this.pick(end === "origin" && this.ends[other] === null ? other : null);
    if (this.picking === null) byId("new-submit").focus();
  }

  #take(end, ground) {
    if (ground === null) return;
    const layer = Number(byId(`${end}-layer`).value);
    this.ends[end] = { lon: ground.lon, lat: ground.lat, alt_m: this.#grid.altitude(layer) };
    const block = this.#grid.blockAt(ground.lon, ground.lat, layer);
    setText(byId(`${end}-place`), block === null
      ? "outside of the airspace"
      : `block [${block.join(", ")}], lon ${ground.lon.toFixed(5)}, lat ${ground.lat.toFixed(5)}`);
    this.#actions.showEnds(this.ends);
  }

  #takeBlock(end, block) {
    byId(`${end}-layer`).value = String(block[2]);
    this.#take(end, this.#grid.centre(block));
  }

  async #send(path) {
    const outcome = byId("new-outcome");
    const missing = this.#missing();
    if (missing) {
      outcome.replaceChildren(unsent(missing));
      return;
    }
    const earliest = this.#actions.now() + Number(byId("new-departure").value) * 60_000;
    const buttons = [byId("new-submit"), byId("new-preview")];
    for (const button of buttons) button.disabled = true;
    try {
      const intent = await post(path, {
        // Who has a token is named by it.
        operator: token() === null ? byId("new-operator").value.trim() : undefined,
        reference: byId("new-reference").value.trim() || null,
        aircraft_type: byId("new-aircraft").value,
        ...this.ends,
        earliest_departure: new Date(Math.round(earliest)).toISOString(),
      });
      outcome.replaceChildren(this.#accepted(intent));
      this.#actions.showPath(intent, intent.state === "preview");
    } catch (error) {
      outcome.replaceChildren(this.#refused(error));
    } finally {
      for (const button of buttons) button.disabled = false;
    }
    outcome.firstElementChild.scrollIntoView({ block: "nearest" });
  }

  #missing() {
    if (this.ends.origin === null) return "Choose the origin on the map.";
    if (this.ends.destination === null) return "Choose the destination on the map.";
    if (token() === null && byId("new-operator").value.trim() === "") return "Name the operator.";
    if (!byId("new-departure").checkValidity() || byId("new-departure").value === "") {
      return "Say in how many minutes the flight shall depart.";
    }
    return null;
  }

  #accepted(intent) {
    const preview = intent.state === "preview";
    const now = this.#actions.now();
    const time = (text) => `${clockTime(Date.parse(text))} UTC, ${relative(Date.parse(text), now)}`;
    const headline = preview ? "It can be flown so (preview, nothing reserved)" : `Accepted as #${intent.sequence}`;
    return element("div", { class: "outcome good" },
      element("strong", { text: headline }),
      facts([
        ["Departure", time(intent.departure)], ["Arrival", time(intent.arrival)],
        ["Flight time", span(intent.flight_time_s)], ["Delay", `${intent.delay_s.toFixed(1)} s`],
        ["Blocks", `${intent.reservations.length} reservations`],
      ]),
      preview ? null : element("button", {
        type: "button", text: "Show the flight", onclick: () => this.#actions.choose({ kind: "flight", id: intent.id }),
      }));
  }

  #refused(error) {
    const problem = error.problem ?? {};
    const box = failure(error);
    const end = { origin_blocked: "origin", destination_blocked: "destination" }[problem.reason];
    if (end && problem.nearest_free_block) {
      box.append(element("button", {
        type: "button", text: `Use the nearest free block [${problem.nearest_free_block.join(", ")}]`,
        onclick: () => this.#takeBlock(end, problem.nearest_free_block),
      }));
    }
    const feasible = problem.earliest_feasible_departure;
    if (feasible) {
      box.append(element("button", {
        type: "button", text: `Use the earliest feasible departure, ${clockTime(Date.parse(feasible))} UTC`,
        onclick: () => this.#depart(Date.parse(feasible)),
      }));
    }
    for (const id of problem.conflicting_intents ?? []) {
      box.append(element("button", {
        type: "button", class: "link", text: `conflicts with flight ${id.slice(-8)}`,
        onclick: () => this.#actions.choose({ kind: "flight", id }),
      }));
    }
    return box;
  }

  #depart(ms) {
    const minutes = Math.max(0, (ms - this.#actions.now()) / 60_000);
    byId("new-departure").value = String(Math.ceil(minutes * 10) / 10);
    byId("new-submit").focus();
  }
}
