/** Times in words. Inside, times are milliseconds since the Unix epoch; on screen they are UTC. */

const CLOCK = new Intl.DateTimeFormat("en-GB", {
  timeZone: "UTC", hour: "2-digit", minute: "2-digit", second: "2-digit",
});
const DATE = new Intl.DateTimeFormat("en-GB", { timeZone: "UTC", day: "numeric", month: "short", year: "numeric" });

/** `12:05:09` */
export const clockTime = (ms) => CLOCK.format(ms);

/** `22 Nov 2026` */
export const date = (ms) => DATE.format(ms);

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
