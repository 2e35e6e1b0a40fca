/** The top bar: which airspace, what time, whether the picture can be trusted, and the counts. */

import { byId, element, setText } from "/console/dom.js";
import { clockTime, date, span } from "/console/time.js";
import { STATUS_WORDS } from "/console/words.js";

const STATUSES = ["green", "yellow", "red"];
const LINK_WORDS = { connecting: "Connecting", live: "Live", stale: "Stale", reconnecting: "Reconnecting", refused: "Refused" };

/** Name the airspace, and whose data it is. */
export function showAirspace({ name, attribution, licence }) {
  setText(byId("airspace-name"), name);
  document.title = `${name} · AirMatrix`;
  setText(byId("attribution"), `Data: ${[attribution, licence].filter(Boolean).join(" · ")}`);
  byId("counts").append(
    ...STATUSES.map((status) => element("li", { id: `count-${status}`, title: `blocks: ${STATUS_WORDS[status]}` },
      element("span", { class: "mark", "data-status": status, "aria-hidden": "true" }),
      element("b", { text: "–" }),
      element("span", { class: "unit", text: status }))),
    element("li", { id: "count-flights", title: "aircraft in the air" },
      element("b", { text: "–" }),
      element("span", { text: "flying" })));
}

/** Show the clock and how old the picture is. */
export function showLink({ now, rate, simulated, state, silentSeconds, refusal }) {
  if (now !== null) {
    setText(byId("clock-time"), clockTime(now));
    setText(byId("clock-date"), date(now));
  }
  byId("simulated").hidden = !simulated;
  setText(byId("simulated"), `simulated clock ×${rate}`);
  byId("link").dataset.state = state;
  setText(byId("link"), LINK_WORDS[state]);
  const old = state === "stale" || state === "reconnecting";
  document.body.classList.toggle("old", old);
  byId("stale").hidden = !old && refusal === null;
  if (old) {
    const again = state === "reconnecting" ? ", connecting again" : "";
    setText(byId("stale"), `Stale since ${span(silentSeconds)}: the service is not heard${again}.`);
  }
  if (refusal !== null) setText(byId("stale"), `Not shown: ${refusal}. Sign out to use another token.`);
}

/** Show how many blocks have which status, and how many aircraft fly. */
export function showCounts(counts, flying) {
  for (const status of STATUSES) setText(byId(`count-${status}`).querySelector("b"), String(counts[status]));
  setText(byId("count-flights").querySelector("b"), String(flying));
}

/** Say that the console cannot work, and why. */
export function showFailure(words) {
  byId("stale").hidden = false;
  setText(byId("stale"), `The console cannot start: ${words}. Reload the page to try again.`);
}
