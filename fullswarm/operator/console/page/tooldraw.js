/** Draws what a tool is about to do: lasso, formation, crosshair, picked points. */

import { assign } from "./geometry.js";

/** @import { Scene } from "./ground.js" */
/** @import { Placed } from "./robots.js" */
/** @import { Selection } from "./selection.js" */
/** @import { Tools } from "./tools.js" */
/** @import { Point } from "./types.d.ts" */

const PREVIEWED = 40; // robots; more would make the drag stutter

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
  for (const [k, point] of tool.picked.entries()) drawPicked(scene, point, String(k + 1));
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
