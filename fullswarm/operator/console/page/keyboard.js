/** All keys. Stop and e-stop take precedence everywhere; only a text field keeps its letters. */

import { byId, steered, typing } from "./dom.js";

const PAN_PX = 60;
const ARROWS = /** @type {Record<string, [number, number]>} */ ({ ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] });

export class Keyboard {
  /**
   * @param {{map: import("./map.js").SwarmMap, tools: import("./tools.js").Tools,
   *   toolbar: import("./toolbar.js").Toolbar, theme: import("./theme.js").Theme,
   *   selection: import("./selection.js").Selection, stops: import("./stops.js").Stops,
   *   arrows: import("./drive.js").ArrowDrive, past: import("./past.js").Past,
   *   timeBar: import("./timeline.js").TimeBar, help: () => void, debug: () => void, escape: () => void}} parts
   */
  constructor({ map, tools, toolbar, theme, selection, stops, arrows, past, timeBar, help, debug, escape }) {
    this.map = map;
    this.tools = tools;
    this.selection = selection;
    this.stops = stops;
    this.arrows = arrows;
    /** @type {Record<string, () => void>} plain key → its action; the page's help lists them too */
    this.actions = {
      f: () => map.fit(), g: () => tools.use("goal"), o: () => tools.use("formation"), s: () => tools.use("select"), m: () => tools.use("measure"),
      c: () => toolbar.layer("coverage"), t: () => toolbar.layer("trails"), r: () => map.ranges?.toggle(), d: () => theme.toggle(),
      b: () => byId("behaviour-search").focus(),
      "+": () => toolbar.zoom(1.3), "=": () => toolbar.zoom(1.3), "-": () => toolbar.zoom(1 / 1.3),
      "[": () => selection.stepRobot(-1), "]": () => selection.stepRobot(1),
      p: () => timeBar.play(), l: () => past.toLive(), ",": () => past.step(-1), ".": () => past.step(1),
      j: () => timeBar.event(-1), k: () => timeBar.event(1),
      "?": help, "`": debug, Escape: escape,
    };
    addEventListener("keydown", (event) => this.#down(event), { capture: true });
    addEventListener("keyup", (event) => this.#up(event), { capture: true });
  }

  /** @param {KeyboardEvent} event */
  #down(event) {
    if (this.#alarm(event)) return;
    if (event.ctrlKey || event.metaKey) return void this.#control(event);
    if (event.altKey || typing(event.target, true) || steered(event.target)) return;
    if (this.arrows.down(event)) return void event.preventDefault();
    if (event.key === "Enter") return void this.#enter(event);
    if (event.key in ARROWS) return void this.#arrow(event);
    const act = this.actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!act) return;
    event.preventDefault();
    if (!event.repeat) act();
  }

  /**
   * Space and E. A number field needs no spaces, so Space stops there too.
   * @param {KeyboardEvent} event
   */
  #alarm(event) {
    const space = event.code === "Space" && !typing(event.target);
    const e = event.key.toLowerCase() === "e" && !typing(event.target, true);
    if (!space && !e) return false;
    if (e && (event.ctrlKey || event.metaKey || event.altKey)) return false;
    event.preventDefault();
    event.stopPropagation();
    if (event.repeat) return true;
    if (space) this.stops.stop();
    else this.stops.estop();
    return true;
  }

  /** @param {KeyboardEvent} event */
  #up(event) {
    this.arrows.up(event);
    if (event.code !== "Space" || typing(event.target)) return;
    event.preventDefault(); // else a focused button would be clicked as well
    event.stopPropagation();
  }

  /** @param {KeyboardEvent} event */
  #control(event) {
    if (event.key.toLowerCase() !== "a" || typing(event.target, true)) return;
    event.preventDefault();
    this.selection.all();
  }

  /**
   * Space is the stop, so Enter ticks boxes and makes choices.
   * @param {KeyboardEvent} event
   */
  #enter(event) {
    const { target } = event;
    if (target === this.map.live) return this.tools.enter();
    if (!(target instanceof HTMLInputElement) || !["checkbox", "radio"].includes(target.type)) return undefined;
    event.preventDefault();
    return target.click();
  }

  /**
   * On the map: move the crosshair of a tool, else the map itself.
   * @param {KeyboardEvent} event
   */
  #arrow(event) {
    if (event.target !== this.map.live) return;
    event.preventDefault();
    const [dx, dy] = ARROWS[event.key];
    if (!this.tools.nudge(dx, dy, this.map.view.centre)) {
      this.map.view.pan(-dx * PAN_PX, dy * PAN_PX);
      this.map.touch(true);
    }
  }
}
