/** The list of flights and tracks, the worst first, to be searched. */

import { element, navigable, setText, showList } from "/console/dom.js";
import { symbolCanvas, symbolOf } from "/console/symbols.js";
import { CONFORMANCE_WORDS, flightName, flightReason, standing } from "/console/words.js";

const ORDER = ["violating", "deviating", "lost", "unseen", "conforming", "scheduled"];
const SHOWN = 150;

export class FlightsPanel {
  #list;
  #more;
  #search;
  #conformance;
  #onChoose;
  #colours;
  #flights = [];
  /** The id of the selected flight or track, or null. */
  selected = null;

  /** `onChoose` gets the flight or track that was clicked. */
  constructor({ list, more, search, conformance }, colours, onChoose) {
    this.#list = list;
    this.#more = more;
    this.#search = search;
    this.#conformance = conformance;
    this.#colours = colours;
    this.#onChoose = onChoose;
    for (const input of [search, conformance]) input.addEventListener("input", () => this.show(this.#flights));
    navigable(list);
  }

  /** Draw symbols in other colours from now on. */
  setColours(colours) {
    this.#colours = colours;
    this.#list.replaceChildren();
  }

  /** Show these flights, as far as the search finds them. */
  show(flights) {
    this.#flights = flights;
    const found = flights.filter((flight) => this.#isFound(flight)).sort(byUrgency);
    const shown = found.slice(0, SHOWN);
    showList(this.#list, shown, idOf, () => this.#item(), (item, flight) => this.#update(item, flight));
    this.#more.hidden = found.length > 0 && found.length === shown.length;
    setText(this.#more, found.length === 0
      ? (flights.length === 0 ? "Nothing flies, and nothing departs within a minute." : "No flight is like that.")
      : `${found.length - shown.length} more; search to find them.`);
  }

  #isFound(flight) {
    const words = this.#search.value.trim().toLowerCase();
    const conformance = this.#conformance.value;
    if (conformance && standing(flight) !== conformance) return false;
    const number = flight.sequence && `#${flight.sequence}`;
    const text = [flight.operator, flight.reference, number, flight.track_id, flight.aircraft_type];
    return words === "" || text.filter(Boolean).join(" ").toLowerCase().includes(words);
  }

  #item() {
    const item = element("li", {},
      element("button", { type: "button", class: "row flight", onclick: () => this.#onChoose(item.flight) },
        element("span", { class: "symbol-place" }),
        element("strong"),
        element("span", { class: "when" }),
        element("span", { class: "message" })));
    return item;
  }

  #update(item, flight) {
    item.flight = flight;
    item.firstElementChild.ariaCurrent = String(idOf(flight) === this.selected);
    const [place, name, altitude, message] = item.firstElementChild.children;
    const symbol = symbolOf(flight);
    if (place.dataset.symbol !== symbol) {
      place.dataset.symbol = symbol;
      place.replaceChildren(symbolCanvas(symbol, this.#colours));
    }
    setText(name, flightName(flight));
    setText(altitude, altitudeWords(flight.position));
    const state = flight.reasons.map(flightReason).join(", ") || CONFORMANCE_WORDS[standing(flight)];
    const number = flight.sequence && `#${flight.sequence}`;
    setText(message, [state, flight.operator, number, flight.aircraft_type].filter(Boolean).join(" · "));
  }
}

function altitudeWords(position) {
  if (position === null) return "";
  return position.airborne === false ? "on the ground" : `${Math.round(position.alt_m)} m`;
}

/** Return a flight's or a track's id. */
export const idOf = (flight) => flight.flight_intent_id ?? flight.track_id;

function byUrgency(one, other) {
  return ORDER.indexOf(standing(one)) - ORDER.indexOf(standing(other))
    || (one.sequence ?? 0) - (other.sequence ?? 0)
    || (idOf(one) < idOf(other) ? -1 : 1);
}
