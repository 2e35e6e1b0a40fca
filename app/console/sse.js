/** Server-Sent Events from text as it arrives, by the letter of the HTML standard, in chunks cut anywhere. */

export class EventParser {
  #rest = "";
  #event = "";
  #data = [];
  /** The id of the newest event that had one. */
  lastId = null;

  /** Take more text and return the events that it completes: `{event, data}`, data being text. */
  feed(text) {
    const all = this.#rest + text;
    // A lone carriage return at the end may be half of a line's end.
    const usable = all.endsWith("\r") ? all.length - 1 : all.length;
    const lines = all.slice(0, usable).split(/\r\n|\n|\r/);
    this.#rest = lines.pop() + all.slice(usable);
    const events = [];
    for (const line of lines) {
      if (line === "") {
        if (this.#data.length) events.push({ event: this.#event || "message", data: this.#data.join("\n") });
        this.#event = "";
        this.#data = [];
      } else {
        this.#field(line);
      }
    }
    return events;
  }

  #field(line) {
    const colon = line.indexOf(":");
    const name = colon < 0 ? line : line.slice(0, colon);
    const value = colon < 0 ? "" : line.slice(colon + 1).replace(/^ /, "");
    if (name === "event") this.#event = value;
    if (name === "data") this.#data.push(value);
    if (name === "id" && !value.includes("\0")) this.lastId = value;
  }
}
