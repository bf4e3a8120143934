/** The buttons on the map: tools, zoom, layers. */

import { byId, setText } from "./dom.js";

/** @import { Commands } from "./commands.js" */
/** @import { Store } from "./store.js" */
/** @import { Tools } from "./tools.js" */

const HINTS = {
  select: "",
  goal: "Click where the selected robots shall go. Esc: leave it.",
  measure: "Drag, or click twice, to measure a distance. Esc: done.",
  formation: "Drag from the middle outwards, release to send them. Esc: leave it.",
  pick: "Click on the map to pick a point. Esc: done.",
};

export class Toolbar {
  /**
   * @param {{map: import("./map.js").SwarmMap, tools: import("./tools.js").Tools,
   *   commands: import("./commands.js").Commands, store: import("./store.js").Store}} parts
   */
  constructor({ map, tools, commands, store }) {
    this.map = map;
    this.tools = tools;
    for (const mode of /** @type {const} */ (["select", "goal", "formation", "measure"])) {
      byId(`tool-${mode}`).addEventListener("click", () => tools.use(mode));
    }
    byId("zoom-in").addEventListener("click", () => this.zoom(1.3));
    byId("zoom-out").addEventListener("click", () => this.zoom(1 / 1.3));
    byId("zoom-fit").addEventListener("click", () => map.fit());
    byId("layer-coverage").addEventListener("click", () => this.layer("coverage"));
    byId("layer-trails").addEventListener("click", () => this.layer("trails"));
    const shape = /** @type {HTMLSelectElement} */ (byId("formation-shape"));
    shape.addEventListener("change", () => (tools.shape = /** @type {Tools["shape"]} */ (shape.value)));
    this.#goalBehaviours(commands, store);
    tools.on("change", () => this.#show());
    tools.on("draw", () => map.touch());
    this.#show();
  }

  /** @param {number} factor */
  zoom(factor) {
    this.map.view.zoomAt(factor);
    this.map.touch(true);
  }

  /**
   * Show or hide a layer.
   * @param {"coverage" | "trails"} name
   */
  layer(name) {
    this.map.options[name] = !this.map.options[name];
    byId(`layer-${name}`).setAttribute("aria-pressed", String(this.map.options[name]));
    this.map.touch(true);
  }

  /**
   * @param {Commands} commands
   * @param {Store} store
   */
  #goalBehaviours(commands, store) {
    const choice = /** @type {HTMLSelectElement} */ (byId("goal-behaviour"));
    choice.addEventListener("change", () => (commands.goalBehaviour = choice.value));
    store.on("world", () => {
      for (const option of choice.options) option.disabled = !(option.value in store.behaviours);
    });
  }

  #show() {
    const { mode } = this.tools;
    for (const each of /** @type {const} */ (["select", "goal", "formation", "measure"])) {
      byId(`tool-${each}`).setAttribute("aria-pressed", String(each === mode));
    }
    setText(byId("tool-hint"), HINTS[mode]);
    byId("tool-hint").hidden = !HINTS[mode];
    this.map.live.dataset.mode = mode;
    this.map.touch();
  }
}
