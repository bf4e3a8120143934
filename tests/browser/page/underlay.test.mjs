/** Where tiles of Web Mercator are drawn, against latitude and longitude of their corners; a picture in the arena. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { page } from "./page.mjs";

const { contained, tilesIn } = await page("underlay.js");
const { Viewport } = await page("viewport.js");
const { rulerWords } = await page("tools.js");

const EARTH_M = 6378137;

/** Latitude and longitude of a tile's lower left corner (wiki.openstreetmap.org, "Slippy map tilenames"). */
function corner(zoom, column, row) {
  const n = Math.PI - (2 * Math.PI * (row + 1)) / 2 ** zoom;
  return [(180 / Math.PI) * Math.atan(0.5 * (Math.exp(n) - Math.exp(-n))), (column / 2 ** zoom) * 360 - 180];
}

test("each tile lies where its corner is on earth, to a part in a thousand", () => {
  for (const origin of [[52.0, 4.4], [-35.36, 149.17], [0, 0], [68, -150]]) {
    const view = new Viewport();
    Object.assign(view, { width: 900, height: 600, scale: 3, centre: [120, -80] });
    const found = tilesIn(view, origin, [0, 22]);
    assert.ok(found.length > 4);
    for (const { zoom, column, row, x_m, y_m } of found) {
      const [latitude, longitude] = corner(zoom, column, row);
      const radians = Math.PI / 180;
      const east = (longitude - origin[1]) * radians * EARTH_M * Math.cos(origin[0] * radians);
      const north = (latitude - origin[0]) * radians * EARTH_M;
      assert.ok(Math.hypot(x_m - east, y_m - north) < 0.5 + 0.001 * Math.hypot(east, north), `${origin}: ${x_m} ${east}, ${y_m} ${north}`);
    }
  }
});

test("the tiles cover the view and nothing beside it, and are never many", () => {
  for (const scale of [2, 10, 55, 600]) {
    const view = new Viewport();
    Object.assign(view, { width: 1400, height: 900, scale, centre: [10, 20] });
    const found = tilesIn(view, [48, 11], [3, 20], 2);
    assert.ok(found.length > 0 && found.length <= 64, `${found.length}`);
    const [left, top] = view.toWorld(0, 0), [right, bottom] = view.toWorld(view.width, view.height);
    const edge = (/** @type {(each: any) => number} */ of, /** @type {(...all: number[]) => number} */ pick) => pick(...found.map(of));
    assert.ok(edge((each) => each.x_m, Math.min) <= left && edge((each) => each.x_m + each.size_m, Math.max) >= right);
    assert.ok(edge((each) => each.y_m, Math.min) <= bottom && edge((each) => each.y_m + each.size_m, Math.max) >= top);
    for (const { x_m, y_m, size_m } of found) {
      assert.ok(x_m < right && x_m + size_m > left && y_m < top && y_m + size_m > bottom);
    }
  }
});

test("a file with few zooms is used at the nearest one, and bounds hold", () => {
  const view = new Viewport();
  Object.assign(view, { width: 800, height: 600, scale: 2, centre: [0, 0] });
  assert.deepEqual([...new Set(tilesIn(view, [48, 11], [19, 19]).map(({ zoom }) => zoom))], [19]);
  assert.ok(tilesIn(view, [48, 11], [22, 22]).length <= 64);
});

test("a picture without a place is in the middle of the arena, as large as fits", () => {
  assert.deepEqual(contained(200, 100, [0, 0, 10, 10]), [0.05, 0, 2.5, 0]);
  assert.deepEqual(contained(100, 200, [-5, 0, 5, 10]), [0.05, -2.5, 0, 0]);
});

test("a measured distance is told with both its parts", () => {
  assert.equal(rulerWords([1, 1], [5, 4]), "5.00 m (x 4.00, y 3.00)");
  assert.equal(rulerWords([0, 0], [-300, 0]), "300.0 m (x −300.0, y 0.00)");
});
