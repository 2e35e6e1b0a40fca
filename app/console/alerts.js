/** The list of alerts: newest first, each leads to its place, new ones are read out. */

import { element, navigable, setText, showList } from "/console/dom.js";
import { clockTime, relative } from "/console/time.js";
import { flightReason } from "/console/words.js";

export class AlertsPanel {
  #list;
  #announcer;
  #onChoose;
  /** Ids that were there before; null until the first picture, whose alerts are no news. */
  #known = null;
  /** The id of the selected flight or track, or null. */
  selected = null;

  /** `onChoose` gets the alert that was clicked. */
  constructor(list, announcer, onChoose) {
    this.#list = list;
    this.#announcer = announcer;
    this.#onChoose = onChoose;
    navigable(list);
  }

  /** Show these alerts; `nameOf` returns the name of a flight by its id. */
  show(alerts, nowMs, nameOf) {
    this.#announce(alerts);
    if (alerts.length === 0) {
      const calm = element("li", { class: "hint", text: "No alerts: every aircraft is where it should be." });
      this.#list.replaceChildren(calm);
      return;
    }
    showList(this.#list, alerts, (alert) => alert.id, () => this.#item(), (item, alert) => {
      const [button] = item.children;
      item.alert = alert;
      button.dataset.status = alert.severity;
      button.ariaCurrent = String((alert.flight_intent_id ?? alert.track_id) === this.selected);
      const [, title, when, message, reasons, threats] = button.children;
      setText(title, alert.flight_intent_id ? nameOf(alert.flight_intent_id) : `track ${alert.track_id}`);
      setText(when, relative(Date.parse(alert.raised), nowMs));
      when.title = `since ${clockTime(Date.parse(alert.raised))} UTC`;
      setText(message, alert.message);
      setText(reasons, [alert.conformance, ...alert.reasons.map(flightReason)].join(" · "));
      setText(threats, threatWords(alert.threatens, nameOf));
    });
  }

  #item() {
    const item = element("li", {},
      element("button", { type: "button", class: "row alert", onclick: () => this.#onChoose(item.alert) },
        element("span", { class: "mark", "aria-hidden": "true" }),
        element("strong"),
        element("span", { class: "when" }),
        element("span", { class: "message" }),
        element("span", { class: "reasons" }),
        element("span", { class: "threats" })));
    return item;
  }

  #announce(alerts) {
    const key = ({ id, severity }) => `${id} ${severity}`;
    const news = this.#known === null ? [] : alerts.filter((alert) => !this.#known.has(key(alert)));
    this.#known = new Set(alerts.map(key));
    if (news.length === 1) setText(this.#announcer, `${news[0].severity} alert: ${news[0].message}`);
    if (news.length > 1) setText(this.#announcer, `${news.length} new alerts. ${news[0].message}`);
  }
}

/** Return which flights are threatened and when first, the most urgent in full. */
function threatWords(threats, nameOf) {
  const first = new Map();
  for (const threat of threats) {
    const known = first.get(threat.flight_intent_id);
    if (!known || threat.reach_s < known.reach_s) first.set(threat.flight_intent_id, threat);
  }
  const [most, ...others] = [...first.values()].sort((one, other) => one.reach_s - other.reach_s);
  if (!most) return "";
  const when = most.reach_s < 1 ? "now" : `in ${Math.round(most.reach_s)} s`;
  const words = `reaches ${nameOf(most.flight_intent_id)} at [${most.block.join(", ")}] ${when}`;
  return others.length ? `${words}, then ${others.map(({ flight_intent_id: id }) => nameOf(id)).join(", ")}` : words;
}
