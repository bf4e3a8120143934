/** The tools of the map, and how they are drawn: select, goal, formation, measure, or pick a point for a form. */

import { Emitter } from "./dom.js";
import { assign, lassoed, places } from "./geometry.js";
import { NOT_REPORTED } from "./selection.js";

/** @import { Scene } from "./ground.js" */
/** @import { Placed } from "./robots.js" */
/** @import { Selection } from "./selection.js" */
/** @import { Point } from "./types.d.ts" */

export const STEP_M = 0.25;
const PREVIEWED = 40; // robots; more would make the drag stutter

/**
 * @typedef {"select" | "goal" | "formation" | "measure" | "pick"} Mode
 */

/**
 * Emits "change" when another tool is taken, "draw" when its picture changed, "open" for the details of a robot.
 * @extends {Emitter<{change: undefined, draw: undefined, open: string}>}
 */
export class Tools extends Emitter {
  /**
   * @param {{store: import("./store.js").Store, selection: import("./selection.js").Selection,
   *   commands: import("./commands.js").Commands, hint: (words: string) => void}} parts
   */
  constructor({ store, selection, commands, hint }) {
    super();
    this.store = store;
    this.selection = selection;
    this.commands = commands;
    this.hint = hint;
    this.mode = /** @type {Mode} */ ("select");
    this.shape = /** @type {"ring" | "line" | "grid"} */ ("ring");
    this.lasso = /** @type {Point[]} */ ([]);
    this.drag = /** @type {{from: Point, to: Point} | null} */ (null);
    this.picked = /** @type {Point[]} */ ([]);
    this.route = /** @type {Point[] | null} */ (null); // of the mission that is being made, if there is one
    this.ruler = /** @type {{from: Point, to: Point} | null} */ (null);
  }

  cursor = /** @type {Point | null} */ (null); // keyboard
  #rulerOpen = false; // its first end was set by a click, the second one is to come
  #pick = /** @type {((point: Point) => boolean) | null} */ (null);

  /**
   * Take a tool; goal and formation want robots.
   * @param {Mode} mode
   */
  use(mode) {
    if ((mode === "goal" || mode === "formation") && this.#addressed().length === 0) return;
    if (this.mode === "pick" && mode !== "pick") this.#pick = null;
    this.mode = mode;
    this.lasso = [];
    this.drag = null;
    this.cursor = null;
    this.picked = [];
    this.ruler = null;
    this.#rulerOpen = false;
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
   * Return whether the next click goes to `onPoint`.
   * @param {(point: Point) => boolean} onPoint
   */
  picksFor(onPoint) {
    return this.mode === "pick" && this.#pick === onPoint;
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
    if (this.mode === "measure") return this.#measure(point);
    if (this.mode !== "select" || !robot) return undefined;
    return extend ? this.selection.toggle(robot.id) : this.selection.set([robot.id]);
  }

  /**
   * Send the selection to a point.
   * @param {Point} point
   */
  goal(point) {
    const robots = this.#addressed();
    if (robots.length === 0) return;
    this.commands.goal(robots, point);
    this.use("select");
  }

  /** Return the robots that an order is for; if there are none, show why. */
  #addressed() {
    const robots = this.selection.list();
    if (this.selection.absent) this.hint(`Not sent: ${NOT_REPORTED}.`);
    else if (robots.length === 0) this.hint("Select robots first: click, lasso, or Ctrl+A for all.");
    return robots;
  }

  /** @param {Point} point */
  dragFrom(point) {
    if (this.mode === "select") this.lasso = [point];
    else if (this.mode === "formation") this.drag = { from: point, to: point };
    else if (this.mode === "measure") this.ruler = { from: point, to: point };
  }

  /** @param {Point} point */
  dragTo(point) {
    if (this.mode === "select") this.lasso.push(point);
    else if (this.drag) this.drag = { from: this.drag.from, to: point };
    else if (this.mode === "measure" && this.ruler) this.ruler = { from: this.ruler.from, to: point };
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
      const robots = this.#addressed();
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
    if (this.#rulerOpen && this.ruler) this.ruler = { from: this.ruler.from, to: this.cursor };
    this.emit("draw");
    return true;
  }

  /**
   * Ask for the details of a robot.
   * @param {string} id
   */
  open(id) {
    this.emit("open", id);
  }

  /** Enter at the crosshair: a click; for a formation first its middle, then its edge. Without a tool: details. */
  enter() {
    const [first] = this.selection.list();
    if (this.mode === "select" && first) return this.open(first);
    if (!this.cursor) return;
    if (this.mode !== "formation") this.click(this.cursor, null, false);
    else if (this.drag) this.dragEnd([], false);
    else this.drag = { from: this.cursor, to: this.cursor };
    this.emit("draw");
  }

  /**
   * The first click begins a measurement, the second one ends it; dragging does both.
   * @param {Point} point
   */
  #measure(point) {
    this.ruler = { from: this.#rulerOpen && this.ruler ? this.ruler.from : point, to: point };
    this.#rulerOpen = !this.#rulerOpen;
    this.emit("draw");
  }

  /** @param {Point} point */
  #picked(point) {
    this.picked = [...this.picked, point];
    if (!this.#pick?.(point)) this.use("select");
    this.emit("draw");
  }
}

// ---------------------------------------------------------------- drawing
/**
 * Draw the tool over the robots; CSS pixels.
 * @param {Scene} scene
 * @param {Tools} tool
 * @param {Placed[]} placed
 * @param {Selection} selection
 */
export function drawTool(scene, tool, placed, selection) {
  if (tool.lasso.length > 1) drawLasso(scene, tool.lasso);
  if (tool.drag) drawFormation(scene, tool, placed, selection);
  if (tool.ruler) drawRuler(scene, tool.ruler);
  if (tool.route) drawRoute(scene, tool.route);
  for (const [k, point] of (tool.route ?? tool.picked).entries()) drawPicked(scene, point, String(k + 1));
  if (tool.cursor) drawCrosshair(scene, tool.cursor);
}

/**
 * @param {Scene} scene
 * @param {Point[]} lasso
 */
function drawLasso({ context, view, colours }, lasso) {
  context.beginPath();
  for (const [x, y] of lasso) context.lineTo(...view.toScreen(x, y));
  context.closePath();
  context.fillStyle = colours.lasso;
  context.fill();
  context.strokeStyle = colours.select;
  context.lineWidth = 2;
  context.setLineDash([6, 4]);
  context.stroke();
  context.setLineDash([]);
}

/**
 * @param {Scene} scene
 * @param {Tools} tool
 * @param {Placed[]} placed
 * @param {Selection} selection
 */
function drawFormation({ context, view, colours, store }, tool, placed, selection) {
  const targets = tool.places();
  const ids = selection.list();
  const robots = ids.flatMap((id) => placed.find((robot) => robot.id === id) ?? []);
  context.strokeStyle = colours.goal;
  context.lineWidth = 2;
  for (const [k, [x, y]] of targets.entries()) {
    context.beginPath();
    context.arc(...view.toScreen(x, y), Math.max(5, store.radius(ids[k]) * view.scale), 0, 2 * Math.PI);
    context.stroke();
  }
  if (targets.length > PREVIEWED || robots.length < ids.length) return;
  const given = assign(robots.map(({ x, y }) => [x, y]), targets);
  context.globalAlpha = 0.5;
  context.setLineDash([2, 5]);
  context.beginPath();
  for (const [k, robot] of robots.entries()) {
    context.moveTo(robot.px, robot.py);
    context.lineTo(...view.toScreen(...given[k]));
  }
  context.stroke();
  context.setLineDash([]);
  context.globalAlpha = 1;
}

/**
 * @param {Scene} scene
 * @param {{from: Point, to: Point}} ruler
 */
function drawRuler({ context, view, colours }, { from, to }) {
  const [x0, y0] = view.toScreen(...from), [x1, y1] = view.toScreen(...to);
  context.strokeStyle = colours.goal;
  context.fillStyle = colours.goal;
  context.lineWidth = 2;
  context.beginPath();
  context.moveTo(x0, y0);
  context.lineTo(x1, y1);
  context.stroke();
  for (const [x, y] of [[x0, y0], [x1, y1]]) {
    context.beginPath();
    context.arc(x, y, 4, 0, 2 * Math.PI);
    context.fill();
  }
  const words = rulerWords(from, to);
  context.font = "600 14px system-ui, sans-serif";
  const wide = context.measureText(words).width;
  const left = Math.max(4, Math.min(view.width - wide - 12, (x0 + x1 - wide) / 2)), top = Math.max(4, (y0 + y1) / 2 - 30);
  context.fillStyle = colours.floor;
  context.fillRect(left, top, wide + 8, 22);
  context.fillStyle = colours.ink;
  context.fillText(words, left + 4, top + 16);
}

/**
 * Return a measured distance in words: its length, and along each axis.
 * @param {Point} from
 * @param {Point} to
 */
export function rulerWords([x0, y0], [x1, y1]) {
  const metres = (/** @type {number} */ value) => value.toFixed(Math.abs(value) < 100 ? 2 : 1).replace("-", "−");
  return `${metres(Math.hypot(x1 - x0, y1 - y0))} m (x ${metres(x1 - x0)}, y ${metres(y1 - y0)})`;
}

/**
 * @param {Scene} scene
 * @param {Point[]} route
 */
function drawRoute({ context, view, colours }, route) {
  context.strokeStyle = colours.goal;
  context.lineWidth = 2;
  context.setLineDash([8, 6]);
  context.beginPath();
  for (const point of route) context.lineTo(...view.toScreen(...point));
  context.stroke();
  context.setLineDash([]);
}

/**
 * @param {Scene} scene
 * @param {Point} point
 * @param {string} words
 */
function drawPicked({ context, view, colours }, point, words) {
  const [x, y] = view.toScreen(...point);
  context.fillStyle = colours.goal;
  context.beginPath();
  context.arc(x, y, 5, 0, 2 * Math.PI);
  context.fill();
  context.font = "600 14px system-ui, sans-serif";
  context.fillText(words, x + 8, y - 6);
}

/**
 * @param {Scene} scene
 * @param {Point} point
 */
function drawCrosshair({ context, view, colours }, point) {
  const [x, y] = view.toScreen(...point);
  context.strokeStyle = colours.goal;
  context.lineWidth = 2;
  context.beginPath();
  context.arc(x, y, 10, 0, 2 * Math.PI);
  for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    context.moveTo(x + dx * 5, y + dy * 5);
    context.lineTo(x + dx * 18, y + dy * 18);
  }
  context.stroke();
}
