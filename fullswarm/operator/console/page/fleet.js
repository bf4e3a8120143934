/** The table of robots, in the order of their names, and the group buttons above it. It shares the map's selection. */

import { AttentionStrip, needsAttention, steady, troubleText } from "./attention.js";
import { byId, make, setFlag, setText } from "./dom.js";
import { OLD_S, seconds } from "./link.js";
import { IDLE, actuatorText } from "./palette.js";
import { byNumber } from "./store.js";
import { titleOf } from "./words.js";

/** @import { Robot } from "./types.d.ts" */

const ROW_PX = 60;
const AGEING_MS = 500;

/**
 * @typedef {{element: HTMLElement, check: HTMLInputElement, id: HTMLElement, state: HTMLElement,
 *   behaviour: HTMLElement, swatch: HTMLElement, battery: HTMLElement, age: HTMLElement, lease: HTMLElement}} Row
 */

export class FleetTable {
  /**
   * @param {{store: import("./store.js").Store, selection: import("./selection.js").Selection,
   *   commands: import("./commands.js").Commands, link: import("./link.js").Link, open: (id: string) => void}} parts
   *   open: shows the details of a robot
   */
  constructor({ store, selection, commands, link, open }) {
    this.store = store;
    this.link = link;
    this.selection = selection;
    this.commands = commands;
    this.open = open;
    this.body = byId("fleet-rows");
    this.area = byId("fleet-region");
    for (const topic of /** @type {const} */ (["fleet", "robots", "leases", "world"])) store.on(topic, () => this.#show());
    selection.on("change", () => this.#select());
    for (const event of ["pointerleave", "focusout"]) this.area.addEventListener(event, () => this.#only && this.#show());
    byId("release-all").addEventListener("click", () => this.#release());
    setInterval(() => this.#ageing(), AGEING_MS);
    new AttentionStrip({
      store, selection, reveal: (id) => this.#reveal(id),
      filter: (only) => {
        this.#only = only;
        this.#filtered = [];
        this.#show();
      },
    });
    this.#show();
  }

  #rows = /** @type {Map<string, Row>} */ (new Map());
  #only = false; // robots that need attention alone
  #filtered = /** @type {string[]} */ ([]);

  /** Rows have one height and one order, so that none is replaced by another under a pointer. */
  #show() {
    const ids = this.#shown();
    for (const [k, id] of ids.entries()) {
      const row = this.#row(id);
      this.#fill(row, id);
      row.element.style.transform = `translateY(${k * ROW_PX}px)`; // not a layout shift
    }
    this.body.style.height = `${ids.length * ROW_PX}px`;
    for (const [id, row] of this.#rows) {
      if (ids.includes(id)) continue;
      row.element.remove();
      this.#rows.delete(id);
    }
    this.#reorder(ids);
    this.#summary();
    this.#select();
  }

  #shown() {
    const ids = this.store.ids();
    if (!this.#only) return ids;
    const wanted = ids.filter((id) => needsAttention(this.store.info(id)));
    const held = this.area.matches(":hover") || this.area.contains(document.activeElement);
    this.#filtered = steady(this.#filtered, wanted, held).filter((id) => ids.includes(id));
    return this.#filtered;
  }

  /**
   * The order for screen readers and the Tab key is the one on the screen.
   * @param {string[]} ids
   */
  #reorder(ids) {
    const elements = ids.map((id) => this.#row(id).element);
    if (!elements.every((element, k) => this.body.children[k] === element)) this.body.append(...elements);
  }

  #summary() {
    const ids = this.store.ids();
    const missing = this.store.missing.length ? ` · not reporting: ${short(this.store.missing)}` : "";
    setText(byId("fleet-summary"), `${ids.length} robots${missing}`);
    byId("fleet-empty").hidden = ids.length > 0;
    byId("fleet-fine").hidden = ids.length === 0 || this.#rows.size > 0;
    const mine = [...this.store.leases.values()].filter((lease) => lease.mine).map((lease) => lease.robot);
    setText(byId("lease-summary"), mine.length ? `You hold ${short(mine)}` : "You hold no robot");
    /** @type {HTMLButtonElement} */ (byId("release-all")).disabled = mine.length === 0;
  }

  /** @param {string} id */
  #reveal(id) {
    this.#rows.get(id)?.element.scrollIntoView({ block: "nearest" });
  }

  #release() {
    const mine = [...this.store.leases.values()].filter((lease) => lease.mine).map((lease) => lease.robot);
    this.commands.lease(mine, false);
  }

  /** @param {string} id */
  #row(id) {
    const known = this.#rows.get(id);
    if (known) return known;
    const check = make("input", { type: "checkbox", "aria-label": `Select ${id}`, on: { change: () => this.selection.toggle(id) } });
    const cell = (/** @type {string} */ name, /** @type {HTMLElement[]} */ ...children) => make("div", { role: "cell", class: name }, ...children);
    const part = (/** @type {string} */ name) => make("span", { class: name });
    const parts = {
      id: make("strong", { text: id }), state: part("row-state"), behaviour: part("row-behaviour"), swatch: part("swatch"),
      battery: part("row-battery"), age: part("row-age"),
      lease: make("span", { class: "row-lease", testid: `lease-${id}`, id: `lease-${id}` }),
    };
    const more = make("button", {
      type: "button", class: "row-more", testid: `details-${id}`, "aria-label": `Details of ${id}`, title: `Details of ${id}`, text: "›",
      on: { click: () => this.open(id) },
    });
    parts.battery.title = "Battery";
    parts.age.title = "Age of its newest report";
    const element = make(
      "div", { role: "row", class: "row", testid: `robot-row-${id}`, id: `robot-row-${id}` },
      cell("cell-check", check),
      cell("cell-robot", parts.swatch, parts.id, parts.lease),
      cell("cell-state", parts.state, parts.behaviour),
      cell("cell-numbers", parts.battery, parts.age),
      cell("cell-more", more),
    );
    element.addEventListener("click", (event) => this.#clicked(event, id, check));
    this.body.append(element);
    const row = { element, check, ...parts };
    this.#rows.set(id, row);
    return row;
  }

  /**
   * @param {MouseEvent} event
   * @param {string} id
   * @param {HTMLInputElement} check
   */
  #clicked(event, id, check) {
    if (event.target === check || event.target instanceof HTMLButtonElement) return;
    const beside = event.target instanceof Element && event.target.closest(".cell-check"); // a finger that misses the box
    if (beside || event.shiftKey || event.ctrlKey || event.metaKey) this.selection.toggle(id);
    else this.selection.set([id]);
  }

  /**
   * @param {Row} row
   * @param {string} id
   */
  #fill(row, id) {
    const info = this.store.info(id);
    const alert = needsAttention(info);
    row.element.classList.toggle("attention", alert);
    setText(row.state, `${alert ? "⚠ " : ""}${info.state_word ?? "no health report"}`);
    row.state.title = alert ? troubleText(info) : (info.state ?? "");
    const parts = actuatorText(info);
    const does = info.ended || titleOf(this.store.behaviours, info.behaviour) || "no behaviour";
    setText(row.behaviour, [alert ? info.brief : "", does, parts].filter(Boolean).join(" · "));
    row.behaviour.title = [does, parts, info.memory && `remembers ${info.memory}`].filter(Boolean).join("\n");
    setText(row.battery, typeof info.battery === "number" && info.battery >= 0 ? `${Math.round(100 * info.battery)} %` : "– %");
    this.#age(row, info);
    row.swatch.style.backgroundColor = info.behaviour ? this.store.looks.of(info.behaviour).colour : IDLE.colour;
    this.#lease(row, id);
  }

  /** Ages grow also while nothing arrives. */
  #ageing() {
    for (const [id, row] of this.#rows) this.#age(row, this.store.info(id));
  }

  /**
   * @param {Row} row
   * @param {Partial<Robot>} robot
   */
  #age(row, { age_s }) {
    const since_s = performance.now() / 1000 - (this.link.fleet_s ?? 0);
    const known = typeof age_s === "number" && (this.store.still || this.link.fleet_s !== null);
    setText(row.age, known ? seconds(age_s + (since_s > OLD_S && !this.store.still ? since_s : 0)) : "–");
  }

  /**
   * @param {Row} row
   * @param {string} id
   */
  #lease(row, id) {
    const lease = this.store.leases.get(id);
    setText(row.lease, lease ? (lease.mine ? "you" : lease.operator) : "free");
    setFlag(row.lease, "data-lease", lease ? (lease.mine ? "mine" : "other") : "free");
    row.lease.title = lease ? `driven by ${lease.operator}${lease.taken_from ? `, taken from ${lease.taken_from}` : ""}` : "not held";
  }

  #select() {
    for (const [id, row] of this.#rows) {
      const chosen = this.selection.has(id);
      if (row.check.checked !== chosen) row.check.checked = chosen;
      row.element.classList.toggle("selected", chosen);
    }
  }
}

/**
 * Name a few, count the rest.
 * @param {Iterable<string>} ids
 * @param {number} [most]
 */
export function short(ids, most = 6) {
  const sorted = [...ids].sort(byNumber);
  if (sorted.length <= most) return sorted.join(", ");
  return `${sorted.slice(0, most).join(", ")} and ${sorted.length - most} more`;
}
