/** What is closed now or will be, each with a button that opens it again. */

import { remove } from "/console/api.js";
import { altitudes, isInForce, times } from "/console/constraints.js";
import { byId, element, setText, showList } from "/console/dom.js";
import { failure } from "/console/outcome.js";

const WORDS = {
  "outcome-unknown": "It is not known whether the airspace was reopened. The list below shows it.",
  "unknown-constraint": "It is no longer known: it was removed long ago.",
};

export class Reopening {
  #actions;
  /** The constraint that the dialog asks about. */
  #asked = null;

  /** `actions`: `find(constraint)`, `reopened()`. */
  constructor(actions) {
    this.#actions = actions;
    const dialog = byId("reopen-dialog");
    byId("reopen-keep").addEventListener("click", () => dialog.close());
    byId("reopen-form").addEventListener("submit", (event) => {
      event.preventDefault();
      dialog.close();
      this.#reopen(this.#asked);
    });
  }

  /** Show those of these constraints that have not ended by a time. */
  show(constraints, timeMs) {
    const shown = constraints.filter(({ until }) => until === null || timeMs < Date.parse(until));
    byId("closures-none").hidden = shown.length > 0;
    setText(byId("closures-count"), String(shown.length));
    showList(byId("closures-list"), shown, ({ id }) => id, () => this.#item(), (item, constraint) => {
      item.constraint = constraint;
      item.dataset.inForce = String(isInForce(constraint, timeMs));
      const [where, reopen] = item.children;
      setText(where.children[0], constraint.name);
      setText(where.children[1], `${altitudes(constraint)}, ${times(constraint, timeMs)}`);
      reopen.ariaLabel = `Reopen ${constraint.name}`;
    });
  }

  #item() {
    const item = element("li", {},
      element("button", { type: "button", class: "closure", onclick: () => this.#actions.find(item.constraint) },
        element("strong"), element("span")),
      element("button", { type: "button", text: "Reopen", onclick: () => this.#ask(item.constraint) }));
    return item;
  }

  #ask(constraint) {
    this.#asked = constraint;
    setText(byId("reopen-title"), `Reopen ${constraint.name}?`);
    byId("reopen-dialog").showModal();
  }

  async #reopen({ id, name }) {
    const outcome = byId("closing-outcome");
    try {
      await remove(`/v1/constraints/${encodeURIComponent(id)}`);
      outcome.replaceChildren(element("div", { class: "outcome good" },
        element("strong", { text: `${name}: open again` }),
        element("p", { class: "hint", text: "Flights that made way stay where they are planned now." })));
    } catch (error) {
      outcome.replaceChildren(failure(error, WORDS));
    }
    outcome.focus({ preventScroll: true });
    outcome.firstElementChild.scrollIntoView({ block: "nearest" });
    this.#actions.reopened();
  }
}
