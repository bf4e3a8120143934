/** The state of the fleet in words, for those who hear the page, and for a glance. */

import { byId, setText } from "./dom.js";
import { short } from "./fleet.js";

/** @import { Robot } from "./types.d.ts" */

const EVERY_MS = 5000; // numbers of moving robots change all the time; a voice needs its time
const URGENT_MS = 1000;
const NAMED = 3;

export class Summary {
  /** @param {import("./store.js").Store} store */
  constructor(store) {
    this.store = store;
    store.on("fleet", () => this.#update());
    store.on("robots", () => this.#update());
  }

  #said_ms = -Infinity;
  #trouble = "";
  #timer = 0;

  #update() {
    clearTimeout(this.#timer);
    const { words, trouble } = fleetWords([...this.store.fleet.values()], this.store.missing);
    setText(byId("fleet-words"), words);
    if (words === byId("fleet-told").textContent) return;
    const wait_ms = this.#said_ms + (trouble === this.#trouble ? EVERY_MS : URGENT_MS) - performance.now();
    if (wait_ms > 0) {
      this.#timer = setTimeout(() => this.#update(), wait_ms);
      return;
    }
    this.#said_ms = performance.now();
    this.#trouble = trouble;
    setText(byId("fleet-told"), words);
  }
}

/**
 * Describe a fleet: "8 robots, 7 moving, 1 needs attention: r3, cliff". `trouble` is the part on those in trouble.
 * @param {Partial<Robot>[]} fleet
 * @param {string[]} missing known, but not reporting
 */
export function fleetWords(fleet, missing = []) {
  const causes = /** @type {Map<string, string[]>} */ (new Map());
  for (const { robot = "", attention, silent, state_word } of fleet) {
    if (!attention && !silent) continue;
    const cause = state_word || "no health report";
    causes.set(cause, [...(causes.get(cause) ?? []), robot]);
  }
  const worried = [...causes.values()].reduce((sum, robots) => sum + robots.length, 0);
  const moving = fleet.filter((robot) => robot.moving).length;
  const parts = [...causes].map(([cause, robots]) => `${robots.length === fleet.length && robots.length > 1 ? "all" : short(robots, NAMED)}, ${cause}`);
  const trouble = worried ? `${worried} need${worried === 1 ? "s" : ""} attention: ${parts.join("; ")}` : "";
  const count = `${fleet.length} robot${fleet.length === 1 ? "" : "s"}, ${moving || "none"} moving`;
  const absent = missing.length ? [`${short(missing, NAMED)} not reporting`] : [];
  return { words: fleet.length ? [count, ...absent, trouble || "none needs attention"].join(", ") : "", trouble };
}
