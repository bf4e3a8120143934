/** The log of requests, refusals, stops and leases; the newest at the bottom. */

import { byId, make } from "./dom.js";

/** @import { Entry } from "./types.d.ts" */

const SIGNS = /** @type {Record<string, string>} */ ({ request: "▸", refused: "✕", stop: "■", estop: "◆", mission: "≡", lease: "●", link: "○", reload: "↻", fault: "⚠" });

export class LogView {
  /** @param {import("./store.js").Store} store */
  constructor(store) {
    this.store = store;
    this.list = byId("log");
    this.kind = /** @type {HTMLSelectElement} */ (byId("log-kind"));
    this.search = /** @type {HTMLInputElement} */ (byId("log-search"));
    this.kind.addEventListener("change", () => this.#all());
    this.search.addEventListener("input", () => this.#all());
    store.on("log", (entry) => (entry ? this.#add(entry) : this.#all()));
    this.#all();
  }

  /** @param {Entry} entry */
  #fits(entry) {
    const words = this.search.value.toLowerCase();
    const kind = this.kind.value;
    if (kind === "mine" ? !entry.mine : kind && entry.kind !== kind) return false;
    return !words || `${entry.text} ${(entry.robots ?? []).join(" ")} ${entry.request_id ?? ""}`.toLowerCase().includes(words);
  }

  #all() {
    const fitting = this.store.log.filter((entry) => this.#fits(entry));
    this.list.replaceChildren(...fitting.map(item));
    if (!fitting.length) {
      const text = this.store.log.length ? "Nothing fits this filter." : "Nothing has happened yet.";
      this.list.append(make("li", { class: "empty", text }));
    }
    this.list.scrollTop = this.list.scrollHeight;
  }

  /** @param {Entry} entry */
  #add(entry) {
    if (!this.#fits(entry)) return;
    const { list } = this;
    list.querySelector(`[data-number="${entry.number}"]`)?.remove(); // the same again: one line with a count
    const atEnd = list.scrollHeight - list.scrollTop - list.clientHeight < 40;
    list.querySelector(".empty")?.remove();
    list.append(item(entry));
    while (list.children.length > 500) list.firstElementChild?.remove();
    if (atEnd) list.scrollTop = list.scrollHeight;
  }
}

/** @param {Entry} entry */
function item(entry) {
  return make(
    "li", { class: `entry entry-${entry.kind}`, "data-number": entry.number },
    make("time", { text: entry.clock ?? "" }),
    make("span", { class: "entry-sign", "aria-hidden": "true", text: SIGNS[entry.kind] ?? "·" }),
    make("span", { class: "entry-kind", text: entry.kind }),
    make("span", { class: "entry-text", text: entry.text }),
    (entry.count ?? 1) > 1 ? make("span", { class: "entry-count", text: `× ${entry.count}` }) : "",
    entry.mine ? make("span", { class: "entry-mine", text: "you" }) : "",
  );
}
