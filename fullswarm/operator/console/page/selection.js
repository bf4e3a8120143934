/** The selected robots: a set of ids that map, table and groups share. */

import { Emitter } from "./dom.js";
import { byNumber } from "./store.js";

const KEPT_AS = "selection";

/** Why an order is not sent to a selection of which no robot is present: no names would mean the whole swarm. */
export const NOT_REPORTED = "none of them has reported yet";

/**
 * Emits "change". Kept over a reload of the tab.
 * @extends {Emitter<{change: undefined}>}
 */
export class Selection extends Emitter {
  /** @param {import("./store.js").Store} store */
  constructor(store) {
    super();
    this.store = store;
    this.ids = new Set(/** @type {string[]} */ (JSON.parse(sessionStorage.getItem(KEPT_AS) ?? "[]")));
    this.group = /** @type {string | undefined} */ (undefined);
  }

  /** @returns {string[]} those that exist, as people count */
  list() {
    return this.store.ids().filter((id) => this.ids.has(id));
  }

  /** Whether robots are selected, but none of them is present. */
  get absent() {
    const selected = this.ids.size > 0 || (this.group !== undefined && this.group !== "all");
    return selected && this.list().length === 0;
  }

  /** @param {string} id */
  has(id) {
    return this.ids.has(id);
  }

  /**
   * Select exactly these.
   * @param {Iterable<string>} ids
   * @param {string} [group]
   */
  set(ids, group) {
    this.ids = new Set(ids);
    this.group = group;
    sessionStorage.setItem(KEPT_AS, JSON.stringify([...this.ids]));
    this.emit("change");
  }

  /** @param {Iterable<string>} ids */
  add(ids) {
    this.set([...this.ids, ...ids]);
  }

  /** @param {string} id */
  toggle(id) {
    const ids = new Set(this.ids);
    if (!ids.delete(id)) ids.add(id);
    this.set(ids);
  }

  clear() {
    this.set([]);
  }

  all() {
    this.set(this.store.ids(), "all");
  }

  /**
   * Go to the next or previous single robot.
   * @param {1 | -1} step
   */
  stepRobot(step) {
    const ids = this.store.ids();
    const current = this.list();
    const next = neighbour(ids, step > 0 ? current.at(-1) : current[0], step);
    if (next !== undefined) this.set([next]);
  }

  /**
   * Go to the next or previous group.
   * @param {1 | -1} step
   */
  stepGroup(step) {
    const groups = this.groups();
    const name = neighbour([...groups.keys()], this.group, step);
    if (name !== undefined) this.set(groups.get(name) ?? [], name);
  }

  /** Return all groups: the whole swarm, those of the fleet file, and one per make if there are several. */
  groups() {
    const ids = this.store.ids();
    const groups = new Map([["all", ids]]);
    for (const [name, robots] of Object.entries(this.store.groups)) groups.set(name, [...robots].sort(byNumber));
    const makes = /** @type {Map<string, string[]>} */ (new Map());
    for (const id of ids) {
      const make = this.store.info(id).make;
      if (make) makes.set(make, [...(makes.get(make) ?? []), id]);
    }
    if (makes.size > 1) for (const [make, robots] of makes) groups.set(`make: ${make}`, robots);
    return groups;
  }
}

/**
 * Return the item after (or before) the current one, in a circle.
 * @template T
 * @param {T[]} items
 * @param {T | undefined} current
 * @param {1 | -1} step
 * @returns {T | undefined}
 */
export function neighbour(items, current, step) {
  if (items.length === 0) return undefined;
  const at = current === undefined ? -1 : items.indexOf(current);
  if (at < 0) return step > 0 ? items[0] : items.at(-1);
  return items[(at + step + items.length) % items.length];
}
