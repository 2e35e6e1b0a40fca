/** Dark or light: as the system has it, until somebody chooses. */

import { byId, setText } from "/console/dom.js";

const KEY = "airmatrix-theme";
const system = matchMedia("(prefers-color-scheme: light)");
let onChange = () => {};

/** Take the theme that was chosen here before, or the system's; `changed` is called after each later change. */
export function startTheme(changed) {
  onChange = changed;
  apply();
  system.addEventListener("change", () => {
    apply();
    onChange();
  });
}

/** Change to the other theme, and remember that. */
export function toggleTheme() {
  localStorage.setItem(KEY, present() === "dark" ? "light" : "dark");
  apply();
  onChange();
}

function present() {
  return localStorage.getItem(KEY) ?? (system.matches ? "light" : "dark");
}

function apply() {
  const theme = present();
  document.documentElement.dataset.theme = theme;
  setText(byId("theme"), theme === "dark" ? "Light" : "Dark");
}
