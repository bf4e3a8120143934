/** Draws what moves: robots with their state, goals, the filter's arrows, sensing radii. CSS pixels. */

import { LINE_FROM_PX, LabelLayout, levelOfDetail } from "./labels.js";
import { seconds } from "./link.js";
import { actuatorText, kindOf, lampColour } from "./palette.js";
import { outline } from "./sprites.js";

/** @import { Scene } from "./ground.js" */
/** @import { Colours } from "./palette.js" */
/** @import { Selection } from "./selection.js" */
/** @import { Store } from "./store.js" */
/** @import { Point, Robot } from "./types.d.ts" */
/** @import { Viewport } from "./viewport.js" */

const LEAST_RADIUS_PX = 7;
const LEAST_LAMP_PX = 3.5;
const ARROW_PX_PER_M_S = 90;
const FEW = 3; // so many selected robots have their reasons beside them; of more only the one that is pointed at
const MOST_LABELS = 200;
const MANY = 8; // of more alarms than these none goes far from its robot, and each is its robot's name alone
const MARK_PX = 11;
const RING_PX = 8;
const STOP_SIGN_PX = 6;

/** Which label gets its place first. */
const RANK = { hovered: 0, alarm: 1, selected: 2, other: 3, words: 4, mark: 5 };

/**
 * @typedef {{id: string, x: number, y: number, px: number, py: number, heading: number, radius: number,
 *   radius_px: number, info: Partial<Robot>, kind: {shape: string, letter: string}}} Placed
 *   a robot where it is drawn now
 * @typedef {{x: number, y: number, place: boolean, radius_m: number | null}} Flag  CSS pixels; place: of a formation
 * @typedef {import("./labels.js").Label & {words: string, size: number, ink: string, bold: boolean}} Text
 */

/** The robots of the map: where each is in this frame, and their picture. Its lists are the same ones in each frame. */
export class RobotLayer {
  constructor() {
    this.placed = /** @type {Placed[]} */ ([]);
    this.labels = /** @type {Text[]} */ ([]);
  }

  #known = /** @type {Map<string, Placed>} */ (new Map());
  #fleet = /** @type {unknown} */ (null);
  #mixed = false;
  #pose = [0, 0, 0, 0];
  #layout = new LabelLayout();
  #discs = /** @type {import("./labels.js").Disc[]} */ ([]);
  #discCount = 0;
  #spare = /** @type {Text[]} */ ([]);
  #many = false; // alarms

  /**
   * Place every robot for this frame.
   * @param {Store} store
   * @param {Viewport} view
   * @param {number} at_s
   */
  place(store, view, at_s) {
    const renewed = this.#fleet !== store.fleet;
    this.#fleet = store.fleet;
    this.placed.length = 0;
    for (const [id, track] of store.tracks) {
      const pose = track.pose(at_s, this.#pose);
      if (!pose) continue;
      const robot = this.#robot(id, store, renewed);
      [robot.x, robot.y, robot.heading] = pose;
      [robot.px, robot.py] = view.toScreen(robot.x, robot.y);
      robot.radius_px = Math.max(LEAST_RADIUS_PX, robot.radius * view.scale);
      this.placed.push(robot);
    }
    if (renewed) this.#forget(store);
  }

  /**
   * @param {string} id
   * @param {Store} store
   * @param {boolean} renewed
   */
  #robot(id, store, renewed) {
    let robot = this.#known.get(id);
    if (robot && !renewed) return robot;
    const info = store.info(id);
    const kind = kindOf(info.make, info.driver, store.icons);
    if (!robot) {
      robot = { id, x: 0, y: 0, px: 0, py: 0, heading: 0, radius: 0, radius_px: 0, info, kind };
      this.#known.set(id, robot);
    }
    return Object.assign(robot, { info, kind, radius: store.radius(id) });
  }

  /** @param {Store} store */
  #forget(store) {
    for (const id of this.#known.keys()) if (!store.tracks.has(id)) this.#known.delete(id);
    this.#mixed = this.placed.some(({ kind }) => kind.letter !== this.placed[0].kind.letter);
  }

  /**
   * Draw all robots, and above them the labels.
   * @param {Scene} scene
   * @param {Selection} selection
   * @param {string | null} hovered
   * @param {{mark: Placed, words: string, matters: boolean}[]} marks  others that have a label
   */
  draw(scene, selection, hovered, marks) {
    const few = selection.ids.size <= FEW;
    for (const robot of this.placed) {
      const chosen = selection.has(robot.id);
      if (chosen && (robot.id === hovered || selection.ids.size === 1)) drawSensing(scene, robot);
    }
    for (const robot of this.placed) drawFilter(scene, robot);
    for (const robot of this.placed) {
      drawRobot(scene, robot, selection.has(robot.id));
      drawLamp(scene, robot);
    }
    this.#discCount = 0;
    this.#spare.push(...this.labels);
    this.labels.length = 0;
    let alarms = 0;
    for (const { info } of this.placed) if (isAlarm(info)) alarms += 1;
    this.#many = alarms > MANY;
    for (const robot of this.placed) {
      const chosen = selection.has(robot.id);
      this.#bodies(robot, chosen && few);
      this.#wanted(scene, robot, chosen, few, robot.id === hovered);
    }
    for (const { mark, words, matters } of marks) {
      this.#bodies(mark, false);
      if (words && this.labels.length < MOST_LABELS) this.#text(scene, mark, "", words, matters ? RANK.selected : RANK.mark, 13, scene.colours.ink, matters);
    }
    this.#layout.place(this.labels, this.#discs, this.#discCount, scene.view);
    for (const label of this.labels) if (label.shown) drawText(scene, label);
  }

  /**
   * Note what labels must not cover: the robot, the signs on it, and its ring if it is one of a few that are selected.
   * @param {Placed} robot
   * @param {boolean} ring
   */
  #bodies({ px, py, radius_px, info }, ring) {
    this.#disc(px, py, radius_px + (info.estop ? STOP_SIGN_PX : ring ? RING_PX : 1));
    const marked = !info.estop && (info.silent || info.attention);
    if (marked) this.#disc(px - radius_px - 3, py - radius_px - 4, MARK_PX);
  }

  /**
   * @param {number} x
   * @param {number} y
   * @param {number} reach
   */
  #disc(x, y, reach) {
    const disc = this.#discs[this.#discCount] ?? (this.#discs[this.#discCount] = { x: 0, y: 0, reach: 0 });
    [disc.x, disc.y, disc.reach] = [x, y, reach];
    this.#discCount += 1;
  }

  /**
   * Add the labels of a robot, as far as they are wanted at this size.
   * @param {Scene} scene
   * @param {Placed} robot
   * @param {boolean} chosen
   * @param {boolean} few
   * @param {boolean} hovered
   */
  #wanted(scene, robot, chosen, few, hovered) {
    const { info } = robot;
    const { view, store, colours } = scene;
    if (this.labels.length >= MOST_LABELS || robot.px < -50 || robot.py < -50 || robot.px > view.width + 50 || robot.py > view.height + 50) return;
    const level = levelOfDetail(robot.radius * view.scale);
    const alarm = isAlarm(info);
    const close = hovered || (chosen && few);
    if (level === "alarms" && !alarm && !close) return;
    const rank = hovered ? RANK.hovered : alarm ? RANK.alarm : chosen ? RANK.selected : RANK.other;
    const ink = info.estop || info.silent ? colours.alarm : colours.ink;
    const words = (level === "all" && !(alarm && this.#many)) || close ? labelWords(robot, this.#mixed) : robot.id;
    this.#text(scene, robot, "", words, rank, close ? 15 : 13, ink, close);
    if (!close) return;
    const reason = store.filter.get(robot.id)?.[2];
    if (reason) this.#text(scene, robot, " filter", reason, RANK.words, 13, colours.filter, false);
    const actuators = actuatorText(info);
    if (actuators) this.#text(scene, robot, " parts", actuators, RANK.words, 13, colours.ink, false);
  }

  /**
   * @param {Scene} scene
   * @param {Placed} robot
   * @param {string} part
   * @param {string} words
   * @param {number} rank
   * @param {number} size
   * @param {string} ink
   * @param {boolean} bold
   */
  #text({ sprites, colours, dpr }, robot, part, words, rank, size, ink, bold) {
    const sprite = sprites.text(words, { size: Math.round(size * dpr), ink, halo: colours.halo, bold });
    const text = this.#spare.pop() ?? /** @type {Text} */ ({});
    const reach = robot.radius_px + (robot.info.estop ? STOP_SIGN_PX : bold ? RING_PX : 1);
    Object.assign(text, {
      key: robot.id + part, rank, x: robot.px, y: robot.py, reach, width: sprite.width / dpr, height: sprite.height / dpr,
      left: 0, top: 0, gap: 0, far: rank === RANK.hovered || (rank === RANK.alarm && !this.#many), shown: false, words, size, ink, bold,
    });
    this.labels.push(text);
  }
}

/** @param {Partial<Robot>} robot */
function isAlarm({ silent, estop, attention }) {
  return Boolean(silent || estop || attention);
}

/**
 * Shapes tell the makes apart, letters name them.
 * @param {Placed} robot
 * @param {boolean} mixed
 */
function labelWords({ id, info, kind }, mixed) {
  const name = mixed ? `${id} ${kind.letter}` : id;
  if (info.silent) return `${name} · silent ${seconds(info.age_s ?? 0)}`;
  return info.estop ? `${name} · E-STOP` : name;
}

/**
 * @param {Scene} scene
 * @param {Text} text
 */
function drawText({ context, sprites, colours, dpr }, text) {
  const { words, size, ink, bold, left, top, width, height, x, y, reach, gap } = text;
  if (gap > LINE_FROM_PX) {
    const [dx, dy] = [Math.max(left, Math.min(x, left + width)) - x, Math.max(top, Math.min(y, top + height)) - y];
    const share = reach / Math.max(reach, Math.hypot(dx, dy));
    context.strokeStyle = ink;
    context.lineWidth = 1;
    context.beginPath();
    context.moveTo(x + share * dx, y + share * dy);
    context.lineTo(x + dx, y + dy);
    context.stroke();
  }
  const sprite = sprites.text(words, { size: Math.round(size * dpr), ink, halo: colours.halo, bold });
  context.drawImage(sprite, left, top, width, height);
}

/**
 * How far a robot detects others: of one that is selected alone or pointed at.
 * @param {Scene} scene
 * @param {Placed} robot
 */
function drawSensing({ context, view, store, colours }, { px, py }) {
  if (!store.sensing_radius_m) return;
  context.strokeStyle = colours.sensing;
  context.lineWidth = 1.25;
  context.setLineDash([4, 5]);
  context.beginPath();
  context.arc(px, py, store.sensing_radius_m * view.scale, 0, 2 * Math.PI);
  context.stroke();
  context.setLineDash([]);
}

/**
 * @param {Scene} scene
 * @param {Placed} robot
 * @param {boolean} selected
 */
function drawRobot(scene, robot, selected) {
  const { context, sprites, store, colours, dpr } = scene;
  const { info, kind, px, py, radius_px } = robot;
  const look = store.looks.of(info.behaviour);
  const silent = Boolean(info.silent);
  const sprite = sprites.body({
    shape: kind.shape,
    radius: Math.round(radius_px * dpr),
    ...look,
    edge: silent ? colours.ink : colours.edge,
    hollow: silent,
  });
  if (selected) drawSelected(context, robot, colours);
  if (!silent && colours.dark) drawRim(context, robot, kind.shape, colours);
  const cos = Math.cos(robot.heading);
  const sin = Math.sin(robot.heading);
  context.setTransform(cos, -sin, sin, cos, px * dpr, py * dpr);
  context.drawImage(sprite, -sprite.width / 2, -sprite.height / 2);
  context.setTransform(dpr, 0, 0, dpr, 0, 0);
  if (info.estop) drawEstop(context, robot, colours);
  else if (silent) drawMark(context, robot, "?", colours);
  else if (info.attention) drawMark(context, robot, "!", colours);
}

/**
 * A light rim, so that a robot is visible on a dark floor.
 * @param {CanvasRenderingContext2D} context
 * @param {Placed} placed
 * @param {string} shape
 * @param {Colours} colours
 */
function drawRim(context, { px, py, radius_px, heading }, shape, colours) {
  context.save();
  context.translate(px, py);
  context.rotate(-heading);
  outline(context, shape, radius_px + 1.5);
  context.strokeStyle = colours.ink;
  context.lineWidth = 1;
  context.stroke();
  context.restore();
}

/**
 * @param {CanvasRenderingContext2D} context
 * @param {Placed} placed
 * @param {Colours} colours
 */
function drawSelected(context, { px, py, radius_px }, colours) {
  context.strokeStyle = colours.select;
  context.lineWidth = 3;
  context.beginPath();
  context.arc(px, py, radius_px + 6, 0, 2 * Math.PI);
  context.stroke();
}

/**
 * A stop sign around the robot: eight corners and a bar, plain in any colour.
 * @param {CanvasRenderingContext2D} context
 * @param {Placed} placed
 * @param {Colours} colours
 */
function drawEstop(context, { px, py, radius_px }, colours) {
  const radius = radius_px + 5;
  context.beginPath();
  for (let k = 0; k < 8; k += 1) {
    const angle = Math.PI / 8 + (Math.PI * k) / 4;
    context.lineTo(px + radius * Math.cos(angle), py + radius * Math.sin(angle));
  }
  context.closePath();
  context.fillStyle = colours.alarm;
  context.fill();
  context.lineWidth = 2;
  context.strokeStyle = "#FFFFFF";
  context.stroke();
  context.fillStyle = "#FFFFFF";
  context.fillRect(px - radius * 0.55, py - radius * 0.16, radius * 1.1, radius * 0.32);
}

/**
 * A triangle with "!" or a disc with "?" at the robot's upper left.
 * @param {CanvasRenderingContext2D} context
 * @param {Placed} placed
 * @param {string} sign
 * @param {Colours} colours
 */
function drawMark(context, { px, py, radius_px }, sign, colours) {
  const [x, y] = [px - radius_px - 3, py - radius_px - 4];
  context.beginPath();
  if (sign === "!") {
    context.moveTo(x, y - 10);
    context.lineTo(x + 10, y + 7);
    context.lineTo(x - 10, y + 7);
    context.closePath();
  } else {
    context.arc(x, y, 9, 0, 2 * Math.PI);
  }
  context.fillStyle = sign === "!" ? "#F0B400" : colours.halo;
  context.fill();
  context.lineWidth = 1.5;
  context.strokeStyle = sign === "!" ? "#14202B" : colours.ink;
  context.stroke();
  context.fillStyle = context.strokeStyle;
  context.font = "700 13px system-ui, sans-serif";
  context.textAlign = "center";
  context.fillText(sign, x, y + 5);
  context.textAlign = "left";
}

/**
 * A lamp that is on, in its colour.
 * @param {Scene} scene
 * @param {Placed} robot
 */
function drawLamp({ context }, { px, py, radius_px, heading, info }) {
  const lamp = info.silent ? undefined : lampColour(info);
  if (!lamp) return;
  const back = 0.45 * radius_px; // behind the arrow
  context.beginPath();
  context.arc(px - back * Math.cos(heading), py + back * Math.sin(heading), Math.max(LEAST_LAMP_PX, radius_px * 0.35), 0, 2 * Math.PI);
  context.fillStyle = lamp;
  context.fill();
  context.lineWidth = 1.5;
  context.strokeStyle = "#14202B";
  context.stroke();
}

/**
 * The filter's change of the velocity as an arrow.
 * @param {Scene} scene
 * @param {Placed} robot
 */
function drawFilter({ context, store, colours }, robot) {
  const change = store.filter.get(robot.id);
  if (!change) return;
  const [dx, dy] = change;
  const size = Math.hypot(dx, dy);
  if (size <= 1e-3) return;
  const length = Math.min(60, 12 + size * ARROW_PX_PER_M_S) + robot.radius_px;
  drawArrow(context, [robot.px, robot.py], [dx / size, -dy / size], length, colours);
}

/**
 * @param {CanvasRenderingContext2D} context
 * @param {Point} point
 * @param {Point} point
 * @param {number} length
 * @param {Colours} colours
 */
function drawArrow(context, [x, y], [ux, uy], length, colours) {
  const [tx, ty] = [x + ux * length, y + uy * length];
  for (const [colour, width] of /** @type {[string, number][]} */ ([[colours.halo, 6], [colours.filter, 3]])) {
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(tx, ty);
    context.moveTo(tx - 8 * ux - 5 * uy, ty - 8 * uy + 5 * ux);
    context.lineTo(tx, ty);
    context.lineTo(tx - 8 * ux + 5 * uy, ty - 8 * uy - 5 * ux);
    context.stroke();
  }
}

/**
 * Flags of requests and places of formations, each with a line to its robot.
 * @param {Scene} scene
 * @param {Placed[]} placed
 */
export function drawGoals(scene, placed) {
  const { context, view, colours, store } = scene;
  const flags = /** @type {Map<string, Flag>} */ (new Map());
  context.lineWidth = 1.5;
  context.strokeStyle = colours.goal;
  for (const robot of placed) {
    const goal = store.goals.get(robot.id);
    const point = goal?.target ?? goal?.goal;
    if (!goal || !point) continue;
    const [x, y] = view.toScreen(point[0], point[1]);
    context.globalAlpha = 0.55;
    context.setLineDash([2, 5]);
    context.beginPath();
    context.moveTo(robot.px, robot.py);
    context.lineTo(x, y);
    context.stroke();
    context.setLineDash([]);
    context.globalAlpha = 1;
    flags.set(`${goal.request_id}|${point}`, { x, y, place: Boolean(goal.target), radius_m: goal.radius_m });
  }
  for (const flag of flags.values()) drawFlag(context, flag, view, colours);
}

/**
 * @param {CanvasRenderingContext2D} context
 * @param {Flag} flag
 * @param {Viewport} view
 * @param {Colours} colours
 */
function drawFlag(context, { x, y, place, radius_m }, view, colours) {
  context.strokeStyle = colours.goal;
  context.fillStyle = colours.goal;
  context.lineWidth = 2;
  if (radius_m && radius_m * view.scale > 4) {
    context.globalAlpha = 0.5;
    context.beginPath();
    context.arc(x, y, radius_m * view.scale, 0, 2 * Math.PI);
    context.stroke();
    context.globalAlpha = 1;
  }
  context.beginPath();
  if (place) {
    context.moveTo(x - 6, y - 6);
    context.lineTo(x + 6, y + 6);
    context.moveTo(x + 6, y - 6);
    context.lineTo(x - 6, y + 6);
    context.stroke();
    return;
  }
  context.moveTo(x, y);
  context.lineTo(x, y - 24);
  context.stroke();
  context.beginPath();
  context.moveTo(x, y - 24);
  context.lineTo(x + 16, y - 18);
  context.lineTo(x, y - 12);
  context.fill();
}
