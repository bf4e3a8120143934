/** The layers under the robots that change seldom: floor, grid, boxes, coverage, what was seen, trails. */

import { context2d } from "./dom.js";
import { drawPlaces } from "./places.js";
import { scaleBar } from "./viewport.js";

/** @import { FloorPicture } from "./floorpicture.js" */
/** @import { Colours } from "./palette.js" */
/** @import { Box, Coverage } from "./types.d.ts" */
/** @import { Underlay } from "./underlay.js" */
/** @import { Viewport } from "./viewport.js" */

const TRAIL_BANDS = 4;
const TRAIL_S = 60;

/**
 * @typedef {{context: CanvasRenderingContext2D, view: import("./viewport.js").Viewport, dpr: number,
 *   colours: Colours, store: import("./store.js").Store, sprites: import("./sprites.js").Sprites}} Scene
 */

/** Draw floor, grid, boxes and seen obstacles; this picture is kept until the view or the world changes. */
export function drawFloor(/** @type {Scene} */ scene, /** @type {{coverage: boolean, underlay: Underlay | null, picture: FloorPicture | null}} */ options) {
  const { context, view, dpr, colours, store } = scene;
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.fillStyle = colours.outside;
  context.fillRect(0, 0, context.canvas.width, context.canvas.height);
  inMetres(context, view, dpr);
  const arena = store.arena;
  if (arena) {
    context.fillStyle = colours.floor;
    context.fillRect(arena[0], arena[1], arena[2] - arena[0], arena[3] - arena[1]);
  }
  options.underlay?.draw(context, view, arena);
  options.picture?.draw(context);
  if (arena) {
    if (options.coverage && store.coverage) drawCoverage(context, store.coverage, colours);
    drawGrid(context, view, arena, colours);
    context.strokeStyle = colours.wall;
    context.lineWidth = 2 / view.scale;
    context.strokeRect(arena[0], arena[1], arena[2] - arena[0], arena[3] - arena[1]);
  }
  drawBoxes(scene);
  drawDocks(scene);
  drawPlaces(scene);
  drawScale(scene);
}

/**
 * @param {CanvasRenderingContext2D} context
 * @param {Viewport} view
 * @param {number} dpr
 */
function inMetres(context, view, dpr) {
  const s = view.scale * dpr;
  const [x, y] = view.toScreen(0, 0);
  context.setTransform(s, 0, 0, -s, x * dpr, y * dpr);
}

/**
 * @param {CanvasRenderingContext2D} context
 * @param {Viewport} view
 * @param {Box} box
 * @param {Colours} colours
 */
function drawGrid(context, view, [x0, y0, x1, y1], colours) {
  const step = [1, 2, 5, 10, 20, 50, 100].find((metres) => metres * view.scale >= 24) ?? 100;
  context.strokeStyle = colours.grid;
  context.lineWidth = 1 / view.scale;
  context.beginPath();
  for (let x = Math.ceil(x0 / step) * step; x <= x1; x += step) {
    context.moveTo(x, y0);
    context.lineTo(x, y1);
  }
  for (let y = Math.ceil(y0 / step) * step; y <= y1; y += step) {
    context.moveTo(x0, y);
    context.lineTo(x1, y);
  }
  context.stroke();
}

/** @param {Scene} scene */
function drawBoxes({ context, view, colours, store }) {
  context.fillStyle = colours.box;
  context.strokeStyle = colours.wall;
  context.lineWidth = 1.5 / view.scale;
  for (const [cx, cy, sx, sy, yaw] of store.boxes) {
    turned(context, cx, cy, yaw, () => {
      context.fillRect(-sx / 2, -sy / 2, sx, sy);
      context.strokeRect(-sx / 2, -sy / 2, sx, sy);
    });
  }
  context.strokeStyle = colours.seen;
  context.lineWidth = 2 / view.scale;
  context.setLineDash([5 / view.scale, 4 / view.scale]);
  for (const [cx, cy, hx, hy, yaw, radius] of store.obstacles.filter((row) => reachesInto(row, store.arena))) {
    turned(context, cx, cy, yaw, () => {
      context.beginPath();
      context.roundRect(-hx - radius, -hy - radius, 2 * (hx + radius), 2 * (hy + radius), radius);
      context.stroke();
    });
  }
  context.setLineDash([]);
}

/**
 * A dock is a bracket before the robot that stands in it, with its way in as a dashed line; its name below it.
 * @param {Scene} scene
 */
function drawDocks({ context, view, dpr, colours, store }) {
  const DEEP_M = 0.12, HALF_M = 0.2;
  for (const { x, y, heading, approach_m, phase } of store.docks) {
    context.strokeStyle = phase === "failed" || phase === "blocked" ? colours.alarm : colours.ink;
    turned(context, x, y, heading, () => {
      context.lineWidth = 3 / view.scale;
      context.beginPath();
      context.moveTo(HALF_M - DEEP_M, -HALF_M);
      context.lineTo(HALF_M, -HALF_M);
      context.lineTo(HALF_M, HALF_M);
      context.lineTo(HALF_M - DEEP_M, HALF_M);
      context.stroke();
      context.lineWidth = 1 / view.scale;
      context.setLineDash([4 / view.scale, 4 / view.scale]);
      context.beginPath();
      context.moveTo(-approach_m, 0);
      context.lineTo(HALF_M - DEEP_M, 0);
      context.stroke();
      context.setLineDash([]);
    });
  }
  context.setTransform(dpr, 0, 0, dpr, 0, 0);
  context.fillStyle = colours.ink;
  context.font = "12px system-ui, sans-serif";
  context.textAlign = "center"; // below it: beside it is the name of the robot that stands in it
  for (const { dock, x, y, phase } of store.docks) {
    const [left, top] = view.toScreen(x, y - HALF_M);
    context.fillText(phase === "failed" || phase === "blocked" ? `${dock}: ${phase}` : dock, left, top + 14);
  }
  context.textAlign = "left";
}

/**
 * The walls of the arena are seen as obstacles too; the arena's own edge shows them.
 * @param {number[]} given
 * @param {Box | null} arena
 */
function reachesInto([cx, cy, hx, hy, yaw, radius], arena) {
  if (!arena) return true;
  const c = Math.abs(Math.cos(yaw)), s = Math.abs(Math.sin(yaw));
  const wide = hx * c + hy * s + radius, high = hx * s + hy * c + radius;
  const [left, low, right, top] = arena;
  const EDGE_M = 0.01;
  return cx + wide > left + EDGE_M && cx - wide < right - EDGE_M && cy + high > low + EDGE_M && cy - high < top - EDGE_M;
}

/**
 * @param {CanvasRenderingContext2D} context
 * @param {number} x
 * @param {number} y
 * @param {number} angle
 * @param {() => void} draw
 */
function turned(context, x, y, angle, draw) {
  context.save();
  context.translate(x, y);
  context.rotate(angle);
  draw();
  context.restore();
}

let pictured = /** @type {{message: Coverage, colour: string, canvas: HTMLCanvasElement} | null} */ (null);

/**
 * @param {CanvasRenderingContext2D} context
 * @param {Coverage} coverage
 * @param {Colours} colours
 */
function drawCoverage(context, coverage, colours) {
  const colour = String(colours.cover);
  if (pictured?.message !== coverage || pictured.colour !== colour) {
    pictured = { message: coverage, colour, canvas: coveragePicture(coverage, colours.cover) };
  }
  const [x, y] = coverage.origin;
  context.imageSmoothingEnabled = false;
  context.drawImage(pictured.canvas, x, y, coverage.columns * coverage.cell_m, coverage.rows * coverage.cell_m);
  context.imageSmoothingEnabled = true;
}

/**
 * Unpack numpy's packbits, one pixel per cell; row 0 lies at the origin, and y points up in the drawing.
 * @param {Coverage} coverage
 * @param {number[]} given
 */
function coveragePicture({ rows, columns, bits }, [red, green, blue, alpha]) {
  const bytes = Uint8Array.from(atob(bits), (letter) => letter.charCodeAt(0));
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [columns, rows];
  const context = context2d(canvas);
  const image = context.createImageData(columns, rows);
  for (let k = 0; k < rows * columns; k += 1) {
    if (bytes[k >> 3] & (128 >> (k & 7))) image.data.set([red, green, blue, alpha], 4 * k);
  }
  context.putImageData(image, 0, 0);
  return canvas;
}

/** @param {Scene} scene */
function drawScale({ context, view, dpr, colours }) {
  const metres = scaleBar(view.scale);
  const length = metres * view.scale;
  context.setTransform(dpr, 0, 0, dpr, 0, 0);
  context.strokeStyle = colours.ink;
  context.fillStyle = colours.ink;
  context.lineWidth = 2;
  const [right, bottom] = [view.width - 16, view.height - 16];
  context.beginPath();
  context.moveTo(right - length, bottom - 6);
  context.lineTo(right - length, bottom);
  context.lineTo(right, bottom);
  context.lineTo(right, bottom - 6);
  context.stroke();
  context.font = "14px system-ui, sans-serif";
  context.textAlign = "right";
  context.fillText(`${metres} m`, right, bottom - 10);
  context.textAlign = "left";
}

/** Draw the trails over the floor, older parts fainter. */
export function drawTrails(/** @type {Scene} */ { context, view, dpr, colours, store }) {
  inMetres(context, view, dpr);
  context.lineJoin = "round";
  context.lineWidth = 1.8 / view.scale;
  for (const [id, track] of store.tracks) {
    const look = store.looks.of(store.info(id).behaviour);
    context.strokeStyle = look.colour === "#F0E442" && colours.halo === "#FFFFFF" ? "#B3A500" : look.colour;
    drawTrail(context, track.trail, store.at_s);
  }
  context.globalAlpha = 1;
}

/**
 * @param {CanvasRenderingContext2D} context
 * @param {number[][]} trail
 * @param {number} now_s
 */
function drawTrail(context, trail, now_s) {
  let from = 0;
  for (let band = 0; band < TRAIL_BANDS; band += 1) {
    const until = now_s - TRAIL_S * (1 - (band + 1) / TRAIL_BANDS);
    let to = from;
    while (to < trail.length && trail[to][0] <= until) to += 1;
    if (to - from > 0 && trail.length > 1) {
      context.globalAlpha = 0.15 + (0.65 * (band + 1)) / TRAIL_BANDS;
      context.beginPath();
      const first = Math.max(0, from - 1);
      context.moveTo(trail[first][1], trail[first][2]);
      for (let k = first + 1; k < to; k += 1) context.lineTo(trail[k][1], trail[k][2]);
      context.stroke();
    }
    from = to;
  }
}
