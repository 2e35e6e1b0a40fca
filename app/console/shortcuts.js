/** Keys for everything that is done often, and the list of them. */

import { byId, element } from "/console/dom.js";

const MORE = [
  ["Esc", "Close what is open"],
  ["Enter", "While a place is chosen: take the map's centre"],
  ["↑ ↓", "Move within a list"],
];
const WRITING = "input:not([type=range]):not([type=checkbox]), select, textarea";

/** Listen to keys: `shortcuts` are `[key, words, action]`; `enter` returns whether it had a use. */
export function listenToKeys(shortcuts, { escape, enter }) {
  const help = byId("help-dialog");
  const all = [...shortcuts, ["?", "This list", () => help.showModal()]];
  byId("help").addEventListener("click", () => help.showModal());
  byId("help-list").append(...[...all, ...MORE].flatMap(([key, words]) => [
    element("dt", {}, element("kbd", { text: key })),
    element("dd", { text: words }),
  ]));
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    if (event.key === "Escape") escape();
    if (event.target.matches(WRITING)) return;
    const shortcut = all.find(([key]) => key.toLowerCase() === event.key.toLowerCase());
    const done = event.key === "Enter" ? !event.target.matches("button, a") && enter() : shortcut !== undefined;
    if (done) event.preventDefault();
    shortcut?.[2]();
  });
}
