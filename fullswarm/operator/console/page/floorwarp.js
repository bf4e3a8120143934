/** How a picture is laid on the floor: for each pixel that is drawn, which one of the picture it shows. Pure. */

/** @import { FloorMesh, Point } from "./types.d.ts" */

const MOST_PIXELS = 500_000; // of the picture as it is drawn
const LONGEST_SIDE = 4096;
const FINEST_M = 0.0005;
const MOST_WORK = 6_000_000; // pixels in the boxes around the triangles: about four times those drawn

/**
 * @typedef {{left: number, top: number, cell_m: number, width: number, height: number, from: Int32Array}} Warp
 *   left, top: x and y of the upper left corner, m; from: for each pixel that is drawn that of the picture, -1: none
 */

/**
 * Return how a picture is drawn on the floor, or on a plane above it; null: nothing of it lies there.
 * @param {FloorMesh} mesh
 * @param {number} wide  of the picture, pixels
 * @param {number} high
 * @param {number} height_m  of the plane
 * @returns {Warp | null}
 */
export function warpOf(mesh, wide, high, height_m) {
  const { columns, rows, eye_m } = mesh;
  // A ray from the camera to the floor passes a plane above it nearer to the camera.
  const share = Math.min(1, height_m / eye_m[2]);
  const places = mesh.places.map((place) => place && /** @type {Point} */ ([place[0] + share * (eye_m[0] - place[0]), place[1] + share * (eye_m[1] - place[1])]));
  const triangles = /** @type {{places: Point[], pixels: Point[]}[]} */ ([]);
  for (let row = 0; row < rows; row += 1) {
    for (let column = 0; column < columns; column += 1) {
      const cell = [[0, 0], [1, 0], [0, 1], [1, 1]].map(([right, down]) => ({
        place: places[(row + down) * (columns + 1) + column + right],
        pixel: /** @type {Point} */ ([((column + right) / columns) * wide, ((row + down) / rows) * high]),
      }));
      for (const ends of [[0, 1, 2], [3, 2, 1]]) {
        const found = ends.map((k) => cell[k].place);
        if (found.every((place) => place)) triangles.push({ places: /** @type {Point[]} */ (found), pixels: ends.map((k) => cell[k].pixel) });
      }
    }
  }
  return triangles.length ? filled(triangles, wide, high) : null;
}

/**
 * Return what each pixel that is drawn shows; null: the grid is none of a picture, and would hold up the page.
 * @param {{places: Point[], pixels: Point[]}[]} triangles
 * @param {number} wide
 * @param {number} high
 * @returns {Warp | null}
 */
function filled(triangles, wide, high) {
  const points = triangles.flatMap(({ places }) => places);
  const [left, right] = [Math.min(...points.map(([x]) => x)), Math.max(...points.map(([x]) => x))];
  const [low, top] = [Math.min(...points.map(([, y]) => y)), Math.max(...points.map(([, y]) => y))];
  // As fine as the finest part of the picture, if that is not too large.
  const finest = Math.sqrt(Math.min(...triangles.map(({ places, pixels }) => Math.abs(area(places) / area(pixels)))));
  const [across, along] = [right - left, top - low];
  const cell_m = Math.max(finest, Math.sqrt((across * along) / MOST_PIXELS), Math.max(across, along) / LONGEST_SIDE, FINEST_M);
  const boxes = triangles.reduce((sum, { places }) => sum + boxArea(places), 0) / cell_m ** 2;
  if (boxes > MOST_WORK) return null;
  const [width, height] = [Math.max(1, Math.ceil((right - left) / cell_m)), Math.max(1, Math.ceil((top - low) / cell_m))];
  const warp = { left, top, cell_m, width, height, from: new Int32Array(width * height).fill(-1) };
  for (const triangle of triangles) fillTriangle(warp, triangle, wide, high);
  return warp;
}

/**
 * Note for each pixel in a triangle of the floor which one of the picture it shows.
 * @param {Warp} warp
 * @param {{places: Point[], pixels: Point[]}} triangle
 * @param {number} wide
 * @param {number} high
 */
function fillTriangle(warp, { places, pixels }, wide, high) {
  const [a, b, c] = places.map(([x, y]) => /** @type {Point} */ ([(x - warp.left) / warp.cell_m, (warp.top - y) / warp.cell_m]));
  const whole = cross(a, b, c);
  if (whole === 0) return;
  const SLACK = 1e-6; // a pixel on the edge of two triangles belongs to one of them
  const rows = [Math.max(0, Math.floor(Math.min(a[1], b[1], c[1]))), Math.min(warp.height - 1, Math.ceil(Math.max(a[1], b[1], c[1])))];
  const columns = [Math.max(0, Math.floor(Math.min(a[0], b[0], c[0]))), Math.min(warp.width - 1, Math.ceil(Math.max(a[0], b[0], c[0])))];
  for (let row = rows[0]; row <= rows[1]; row += 1) {
    for (let column = columns[0]; column <= columns[1]; column += 1) {
      const at = /** @type {Point} */ ([column + 0.5, row + 0.5]);
      const second = cross(a, at, c) / whole, third = cross(a, b, at) / whole;
      if (second < -SLACK || third < -SLACK || second + third > 1 + SLACK) continue;
      const x = pixels[0][0] + second * (pixels[1][0] - pixels[0][0]) + third * (pixels[2][0] - pixels[0][0]);
      const y = pixels[0][1] + second * (pixels[1][1] - pixels[0][1]) + third * (pixels[2][1] - pixels[0][1]);
      const [from_x, from_y] = [Math.min(wide - 1, Math.max(0, Math.floor(x))), Math.min(high - 1, Math.max(0, Math.floor(y)))];
      warp.from[row * warp.width + column] = from_y * wide + from_x;
    }
  }
}

/** @param {Point[]} points */
function area([a, b, c]) {
  return cross(a, b, c) / 2;
}

/** @param {Point[]} points */
function boxArea([a, b, c]) {
  const across = Math.max(a[0], b[0], c[0]) - Math.min(a[0], b[0], c[0]);
  return across * (Math.max(a[1], b[1], c[1]) - Math.min(a[1], b[1], c[1]));
}

/**
 * Twice the area of a triangle, with its sign.
 * @param {Point} a
 * @param {Point} b
 * @param {Point} c
 */
function cross(a, b, c) {
  return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
}
