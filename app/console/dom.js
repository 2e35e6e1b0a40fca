/** DOM nodes without HTML: what operators wrote becomes text nodes and is never parsed. */

/**
 * Make an element. Attributes that are functions listen (`onclick`), booleans are set or left out, `text` is its text.
 */
export function element(tag, { text, ...attributes } = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") made.addEventListener(name.slice(2), value);
    else if (value === true) made.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) made.setAttribute(name, value);
  }
  if (text !== undefined) made.textContent = text;
  made.append(...children.filter((child) => child !== null));
  return made;
}

/** Return the page's element of this id. */
export const byId = (id) => document.getElementById(id);

/** Set an element's text only where it differs, so that screen readers and selections are left in peace. */
export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

/** Let the arrow keys, Home and End move the focus among the buttons of a list. */
export function navigable(list, keys = { next: "ArrowDown", previous: "ArrowUp" }) {
  list.addEventListener("keydown", (event) => {
    const buttons = [...list.querySelectorAll("button")];
    const at = buttons.indexOf(document.activeElement);
    const to = {
      [keys.next]: at + 1,
      [keys.previous]: at - 1,
      Home: 0,
      End: buttons.length - 1,
    }[event.key];
    if (at < 0 || to === undefined) return;
    event.preventDefault();
    buttons[Math.max(0, Math.min(buttons.length - 1, to))].focus();
  });
}

/**
 * Make a list show these items, an element each. Elements stay with their keys, so that focus and scrolling stay
 * where they are while items come and go.
 */
export function showList(list, items, key, make, update) {
  const focused = list.contains(document.activeElement) ? document.activeElement : null;
  const gone = new Map([...list.children].map((node) => [node.dataset.key, node]));
  items.forEach((item, place) => {
    const itsKey = key(item);
    let node = gone.get(itsKey);
    if (node) {
      gone.delete(itsKey);
    } else {
      node = make(item);
      node.dataset.key = itsKey;
    }
    update(node, item);
    if (list.children[place] !== node) list.insertBefore(node, list.children[place] ?? null);
  });
  for (const node of gone.values()) node.remove();
  if (focused?.isConnected && focused !== document.activeElement) focused.focus({ preventScroll: true });
}

/** Make a definition list of `[term, description]` pairs; a description is text or an element, null leaves it out. */
export function facts(pairs) {
  const list = element("dl", { class: "facts" });
  for (const [term, description] of pairs) {
    if (description === null || description === undefined) continue;
    list.append(element("dt", { text: term }), element("dd", {}, description));
  }
  return list;
}

/** Make the chip of a block's status: colour, shape and word. */
export function statusChip(status, words) {
  return element("span", { class: "chip", "data-status": status },
    element("span", { class: "mark", "aria-hidden": "true" }), words);
}
