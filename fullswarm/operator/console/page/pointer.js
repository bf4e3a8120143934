/** Mouse, pen and fingers on the map. */

import { robotAt } from "./geometry.js";

/** @import { Placed } from "./robots.js" */

const DRAG_PX = 5;
const REACH_PX = 12;
const DOUBLE_MS = 350;
const DOUBLE_PX = 14;

/** @typedef {{x: number, y: number}} Place CSS pixels in the map */

export class Pointer {
  /**
   * @param {import("./map.js").SwarmMap} map
   * @param {import("./tools.js").Tools} tools
   */
  constructor(map, tools) {
    this.map = map;
    this.tools = tools;
    const canvas = map.live;
    canvas.addEventListener("pointerdown", (event) => this.#down(event));
    canvas.addEventListener("pointermove", (event) => this.#move(event));
    canvas.addEventListener("pointerup", (event) => this.#up(event));
    canvas.addEventListener("pointercancel", (event) => this.#cancel(event));
    canvas.addEventListener("pointerleave", () => this.#hover(null));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
  }

  #held = /** @type {Map<number, Place>} */ (new Map());
  #doing = /** @type {"none" | "press" | "drag" | "pan" | "pinch"} */ ("none");
  #start = { x: 0, y: 0 };
  #lastClick = { x: 0, y: 0, ms: 0 };

  /** @param {MouseEvent} event */
  #place(event) {
    const corner = this.map.live.getBoundingClientRect();
    return { x: event.clientX - corner.left, y: event.clientY - corner.top };
  }

  /** @param {Place} place */
  #world({ x, y }) {
    return this.map.view.toWorld(x, y);
  }

  /** @param {Place} place */
  #robot(place) {
    return robotAt(this.map.placed, this.#world(place), REACH_PX / this.map.view.scale);
  }

  /** @param {PointerEvent} event */
  #down(event) {
    const place = this.#place(event);
    this.#held.set(event.pointerId, place);
    this.map.live.setPointerCapture(event.pointerId);
    this.map.live.focus({ preventScroll: true });
    if (this.#held.size === 2) {
      this.tools.dragCancel();
      this.#doing = "pinch";
    } else if (event.button === 0) {
      this.#doing = "press";
      this.#start = place;
    } else {
      this.#doing = "pan";
    }
    event.preventDefault();
  }

  /** @param {PointerEvent} event */
  #move(event) {
    const before = this.#held.get(event.pointerId);
    const place = this.#place(event);
    if (!before) return this.#hover(place);
    if (this.#doing === "pinch") this.#pinch(event.pointerId, place);
    else if (this.#doing === "pan") this.#pan(before, place);
    else if (this.#doing === "press") this.#maybeDrag(place);
    else if (this.#doing === "drag") this.tools.dragTo(this.#world(place));
    this.#held.set(event.pointerId, place);
    return this.map.touch();
  }

  /** @param {Place} place */
  #maybeDrag(place) {
    if (Math.hypot(place.x - this.#start.x, place.y - this.#start.y) < DRAG_PX) return;
    if (this.tools.mode === "goal" || this.tools.mode === "pick") return; // a click that trembles
    this.#doing = "drag";
    this.tools.dragFrom(this.#world(this.#start));
    this.tools.dragTo(this.#world(place));
  }

  /**
   * @param {Place} before
   * @param {Place} place
   */
  #pan(before, place) {
    this.map.view.pan(place.x - before.x, place.y - before.y);
    this.map.touch(true);
  }

  /**
   * @param {number} id
   * @param {Place} place
   */
  #pinch(id, place) {
    const other = [...this.#held].find(([each]) => each !== id)?.[1];
    const before = this.#held.get(id);
    if (!other || !before) return;
    const wide = (/** @type {Place} */ a, /** @type {Place} */ b) => Math.max(1, Math.hypot(a.x - b.x, a.y - b.y));
    const middle = { x: (place.x + other.x) / 2, y: (place.y + other.y) / 2 };
    this.map.view.pan((place.x - before.x) / 2, (place.y - before.y) / 2);
    this.map.view.zoomAt(wide(place, other) / wide(before, other), middle.x, middle.y);
    this.map.touch(true);
  }

  /** @param {PointerEvent} event */
  #up(event) {
    const place = this.#place(event);
    this.#held.delete(event.pointerId);
    if (this.#doing === "press") this.#click(place, event);
    else if (this.#doing === "drag") this.tools.dragEnd(this.map.placed, event.shiftKey);
    if (this.#doing === "pinch" && this.#held.size > 0) return; // the other finger still lies there
    this.#doing = "none";
    this.map.touch();
  }

  /**
   * @param {Place} place
   * @param {PointerEvent} event
   */
  #click(place, event) {
    const robot = this.#robot(place);
    const { x, y, ms } = this.#lastClick;
    const near = Math.hypot(place.x - x, place.y - y) < DOUBLE_PX;
    const twice = near && event.timeStamp - ms < DOUBLE_MS;
    this.#lastClick = { ...place, ms: twice ? 0 : event.timeStamp };
    if (twice && this.tools.mode === "select") this.#twice(place, robot);
    else this.tools.click(this.#world(place), robot, event.shiftKey || event.ctrlKey || event.metaKey);
  }

  /**
   * A double click on the ground is a goal, on a robot it opens its details.
   * @param {Place} place
   * @param {Placed | null} robot
   */
  #twice(place, robot) {
    if (robot) this.tools.open(robot.id);
    else this.tools.goal(this.#world(place));
  }

  /** @param {PointerEvent} event */
  #cancel(event) {
    this.#held.delete(event.pointerId);
    this.#doing = "none";
    this.tools.dragCancel();
  }

  /** @param {Place | null} place */
  #hover(place) {
    const robot = place ? this.#robot(place) : null;
    if (this.map.hovered === (robot?.id ?? null)) return;
    this.map.hovered = robot?.id ?? null;
    this.map.live.title = robot ? hoverText(robot) : "";
    this.map.touch();
  }

  /** @param {WheelEvent} event */
  #wheel(event) {
    event.preventDefault();
    const { x, y } = this.#place(event);
    const lines = event.deltaMode === 1 ? 16 : 1;
    this.map.view.zoomAt(Math.exp(-event.deltaY * lines * 0.0015), x, y);
    this.map.touch(true);
  }
}

/** @param {Placed} placed */
function hoverText({ id, info }) {
  const memory = info.memory && `remembers ${info.memory}`;
  const pose = info.pose_by && `pose by ${info.pose_by}`;
  const parts = [id, info.state, info.behaviour, memory, info.filter_note, info.advice, pose];
  return parts.filter(Boolean).join("\n");
}
