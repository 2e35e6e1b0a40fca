/** Colours for what is drawn and not styled: read from the style sheet, which is where they are chosen. */

const NAMES = [
  "ground", "outside", "building", "building-high", "grid", "green", "yellow", "red", "accent", "aircraft", "outline",
  "origin", "destination",
];

/** Return the present theme's colours by name, as `rgb(…)`. */
export function palette() {
  const probe = document.createElement("span");
  document.body.append(probe);
  const colours = {};
  for (const name of NAMES) {
    probe.style.color = `var(--${name})`;
    colours[name] = getComputedStyle(probe).color;
  }
  probe.remove();
  return colours;
}

/** Return `rgb(…)` as red, green, blue (0 to 1) and an alpha. */
export function rgba(colour, alpha = 1) {
  const [red, green, blue] = colour.match(/[\d.]+/g).map(Number);
  return [red / 255, green / 255, blue / 255, alpha];
}
