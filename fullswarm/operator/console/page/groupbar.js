/** Above the table: how many are selected, and the groups as buttons. */

import { byId, make, setText } from "./dom.js";
import { short } from "./fleet.js";

export class GroupBar {
  /**
   * @param {import("./store.js").Store} store
   * @param {import("./selection.js").Selection} selection
   */
  constructor(store, selection) {
    this.store = store;
    this.selection = selection;
    for (const topic of /** @type {const} */ (["world", "robots"])) store.on(topic, () => this.#groups());
    selection.on("change", () => this.#show());
    store.on("robots", () => this.#show());
    byId("select-none").addEventListener("click", () => selection.clear());
    this.#groups();
    this.#show();
  }

  #shown = "";

  #groups() {
    const groups = this.selection.groups();
    const names = JSON.stringify([...groups.keys()]);
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
    setText(byId("selection-names"), ids.length ? short(ids, 8) : this.#nobody());
    /** @type {HTMLButtonElement} */ (byId("select-none")).disabled = ids.length === 0 && !this.selection.unheard;
  }

  #nobody() {
    const { ids, group, unheard } = this.selection;
    return unheard ? `${short(ids, 4) || group}: not heard` : "click, lasso, or tick robots";
  }
}
