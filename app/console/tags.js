/** Name tags beside the aircraft that want attention, as on a radar screen: where there is room, the worst first. */

import { element, setText } from "/console/dom.js";
import { flightName, flightReason } from "/console/words.js";

const MOST = 24;
const WIDTH_PX = 210;
const HEIGHT_PX = 38;
const ASIDE_PX = 16;
const ABOVE_PX = 34;
const RANK = { violating: 0, deviating: 1, lost: 2, unseen: 3 };

/** Tell whether a symbol is of an aircraft that does not do as it should. */
export const isAlarming = (symbol) => symbol in RANK;

export class Tags {
  #place;

  constructor(place) {
    this.#place = place;
  }

  /** Tag aircraft `{flight, symbol, screen, marked}` on a canvas of this size; those that are marked come first. */
  show(aircraft, width, height) {
    const inside = ([x, y]) => x > 0 && y > 0 && x < width && y < height;
    const wanted = aircraft
      .filter(({ symbol, screen, marked }) => (marked || isAlarming(symbol)) && screen !== null && inside(screen))
      .sort((one, other) => rank(one) - rank(other));
    const taken = [];
    for (const { flight, symbol, screen } of wanted) {
      const corner = cornerOf(screen, width);
      if (taken.length === MOST) break;
      if (taken.some((other) => overlap(corner, other))) continue;
      this.#write(this.#tag(taken.length), flight, symbol, corner);
      taken.push(corner);
    }
    for (const spare of [...this.#place.children].slice(taken.length)) spare.hidden = true;
  }

  #tag(number) {
    const made = this.#place.children[number];
    return made ?? this.#place.appendChild(element("div", { class: "tag" }, element("b"), element("span")));
  }

  #write(tag, flight, symbol, [x, y]) {
    tag.hidden = false;
    tag.dataset.symbol = symbol;
    tag.style.transform = `translate(${x}px, ${y}px)`;
    setText(tag.firstChild, flightName(flight));
    setText(tag.lastChild, words(flight));
  }
}

/** Return a tag's upper left corner: right of the aircraft, or left of it at the canvas's edge. */
function cornerOf([x, y], width) {
  const right = Math.round(x) + ASIDE_PX;
  const fits = right + WIDTH_PX < width;
  return [fits ? right : Math.round(x) - ASIDE_PX - WIDTH_PX, Math.round(y) - ABOVE_PX];
}

function overlap([x, y], [otherX, otherY]) {
  return Math.abs(otherX - x) < WIDTH_PX && Math.abs(otherY - y) < HEIGHT_PX;
}

function rank({ symbol, marked }) {
  return marked ? -1 : RANK[symbol];
}

function words({ position, velocity_mps: velocity, reasons }) {
  const speed = velocity && `${Math.hypot(velocity.east, velocity.north).toFixed(0)} m/s`;
  const altitude = position && `${Math.round(position.alt_m)} m`;
  return [altitude, speed, reasons.map(flightReason).join(", ")].filter(Boolean).join(" · ");
}
