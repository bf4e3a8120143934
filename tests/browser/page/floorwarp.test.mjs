/** Which pixel of a picture each pixel of the floor shows, against a camera's projection written out here. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { page } from "./page.mjs";

const { warpOf } = await page("floorwarp.js");

const EYE = [2, 1, 3]; // straight down, 100 pixels per radian, no distortion
const WIDE = 400, HIGH = 300, FOCAL = 100;

/** Where a pixel's ray meets a height. */
function place(u, v, height = 0) {
  const reach = (EYE[2] - height) / FOCAL;
  return [EYE[0] + (u - WIDE / 2) * reach, EYE[1] - (v - HIGH / 2) * reach];
}

function mesh(columns, rows, change = (point) => point) {
  const places = [];
  for (let row = 0; row <= rows; row += 1) {
    for (let column = 0; column <= columns; column += 1) places.push(change(place((column / columns) * WIDE, (row / rows) * HIGH), column, row));
  }
  return { columns, rows, places, eye_m: EYE, tops_m: 0.5 };
}

function shown(warp, x, y) {
  const column = Math.floor((x - warp.left) / warp.cell_m), row = Math.floor((warp.top - y) / warp.cell_m);
  const from = warp.from[row * warp.width + column];
  return from < 0 ? null : [(from % WIDE) + 0.5, Math.floor(from / WIDE) + 0.5];
}

for (const height of [0, 0.5]) {
  test(`each place ${height} m above the floor shows its own pixel, to a pixel`, () => {
    const warp = warpOf(mesh(8, 6), WIDE, HIGH, height);
    for (let u = 3; u < WIDE; u += 13) {
      for (let v = 3; v < HIGH; v += 11) {
        const [x, y] = shown(warp, ...place(u, v, height));
        assert.ok(Math.abs(x - u) <= 1.01 && Math.abs(y - v) <= 1.01, `${u}, ${v}: ${x}, ${y}`);
      }
    }
    assert.ok(!warp.from.includes(-1), "it has no hole");
  });
}

test("where the picture is not on the floor nothing is drawn", () => {
  const warp = warpOf(mesh(8, 6, (point, column) => (column < 2 ? null : point)), WIDE, HIGH, 0);
  assert.notEqual(shown(warp, ...place(300, 150)), null);
  assert.ok(warp.left > place(50, 0)[0]);
});

test("a grid that is none of a picture is refused at once, and a picture is never drawn with too many pixels", () => {
  const began_ms = performance.now();
  assert.equal(warpOf(mesh(60, 60, (_, column, row) => [(column * 7919) % 4001, (row * 7919 + column * 104729) % 3989]), WIDE, HIGH, 0), null);
  assert.equal(warpOf(mesh(2, 2, () => null), WIDE, HIGH, 0), null);
  const far = warpOf(mesh(2, 2, ([x, y]) => [1e6 * x, 1e-6 * y]), WIDE, HIGH, 0);
  assert.ok(far === null || far.width * far.height <= 4096 * 200);
  assert.ok(performance.now() - began_ms < 2000);
});
