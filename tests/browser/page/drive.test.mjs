import assert from "node:assert/strict";
import { test } from "node:test";
import { Bench } from "./browser.mjs";

const B = 1;
const LB = 4;
const POLL_MS = 20;
const LONGEST_MS = 100; // so often the console wants to hear that the dead-man is held
const ZERO = { linear: 0, angular: 0 };

/** Return a bench on which pad 0 drives r1. */
async function driving() {
  const bench = await Bench.with("r1", "r2");
  bench.selection.set(["r1"]);
  bench.plug(0);
  await bench.clock.pass(100);
  bench.press(0, LB);
  await bench.clock.pass(100);
  assert.equal(bench.driver.words, "driving r1");
  return bench;
}

/** Move the stick at every poll, to what `axis` returns for its number. */
async function steer(bench, polls, axis) {
  for (let k = 0; k < polls; k += 1) {
    bench.pads[0].axes = [0, axis(k), 0, 0];
    await bench.clock.pass(POLL_MS);
  }
}

function gaps(frames) {
  return frames.slice(1).map((frame, k) => frame.at_ms - frames[k].at_ms);
}

// -------------------------------------------------------------------- which pad
test("a second pad whose dead-man is down does not drive on when the first is unplugged", async () => {
  const bench = await driving();
  bench.plug(1, [LB]);
  bench.pads[1].axes = [0, -1, 0, 0];
  await bench.clock.pass(100);
  bench.unplug(0);
  const { length } = bench.sent("drive");
  assert.equal(bench.sent().at(-1).t, "release");
  await bench.clock.pass(500);
  assert.equal(bench.driver.held, false);
  assert.equal(bench.sent("drive").length, length);
  bench.press(1, LB, false);
  await bench.clock.pass(100);
  bench.press(1, LB);
  await bench.clock.pass(100);
  assert.equal(bench.driver.held, true, "a fresh press drives");
});

test("the pad that drives goes on when another one is plugged in before it or after it", async () => {
  const bench = await Bench.with("r1");
  bench.selection.set(["r1"]);
  bench.plug(1);
  await bench.clock.pass(100);
  bench.press(1, LB);
  await bench.clock.pass(100);
  bench.plug(0);
  await bench.clock.pass(500);
  assert.equal(bench.driver.held, true);
  assert.equal(bench.pad.name, "pad 1");
  bench.press(1, LB, false);
  await bench.clock.pass(100);
  assert.equal(bench.driver.held, false, "it is still the one that counts");
});

test("the e-stop of every pad counts, once a press, and not if it was down when the pad was plugged in", async () => {
  const bench = await driving();
  bench.plug(1, [B]);
  await bench.clock.pass(100);
  assert.equal(bench.sent("estop").length, 0);
  for (const presses of [1, 2]) {
    bench.press(1, B, false);
    await bench.clock.pass(100);
    bench.press(1, B);
    await bench.clock.pass(100);
    assert.equal(bench.sent("estop").length, presses);
  }
  bench.press(0, B);
  await bench.clock.pass(100);
  assert.equal(bench.sent("estop").length, 3, "the one that drives has it, too");
});

test("a pad that takes the place of another between two looks is another pad", async () => {
  const bench = await driving();
  bench.plug(0, [LB]);
  await bench.clock.pass(500);
  assert.equal(bench.driver.held, false);
});

// -------------------------------------------------------------------- how often
test("a stick that moves all the time is told at most 30 times a second, and never too seldom", async () => {
  const bench = await driving();
  const { length } = bench.sent();
  await steer(bench, 500, (k) => -0.3 - 0.0005 * k);
  const frames = bench.sent().slice(length);
  assert.ok(frames.length <= 30 * 10, `${frames.length / 10} frames/s`);
  assert.ok(frames.length >= 25 * 10, `${frames.length / 10} frames/s`);
  assert.ok(Math.max(...gaps(frames)) <= LONGEST_MS);
  assert.equal(bench.driver.held, true);
});

test("a stick that trembles at the edge of its dead zone is told no more often", async () => {
  const bench = await driving();
  const { length } = bench.sent();
  await steer(bench, 500, (k) => (k % 2 ? 0 : -0.2));
  const frames = bench.sent().slice(length);
  assert.ok(frames.length <= 30 * 10, `${frames.length / 10} frames/s`);
  assert.ok(Math.max(...gaps(frames)) <= LONGEST_MS);
});

test("zero and letting go are told at once, however lately the last frame was sent", async () => {
  const bench = await Bench.with("r1");
  bench.selection.set(["r1"]);
  bench.driver.begin();
  bench.driver.set({ linear: 0.5, angular: 0 });
  await bench.clock.pass(34);
  assert.equal(bench.sent().at(-1).sticks.linear, 0.5);
  bench.driver.set({ linear: 0.6, angular: 0 });
  const { length } = bench.sent();
  bench.driver.set(ZERO);
  assert.deepEqual(bench.sent().slice(length).map(({ sticks }) => sticks), [ZERO]);
  bench.driver.release();
  assert.equal(bench.sent().at(-1).t, "release");
  await bench.clock.pass(1000);
  assert.equal(bench.sent().at(-1).t, "release");
});

test("the last of quick moves is told, and a stick that rests 20 times a second", async () => {
  const bench = await driving();
  for (const linear of [0.2, 0.3, 0.4]) bench.driver.set({ linear, angular: 0 });
  bench.pads[0].axes = [0, -1, 0, 0];
  await bench.clock.pass(100);
  const { length } = bench.sent();
  await bench.clock.pass(1000);
  const rest = bench.sent().slice(length);
  assert.equal(rest.length, 20);
  assert.ok(rest.every(({ sticks }) => sticks.linear === 0.5));
});

test("sticks that are moved while nobody drives do not count when somebody does", async () => {
  const bench = await Bench.with("r1");
  bench.selection.set(["r1"]);
  bench.driver.set({ linear: 0.5, angular: 0 });
  bench.driver.begin();
  await bench.clock.pass(200);
  assert.ok(bench.sent("drive").every(({ sticks }) => sticks.linear === 0));
});

// -------------------------------------------------------------------- refusals
test("who is refused is told why, and drives only after a new press", async () => {
  const reason = "stopped while driving: release the dead-man switch first";
  const bench = await driving();
  bench.answers(({ t }) => (t === "drive" ? { ok: false, reason } : { ok: true }));
  await bench.clock.pass(200);
  assert.equal(bench.driver.words, `not driving: ${reason}`);
  assert.equal(bench.driver.held, false);
  assert.deepEqual(bench.refused, [reason]);
  assert.equal(bench.sent().at(-1).t, "release");
  bench.answers(() => ({ ok: true }));
  await bench.clock.pass(1000);
  assert.equal(bench.driver.held, false, "the thumb is still down");
  bench.press(0, LB, false);
  await bench.clock.pass(100);
  bench.press(0, LB);
  await bench.clock.pass(200);
  assert.equal(bench.driver.words, "driving r1");
});

test("what is refused of an earlier press does not end the present one", async () => {
  const bench = await Bench.with("r1");
  bench.selection.set(["r1"]);
  bench.answers(() => ({ ok: false, reason: "too late" }));
  bench.driver.begin();
  bench.driver.release();
  bench.answers(() => ({ ok: true }));
  bench.driver.begin();
  await bench.clock.pass(500);
  assert.equal(bench.driver.words, "driving r1");
  assert.deepEqual(bench.refused, []);
});

test("a link that breaks ends the driving, and is no refusal", async () => {
  const bench = await driving();
  bench.breakLine();
  assert.equal(bench.driver.words, "not driving: no link");
  assert.deepEqual(bench.refused, []);
});
