/** Above the table: the number of selected robots, the groups as buttons, and making a group of the selection. */

import { byId, make, setText, touched } from "./dom.js";
import { short } from "./fleet.js";

const NAME = /^[A-Za-z0-9_-]{1,64}$/;

/**
 * Return why a name cannot be that of a new group, or of something else that is kept; empty: it can.
 * @param {string} name
 * @param {Iterable<string>} taken names of the fleet file, which are not replaced from here
 * @param {string} [what] it is the name of
 */
export function nameProblem(name, taken, what = "group") {
  if (!name) return `give the ${what} a name`;
  if (!NAME.test(name)) return "letters, digits, - and _ only, 64 at most";
  if ((what === "group" && name === "all") || [...taken].includes(name)) return `the group ${name} is in the fleet file: choose another name`;
  return "";
}

export class GroupBar {
  /**
   * @param {import("./store.js").Store} store
   * @param {import("./selection.js").Selection} selection
   * @param {import("./commands.js").Commands} commands
   */
  constructor(store, selection, commands) {
    this.store = store;
    this.selection = selection;
    this.commands = commands;
    this.form = byId("group-form");
    this.name = /** @type {HTMLInputElement} */ (byId("group-name"));
    for (const topic of /** @type {const} */ (["world", "robots"])) store.on(topic, () => this.#groups());
    selection.on("change", () => this.#show());
    store.on("robots", () => this.#show());
    store.on("world", () => this.#show());
    byId("select-none").addEventListener("click", () => selection.clear());
    byId("group-new").addEventListener("click", () => this.#ask(true));
    byId("group-cancel").addEventListener("click", () => this.#ask(false));
    byId("group-delete").addEventListener("click", () => void this.#delete());
    this.form.addEventListener("submit", (event) => void this.#save(event));
    this.#groups();
    this.#show();
  }

  #shown = "";

  #groups() {
    const groups = this.selection.groups();
    const names = JSON.stringify([[...groups.keys()], this.store.own_groups]);
    if (names === this.#shown) return;
    this.#shown = names;
    const buttons = [...groups.keys()].map((name) =>
      make("button", {
        type: "button", class: "chip", text: name, testid: `group-${name}`,
        on: { click: () => this.selection.set(this.selection.groups().get(name) ?? [], name) },
      }),
    );
    byId("groups").replaceChildren(...buttons);
  }

  #show() {
    const ids = this.selection.list();
    setText(byId("selection"), `${ids.length} selected`);
    setText(byId("selection-names"), ids.length ? short(ids, 8) : this.#noneSelected());
    /** @type {HTMLButtonElement} */ (byId("select-none")).disabled = ids.length === 0 && !this.selection.absent;
    /** @type {HTMLButtonElement} */ (byId("group-new")).disabled = ids.length === 0;
    byId("group-delete").hidden = !this.#own();
    setText(byId("group-delete"), `Delete ${this.#own()}`);
  }

  /** The selected group, if it was made in a console; empty: it is none of these. */
  #own() {
    const { group } = this.selection;
    return group && this.store.own_groups.includes(group) ? group : "";
  }

  /** @param {boolean} open */
  #ask(open) {
    this.form.hidden = !open;
    byId("group-bar").hidden = open;
    this.#problem("");
    if (open) this.name.focus();
    else byId("group-new").focus({ preventScroll: true });
  }

  /** @param {string} words */
  #problem(words) {
    setText(byId("group-problem"), words);
    this.name.setAttribute("aria-invalid", String(Boolean(words)));
  }

  /** @param {SubmitEvent} event */
  async #save(event) {
    event.preventDefault();
    const name = this.name.value.trim();
    const taken = Object.keys(this.store.groups).filter((each) => !this.store.own_groups.includes(each));
    const robots = this.selection.list();
    const problem = robots.length ? nameProblem(name, taken) : "select robots first";
    if (problem) return this.#problem(problem);
    const answer = await this.commands.group("save", name, robots);
    if (!answer.ok) return this.#problem(answer.reason ?? "not saved");
    this.name.value = "";
    this.#ask(false);
    return this.selection.set(robots, name);
  }

  async #delete() {
    const name = this.#own();
    if (!name) return;
    const answer = await this.commands.group("delete", name, []);
    if (answer.ok) this.selection.set(this.selection.list());
  }

  #noneSelected() {
    const { ids, group, absent } = this.selection;
    return absent ? `${short(ids, 4) || group}: not reported` : `${touched() ? "tap" : "click"}, lasso, or tick robots`;
  }
}
