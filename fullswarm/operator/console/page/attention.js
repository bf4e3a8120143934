/**
 * The strip above the table that names the robots which need attention. It is of one height, whatever it says, and what
 * is in it stays where it is while a pointer or the focus is there.
 */

import { byId, make, setFlag, setText } from "./dom.js";

/** @import { Robot } from "./types.d.ts" */

/**
 * Return what to list: those listed before keep their places, new ones are added at the end. Those that are no longer
 * wanted are removed, unless the list is `held`, because a pointer is on its way to one of them.
 * @param {string[]} listed
 * @param {string[]} wanted in the order in which new ones are added
 * @param {boolean} held
 * @returns {string[]}
 */
export function steady(listed, wanted, held) {
  const stay = held ? listed : listed.filter((id) => wanted.includes(id));
  return [...stay, ...wanted.filter((id) => !stay.includes(id))];
}

/**
 * Whether a robot needs attention.
 * @param {Partial<Robot>} robot
 */
export function needsAttention({ attention, silent }) {
  return Boolean(attention || silent);
}

/**
 * Say in a sentence or two what is wrong with a robot and what to do.
 * @param {Partial<Robot>} robot
 */
export function troubleText({ state_why: why = "", fault = "", state_word: word = "", advice = "" }) {
  const reason = why || fault || word;
  return [reason && `${reason[0].toUpperCase()}${reason.slice(1).replace(/[.]$/, "")}.`, advice].filter(Boolean).join(" ");
}

export class AttentionStrip {
  /**
   * @param {{store: import("./store.js").Store, selection: import("./selection.js").Selection,
   *   reveal: (id: string) => void, filter: (only: boolean) => void}} parts
   */
  constructor({ store, selection, reveal, filter }) {
    this.store = store;
    this.selection = selection;
    this.reveal = reveal;
    this.strip = byId("attention");
    this.list = byId("attention-list");
    const only = byId("attention-only");
    only.addEventListener("click", () => {
      const pressed = only.getAttribute("aria-pressed") !== "true";
      setFlag(only, "aria-pressed", pressed);
      filter(pressed);
    });
    for (const topic of /** @type {const} */ (["fleet", "robots"])) store.on(topic, () => this.#show());
    selection.on("change", () => this.#show());
    for (const event of ["pointerleave", "focusout"]) this.strip.addEventListener(event, () => this.#show());
    this.#show();
  }

  #listed = /** @type {string[]} */ ([]);
  #chips = /** @type {Map<string, HTMLButtonElement>} */ (new Map());

  #show() {
    const wanted = this.store.ids().filter((id) => needsAttention(this.store.info(id)));
    const held = this.strip.matches(":hover") || this.strip.contains(document.activeElement);
    this.#listed = steady(this.#listed, wanted, held);
    this.#fill(wanted);
    const count = wanted.length;
    setText(byId("attention-count"), count ? `${count} need${count === 1 ? "s" : ""} attention` : "None needs attention");
    setFlag(this.strip, "data-any", count > 0);
    const about = this.selection.list().find((id) => wanted.includes(id)) ?? wanted[0];
    const words = about ? `${about}: ${troubleText(this.store.info(about))}` : "";
    setText(byId("attention-words"), words);
    byId("attention-words").title = words;
  }

  /** @param {string[]} wanted */
  #fill(wanted) {
    for (const [id, chip] of this.#chips) {
      if (this.#listed.includes(id)) continue;
      chip.remove();
      this.#chips.delete(id);
    }
    for (const id of this.#listed) {
      const chip = this.#chip(id);
      const over = !wanted.includes(id);
      setText(chip, `${id} ${over ? "well again" : (this.store.info(id).brief ?? "")}`.trim());
      setFlag(chip, "data-over", over);
    }
  }

  /** @param {string} id */
  #chip(id) {
    const known = this.#chips.get(id);
    if (known) return known;
    const chip = make("button", {
      type: "button", class: "chip attention-chip", testid: `attention-${id}`, on: { click: () => this.#choose(id) },
    });
    this.#chips.set(id, chip);
    this.list.append(chip);
    return chip;
  }

  /** @param {string} id */
  #choose(id) {
    this.selection.set([id]);
    this.reveal(id);
  }
}
