/** Which part of the world the map shows: metres to CSS pixels and back, pan, zoom, fit. y points up. */

/** @import { Box } from "./types.d.ts" */

const LEAST_PX_PER_M = 2;
const MOST_PX_PER_M = 600;

export class Viewport {
  width = 1; // CSS pixels
  height = 1;
  centre = /** @type {[number, number]} */ ([0, 0]); // metres
  scale = 40; // CSS pixels per metre
  covered = /** @type {{left: number, top: number, right: number, bottom: number}[]} */ ([]); // CSS pixels; by buttons and the legend

  /**
   * @param {number} x_m
   * @param {number} y_m
   * @returns {[number, number]} CSS pixels from the map's corner at the top left
   */
  toScreen(x_m, y_m) {
    return [
      this.width / 2 + (x_m - this.centre[0]) * this.scale,
      this.height / 2 - (y_m - this.centre[1]) * this.scale,
    ];
  }

  /**
   * @param {number} x_px
   * @param {number} y_px
   * @returns {[number, number]} metres
   */
  toWorld(x_px, y_px) {
    return [
      this.centre[0] + (x_px - this.width / 2) / this.scale,
      this.centre[1] - (y_px - this.height / 2) / this.scale,
    ];
  }

  /**
   * Shift what is shown by CSS pixels.
   * @param {number} dx_px
   * @param {number} dy_px
   */
  pan(dx_px, dy_px) {
    this.centre = [this.centre[0] - dx_px / this.scale, this.centre[1] + dy_px / this.scale];
  }

  /**
   * Zoom by a factor; the point of the world under (x_px, y_px) stays where it is.
   * @param {number} factor
   * @param {number} [x_px]
   * @param {number} [y_px]
   */
  zoomAt(factor, x_px = this.width / 2, y_px = this.height / 2) {
    const [x, y] = this.toWorld(x_px, y_px);
    this.scale = Math.min(MOST_PX_PER_M, Math.max(LEAST_PX_PER_M, this.scale * factor));
    const [now_x, now_y] = this.toWorld(x_px, y_px);
    this.centre = [this.centre[0] + x - now_x, this.centre[1] + y - now_y];
  }

  /**
   * Show the whole of a box (x0, y0, x1, y1 in metres) with some room around it.
   * @param {Box} box
   * @param {number} [margin_px]  less on a small map
   */
  fit([x0, y0, x1, y1], margin_px = Math.min(28, 0.07 * Math.min(this.width, this.height))) {
    const wide = Math.max(x1 - x0, 0.5);
    const high = Math.max(y1 - y0, 0.5);
    this.centre = [(x0 + x1) / 2, (y0 + y1) / 2];
    const scale = Math.min((this.width - 2 * margin_px) / wide, (this.height - 2 * margin_px) / high);
    this.scale = Math.min(MOST_PX_PER_M, Math.max(LEAST_PX_PER_M, scale));
  }
}

/**
 * Return a round length in metres whose bar is at most `most_px` long.
 * @param {number} px_per_m
 * @param {number} [most_px]
 */
export function scaleBar(px_per_m, most_px = 120) {
  const most_m = most_px / px_per_m;
  const ten = 10 ** Math.floor(Math.log10(most_m));
  return [5, 2, 1].map((n) => n * ten).find((m) => m <= most_m) ?? ten;
}
