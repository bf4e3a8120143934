/**
 * The guide for the first minute: at most six steps that point at parts of the page and advance when the thing is done. It has
 * the row above the map, covers neither map nor stops, and takes no focus: robots can be operated meanwhile.
 */

import { byId, setFlag, setText, touched } from "./dom.js";

const KEPT_AS = "guide";
const SEEN = "seen";
const CHECK_MS = 250;

/**
 * @typedef {{selected: number, requested: boolean, stopped: boolean, helped: boolean}} Done  what the operator has done
 * @typedef {{name: string, mouse: string, touch: string, at: string[], done?: (done: Done) => boolean, commands?: boolean}} Step
 *   at: the parts that it points at, of which the first one that can be seen is marked
 */

/** @type {Step[]} */
export const STEPS = [
  {
    name: "select", at: ["#fleet-rows > [role=row]", "#fleet-region", '#tabs [data-tab="fleet"]'], done: ({ selected }) => selected > 0,
    mouse: "Select a robot: click it on the map, or tick it in the table.", touch: "Select a robot: tap it on the map, or tick it in the table.",
  },
  {
    name: "request", at: ["#start", "#behaviour-list .behaviour", '#tabs [data-tab="behaviours"]'], done: ({ requested }) => requested, commands: true,
    mouse: "Ask for a behaviour: choose one, then Start. Or double-click on the ground: it drives there.",
    touch: "Ask for a behaviour: tap one in Behaviour, then Start.",
  },
  {
    name: "stop", at: ["#stop"], done: ({ stopped }) => stopped, commands: true,
    mouse: "Press Stop, or the Space key: all robots stop at once.", touch: "Tap Stop: all robots stop at once.",
  },
  {
    name: "estop", at: ["#estop"], commands: true,
    mouse: "E-stop, or the E key, is for danger. Robots stay off until it is cleared. Do not press it now.",
    touch: "E-stop is for danger. Robots stay off until it is cleared. Do not tap it now.",
  },
  {
    name: "attention", at: ["#attention", '#tabs [data-tab="fleet"]'],
    mouse: "Robots that need attention are named here; click one for the cause and what to do.",
    touch: "Robots that need attention are named here; tap one for the cause and what to do.",
  },
  {
    name: "help", at: ["#help", "#bar-fold"], done: ({ helped }) => helped,
    mouse: "Open the help: it has all keys, and this guide.", touch: "Open the help, ? at the top (on small screens in ☰): it has this guide again.",
  },
];

export class Guide {
  /**
   * @param {{present: import("./store.js").Store, selection: import("./selection.js").Selection,
   *   stops: import("./stops.js").Stops}} parts
   */
  constructor({ present, selection, stops }) {
    this.present = present;
    this.selection = selection;
    this.box = byId("guide");
    byId("guide-next").addEventListener("click", () => this.#go(this.#at + 1));
    byId("guide-close").addEventListener("click", () => this.close());
    byId("guide-again").addEventListener("click", () => this.#again());
    present.on("timeline", ({ offered, recording }) => this.#may(offered && !recording));
    present.on("study", () => this.#may(false));
    present.on("request", ({ mine, phase }) => (this.#done.requested ||= mine && phase !== "refused"));
    stops.on("pressed", (what) => (this.#stopping ||= what === "stop"));
    present.on("stop", () => (this.#done.stopped ||= this.#stopping));
    setInterval(() => this.#check(), CHECK_MS);
  }

  #allowed = false;
  #steps = STEPS;
  #at = 0;
  #stopping = false; // a stop was pressed here: its receipts show that it was received
  #done = { requested: false, stopped: false };
  #marked = /** @type {Element | null} */ (null);

  get open() {
    return !this.box.hidden;
  }

  /** Start at the first step. */
  start() {
    localStorage.setItem(KEPT_AS, SEEN);
    this.#steps = STEPS.filter(({ commands }) => !commands || !this.present.hello?.read_only);
    this.#stopping = false;
    this.#done = { requested: false, stopped: false };
    this.box.hidden = false;
    this.#go(0);
  }

  close() {
    this.box.hidden = true;
    this.#mark(null);
  }

  /**
   * A person who comes for the first time is guided; a study and a recording are not disturbed.
   * @param {boolean} allowed
   */
  #may(allowed) {
    const first = allowed && !this.#allowed;
    this.#allowed = allowed;
    byId("guide-again").hidden = !allowed;
    if (!allowed) return this.close();
    if (first && !this.present.hello?.read_only && localStorage.getItem(KEPT_AS) !== SEEN) this.start();
    return undefined;
  }

  #again() {
    byId("help-close").click();
    this.start();
  }

  /**
   * @param {number} at
   * @param {boolean} [done] the step before was done, not skipped
   */
  #go(at, done = false) {
    this.#at = at;
    const step = this.#steps[at];
    if (!step) return this.close();
    const words = `${done ? "✓ " : ""}${at + 1} of ${this.#steps.length}. ${touched() ? step.touch : step.mouse}`;
    setText(byId("guide-words"), words);
    byId("guide-words").title = words;
    setText(byId("guide-next"), at === this.#steps.length - 1 ? "Done" : "Next");
    setFlag(this.box, "data-step", step.name);
    return this.#point(step);
  }

  #check() {
    if (!this.open) return;
    const step = this.#steps[this.#at];
    const done = { ...this.#done, selected: this.selection.list().length, helped: !byId("help-panel").hidden };
    if (step?.done?.(done)) this.#go(this.#at + 1, true);
    else if (step) this.#point(step);
  }

  /** @param {Step} step */
  #point({ at }) {
    const found = at.map((each) => document.querySelector(each)).find((each) => each?.checkVisibility({ visibilityProperty: true }));
    this.#mark(found ?? null);
  }

  /** @param {Element | null} element */
  #mark(element) {
    if (this.#marked === element) return;
    this.#marked?.removeAttribute("data-guided");
    element?.setAttribute("data-guided", "");
    this.#marked = element;
  }
}
