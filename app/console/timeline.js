/** The time that the map shows: live, or a moment in the past or the future. */

import { setText } from "/console/dom.js";
import { clockTime, relative } from "/console/time.js";

const SETTLED_MS = 120;

export class Timeline {
  /** The moment shown in ms, null while live. */
  moment = null;
  #parts;
  #now;
  #onChange;
  #timer;

  /** `now` returns the service's time, `onChange` is called when another moment is to be shown. */
  constructor({ slider, live, earlier, later, text }, now, onChange) {
    this.#parts = { slider, live, text };
    this.#now = now;
    this.#onChange = onChange;
    slider.addEventListener("input", () => this.#show(now() + Number(slider.value) * 1000));
    live.addEventListener("click", () => this.goLive());
    earlier.addEventListener("click", () => this.step(-60));
    later.addEventListener("click", () => this.step(60));
  }

  /** Show the present again. */
  goLive() {
    if (this.moment === null) return;
    this.moment = null;
    this.#changed();
  }

  /** Move the moment by seconds, as far as the slider goes. */
  step(seconds) {
    const now = this.#now();
    if (now === null) return;
    const { min, max } = this.#parts.slider;
    const offset = ((this.moment ?? now) - now) / 1000 + seconds;
    this.#show(now + Math.max(Number(min), Math.min(Number(max), offset)) * 1000);
  }

  /** Write the time anew, and let the slider's thumb wander towards the past. */
  refresh() {
    const { slider, live, text } = this.#parts;
    const now = this.#now();
    if (now === null) return;
    const offset = this.moment === null ? 0 : (this.moment - now) / 1000;
    slider.value = String(offset);
    live.setAttribute("aria-pressed", String(this.moment === null));
    const [where, basis] = this.moment === null
      ? ["live", "reservations and reported positions"]
      : [`${clockTime(this.moment)} UTC, ${relative(this.moment, now)}`,
        offset > 0 ? "as reserved" : "as reserved and recorded"];
    setText(text, this.moment === null ? "Showing the present" : `Showing ${where}, ${basis}`);
    slider.setAttribute("aria-valuetext", where);
  }

  #show(moment) {
    this.moment = moment;
    this.#changed();
  }

  #changed() {
    this.refresh();
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#onChange(this.moment), this.moment === null ? 0 : SETTLED_MS);
  }
}
