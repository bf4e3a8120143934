/** Driving by hand: 20 frames a second while the dead-man is held, and none after. */

import { Emitter } from "./emitter.js";
import { short } from "./fleet.js";
import { pressed, readArrows, readPad } from "./padlogic.js";

const RATE_MS = 50;
const POLL_MS = 20;
const BEHAVIOUR = "drive_bc";

/** The stream of frames. Emits "change" with what it does in words. */
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
  #sticks = { linear: 0, angular: 0 };

  get held() {
    return this.#timer !== 0;
  }

  /** Start driving the selection; false, with the reason in words, if that cannot be. */
  begin() {
    if (this.held) return true;
    const robots = this.selection.list();
    if (!this.link.open) return this.#say("not driving: no link");
    if (this.store.hello?.read_only) return this.#say("not driving: this console only shows");
    if (robots.length === 0) return this.#say("not driving: select robots");
    const holders = this.store.heldByOthers(robots);
    if (holders.size) {
      this.commands.emit("question", { holders, take: () => this.commands.lease(robots, true, true) });
      return this.#say(`not driving: held by ${[...new Set(holders.values())].join(", ")}`);
    }
    this.robots = robots;
    this.#timer = setInterval(() => this.#send(), RATE_MS);
    this.#say(`driving ${short(robots, 4)}`);
    this.#send();
    return true;
  }

  /** Set the sticks, -1 to 1; a move is told at once. */
  set(sticks) {
    const moved = sticks.linear !== this.#sticks.linear || sticks.angular !== this.#sticks.angular;
    this.#sticks = { linear: sticks.linear, angular: sticks.angular };
    if (this.held && moved) this.#send();
  }

  /** Let go: the console sends zeros at once. */
  release() {
    this.#end("not driving");
  }

  #end(words) {
    const was = this.held;
    clearInterval(this.#timer);
    this.#timer = 0;
    this.#sticks = { linear: 0, angular: 0 };
    this.robots = [];
    if (!was) return;
    this.link.post({ t: "release" });
    this.#say(words);
  }

  #send() {
    this.link.post({ t: "drive", robots: this.robots, behaviour: BEHAVIOUR, sticks: this.#sticks, fixed: {} });
  }

  #say(words) {
    this.words = words;
    this.emit("change", words);
    return false;
  }
}

/** The browser's gamepad. The dead-man must go down anew after everything that ended the driving. */
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
    addEventListener("gamepaddisconnected", () => this.#poll());
  }

  #timer = 0;
  #before = /** @type {ReturnType<typeof readPad> | null} */ (null);
  #drives = false;

  #plugged(event) {
    this.name = event.gamepad?.id ?? "gamepad";
    this.#before = null;
    if (!this.#timer) this.#timer = setInterval(() => this.#poll(), POLL_MS);
    this.emit("change", this.name);
  }

  #pad() {
    try {
      return [...navigator.getGamepads()].find((pad) => pad && pad.connected !== false && pad.buttons.length > 5) ?? null;
    } catch {
      return null; // the browser forbids it here
    }
  }

  #poll() {
    const pad = this.#pad();
    if (!pad) return this.#unplugged();
    const now = readPad(pad);
    const before = this.#before ?? { ...now, step: now.step }; // what is held already does not count as pressed
    this.#before = now;
    if (now.estop && !before.estop) this.estop();
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

  #unplugged() {
    clearInterval(this.#timer);
    this.#timer = 0;
    this.#before = null;
    if (this.#drives) this.#release();
    this.name = "";
    this.emit("change", "");
  }

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

  #keys = new Set();
  #drives = false;

  /** A key went down; true if it was meant for driving. */
  down(event) {
    if (!event.shiftKey || !event.key.startsWith("Arrow")) return false;
    this.#keys.add(event.key);
    if (!this.#drives && !event.repeat) this.#drives = this.driver.begin();
    if (this.#drives && !this.driver.held) this.#drives = false;
    if (this.#drives) this.driver.set(readArrows(this.#keys));
    return true;
  }

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
