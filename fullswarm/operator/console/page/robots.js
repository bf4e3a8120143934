/** Draws what moves: robots with their state, goals, the filter's arrows, sensing radii. CSS pixels. */

import { actuatorText, kindOf, lampColour } from "./palette.js";
import { outline } from "./sprites.js";
import { seconds } from "./link.js";

/** @import { Scene } from "./ground.js" */
/** @import { Colours } from "./palette.js" */
/** @import { Selection } from "./selection.js" */
/** @import { Store } from "./store.js" */
/** @import { Point, Robot } from "./types.d.ts" */
/** @import { Viewport } from "./viewport.js" */

const LEAST_RADIUS_PX = 7;
const LEAST_LAMP_PX = 3.5;
const MOST_DASHED = 12;
const ARROW_PX_PER_M_S = 90;

/**
 * @typedef {{id: string, x: number, y: number, px: number, py: number, heading: number, radius: number,
 *   radius_px: number, info: Partial<Robot>}} Placed  a robot where it is drawn now
 * @typedef {{x: number, y: number, place: boolean, radius_m: number | null}} Flag  CSS pixels; place: of a formation
 */

/**
 * Place every robot for this frame.
 * @param {Store} store
 * @param {Viewport} view
 * @param {number} at_s
 * @returns {Placed[]}
 */
export function placeRobots(store, view, at_s) {
  const placed = [];
  for (const [id, track] of store.tracks) {
    const pose = track.pose(at_s);
    if (!pose) continue;
    const [px, py] = view.toScreen(pose[0], pose[1]);
    const radius = store.radius(id);
    const radius_px = Math.max(LEAST_RADIUS_PX, radius * view.scale);
    placed.push({ id, x: pose[0], y: pose[1], px, py, heading: pose[2], radius, radius_px, info: store.info(id) });
  }
  return placed;
}

/**
 * Draw all robots, the selected ones last and with their labels.
 * @param {Scene} scene
 * @param {Placed[]} placed
 * @param {Selection} selection
 * @param {string | null} hovered
 */
export function drawRobots(scene, placed, selection, hovered) {
  const crowded = placed.length > 60 && scene.view.scale < 30;
  const mixed = new Set(placed.map(({ info }) => kindOf(info.make, info.driver, scene.store.icons).letter)).size > 1;
  drawSensing(scene, placed.filter((robot) => selection.has(robot.id)));
  for (const robot of placed) drawFilter(scene, robot, selection.has(robot.id) || robot.id === hovered);
  for (const robot of placed) drawRobot(scene, robot, selection.has(robot.id));
  for (const robot of placed) {
    const chosen = selection.has(robot.id) || robot.id === hovered;
    drawActuators(scene, robot, chosen);
    if (chosen || !crowded || robot.info.attention) drawLabel(scene, robot, chosen, mixed);
  }
}

/**
 * One path for all; dashes of many circles would cost more than everything else.
 * @param {Scene} scene
 * @param {Placed[]} robots
 */
function drawSensing({ context, view, store, colours }, robots) {
  if (!store.sensing_radius_m || robots.length === 0) return;
  const radius_px = store.sensing_radius_m * view.scale;
  context.strokeStyle = colours.sensing;
  context.lineWidth = robots.length > MOST_DASHED ? 0.75 : 1.25;
  if (robots.length <= MOST_DASHED) context.setLineDash([4, 5]);
  context.beginPath();
  for (const { px, py } of robots) {
    context.moveTo(px + radius_px, py);
    context.arc(px, py, radius_px, 0, 2 * Math.PI);
  }
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
  const { info, px, py, radius_px } = robot;
  const look = store.looks.of(info.behaviour);
  const kind = kindOf(info.make, info.driver, store.icons);
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
 * @param {Scene} scene
 * @param {Placed} robot
 * @param {boolean} chosen
 * @param {boolean} mixed
 */
function drawLabel(scene, robot, chosen, mixed) {
  const { context, sprites, store, colours, dpr } = scene;
  const { info, px, py, radius_px } = robot;
  const { letter } = kindOf(info.make, info.driver, store.icons);
  const words = [mixed ? `${robot.id} ${letter}` : robot.id]; // shapes tell the makes apart, letters name them
  if (info.silent) words.push(`silent ${seconds(info.age_s ?? 0)}`);
  else if (info.estop) words.push("E-STOP");
  const sprite = sprites.text(words.join(" · "), {
    size: Math.round((chosen ? 15 : 13) * dpr),
    ink: info.estop || info.silent ? colours.alarm : colours.ink,
    halo: colours.halo,
    bold: chosen,
  });
  const [x, y] = [px + radius_px + (info.estop || chosen ? 6 : 2), py - radius_px - 10];
  context.drawImage(sprite, x, y, sprite.width / dpr, sprite.height / dpr);
}

/**
 * A lamp that is on, in its colour, on any robot; all actuators in words below a robot that is selected or hovered.
 * @param {Scene} scene
 * @param {Placed} robot
 * @param {boolean} inWords
 */
function drawActuators({ context, sprites, store, colours, dpr }, robot, inWords) {
  const { px, py, radius_px, info } = robot;
  const lamp = lampColour(info);
  if (lamp && !info.silent) {
    const back = 0.45 * radius_px; // behind the arrow
    context.beginPath();
    context.arc(px - back * Math.cos(robot.heading), py + back * Math.sin(robot.heading), Math.max(LEAST_LAMP_PX, radius_px * 0.35), 0, 2 * Math.PI);
    context.fillStyle = lamp;
    context.fill();
    context.lineWidth = 1.5;
    context.strokeStyle = "#14202B";
    context.stroke();
  }
  const words = inWords ? actuatorText(info) : "";
  if (!words) return;
  const sprite = sprites.text(words, { size: Math.round(13 * dpr), ink: colours.ink, halo: colours.halo });
  const y = py + (store.filter.has(robot.id) ? 22 : 4); // below the filter's reason
  context.drawImage(sprite, px + radius_px + 4, y, sprite.width / dpr, sprite.height / dpr);
}

/**
 * The filter's change of the velocity as an arrow; its reason as text.
 * @param {Scene} scene
 * @param {Placed} robot
 * @param {boolean} withReason
 */
function drawFilter(scene, robot, withReason) {
  const change = scene.store.filter.get(robot.id);
  if (!change) return;
  const { context, sprites, colours, dpr } = scene;
  const [dx, dy, reason] = change;
  const size = Math.hypot(dx, dy);
  if (size > 1e-3) {
    const length = Math.min(60, 12 + size * ARROW_PX_PER_M_S) + robot.radius_px;
    drawArrow(context, [robot.px, robot.py], [dx / size, -dy / size], length, colours);
  }
  if (!withReason || !reason) return;
  const sprite = sprites.text(reason, { size: Math.round(13 * dpr), ink: colours.filter, halo: colours.halo });
  context.drawImage(sprite, robot.px + robot.radius_px + 4, robot.py + 4, sprite.width / dpr, sprite.height / dpr);
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
