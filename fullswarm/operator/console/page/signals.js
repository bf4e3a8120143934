/** A sound and a vibration for what must not be missed by those who do not look: an e-stop, a lost link. */

import { byId, setText } from "./dom.js";

const KEPT_AS = "signals";
const LOUD = 0.25;
const RAMP_S = 0.01; // so that a tone does not click

/** @typedef {{tones: [hertz: number, at_s: number, for_s: number][], shake: number[]}} Signal */

/** @type {Record<"estop" | "link", Signal>} */
const SIGNALS = {
  estop: { tones: [[988, 0, 0.14], [988, 0.2, 0.14], [988, 0.4, 0.14]], shake: [200, 80, 200, 80, 200] },
  link: { tones: [[660, 0, 0.18], [440, 0.2, 0.3]], shake: [400] },
};

export class Signals {
  /**
   * @param {import("./store.js").Store} store  the present: the past gives no signal
   * @param {import("./banners.js").Banners} banners
   */
  constructor(store, banners) {
    this.on = localStorage.getItem(KEPT_AS) !== "off"; // on by default, as a safety signal
    this.#still = matchMedia("(prefers-reduced-motion: reduce)");
    byId("signals").addEventListener("click", () => this.#toggle());
    store.on("fleet", ({ robots }) => this.#latched(robots.filter(({ estop }) => estop).length));
    store.on("estop", ({ id, engaged }) => engaged && this.#ordered(id));
    banners.on("level", (level) => this.#linked(level));
    this.#show();
  }

  #still;
  #context = /** @type {AudioContext | null} */ (null);
  #number = /** @type {number | null} */ (null); // of latched robots; null: none has been reported yet
  #order = "";
  #live = false;

  #toggle() {
    this.on = !this.on;
    localStorage.setItem(KEPT_AS, this.on ? "on" : "off");
    this.#show();
    if (this.on) this.#give(SIGNALS.link); // what is switched on is heard at once
  }

  #show() {
    setText(byId("signals"), `Sound: ${this.on ? "on" : "off"}`);
  }

  /**
   * A robot that latches by itself counts as well; those that were latched when the page was opened do not.
   * @param {number} number
   */
  #latched(number) {
    if (this.#number === 0 && number > 0 && !this.#order) this.#give(SIGNALS.estop);
    if (number === 0) this.#order = "";
    this.#number = number;
  }

  /** @param {string} id */
  #ordered(id) {
    if (id === this.#order || this.#number === null) return;
    if (this.#number === 0) this.#give(SIGNALS.estop);
    this.#order = id;
  }

  /** @param {string} level */
  #linked(level) {
    if (this.#live && (level === "old" || level === "hub" || level === "refused")) this.#give(SIGNALS.link);
    if (level !== "start") this.#live = level === "live" || level === "core";
  }

  /**
   * Browsers allow neither before the person has touched the page: there is no signal then, and no complaint.
   * @param {Signal} signal
   */
  #give({ tones, shake }) {
    if (!this.on || !navigator.userActivation?.hasBeenActive) return;
    if (!this.#still.matches) navigator.vibrate?.(shake);
    this.#context ??= new AudioContext();
    const context = this.#context;
    void context.resume();
    for (const [hertz, at_s, for_s] of tones) tone(context, hertz, context.currentTime + at_s, for_s);
  }
}

/**
 * @param {AudioContext} context
 * @param {number} hertz
 * @param {number} at_s
 * @param {number} for_s
 */
function tone(context, hertz, at_s, for_s) {
  const source = new OscillatorNode(context, { frequency: hertz });
  const volume = new GainNode(context, { gain: 0 });
  volume.gain.setValueAtTime(0, at_s);
  volume.gain.linearRampToValueAtTime(LOUD, at_s + RAMP_S);
  volume.gain.setValueAtTime(LOUD, at_s + for_s - RAMP_S);
  volume.gain.linearRampToValueAtTime(0, at_s + for_s);
  source.connect(volume).connect(context.destination);
  source.start(at_s);
  source.stop(at_s + for_s);
}
