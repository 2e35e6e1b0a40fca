/** Times in words. Inside, times are milliseconds since the Unix epoch; on screen they are UTC. */

const CLOCK = new Intl.DateTimeFormat("en-GB", {
  timeZone: "UTC", hour: "2-digit", minute: "2-digit", second: "2-digit",
});
const DATE = new Intl.DateTimeFormat("en-GB", { timeZone: "UTC", day: "numeric", month: "short", year: "numeric" });

const calendar = (ms) => new Date(ms).toISOString().slice(0, 19).replace("T", " ");
const MINUTE_MS = 60_000;
const DAY_MS = 86_400_000;

/** `12:05:09` */
export const clockTime = (ms) => CLOCK.format(ms);

/** `22 Nov 2026` */
export const date = (ms) => DATE.format(ms);

/** `12:05:09 UTC`, with the date where that is not the day of another time. */
export function moment(ms, nowMs) {
  return `${date(ms) === date(nowMs) ? "" : `${date(ms)}, `}${clockTime(ms)} UTC`;
}

/** `2026-11-22 12:05:09`, as `readTime` reads it; whole minutes without seconds. */
export const writeTime = (ms) => calendar(ms).replace(/:00$/, "");

/**
 * Read a time in UTC, return it in ms, or null if it is none: `2026-11-22 10:00`, seconds as you like; `10:00`, the
 * first after a time (ms); `+30`, minutes after that, and up to the next full one.
 */
export function readTime(text, afterMs) {
  const later = /^\+\s*(\d{1,6})(?:\s*min)?$/i.exec(text.trim());
  if (later) return Math.ceil(afterMs / MINUTE_MS + Number(later[1])) * MINUTE_MS;
  const match = /^(?:(\d{4}-\d\d-\d\d)[T ]\s*)?(\d?\d):(\d\d)(?::(\d\d))?\s*(?:Z|UTC)?$/i.exec(text.trim());
  if (match === null) return null;
  const [, day = calendar(afterMs).slice(0, 10), hours, minutes, seconds = "00"] = match;
  const written = `${day} ${hours.padStart(2, "0")}:${minutes}:${seconds}`;
  const ms = Date.parse(`${written.replace(" ", "T")}Z`);
  // What no calendar has, the 30th of February, comes out as something else or nothing.
  if (Number.isNaN(ms) || calendar(ms) !== written) return null;
  return match[1] === undefined && ms <= afterMs ? ms + DAY_MS : ms;
}

/** A length of time: `9 s`, `3 min 05 s`, `2 h 05 min`. */
export function span(seconds) {
  const whole = Math.round(Math.abs(seconds));
  const two = (number) => String(number).padStart(2, "0");
  if (whole < 60) return `${whole} s`;
  if (whole < 3600) return `${Math.floor(whole / 60)} min ${two(whole % 60)} s`;
  return `${Math.floor(whole / 3600)} h ${two(Math.floor((whole % 3600) / 60))} min`;
}

/** A time as seen from another: `now`, `9 s ago`, `in 3 min 05 s`. */
export function relative(ms, nowMs) {
  const seconds = (ms - nowMs) / 1000;
  if (Math.abs(seconds) < 0.5) return "now";
  return seconds < 0 ? `${span(seconds)} ago` : `in ${span(seconds)}`;
}
