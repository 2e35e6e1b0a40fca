/** The airspace at a moment of the past or the future: blocks as the service knows them, flights by their plans. */

import { get } from "/console/api.js";

const PAGE = 200;
const MOST_FLIGHTS = 600;

/** Return the blocks in use at a time, `{blocks, counts}`. */
export async function blocksAt(timeMs, signal) {
  return get("/v1/airspace/status", { at: new Date(timeMs).toISOString() }, signal);
}

/** Return the aircraft of a time by plan, `{flight, lon, lat, alt_m, heading}`. */
export async function aircraftAt(timeMs, signal) {
  const [from, to] = [timeMs, timeMs + 1].map((ms) => new Date(ms).toISOString());
  const aircraft = [];
  let cursor = null;
  do {
    const page = await get("/v1/flight-intents", { from, to, limit: PAGE, cursor }, signal);
    for (const intent of page.items) {
      const flown = intent.reservations.length > 0 ? plannedAt(intent.trajectory, timeMs) : null;
      if (flown) aircraft.push({ ...flown, flight: asFlight(intent) });
    }
    cursor = page.next_cursor;
  } while (cursor !== null && aircraft.length < MOST_FLIGHTS);
  return aircraft;
}

/** Return an intent as an item of the list of flights of which nothing is reported. */
function asFlight({ id, sequence, operator, reference, aircraft_type }) {
  return {
    flight_intent_id: id, track_id: null, sequence, operator, reference, aircraft_type,
    conformance: "conforming", reasons: [], position: null, velocity_mps: null,
  };
}

/** Return a flight's position and heading at a time by its trajectory, null before departure and after arrival. */
export function plannedAt(trajectory, timeMs) {
  const next = trajectory.findIndex(({ depart }) => Date.parse(depart) >= timeMs);
  if (next < 0 || timeMs < Date.parse(trajectory[0].arrive)) return null;
  const to = trajectory[next];
  const from = trajectory[Math.max(0, next - 1)];
  const [left, arrived] = [Date.parse(from.depart), Date.parse(to.arrive)];
  const share = arrived > left ? Math.min(1, Math.max(0, (timeMs - left) / (arrived - left))) : 1;
  const mix = (name) => from[name] + (to[name] - from[name]) * share;
  const east = (to.lon - from.lon) * Math.cos((to.lat * Math.PI) / 180);
  return { lon: mix("lon"), lat: mix("lat"), alt_m: mix("alt_m"), heading: Math.atan2(east, to.lat - from.lat) };
}
