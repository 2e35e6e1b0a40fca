/** The picture of the airspace that the event stream paints: blocks, flights, alerts, the service's clock. */

import { keyOf } from "/console/grid.js";

/** Ticks come once a second; without one for so long the picture is stale. */
const STALE_MS = 3_500;

/**
 * Tells of changes by events: `tick`, `blocks`, `flights`, `alerts`, `link` (the connection), `intent`, `conformance`
 * and `constraint` (detail: the journal's entry). Takes the time from outside, so that tests can choose it.
 */
export class Picture extends EventTarget {
  /** Blocks in use by key. */
  blocks = new Map();
  counts = { green: 0, yellow: 0, red: 0 };
  flights = [];
  alerts = [];
  rate = 1;
  simulated = false;
  connected = false;
  /** Why the service does not show it to who is here, null if it does. */
  refusal = null;
  #whole = false;
  #clockMs = null;
  #clockReadAt = 0;
  #tickAt = null;
  #monotonic;

  constructor(monotonic = () => performance.now()) {
    super();
    this.#monotonic = monotonic;
  }

  /** Take the clock of any answer. */
  takeClock({ now, rate, simulated }) {
    this.#clockMs = Date.parse(now);
    this.#clockReadAt = this.#monotonic();
    this.rate = rate;
    this.simulated = simulated;
  }

  /** The service's time in ms, or null before the first answer. It stands still while the picture is stale. */
  get now() {
    if (this.#clockMs === null) return null;
    const silent = Math.min(this.#monotonic() - this.#clockReadAt, STALE_MS);
    return this.#clockMs + silent * this.rate;
  }

  /** How the connection is: `connecting`, `live`, `stale` (connected but silent), `reconnecting` or `refused`. */
  get state() {
    if (this.refusal !== null) return "refused";
    if (!this.connected) return this.#tickAt === null ? "connecting" : "reconnecting";
    if (this.#tickAt === null) return "connecting";
    return this.#monotonic() - this.#tickAt < STALE_MS ? "live" : "stale";
  }

  /** Seconds since the last tick, null before the first. */
  get silentSeconds() {
    return this.#tickAt === null ? null : (this.#monotonic() - this.#tickAt) / 1000;
  }

  /** The stream is open. What it shows first is the whole; differences before that mean nothing. */
  opened() {
    this.connected = true;
    this.#whole = false;
    this.#tell("link");
  }

  /** The stream was lost; the last picture stays. */
  lost() {
    this.connected = false;
    this.#tell("link");
  }

  /** The stream is not for who is here. */
  refused(why) {
    this.connected = false;
    this.refusal = why;
    this.#tell("link");
  }

  /** Take an event of the stream. */
  take(event, data) {
    if (event === "status") this.#takeStatus(data);
    if (event === "flights") {
      this.flights = data.items;
      this.#tell("flights");
    }
    if (event === "alerts") {
      this.alerts = data.items;
      this.#tell("alerts");
    }
    if (["intent", "conformance", "constraint"].includes(event)) this.#tell(event, data);
  }

  #takeStatus(data) {
    if (!data.full && !this.#whole) return;
    this.takeClock(data.clock);
    this.#tickAt = this.#monotonic();
    let changed = data.blocks.length > 0;
    if (data.full) {
      this.#whole = true;
      this.blocks = new Map();
      changed = true;
    } else {
      for (const block of data.idle) changed = this.blocks.delete(keyOf(block)) || changed;
    }
    for (const entry of data.blocks) this.blocks.set(keyOf(entry.block), entry);
    this.counts = data.counts;
    this.#tell("tick");
    if (changed) this.#tell("blocks");
  }

  #tell(type, detail = null) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }
}
