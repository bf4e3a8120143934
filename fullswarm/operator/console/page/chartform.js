/** The form that chooses what a chart shows: which value, and of which robots. It takes the place of the charts. */

import { byId, make, setText } from "./dom.js";
import { aboutOf, format, parse } from "./series.js";

/** @import { Catalogue } from "./types.d.ts" */
/** @import { Choice } from "./series.js" */

export class ChartForm {
  /**
   * @param {{selection: import("./selection.js").Selection, done: (choice: Choice) => void, remove: () => void}} parts
   */
  constructor({ selection, done, remove }) {
    this.selection = selection;
    this.number = -1; // of the chart that is changed; -1: a new one
    this.form = /** @type {HTMLFormElement} */ (byId("chart-form"));
    this.of = /** @type {HTMLSelectElement} */ (byId("chart-of"));
    this.who = /** @type {HTMLSelectElement} */ (byId("chart-who"));
    this.of.addEventListener("change", () => this.#explain());
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#close();
      done(this.#choice());
    });
    byId("chart-remove").addEventListener("click", () => {
      this.#close();
      remove();
    });
    byId("chart-cancel").addEventListener("click", () => this.cancel());
    this.form.addEventListener("keydown", ({ key }) => key === "Escape" && this.cancel());
  }

  #catalogue = /** @type {Catalogue | null} */ (null);
  #opener = /** @type {HTMLElement | null} */ (null);

  /** Whether the focus is in it. */
  get focused() {
    return !this.form.hidden && this.form.contains(document.activeElement);
  }

  /**
   * @param {Catalogue} catalogue
   * @param {Choice | null} choice  what is shown now
   * @param {number} number
   */
  open(catalogue, choice, number) {
    this.#catalogue = catalogue;
    this.number = number;
    this.#opener = document.activeElement instanceof HTMLElement ? document.activeElement : null;
    const { fields, metrics } = catalogue;
    this.of.replaceChildren(group("Of robots", fields.map(({ name, title }) => option(name, title))), group("Of the swarm", metrics.map(({ name, title }) => option(name, title))));
    this.of.value = choice?.of ?? fields[0]?.name ?? "";
    if (this.of.selectedIndex < 0) this.of.selectedIndex = 0;
    this.#offer(choice);
    this.#explain();
    byId("chart-remove").hidden = number < 0;
    setText(byId("chart-submit"), number < 0 ? "Add" : "Change");
    this.form.hidden = false;
    byId("chart-strip").hidden = true;
    this.of.focus();
  }

  /**
   * Offer all robots, groups, those that are selected, and each one.
   * @param {Choice | null} choice
   */
  #offer(choice) {
    const selected = this.selection.list();
    const ids = this.selection.store.ids();
    const groups = [...this.selection.groups().keys()].filter((name) => name !== "all");
    const who = (/** @type {Partial<Choice>} */ part) => format({ of: "", robots: [], group: "", ...part });
    const parts = /** @type {HTMLElement[]} */ ([option("", "All robots")]);
    if (selected.length) parts.push(option(who({ robots: selected }), `Selected: ${selected.join(", ")}`));
    if (groups.length) parts.push(group("Groups", groups.map((name) => option(who({ group: name }), name))));
    parts.push(group("One robot", ids.map((id) => option(who({ robots: [id] }), id))));
    this.who.replaceChildren(...parts);
    const now = choice ? who({ robots: choice.robots, group: choice.group === "all" ? "" : choice.group }) : selected.length ? who({ robots: selected }) : "";
    if (![...this.who.options].some(({ value }) => value === now)) this.who.prepend(option(now, choice?.group || choice?.robots.join(", ") || ""));
    this.who.value = now;
  }

  /** Say what the value is; a quantity of the swarm is of all robots together. */
  #explain() {
    const about = this.#catalogue && aboutOf(this.#catalogue, this.of.value);
    const single = this.#catalogue?.fields.some(({ name }) => name === this.of.value) ?? true;
    this.who.disabled = !single;
    const unit = about?.unit ? ` Unit: ${about.unit}.` : "";
    setText(byId("chart-doc"), `${capital(about?.doc ?? "")}.${unit}${single ? " Several robots: select them first." : ""}`);
  }

  /** @returns {Choice} */
  #choice() {
    return parse(this.of.value + (this.who.disabled ? "" : this.who.value));
  }

  cancel() {
    this.#close();
    this.#opener?.focus();
  }

  #close() {
    this.form.hidden = true;
    byId("chart-strip").hidden = false;
  }
}

/**
 * @param {string} value
 * @param {string} text
 */
function option(value, text) {
  return make("option", { value, text });
}

/**
 * @param {string} label
 * @param {HTMLElement[]} options
 */
function group(label, options) {
  return make("optgroup", { label }, ...options);
}

/** @param {string} text */
function capital(text) {
  return text.charAt(0).toUpperCase() + text.slice(1);
}
