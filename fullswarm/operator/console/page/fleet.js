/** The table of robots, those that need attention first, and the group buttons above it. It shares the map's selection. */

import { byId, make, setFlag, setText } from "./dom.js";
import { OLD_S, seconds } from "./link.js";
import { IDLE, actuatorText } from "./palette.js";
import { byNumber } from "./store.js";

/** @import { Robot } from "./types.d.ts" */

const CALM_PX = 60;
const AGEING_MS = 500;
const LINE_PX = 19;
const LETTERS_PER_LINE = 46;
const MOST_LINES = 3;

/**
 * @typedef {{element: HTMLElement, check: HTMLInputElement, lines: number, id: HTMLElement, state: HTMLElement,
 *   behaviour: HTMLElement, swatch: HTMLElement, battery: HTMLElement, age: HTMLElement, driver: HTMLElement,
 *   version: HTMLElement, advice: HTMLElement, lease: HTMLElement}} Row
 */

export class FleetTable {
  /**
   * @param {{store: import("./store.js").Store, selection: import("./selection.js").Selection,
   *   commands: import("./commands.js").Commands, link: import("./link.js").Link}} parts
   */
  constructor({ store, selection, commands, link }) {
    this.store = store;
    this.link = link;
    this.selection = selection;
    this.commands = commands;
    this.body = byId("fleet-rows");
    for (const topic of /** @type {const} */ (["fleet", "robots", "leases"])) store.on(topic, () => this.#show());
    selection.on("change", () => this.#select());
    byId("release-all").addEventListener("click", () => this.#release());
    setInterval(() => this.#ageing(), AGEING_MS);
    this.#show();
  }

  #rows = /** @type {Map<string, Row>} */ (new Map());

  #show() {
    const ids = this.store.ids().sort((a, b) => this.#rank(a) - this.#rank(b) || byNumber(a, b));
    let top = 0;
    for (const id of ids) {
      const row = this.#row(id);
      this.#fill(row, id);
      const high = CALM_PX + row.lines * LINE_PX;
      row.element.style.transform = `translateY(${top}px)`; // not a layout shift
      row.element.style.height = `${high}px`;
      top += high;
    }
    this.body.style.height = `${top}px`;
    for (const [id, row] of this.#rows) {
      if (ids.includes(id)) continue;
      row.element.remove();
      this.#rows.delete(id);
    }
    this.#reorder(ids);
    this.#summary(ids);
    this.#select();
  }

  /**
   * The order for screen readers and the Tab key follows the one on the screen, unless the focus is in the table.
   * @param {string[]} ids
   */
  #reorder(ids) {
    if (this.body.contains(document.activeElement)) return;
    const elements = ids.map((id) => this.#row(id).element);
    if (!elements.every((element, k) => this.body.children[k] === element)) this.body.append(...elements);
  }

  /** @param {string} id */
  #rank(id) {
    const info = this.store.info(id);
    return info.attention || info.silent ? 0 : 1;
  }

  /** @param {string[]} ids */
  #summary(ids) {
    const worried = ids.filter((id) => this.#rank(id) === 0).length;
    const missing = this.store.missing.length ? ` · never reported: ${this.store.missing.join(", ")}` : "";
    setText(byId("fleet-summary"), `${ids.length} robots · ${worried || "none"} need${worried === 1 ? "s" : ""} attention${missing}`);
    byId("fleet-empty").hidden = ids.length > 0;
    const mine = [...this.store.leases.values()].filter((lease) => lease.mine).map((lease) => lease.robot);
    setText(byId("lease-summary"), mine.length ? `You hold ${short(mine)}` : "You hold no robot");
    /** @type {HTMLButtonElement} */ (byId("release-all")).disabled = mine.length === 0;
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
      battery: part("row-battery"), age: part("row-age"), driver: part("row-driver"), version: part("row-version"),
      advice: part("row-advice"),
      lease: make("span", { class: "row-lease", testid: `lease-${id}`, id: `lease-${id}` }),
    };
    const element = make(
      "div", { role: "row", class: "row", testid: `robot-row-${id}`, id: `robot-row-${id}` },
      cell("cell-check", check),
      cell("cell-robot", parts.swatch, parts.id, parts.lease),
      cell("cell-state", parts.state, parts.behaviour),
      cell("cell-numbers", parts.battery, parts.age),
      cell("cell-driver", parts.driver, parts.version),
      cell("cell-advice", parts.advice),
    );
    element.addEventListener("click", (event) => this.#clicked(event, id, check));
    this.body.append(element);
    const row = { element, check, lines: 0, ...parts };
    this.#rows.set(id, row);
    return row;
  }

  /**
   * @param {MouseEvent} event
   * @param {string} id
   * @param {HTMLInputElement} check
   */
  #clicked(event, id, check) {
    if (event.target === check) return;
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
    const alert = Boolean(info.attention || info.silent);
    const { head, rest } = stateWords(info, alert);
    row.element.classList.toggle("attention", alert);
    setText(row.state, head);
    const parts = actuatorText(info);
    setText(row.behaviour, [info.behaviour || "no behaviour", parts].filter(Boolean).join(" · "));
    row.behaviour.title = [info.behaviour, parts, info.memory && `remembers ${info.memory}`].filter(Boolean).join("\n");
    setText(row.advice, rest);
    row.advice.title = rest;
    row.state.title = info.state ?? "";
    row.lines = rest ? Math.min(MOST_LINES, Math.ceil(rest.length / LETTERS_PER_LINE)) : 0;
    setText(row.battery, typeof info.battery === "number" && info.battery >= 0 ? `${Math.round(100 * info.battery)} %` : "– %");
    this.#age(row, info);
    setText(row.driver, driverText(info));
    setText(row.version, info.version ?? "");
    row.driver.title = [info.driver, info.make, info.model, info.firmware, info.host, info.capabilities?.join(", ")].filter(Boolean).join("\n");
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
 * Split the state of a robot in trouble: a word for the column, and below it the reason and what to do.
 * @param {Partial<Robot>} robot
 * @param {boolean} alert
 */
function stateWords({ state_word: head = "no health report", state_why: why = "", advice = "", fault = "" }, alert) {
  if (!alert) return { head, rest: "" };
  const reason = why || fault;
  const rest = [reason && `${reason[0].toUpperCase()}${reason.slice(1)}.`, advice].filter(Boolean).join(" ");
  return { head: `⚠ ${head}`, rest };
}

/** @param {Partial<Robot>} robot */
function driverText({ driver = "", make: maker = "" }) {
  return /^[a-z]+/.exec(driver)?.[0] ?? maker;
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

/** Above the table: the number of selected robots, and the groups as buttons. */
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
    setText(byId("selection-names"), ids.length ? short(ids, 8) : this.#noneSelected());
    /** @type {HTMLButtonElement} */ (byId("select-none")).disabled = ids.length === 0 && !this.selection.absent;
  }

  #noneSelected() {
    const { ids, group, absent } = this.selection;
    return absent ? `${short(ids, 4) || group}: not reported` : "click, lasso, or tick robots";
  }
}
