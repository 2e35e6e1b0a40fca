/** What the map shows of the blocks: layers, statuses, or the heat map. */

import { element, statusChip } from "/console/dom.js";
import { STATUS_WORDS } from "/console/words.js";

export class Filters {
  #layers;
  #statuses;
  #heat;
  #span;

  /** `onChange` is called when anything was switched. */
  constructor({ layers, statuses, heat, span, options }, grid, onChange) {
    this.#layers = switches(layers, Array.from({ length: grid.dimensions[2] }, (_, k) => k).reverse(),
      (layer) => grid.layerName(layer), onChange);
    this.#statuses = switches(statuses, ["red", "yellow", "green"],
      (status) => statusChip(status, STATUS_WORDS[status]), onChange);
    this.#heat = heat;
    this.#span = span;
    heat.addEventListener("change", () => {
      options.hidden = !heat.checked;
      onChange();
    });
    span.addEventListener("change", onChange);
  }

  /** Return the blocks that are to be shown of these. */
  shown(entries) {
    return entries.filter(({ block, status }) => this.showsLayer(block[2]) && this.#statuses.get(status).checked);
  }

  /** Tell whether a layer is shown. */
  showsLayer(layer) {
    return this.#layers.get(layer).checked;
  }

  /** The heat map's span in seconds from the moment shown, negative for the past; null while it is off. */
  get heatSpan() {
    return this.#heat.checked ? Number(this.#span.value) : null;
  }

  /** Switch the heat map on or off. */
  toggleHeat() {
    this.#heat.click();
  }
}

function switches(place, values, label, onChange) {
  return new Map(values.map((value) => {
    const box = element("input", { type: "checkbox", checked: true, value, onchange: onChange });
    place.append(element("label", { class: "choice" }, box, label(value)));
    return [value, box];
  }));
}
