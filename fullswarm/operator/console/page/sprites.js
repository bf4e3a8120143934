/** Robots and labels as small pictures, drawn once and then copied at each frame. */

import { context2d } from "./dom.js";

const KEPT = 600;

/** @typedef {{shape: string, radius: number, colour: string, pattern: string, edge: string, hollow: boolean}} Body */

export class Sprites {
  #kept = /** @type {Map<string, HTMLCanvasElement>} */ (new Map());

  /** Forget everything, after the theme or the screen's resolution has changed. */
  clear() {
    this.#kept.clear();
  }

  /** Return the picture of a robot that heads along x; `radius` in device pixels. */
  body(/** @type {Body} */ body) {
    const key = `${body.shape}|${body.radius}|${body.colour}|${body.pattern}|${body.edge}|${body.hollow}`;
    return this.#keep(key, () => drawBody(body));
  }

  /**
   * Return the picture of a text with a halo; `size` in device pixels.
   * @param {string} words
   * @param {{size: number, ink: string, halo: string, bold?: boolean}} given
   */
  text(words, { size, ink, halo, bold = false }) {
    return this.#keep(`${words}|${size}|${ink}|${halo}|${bold}`, () => drawText(words, size, ink, halo, bold));
  }

  /**
   * @param {string} key
   * @param {() => HTMLCanvasElement} draw
   */
  #keep(key, draw) {
    let sprite = this.#kept.get(key);
    if (!sprite) {
      if (this.#kept.size > KEPT) this.#kept.clear();
      this.#kept.set(key, (sprite = draw()));
    }
    return sprite;
  }
}

/**
 * @param {number} width
 * @param {number} height
 */
function blank(width, height) {
  const canvas = document.createElement("canvas");
  canvas.width = Math.max(1, Math.ceil(width));
  canvas.height = Math.max(1, Math.ceil(height));
  return canvas;
}

/**
 * Add a robot's outline to the path: circle, square or hexagon, the same area of influence for all.
 * @param {CanvasRenderingContext2D} context
 * @param {string} shape
 * @param {number} radius
 */
export function outline(context, shape, radius) {
  context.beginPath();
  if (shape === "circle") {
    context.arc(0, 0, radius, 0, 2 * Math.PI);
    return;
  }
  const [corners, turn] = shape === "square" ? [4, Math.PI / 4] : [6, 0];
  for (let k = 0; k < corners; k += 1) {
    const angle = turn + (2 * Math.PI * k) / corners;
    context.lineTo(radius * Math.cos(angle), radius * Math.sin(angle));
  }
  context.closePath();
}

/** @param {Body} body */
function drawBody({ shape, radius, colour, pattern, edge, hollow }) {
  const canvas = blank(2 * radius + 8, 2 * radius + 8);
  const context = context2d(canvas);
  context.translate(canvas.width / 2, canvas.height / 2);
  const line = Math.max(1.5, radius * 0.12);
  context.lineWidth = line;
  outline(context, shape, radius);
  if (hollow) {
    context.setLineDash([radius * 0.45, radius * 0.35]);
    context.strokeStyle = edge;
    context.stroke();
    return canvas;
  }
  context.fillStyle = colour;
  context.fill();
  context.save();
  context.clip();
  fillPattern(context, pattern, radius, edge);
  context.restore();
  outline(context, shape, radius);
  context.strokeStyle = edge;
  context.stroke();
  drawHeading(context, radius, edge);
  return canvas;
}

/**
 * A wedge from the middle to the rim, and beyond it, in the direction of the heading.
 * @param {CanvasRenderingContext2D} context
 * @param {number} radius
 * @param {string} edge
 */
function drawHeading(context, radius, edge) {
  context.beginPath();
  context.moveTo(radius + 3, 0);
  context.lineTo(radius * 0.1, radius * 0.5);
  context.lineTo(radius * 0.35, 0);
  context.lineTo(radius * 0.1, -radius * 0.5);
  context.closePath();
  context.fillStyle = edge;
  context.fill();
}

/**
 * Stripes, dots or rings over what is filled, so that the colour is not alone.
 * @param {CanvasRenderingContext2D} context
 * @param {string} pattern
 * @param {number} radius
 * @param {string} ink
 */
export function fillPattern(context, pattern, radius, ink) {
  context.strokeStyle = ink;
  context.fillStyle = ink;
  context.globalAlpha = 0.55;
  context.lineWidth = Math.max(1, radius * 0.13);
  if (pattern === "stripes") {
    for (let k = -2; k <= 2; k += 1) {
      context.beginPath();
      context.moveTo(k * radius * 0.5, -radius);
      context.lineTo(k * radius * 0.5, radius);
      context.stroke();
    }
  } else if (pattern === "dots") {
    for (const [x, y] of [[-0.55, -0.4], [-0.55, 0.4], [0, -0.7], [0, 0.7], [-0.1, 0]]) {
      context.beginPath();
      context.arc(x * radius, y * radius, Math.max(1, radius * 0.14), 0, 2 * Math.PI);
      context.fill();
    }
  } else if (pattern === "rings") {
    context.beginPath();
    context.arc(0, 0, radius * 0.62, 0, 2 * Math.PI);
    context.stroke();
  }
  context.globalAlpha = 1;
}

/**
 * @param {string} words
 * @param {number} size
 * @param {string} ink
 * @param {string} halo
 * @param {boolean} bold
 */
function drawText(words, size, ink, halo, bold) {
  const font = `${bold ? "600 " : ""}${size}px system-ui, "Segoe UI", Roboto, "Noto Sans", sans-serif`;
  const probe = context2d(blank(1, 1));
  probe.font = font;
  const canvas = blank(probe.measureText(words).width + 8, size * 1.4 + 4);
  const context = context2d(canvas);
  context.font = font;
  context.textBaseline = "middle";
  context.lineJoin = "round";
  context.lineWidth = Math.max(3, size * 0.28);
  context.strokeStyle = halo;
  context.strokeText(words, 4, canvas.height / 2);
  context.fillStyle = ink;
  context.fillText(words, 4, canvas.height / 2);
  return canvas;
}
