/** Requests that are kept under a name for all consoles: one press opens the form as it was filled in. */

import { byId, make, setText } from "./dom.js";
import { nameProblem } from "./groups.js";
import { titleOf } from "./words.js";

/** @import { SavedRequest } from "./types.d.ts" */

export class SavedRequests {
  /**
   * @param {{store: import("./store.js").Store, selection: import("./selection.js").Selection,
   *   commands: import("./commands.js").Commands, panel: import("./panel.js").Panel}} parts
   */
  constructor({ store, selection, commands, panel }) {
    this.store = store;
    this.selection = selection;
    this.commands = commands;
    this.panel = panel;
    this.name = /** @type {HTMLInputElement} */ (byId("save-name"));
    this.these = /** @type {HTMLInputElement} */ (byId("save-robots"));
    store.on("world", () => this.#list());
    selection.on("change", () => this.#robots());
    panel.on("choose", () => this.#form(false));
    byId("save-open").addEventListener("click", () => this.#form(byId("save-as").hidden));
    byId("save-cancel").addEventListener("click", () => this.#form(false));
    byId("save").addEventListener("click", () => void this.#save());
    byId("saved-delete").addEventListener("click", () => void this.#delete());
    this.name.addEventListener("keydown", (event) => {
      if (event.key !== "Enter") return;
      event.preventDefault(); // it is within the form that starts the behaviour
      void this.#save();
    });
    this.#list();
  }

  #shown = "";

  #list() {
    const shown = JSON.stringify(this.store.saved);
    if (shown === this.#shown) return;
    this.#shown = shown;
    const chips = Object.entries(this.store.saved).map(([name, saved]) =>
      make("button", {
        type: "button", class: "chip", text: name, testid: `saved-${name}`, title: this.#words(saved),
        on: { click: () => this.#open(name, saved) },
      }),
    );
    byId("saved-row").hidden = chips.length === 0;
    byId("saved").replaceChildren(...chips);
    this.#own();
  }

  /** @param {SavedRequest} saved */
  #words({ behaviour, robots = [] }) {
    return `${titleOf(this.store.behaviours, behaviour)} for ${robots.length ? robots.join(", ") : "the selected robots"}`;
  }

  /**
   * @param {string} name
   * @param {SavedRequest} saved
   */
  #open(name, saved) {
    if (saved.robots?.length) this.selection.set(saved.robots);
    this.panel.open(saved, name);
    this.#own();
  }

  /** Show which saved request the form is, and its deletion. */
  #own() {
    const name = this.panel.savedAs && this.store.saved[this.panel.savedAs] ? this.panel.savedAs : "";
    byId("saved-delete").hidden = !name;
    setText(byId("saved-delete"), `Delete ${name}`);
  }

  #robots() {
    const count = this.selection.list().length;
    this.these.disabled = count === 0;
    if (count === 0) this.these.checked = false;
    setText(byId("save-robots-words"), count ? `for these ${count} robots, else for the ones selected then` : "for the robots that are selected then");
  }

  /** @param {boolean} open */
  #form(open) {
    byId("save-as").hidden = !open;
    byId("save-open").setAttribute("aria-expanded", String(open));
    this.#problem("");
    this.#robots();
    this.#own();
    if (!open) return;
    this.name.value = this.panel.savedAs;
    this.name.focus();
  }

  async #save() {
    const name = this.name.value.trim();
    const problem = nameProblem(name, [], "request");
    if (problem) return this.#problem(problem);
    const filled = this.panel.filled();
    if (!filled) return this.#problem("not kept: see above");
    const robots = this.these.checked ? this.selection.list() : [];
    const answer = await this.commands.keep("save", "saved", name, { ...filled, robots });
    if (!answer.ok) return this.#problem(answer.reason ?? "not kept");
    this.panel.savedAs = name;
    this.#form(false);
    return byId("save-open").focus();
  }

  async #delete() {
    const answer = await this.commands.keep("delete", "saved", this.panel.savedAs);
    if (!answer.ok) return this.#problem(answer.reason ?? "not deleted");
    this.panel.savedAs = "";
    return this.#own();
  }

  /** @param {string} words */
  #problem(words) {
    setText(byId("save-problem"), words);
    this.name.setAttribute("aria-invalid", String(Boolean(words)));
  }
}
