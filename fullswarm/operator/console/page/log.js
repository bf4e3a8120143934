/** The log of requests, refusals, stops and leases; the newest at the bottom; with a filter that the address keeps. */

import { byId, make, setFlag, setText } from "./dom.js";
import { ME, NO_FILTER, SELECTED, fitting, isSet, readFilter, writeFilter } from "./logfilter.js";

/** @import { Entry } from "./types.d.ts" */
/** @import { LogFilter } from "./logfilter.js" */

const SIGNS = /** @type {Record<string, string>} */ ({ request: "▸", refused: "✕", stop: "■", estop: "◆", mission: "≡", lease: "●", link: "○", reload: "↻", fault: "⚠" });
const SHOWN = 500;
const CHOICES = /** @type {const} */ (["kind", "level", "by", "robots"]);
const NOTHING_YET = "Nothing has happened yet. Requests, stops, leases and faults appear here, of all operators.";

export class LogView {
  /**
   * @param {import("./store.js").Store} store
   * @param {import("./selection.js").Selection} selection
   */
  constructor(store, selection) {
    this.store = store;
    this.selection = selection;
    this.list = byId("log");
    this.filter = readFilter(new URLSearchParams(location.search));
    this.search = /** @type {HTMLInputElement} */ (byId("log-search"));
    this.search.addEventListener("input", () => this.#set({ text: this.search.value }));
    for (const name of CHOICES) {
      const choice = select(name);
      choice.addEventListener("change", () => this.#set({ [name]: choice.value }));
    }
    byId("log-filter").addEventListener("click", () => this.#unfold(byId("log-filters").hidden));
    byId("log-clear").addEventListener("click", () => this.#clear());
    store.on("log", (entry) => (entry ? this.#add(entry) : this.#all()));
    for (const topic of /** @type {const} */ (["robots", "world"])) store.on(topic, () => this.#choices());
    store.on("world", () => this.filter.robots && this.#all());
    selection.on("change", () => this.filter.robots === SELECTED && this.#all());
    this.#fields();
    this.#all();
  }

  #fits = /** @type {(entry: Entry) => boolean} */ (() => true);
  #hidden = 0;
  #known = ""; // what can be chosen, as it was offered last

  /** @param {Partial<LogFilter>} change */
  #set(change) {
    this.filter = { ...this.filter, ...change };
    const address = new URL(location.href);
    writeFilter(address.searchParams, this.filter);
    if (address.href !== location.href) history.replaceState(null, "", address);
    this.#all();
  }

  #clear() {
    this.#set(NO_FILTER);
    this.#fields();
    byId("log-filter").focus({ preventScroll: true }); // the button that was pressed is gone
  }

  /** @param {boolean} open */
  #unfold(open) {
    byId("log-filters").hidden = !open;
    setFlag(byId("log-filter"), "aria-expanded", open);
  }

  /** Show the filter in its fields. */
  #fields() {
    this.search.value = this.filter.text;
    this.#known = "";
    this.#choices();
    for (const name of ["kind", "level"]) select(name).value = this.filter[/** @type {"kind" | "level"} */ (name)];
  }

  /** Offer the operators of the log, the groups and the robots; what is chosen stays, also when it is not there now. */
  #choices() {
    const operators = [...new Set(this.store.log.map(({ by }) => by).filter(Boolean))].sort();
    const groups = Object.keys(this.store.groups).sort().map((name) => `@${name}`);
    const robots = this.store.ids();
    const known = JSON.stringify([operators, groups, robots]);
    if (known === this.#known) return;
    this.#known = known;
    offer(select("by"), [["", "operator"], [ME, "me"], ...operators.map(same)], this.filter.by);
    offer(select("robots"), [["", "robots"], [SELECTED, "selected robots"], ...groups.map(same), ...robots.map(same)], this.filter.robots);
  }

  #all() {
    this.#fits = fitting(this.filter, { selected: this.selection.list(), groups: this.store.groups });
    const shown = this.store.log.filter(this.#fits);
    this.#hidden = this.store.log.length - shown.length;
    this.list.replaceChildren(...shown.map(item));
    if (!shown.length) {
      const text = this.store.log.length ? "No line fits this filter." : NOTHING_YET;
      this.list.append(make("li", { class: "empty", text }));
    }
    this.list.scrollTop = this.list.scrollHeight;
    this.#choices();
    this.#tell();
  }

  /** @param {Entry} entry */
  #add(entry) {
    this.#choices();
    if (!this.#fits(entry)) {
      this.#hidden = this.store.log.filter((each) => !this.#fits(each)).length; // the same again is no further line
      return this.#tell();
    }
    const { list } = this;
    list.querySelector(`[data-number="${entry.number}"]`)?.remove(); // the same again: one line with a count
    const atEnd = list.scrollHeight - list.scrollTop - list.clientHeight < 40;
    list.querySelector(".empty")?.remove();
    list.append(item(entry));
    while (list.children.length > SHOWN) list.firstElementChild?.remove();
    if (atEnd) list.scrollTop = list.scrollHeight;
    return undefined;
  }

  /** Say how many lines are not shown, as long as there is a filter. */
  #tell() {
    const on = isSet(this.filter);
    byId("log-hidden").hidden = !on;
    setFlag(byId("log-filter"), "data-on", on);
    if (on) setText(byId("log-hidden-words"), `${this.#hidden} of ${this.store.log.length} hidden by the filter`);
  }
}

/** @param {string} name */
function select(name) {
  return /** @type {HTMLSelectElement} */ (byId(`log-${name}`));
}

/** @param {string} name @returns {[string, string]} */
const same = (name) => [name, name];

/**
 * @param {HTMLSelectElement} choice
 * @param {[value: string, text: string][]} options
 * @param {string} chosen
 */
function offer(choice, options, chosen) {
  const all = options.some(([value]) => value === chosen) ? options : [...options, same(chosen)];
  choice.replaceChildren(...all.map(([value, text]) => make("option", { value, text })));
  choice.value = chosen;
}

/** @param {Entry} entry */
function item(entry) {
  return make(
    "li", { class: `entry entry-${entry.kind}`, "data-number": entry.number, "data-severity": entry.severity },
    make("time", { text: entry.clock ?? "" }),
    make("span", { class: "entry-sign", "aria-hidden": "true", text: SIGNS[entry.kind] ?? "·" }),
    make("span", { class: "entry-kind", text: entry.kind }),
    make("span", { class: "entry-text", text: entry.text }),
    (entry.count ?? 1) > 1 ? make("span", { class: "entry-count", text: `× ${entry.count}` }) : "",
    entry.mine ? make("span", { class: "entry-mine", text: "you" }) : "",
  );
}
