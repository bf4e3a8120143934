import assert from "node:assert/strict";
import { test } from "node:test";
import { page } from "./page.mjs";

const { fleetWords } = await page("summary.js");
const { readStick } = await page("stick.js");

const calm = (robot, more = {}) => ({ robot, moving: true, attention: false, silent: false, state_word: "driving", ...more });
const latched = { attention: true, moving: false, state_word: "E-STOP" };

test("a calm fleet is counted", () => {
  assert.equal(fleetWords([calm("r1"), calm("r2", { moving: false })]).words, "2 robots, 1 moving, none needs attention");
  assert.equal(fleetWords([calm("r1", { moving: false })]).words, "1 robot, none moving, none needs attention");
  assert.equal(fleetWords([]).words, "");
});

test("those in trouble are named with the cause, together if they share it", () => {
  const fleet = [calm("r1"), calm("r3", { attention: true, moving: false, state_word: "cliff" }), calm("r10", latched), calm("r2", latched)];
  const { words, trouble } = fleetWords(fleet);
  assert.equal(words, `4 robots, 1 moving, ${trouble}`);
  assert.equal(trouble, "3 need attention: r3, cliff; r2, r10, E-STOP");
});

test("many are counted, and all are all", () => {
  const ids = ["r1", "r2", "r3", "r4", "r5"];
  assert.equal(fleetWords(ids.map((id) => calm(id, latched))).trouble, "5 need attention: all, E-STOP");
  assert.equal(fleetWords([calm("r9"), ...ids.map((id) => calm(id, latched))]).trouble, "5 need attention: r1, r2, r3 and 2 more, E-STOP");
});

test("a robot that is silent counts though it reports nothing wrong", () => {
  assert.equal(fleetWords([calm("r1"), { robot: "r2", silent: true }]).trouble, "1 needs attention: r2, no health report");
});

test("a stick reads as a part of its reach, and never more than 1 in all", () => {
  assert.deepEqual(readStick(0, 0, 80), { x: 0, y: 0 });
  assert.deepEqual(readStick(40, -20, 80), { x: 0.5, y: -0.25 });
  const { x, y } = readStick(300, -400, 80);
  assert.ok(Math.abs(x - 0.6) < 1e-9 && Math.abs(y + 0.8) < 1e-9);
});
