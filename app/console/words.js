/** What the service's slugs mean, in words for the control room. */

import { clockTime } from "/console/time.js";

export const STATUS_WORDS = {
  green: "as planned",
  yellow: "deviation",
  red: "conflict",
  idle: "not in use",
};

export const CONFORMANCE_WORDS = {
  conforming: "conforming",
  deviating: "deviating",
  violating: "violating",
  lost: "lost",
  unseen: "not seen",
  scheduled: "not departed yet",
};

const BLOCK_REASONS = {
  unplanned_use: "an aircraft is here, where nothing is reserved",
  off_track: "the flight that reserved it is off its track",
  wrong_layer: "the flight that reserved it flies in another layer",
  early: "the flight that reserved it is early",
  late: "the flight that reserved it is late",
  lost: "the flight that reserved it has not been heard of lately",
  contingent: "the flight that reserved it is in contingency",
  not_seen: "the flight that reserved it should fly and has never been seen",
  several_aircraft: "several aircraft are here at once",
  reserved_by_another: "an aircraft is here, and another flight has reserved the block",
  in_building: "an aircraft is where a building stands",
  in_constraint: "an aircraft is in closed airspace",
  not_accepted: "an aircraft flies here without an accepted plan",
};

const FLIGHT_REASONS = {
  unplanned_use: "flies where nothing is reserved",
  off_track: "off its track",
  wrong_layer: "in the wrong layer",
  early: "early",
  late: "late",
  lost: "not heard of lately",
  contingent: "in contingency",
  not_seen: "should fly, never seen",
  several_aircraft: "shares a block with another aircraft",
  reserved_by_another: "in a block reserved by another flight",
  in_building: "where a building stands",
  in_constraint: "in closed airspace",
  not_activated: "flies without having been activated",
  not_accepted: "flies without an accepted plan",
  no_flight_intent: "no flight intent belongs to it",
};

const REFUSALS = {
  outside_airspace: "A position lies outside of the airspace. Choose points and layers within its outline.",
  origin_blocked: "A building stands in the origin's block.",
  destination_blocked: "A building stands in the destination's block.",
  same_block: "Origin and destination lie in the same block: there is nothing to plan.",
  disconnected: "Buildings leave no way from the origin to the destination, whatever the traffic.",
  no_departure_slot: "Within the departure window the origin's block is never free for long enough.",
  no_conflict_free_path: "Within the departure window other flights and closed airspace leave no way through.",
  search_too_long: "No way was found with the work that one flight may take: ask for a shorter window, or a later one.",
  endurance_exceeded: "A way exists, but it takes longer than this aircraft can stay in the air.",
};

const PROBLEMS = {
  "departure-in-the-past": "The departure window has passed. Choose a later departure.",
  "beyond-horizon": "The departure lies further ahead than the service plans. Choose an earlier one.",
  "aircraft-too-slow": "This aircraft is too slow for the airspace. Choose another.",
  "insufficient-scope": "Your token does not allow this. Sign out, and in again with one that does.",
  "queue-full": "Too many requests are waiting. Try again in a second.",
  "ledger-unavailable": "The ledger is unavailable and nothing was recorded. Try again later.",
  "outcome-unknown": "It is not known whether this was recorded. Look into the list of flights before you repeat it.",
  "read-only": "This server only answers reads. Open the console of one that plans.",
};

/** Return what a reason says of a block. */
export const blockReason = (slug) => BLOCK_REASONS[slug] ?? slug.replaceAll("_", " ");

/** Return what a reason says of a flight. */
export const flightReason = (slug) => FLIGHT_REASONS[slug] ?? slug.replaceAll("_", " ");

/** Return a refusal or another failed request as `{headline, explanation, detail}`; `words` go before ours, by slug. */
export function explained(failure, words = {}) {
  const problem = failure.problem;
  if (problem === null) {
    return { headline: "No answer", explanation: `Nothing is known: ${failure.message}.`, detail: "" };
  }
  const slug = String(problem.type).split("/").pop();
  const explanation = REFUSALS[problem.reason] ?? words[slug] ?? PROBLEMS[slug] ?? problem.detail;
  return {
    headline: REFUSALS[problem.reason] ? "Refused" : problem.title,
    explanation,
    detail: explanation === problem.detail ? "" : problem.detail,
  };
}

/** Return how a flight keeps to its plan: its conformance, or `scheduled` where it need not be seen yet. */
export function standing({ conformance, reasons }) {
  return conformance === "unseen" && reasons.length === 0 ? "scheduled" : conformance;
}

/** Return what a flight or track is called. */
export function flightName({ reference, operator, sequence, track_id: track }) {
  if (track) return `track ${track}`;
  return reference ?? `${operator} #${sequence}`;
}

const CONSTRAINT_EVENTS = {
  constraint_created: "airspace closed",
  constraint_removed: "closed airspace opened",
};

/** Return a journal entry in words. */
export function journalWords(entry) {
  const { kind, sequence, track_id: track, time } = entry;
  const what = CONSTRAINT_EVENTS[kind] ?? `${track ? `track ${track}` : `#${sequence}`} ${became(entry)}`;
  return `${what} at ${clockTime(Date.parse(time))} UTC`;
}

/** Return what became of a flight: its state or, where it was planned again and still flies, how. */
function became({ kind, details }) {
  if (kind === "unmoved") return "can no longer make way";
  if (kind === "displaced" || details.cause === undefined) return kind;
  if (details.cause === null) return "changed";
  return `made way, ${arrivalWords(details.arrival_moved_s)}`;
}

/** Return how much a flight that was planned again arrives sooner or later. */
export function arrivalWords(seconds) {
  return `arrives ${Math.abs(seconds).toFixed(1)} s ${seconds < 0 ? "sooner" : "later"}`;
}

/** Return why there is no plan for a flight, or any more. */
export const refusalWords = (reason) => REFUSALS[reason] ?? reason.replaceAll("_", " ");
