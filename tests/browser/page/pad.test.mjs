import assert from "node:assert/strict";
import { test } from "node:test";
import { page } from "./page.mjs";

const { DEAD_ZONE, deadZone, pressed, readArrows, readPad } = await page("drive.js");
const { neighbour } = await page("selection.js");

function pad(axes, held = []) {
  return { axes, buttons: Array.from({ length: 17 }, (_, k) => ({ pressed: held.includes(k), value: 0 })) };
}

test("within the dead zone there is nothing, at its edge it starts from zero, at the end it is full", () => {
  assert.equal(deadZone(DEAD_ZONE), 0);
  assert.equal(deadZone(-0.1), 0);
  assert.ok(deadZone(DEAD_ZONE + 0.001) > 0 && deadZone(DEAD_ZONE + 0.001) < 0.01);
  assert.equal(deadZone(1), 1);
  assert.equal(deadZone(-1.2), -1);
});

test("an axis that is not a number counts as zero", () => {
  for (const broken of [NaN, undefined, null]) assert.equal(deadZone(broken), 0);
  const { linear, angular } = readPad(pad([]));
  assert.deepEqual([linear, angular], [0, 0]);
});

test("forwards is up, left is a positive turn, half without the turbo", () => {
  const slow = readPad(pad([-1, -1], [4]));
  assert.deepEqual([slow.deadman, slow.linear, slow.angular], [true, 0.5, 0.5]);
  const fast = readPad(pad([1, 1], [4, 5]));
  assert.deepEqual([fast.linear, fast.angular], [-1, -1]);
});

test("the e-stop needs no dead-man", () => {
  const read = readPad(pad([0, 0], [1]));
  assert.deepEqual([read.estop, read.deadman], [true, false]);
});

test("only what went down since the last reading counts as pressed", () => {
  const before = { left: true, right: false };
  assert.deepEqual(pressed(before, { left: true, right: true }), ["right"]);
  assert.deepEqual(pressed(before, { left: false, right: false }), []);
});

test("opposite arrows cancel", () => {
  assert.deepEqual(readArrows(new Set(["ArrowUp", "ArrowDown", "ArrowLeft"])), { linear: 0, angular: 0.5 });
});

test("the next of the last is the first; nobody has no next", () => {
  assert.equal(neighbour(["a", "b"], "b", 1), "a");
  assert.equal(neighbour(["a", "b"], "a", -1), "b");
  assert.equal(neighbour(["a", "b"], undefined, 1), "a");
  assert.equal(neighbour(["a", "b"], "gone", -1), "b");
  assert.equal(neighbour([], undefined, 1), undefined);
});
