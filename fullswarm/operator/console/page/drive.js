/** Driving by hand: 20 to 30 frames a second while the dead-man is held, and none after. */

import { Emitter } from "./dom.js";
import { short } from "./fleet.js";
import { NOT_REPORTED } from "./selection.js";

/** @import { Answer } from "./link.js" */

const RATE_MS = 50;
const LEAST_MS = 34; // between frames, on average: the console closes pages that send 60 a second for long
const POLL_MS = 20;
const BEHAVIOUR = "drive_bc";
export const DEAD_ZONE = 0.12;
export const SLOW_SHARE = 0.5;
/** The gamepad's buttons by function, in the W3C standard mapping; the sticks' axes are in `readPad`. */
const BUTTON = { estop: 1, deadman: 4, turbo: 5, up: 12, down: 13, left: 14, right: 15 };

/**
 * The stream of frames. Emits "change" with its state in words.
 * @extends {Emitter<{change: string}>}
 */
export class Driver extends Emitter {
  /**
   * @param {{link: import("./link.js").Link, store: import("./store.js").Store,
   *   selection: import("./selection.js").Selection, commands: import("./commands.js").Commands}} parts
   */
  constructor({ link, store, selection, commands }) {
    super();
    this.link = link;
    this.store = store;
    this.selection = selection;
    this.commands = commands;
    this.robots = /** @type {string[]} */ ([]);
    this.words = "not driving";
    selection.on("change", () => this.held && this.release());
    link.on("closed", () => this.#end("not driving: no link"));
    store.on("lost", ({ robots, by }) => {
      if (this.robots.some((id) => robots.includes(id))) this.#end(`not driving: taken over by ${by}`);
    });
  }

  #timer = 0;
  #due_ms = 0; // before it only zeros are sent
  #press = 0; // counts the presses: the answer to an earlier one does not end this one
  #sticks = { linear: 0, angular: 0 };
  #sent = { linear: 0, angular: 0 };

  get held() {
    return this.#timer !== 0;
  }

  /** Start driving the selection; false if that is not possible: then `words` has the reason. */
  begin() {
    if (this.held) return true;
    const robots = this.selection.list();
    if (!this.link.open) return this.#show("not driving: no link");
    if (this.commands.withheld) return this.#show(`not driving: ${this.commands.withheld}`);
    if (this.store.hello?.read_only) return this.#show("not driving: this console is read-only");
    if (this.selection.absent) {
      this.#refused(NOT_REPORTED);
      return this.#show(`not driving: ${NOT_REPORTED}`);
    }
    if (robots.length === 0) return this.#show("not driving: select robots");
    const holders = this.store.heldByOthers(robots);
    if (holders.size) {
      this.commands.emit("question", { holders, take: () => this.commands.lease(robots, true, true) });
      return this.#show(`not driving: held by ${[...new Set(holders.values())].join(", ")}`);
    }
    this.robots = robots;
    this.#press += 1;
    this.#send();
    this.#show(`driving ${short(robots, 4)}`);
    return true;
  }

  /**
   * Set the sticks, -1 to 1; zero is sent at once, any other change as soon as the last frame is old enough.
   * @param {{linear: number, angular: number}} given
   */
  set({ linear, angular }) {
    if (!this.held) return;
    this.#sticks = { linear, angular };
    if (linear === this.#sent.linear && angular === this.#sent.angular) return;
    const wait_ms = this.#due_ms - performance.now();
    if (wait_ms <= 0 || (linear === 0 && angular === 0)) this.#send();
    else this.#sendIn(wait_ms);
  }

  /** Release the dead-man: the console sends zeros at once. */
  release() {
    this.#end("not driving");
  }

  /** @param {string} words */
  #end(words) {
    const was = this.held;
    clearTimeout(this.#timer);
    this.#timer = 0;
    this.#sticks = { linear: 0, angular: 0 };
    this.robots = [];
    if (!was) return;
    this.link.post({ t: "release" });
    this.#show(words);
  }

  #send() {
    const press = this.#press;
    this.#due_ms = Math.max(this.#due_ms, performance.now()) + LEAST_MS;
    this.#sent = this.#sticks;
    const frame = { t: "drive", robots: this.robots, behaviour: BEHAVIOUR, sticks: this.#sticks, fixed: {} };
    this.link.post(frame, (answer) => press === this.#press && this.#onAnswer(answer));
    this.#sendIn(RATE_MS);
  }

  /** @param {number} wait_ms */
  #sendIn(wait_ms) {
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#send(), wait_ms);
  }

  /**
   * A refusal ends driving: the dead-man must be pressed again.
   * @param {Answer} answer
   */
  #onAnswer({ ok, lost, reason }) {
    if (ok || lost || !this.held) return;
    this.#end(`not driving: ${reason}`);
    this.#refused(reason);
  }

  /**
   * Report it also where there is room for a long reason.
   * @param {string | undefined} reason
   */
  #refused(reason) {
    this.commands.emit("refused", { behaviour: BEHAVIOUR, reason });
  }

  /** @param {string} words */
  #show(words) {
    this.words = words;
    this.emit("change", words);
    return false;
  }
}

/**
 * The browser's gamepad: the first one, while it is connected. The dead-man must be pressed again after everything that
 * ended the driving, also when another pad replaces it. The e-stop works on every pad.
 * @extends {Emitter<{change: string}>}
 */
export class Pad extends Emitter {
  /**
   * @param {Driver} driver
   * @param {import("./selection.js").Selection} selection
   * @param {() => void} estop
   */
  constructor(driver, selection, estop) {
    super();
    this.driver = driver;
    this.selection = selection;
    this.estop = estop;
    this.name = "";
    addEventListener("gamepadconnected", (event) => this.#plugged(event));
    addEventListener("gamepaddisconnected", (event) => this.#unplugged(event));
  }

  #timer = 0;
  #index = /** @type {number | null} */ (null);
  #before = /** @type {ReturnType<typeof readPad> | null} */ (null);
  #drives = false;
  #estops = /** @type {Map<number, boolean>} */ (new Map()); // by pad: is its button down?

  /** @param {GamepadEvent} event */
  #plugged({ gamepad }) {
    this.#estops.delete(gamepad.index);
    if (gamepad.index === this.#index) this.#take(null); // another one replaces it
    if (!this.#timer) this.#timer = setInterval(() => this.#poll(), POLL_MS);
    this.#poll();
  }

  /** @param {GamepadEvent} event */
  #unplugged({ gamepad }) {
    if (gamepad.index === this.#index) this.#take(null);
    this.#poll();
  }

  #pads() {
    try {
      return [...navigator.getGamepads()].filter((pad) => !!pad).filter((pad) => pad.connected !== false && pad.buttons.length > 5);
    } catch {
      return []; // the browser denies access
    }
  }

  /**
   * Whether the e-stop of a pad was pressed; one that is held when a pad is connected does not count.
   * @param {Gamepad[]} pads
   */
  #pressesEstop(pads) {
    const before = this.#estops;
    this.#estops = new Map(pads.map((pad) => [pad.index, readPad(pad).estop]));
    return pads.some(({ index }) => this.#estops.get(index) && before.get(index) === false);
  }

  /**
   * Change to another pad, or to none: what is held down on it does not count.
   * @param {Gamepad | null} pad
   */
  #take(pad) {
    if (this.#drives) this.#release();
    this.#before = null;
    this.#index = pad ? pad.index : null;
    this.name = pad ? pad.id || "gamepad" : "";
    this.emit("change", this.name);
  }

  #poll() {
    const pads = this.#pads();
    if (this.#pressesEstop(pads)) this.estop();
    const pad = pads.find(({ index }) => index === this.#index) ?? pads[0] ?? null;
    if ((pad ? pad.index : null) !== this.#index) this.#take(pad);
    if (!pad) return this.#rest();
    const now = readPad(pad);
    const before = this.#before ?? { ...now, step: now.step }; // what is held already does not count as pressed
    this.#before = now;
    if (now.deadman && !before.deadman) this.#drives = this.driver.begin();
    if (this.#drives && !this.driver.held) this.#drives = false;
    if (this.#drives && now.deadman) this.driver.set(now);
    else if (this.#drives) this.#release();
    return this.#step(pressed(before.step, now.step));
  }

  #release() {
    this.#drives = false;
    this.driver.release();
  }

  #rest() {
    clearInterval(this.#timer);
    this.#timer = 0;
  }

  /** @param {string[]} names */
  #step(names) {
    for (const name of names) {
      if (name === "left" || name === "right") this.selection.stepRobot(name === "right" ? 1 : -1);
      else this.selection.stepGroup(name === "down" ? 1 : -1);
    }
  }
}

/** Shift held and arrows: driving without a pad. */
export class ArrowDrive {
  /** @param {Driver} driver */
  constructor(driver) {
    this.driver = driver;
  }

  #keys = /** @type {Set<string>} */ (new Set());
  #drives = false;

  /**
   * A key went down; true if it is for driving.
   * @param {KeyboardEvent} event
   */
  down(event) {
    if (!event.shiftKey || !event.key.startsWith("Arrow")) return false;
    this.#keys.add(event.key);
    if (!this.#drives && !event.repeat) this.#drives = this.driver.begin();
    if (this.#drives && !this.driver.held) this.#drives = false;
    if (this.#drives) this.driver.set(readArrows(this.#keys));
    return true;
  }

  /** @param {KeyboardEvent} event */
  up(event) {
    this.#keys.delete(event.key);
    if (!this.#drives) return;
    if (event.key === "Shift") this.end();
    else this.driver.set(readArrows(this.#keys));
  }

  end() {
    this.#keys.clear();
    if (this.#drives) this.driver.release();
    this.#drives = false;
  }
}

// ---------------------------------------------------------------- inputs
/**
 * Rescale an axis so that it starts from zero at the edge of the dead zone; not a number counts as zero.
 * @param {number} value -1 to 1
 */
export function deadZone(value, zone = DEAD_ZONE) {
  const size = Math.min(1, Math.abs(value));
  if (!(size > zone)) return 0;
  return Math.sign(value) * ((size - zone) / (1 - zone));
}

/**
 * Read one pad.
 * @param {{axes: readonly number[], buttons: readonly {pressed: boolean, value: number}[]}} pad
 */
export function readPad(pad) {
  const down = (/** @type {number} */ index) => Boolean(pad.buttons[index]?.pressed);
  const share = down(BUTTON.turbo) ? 1 : SLOW_SHARE;
  const stick = (/** @type {number} */ index) => -share * deadZone(pad.axes[index] ?? 0) || 0; // || 0: no minus zero
  return {
    deadman: down(BUTTON.deadman),
    turbo: down(BUTTON.turbo),
    estop: down(BUTTON.estop),
    linear: stick(1),
    angular: stick(0),
    step: { left: down(BUTTON.left), right: down(BUTTON.right), up: down(BUTTON.up), down: down(BUTTON.down) },
  };
}

/**
 * Return the names of the d-pad's buttons that went down between two readings.
 * @param {Record<string, boolean> | undefined} before
 * @param {Record<string, boolean>} now
 */
export function pressed(before, now) {
  return Object.keys(now).filter((name) => now[name] && !before?.[name]);
}

/**
 * Convert held arrow keys to sticks.
 * @param {Set<string>} keys
 */
export function readArrows(keys) {
  const axis = (/** @type {string} */ plus, /** @type {string} */ minus) => (Number(keys.has(plus)) - Number(keys.has(minus))) * SLOW_SHARE;
  return { linear: axis("ArrowUp", "ArrowDown"), angular: axis("ArrowLeft", "ArrowRight") };
}
