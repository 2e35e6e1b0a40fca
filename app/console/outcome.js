/** What became of a request, under the form that sent it. */

import { element } from "/console/dom.js";
import { explained } from "/console/words.js";

/** Say what went wrong; `words` say it for problems that mean something else here, by their slugs. */
export function failure(error, words = {}) {
  const { headline, explanation, detail } = explained(error, words);
  return element("div", { class: "outcome bad" },
    element("strong", { text: headline }), element("p", { text: explanation }),
    detail ? element("p", { class: "hint", text: detail }) : null);
}

/** Say what is still to be put right before anything can be sent. */
export const unsent = (text) => element("p", { class: "outcome bad", text });
