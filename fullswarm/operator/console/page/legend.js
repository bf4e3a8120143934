/** What the colours and patterns on the map mean now. */

import { byId, context2d, make } from "./dom.js";
import { IDLE, lawOf } from "./palette.js";
import { fillPattern, outline } from "./sprites.js";
import { titleOf } from "./words.js";

/** @import { Look } from "./palette.js" */

const SIZE = 18;

export class Legend {
  /** @param {import("./store.js").Store} store */
  constructor(store) {
    this.store = store;
    store.on("fleet", () => this.#show());
  }

  #shown = "";

  /**
   * Both variants of a behaviour look the same here: they share the title of the one behind the safety filter.
   * @param {string} law
   */
  #title(law) {
    const { behaviours } = this.store;
    return law ? titleOf(behaviours, `${law}_bc` in behaviours ? `${law}_bc` : law) : "no behaviour";
  }

  #show() {
    const laws = /** @type {Map<string, number>} */ (new Map());
    for (const { behaviour } of this.store.fleet.values()) {
      const law = behaviour ? lawOf(behaviour) : "";
      laws.set(law, (laws.get(law) ?? 0) + 1);
    }
    const words = JSON.stringify([...laws]);
    if (words === this.#shown) return;
    this.#shown = words;
    const items = [...laws].sort().map(([law, count]) =>
      make("li", {}, swatch(law ? this.store.looks.of(law) : IDLE), `${this.#title(law)} ${count}`),
    );
    byId("legend").replaceChildren(...items);
  }
}

/** @param {Look} look */
function swatch({ colour, pattern }) {
  const canvas = make("canvas", { width: 2 * SIZE, height: 2 * SIZE, class: "legend-swatch", "aria-hidden": "true" });
  const context = context2d(canvas);
  context.translate(SIZE, SIZE);
  outline(context, "circle", SIZE - 3);
  context.fillStyle = colour;
  context.fill();
  context.save();
  context.clip();
  fillPattern(context, pattern, SIZE - 3, "#0B1015");
  context.restore();
  outline(context, "circle", SIZE - 3);
  context.lineWidth = 2;
  context.strokeStyle = "#7D8894";
  context.stroke();
  return canvas;
}
