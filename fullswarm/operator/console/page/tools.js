/** What a click or a drag on the map means now: select, set a goal, lay a formation, or pick a point for a form. */

import { Emitter } from "./emitter.js";
import { lassoed, places } from "./geometry.js";
import { UNHEARD } from "./selection.js";

/** @import { Placed } from "./robots.js" */
/** @import { Point } from "./types.d.ts" */

export const STEP_M = 0.25;

/**
 * @typedef {"select" | "goal" | "formation" | "pick"} Mode
 */

/**
 * Emits "change" when another tool is taken, "draw" when its picture changed.
 * @extends {Emitter<{change: undefined, draw: undefined}>}
 */
export class Tools extends Emitter {
  /**
   * @param {{store: import("./store.js").Store, selection: import("./selection.js").Selection,
   *   commands: import("./commands.js").Commands, tell: (words: string) => void}} parts
   */
  constructor({ store, selection, commands, tell }) {
    super();
    this.store = store;
    this.selection = selection;
    this.commands = commands;
    this.tell = tell;
    this.mode = /** @type {Mode} */ ("select");
    this.shape = /** @type {"ring" | "line" | "grid"} */ ("ring");
    this.lasso = /** @type {Point[]} */ ([]);
    this.drag = /** @type {{from: Point, to: Point} | null} */ (null);
    this.picked = /** @type {Point[]} */ ([]);
  }

  cursor = /** @type {Point | null} */ (null); // keyboard
  #pick = /** @type {((point: Point) => boolean) | null} */ (null);

  /**
   * Take a tool; goal and formation want robots.
   * @param {Mode} mode
   */
  use(mode) {
    if ((mode === "goal" || mode === "formation") && this.#meant().length === 0) return;
    if (this.mode === "pick" && mode !== "pick") this.#pick = null;
    this.mode = mode;
    this.lasso = [];
    this.drag = null;
    this.cursor = null;
    this.picked = [];
    this.emit("change");
  }

  /**
   * Let the next clicks go to `onPoint` instead; it returns whether it wants more.
   * @param {Point[]} points
   * @param {(point: Point) => boolean} onPoint
   */
  pick(points, onPoint) {
    this.use("pick");
    this.picked = points;
    this.#pick = onPoint;
    this.emit("change");
  }

  /**
   * A click on a robot or on the ground.
   * @param {Point} point
   * @param {{id: string} | null} robot
   * @param {boolean} extend
   */
  click(point, robot, extend) {
    if (this.mode === "goal") return this.goal(point);
    if (this.mode === "pick") return this.#picked(point);
    if (this.mode !== "select" || !robot) return undefined;
    return extend ? this.selection.toggle(robot.id) : this.selection.set([robot.id]);
  }

  /**
   * Send the selection to a point.
   * @param {Point} point
   */
  goal(point) {
    const robots = this.#meant();
    if (robots.length === 0) return;
    this.commands.goal(robots, point);
    this.use("select");
  }

  /** Return who an order is for; if it is nobody, say why. */
  #meant() {
    const robots = this.selection.list();
    if (this.selection.unheard) this.tell(`Not sent: ${UNHEARD}.`);
    else if (robots.length === 0) this.tell("Select robots first: click, lasso, or Ctrl+A for all.");
    return robots;
  }

  /** @param {Point} point */
  dragFrom(point) {
    if (this.mode === "select") this.lasso = [point];
    else if (this.mode === "formation") this.drag = { from: point, to: point };
  }

  /** @param {Point} point */
  dragTo(point) {
    if (this.mode === "select") this.lasso.push(point);
    else if (this.drag) this.drag = { from: this.drag.from, to: point };
    this.emit("draw");
  }

  /**
   * @param {Placed[]} robots
   * @param {boolean} extend
   */
  dragEnd(robots, extend) {
    if (this.mode === "select" && this.lasso.length > 2) {
      const ids = lassoed(robots, this.lasso);
      if (extend) this.selection.add(ids);
      else this.selection.set(ids);
    } else if (this.drag) {
      const robots = this.#meant();
      if (robots.length) this.commands.formation(robots, this.places());
      this.use("select");
    }
    this.dragCancel();
  }

  dragCancel() {
    this.lasso = [];
    this.drag = null;
    this.emit("draw");
  }

  /** Return the places of the formation that is being dragged. */
  places() {
    if (!this.drag) return [];
    return places(this.shape, this.drag.from, this.drag.to, this.selection.list().length);
  }

  /**
   * Move the keyboard's crosshair; false if no tool wants one.
   * @param {number} dx
   * @param {number} dy
   * @param {Point} start
   */
  nudge(dx, dy, start) {
    if (this.mode === "select") return false;
    const [x, y] = this.cursor ?? start;
    this.cursor = [x + dx * STEP_M, y + dy * STEP_M];
    if (this.drag) this.drag = { from: this.drag.from, to: this.cursor };
    this.emit("draw");
    return true;
  }

  /** Enter at the crosshair: a click; for a formation first its middle, then its edge. */
  enter() {
    if (!this.cursor) return;
    if (this.mode !== "formation") this.click(this.cursor, null, false);
    else if (this.drag) this.dragEnd([], false);
    else this.drag = { from: this.cursor, to: this.cursor };
    this.emit("draw");
  }

  /** @param {Point} point */
  #picked(point) {
    this.picked = [...this.picked, point];
    if (!this.#pick?.(point)) this.use("select");
    this.emit("draw");
  }
}
