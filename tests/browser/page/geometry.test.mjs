import assert from "node:assert/strict";
import { test } from "node:test";
import { page } from "./page.mjs";

const { assign, bounds, closestPair, goalRadius, insidePolygon, lassoed, mixAngle, places, robotAt } = await page("geometry.js");

const U_SHAPE = [[0, 0], [6, 0], [6, 4], [4, 4], [4, 1], [2, 1], [2, 4], [0, 4]];

test("a lasso holds what lies within it, also in a bent one", () => {
  assert.ok(insidePolygon([1, 3], U_SHAPE));
  assert.ok(insidePolygon([5, 3], U_SHAPE));
  assert.ok(!insidePolygon([3, 3], U_SHAPE), "the gap of the U");
  assert.ok(!insidePolygon([7, 1], U_SHAPE));
});

test("the direction in which a lasso is drawn does not matter", () => {
  const robots = [{ id: "a", x: 1, y: 1 }, { id: "b", x: 3, y: 3 }];
  assert.deepEqual(lassoed(robots, U_SHAPE), ["a"]);
  assert.deepEqual(lassoed(robots, [...U_SHAPE].reverse()), ["a"]);
});

test("a lasso of two points holds nobody", () => {
  assert.deepEqual(lassoed([{ id: "a", x: 0, y: 0 }], [[-1, -1], [1, 1]]), []);
});

test("a click takes the nearest robot within reach", () => {
  const robots = [{ id: "far", x: 1, y: 0, radius: 0.2 }, { id: "near", x: 0.5, y: 0, radius: 0.2 }];
  assert.equal(robotAt(robots, [0.2, 0], 0.3)?.id, "near");
  assert.equal(robotAt(robots, [-0.5, 0], 0.3), null);
});

test("a ring passes through where the mouse is, with equal gaps", () => {
  const ring = places("ring", [1, 1], [1, 4], 6);
  assert.ok(Math.hypot(ring[0][0] - 1, ring[0][1] - 4) < 1e-9);
  for (const [x, y] of ring) assert.ok(Math.abs(Math.hypot(x - 1, y - 1) - 3) < 1e-9);
  assert.ok(Math.abs(closestPair(ring) - 3) < 1e-9);
});

test("a line has its middle where the drag began; one robot stands there", () => {
  assert.deepEqual(places("line", [0, 0], [2, 0], 3), [[2, 0], [0, 0], [-2, 0]]);
  assert.deepEqual(places("line", [3, 1], [5, 1], 1), [[3, 1]]);
});

test("a grid has a corner at the mouse when it is square", () => {
  const grid = places("grid", [0, 0], [1, 1], 4);
  assert.equal(grid.length, 4);
  assert.ok(grid.some(([x, y]) => Math.hypot(x - 1, y - 1) < 1e-9));
  assert.ok(Math.abs(closestPair(grid) - 2) < 1e-9);
});

function cost(from, targets) {
  return from.reduce((sum, [x, y], k) => sum + (x - targets[k][0]) ** 2 + (y - targets[k][1]) ** 2, 0);
}

function permutations(items) {
  if (items.length < 2) return [items];
  return items.flatMap((item, k) => permutations(items.toSpliced(k, 1)).map((rest) => [item, ...rest]));
}

test("targets are handed out as well as any permutation could", () => {
  let seed = 7;
  const random = () => (seed = (seed * 16807) % 2147483647) / 2147483647;
  for (let n = 1; n <= 6; n += 1) {
    const from = Array.from({ length: n }, () => [random() * 10, random() * 10]);
    const targets = Array.from({ length: n }, () => [random() * 10, random() * 10]);
    const given = assign(from, targets);
    assert.deepEqual([...given].sort(), [...targets].sort(), "each exactly once");
    const best = Math.min(...permutations(targets).map((order) => cost(from, order)));
    assert.ok(cost(from, given) <= best + 1e-9, `${n} robots`);
  }
});

test("several robots get room around a goal, one drives right to it", () => {
  assert.equal(goalRadius(1, 0.17), 0.05);
  for (const n of [2, 8, 40]) {
    const area = Math.PI * goalRadius(n, 0.17) ** 2;
    assert.ok(area > n * Math.PI * 0.17 ** 2 * 2, "twice the area of the discs");
  }
});

test("a heading turns the short way round", () => {
  assert.ok(Math.abs(Math.abs(mixAngle(3, -3, 0.5)) - Math.PI) < 1e-9);
});

test("the box around no points is null", () => {
  assert.equal(bounds([]), null);
  assert.deepEqual(bounds([[1, 2], [-1, 5]]), [-1, 2, 1, 5]);
});
