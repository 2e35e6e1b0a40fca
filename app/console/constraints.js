/** Closed airspace: what is closed at the time shown, and what will be. */

import { get } from "/console/api.js";
import { element, navigable, setText, showList } from "/console/dom.js";
import { moment, relative } from "/console/time.js";

/** As many as there may be. */
const MOST = 500;

/** Return the constraints in force and to come; those in force at a time, where one is given (ms). */
export async function constraintsAt(timeMs, signal) {
  const at = timeMs === null ? null : new Date(timeMs).toISOString();
  return (await get("/v1/constraints", { at, limit: MOST }, signal)).items;
}

/** Tell whether a constraint closes airspace at a time. */
export function isInForce({ from, until }, timeMs) {
  return Date.parse(from) <= timeMs && (until === null || timeMs < Date.parse(until));
}

/** Return the middle of a constraint's bounds. */
export function middleOf({ polygon }) {
  const numbers = polygon.coordinates.flat(polygon.type === "Polygon" ? 1 : 2);
  const [lon, lat] = [0, 1].map((axis) => {
    const along = numbers.map((vertex) => vertex[axis]);
    return (Math.min(...along) + Math.max(...along)) / 2;
  });
  return { lon, lat };
}

export class ConstraintsPanel {
  #place;
  #list;
  #onChoose;

  /** `onChoose` gets the constraint that was clicked. */
  constructor(place, list, onChoose) {
    this.#place = place;
    this.#list = list;
    this.#onChoose = onChoose;
    navigable(list);
  }

  /** Show those of these constraints that have not ended by a time. */
  show(constraints, timeMs) {
    const shown = constraints.filter(({ until }) => until === null || timeMs < Date.parse(until));
    this.#place.hidden = shown.length === 0;
    showList(this.#list, shown, ({ id }) => id, () => this.#item(), (item, constraint) => {
      item.constraint = constraint;
      item.dataset.inForce = String(isInForce(constraint, timeMs));
      const [name, words] = item.firstElementChild.children;
      setText(name, constraint.name);
      setText(words, `${altitudes(constraint)}, ${times(constraint, timeMs)}`);
    });
  }

  #item() {
    const item = element("li", {},
      element("button", { type: "button", onclick: () => this.#onChoose(item.constraint) },
        element("strong"), element("span")));
    return item;
  }
}

/** Return a constraint's altitudes in words. */
export function altitudes({ base_m: base, top_m: top }) {
  return top === null ? `from ${Math.round(base)} m up` : `${Math.round(base)}–${Math.round(top)} m`;
}

/** Return when a constraint begins or ends, in words, as seen from a time. */
export function times({ from, until }, timeMs) {
  if (timeMs < Date.parse(from)) return `closes ${relative(Date.parse(from), timeMs)}`;
  return until === null ? "for good" : `until ${moment(Date.parse(until), timeMs)}`;
}
