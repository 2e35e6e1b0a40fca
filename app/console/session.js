/** Who is at the console: a bearer token, asked for where the service wants one, kept for as long as the tab is open. */

import { byId, setText } from "/console/dom.js";

const KEY = "airmatrix-token";
// What a header may carry; a token has nothing else.
const SENDABLE = /^[\x21-\x7e]+$/;
let asking = null;

/** Return the token, or null. */
export const token = () => sessionStorage.getItem(KEY);

/** Return the scopes that the token names; null where nothing can be said of them. What counts the service decides. */
export function scopes() {
  try {
    const claims = JSON.parse(atob(token().split(".")[1].replaceAll("-", "+").replaceAll("_", "/")));
    const given = claims.scope ?? claims.scp ?? claims.scopes ?? "";
    return Array.isArray(given) ? given : given.split(" ");
  } catch {
    return null;
  }
}

/** Show the button to sign out where there is something to forget. */
export function startSession() {
  byId("sign-out").addEventListener("click", signOut);
  showSession();
}

/** Ask for a token, saying why; requests that need one at the same time wait for the same answer. */
export function askForToken(why) {
  asking ??= ask(why).finally(() => {
    asking = null;
  });
  return asking;
}

/** Forget the token, and all that was read with it. */
function signOut() {
  sessionStorage.removeItem(KEY);
  location.reload();
}

function ask(why) {
  const dialog = byId("session-dialog");
  const input = byId("session-token");
  setText(byId("session-why"), why);
  input.value = "";
  dialog.showModal();
  const over = new AbortController();
  return new Promise((resolve) => {
    // Without a token there is nothing behind it to go back to.
    dialog.addEventListener("close", () => dialog.showModal(), { signal: over.signal });
    byId("session-form").addEventListener("submit", (event) => {
      event.preventDefault();
      const given = input.value.trim().replace(/^Bearer\s+/i, "");
      if (!SENDABLE.test(given)) {
        setText(byId("session-why"), "A token is one line without spaces.");
        return;
      }
      over.abort();
      input.value = "";
      dialog.close();
      sessionStorage.setItem(KEY, given);
      showSession();
      resolve();
    }, { signal: over.signal });
  });
}

function showSession() {
  byId("sign-out").hidden = token() === null;
  // The service takes the operator from the token.
  byId("new-operator-label").hidden = token() !== null;
}
