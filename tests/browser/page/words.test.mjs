import assert from "node:assert/strict";
import { test } from "node:test";
import { page } from "./page.mjs";

const { needsAttention, steady, troubleText } = await page("attention.js");
const { parameterWords, sections } = await page("facts.js");
const { nameProblem } = await page("groups.js");
const { causeHolds } = await page("refusals.js");
const { newestOfEach } = await page("store.js");
const { fleetWords, progressWords, titleOf } = await page("words.js");

const BEHAVIOURS = { flocking_bc: { title: "Flocking", filtered: true }, old: {} };

test("what is listed keeps its place; new ones are added at the end", () => {
  assert.deepEqual(steady([], ["r2", "r7"], false), ["r2", "r7"]);
  assert.deepEqual(steady(["r7"], ["r2", "r7"], false), ["r7", "r2"]);
  assert.deepEqual(steady(["r7", "r2"], ["r2"], false), ["r2"]);
  assert.deepEqual(steady(["r7", "r2"], ["r2"], true), ["r7", "r2"], "while a pointer is there, none moves");
});

test("silence and trouble need attention, an ending does not", () => {
  assert.ok(needsAttention({ silent: true }) && needsAttention({ attention: true }));
  assert.ok(!needsAttention({ ended: "stick released" }));
  assert.equal(troubleText({ state_why: "a cliff is ahead", advice: "Move it." }), "A cliff is ahead. Move it.");
  assert.equal(troubleText({ state_word: "SILENT for 3 s", advice: "Check it." }), "SILENT for 3 s. Check it.");
});

test("the header says what the fleet does", () => {
  const robot = (behaviour, moving, silent = false) => ({ behaviour, moving, silent });
  assert.equal(fleetWords([]), "no robots");
  assert.equal(fleetWords([robot("x", true), robot("x", false), robot("", false)]), "2 active · 1 moving");
  assert.equal(fleetWords([robot("", false), robot("stop", false)]), "none active · all standing");
  assert.equal(fleetWords([robot("x", true, true), robot("", false)]), "none active · none moving");
  assert.equal(fleetWords([robot("x", true, true)]), "1 robot silent");
});

test("behaviours have titles, and a stop is stopped", () => {
  assert.deepEqual(["flocking_bc", "old", "gone", "stop", ""].map((name) => titleOf(BEHAVIOURS, name)), ["Flocking", "old", "gone", "Stop", ""]);
  const status = { behaviour: "stop", phase: "running", robots: ["a", "b"], running: ["a", "b"] };
  assert.equal(progressWords(status, "Stop"), "stopped, 2 of 2");
  assert.equal(progressWords({ ...status, behaviour: "flocking_bc" }, "Flocking"), "Flocking: 2 of 2 run it");
  const partly = { ...status, behaviour: "flocking_bc", running: ["a"], refused_by: ["b"], reason: "its e-stop is latched" };
  assert.equal(progressWords(partly, "Flocking"), "Flocking: 1 of 2 run it so far · refused by b: its e-stop is latched");
});

test("the cause of a refusal is judged by its code", () => {
  const facts = { info: (id) => ({ estop: id === "r1", fault: id === "r2" ? "cliff" : "" }), heldByOthers: (ids) => new Map(ids.includes("r3") ? [["r3", "bob"]] : []) };
  assert.equal(causeHolds("estop_latched", ["r1", "r2"], facts), true);
  assert.equal(causeHolds("estop_latched", ["r2"], facts), false);
  assert.equal(causeHolds("held", ["r3"], facts), true);
  assert.equal(causeHolds("held", ["r1"], facts), false);
  assert.equal(causeHolds("cliff", ["r2"], facts), true);
  assert.equal(causeHolds("parameters", ["r1"], facts), null, "the page does not see it");
  assert.equal(causeHolds("toString", ["r1"], facts), null);
});

test("of a line that is repeated the newest one is kept", () => {
  const log = [{ number: 1, count: 1 }, { number: 2, count: 1 }, { number: 1, count: 2 }, { text: "of an older console" }];
  assert.deepEqual(newestOfEach(log), log.slice(1));
});

test("a group has a name of its own", () => {
  assert.equal(nameProblem("left", ["scouts"]), "");
  for (const name of ["", "two words", "all", "scouts", "x".repeat(65)]) assert.ok(nameProblem(name, ["scouts"]), name);
});

test("a parameter is named with its unit", () => {
  assert.deepEqual(parameterWords("safety_margin_m"), { label: "safety margin", unit: "m" });
  assert.deepEqual(parameterWords("barrier_gain_per_s"), { label: "barrier gain", unit: "1/s" });
  assert.deepEqual(parameterWords("goal", { type: "point", unit: "m" }), { label: "goal", unit: "m" });
});

test("the details name pose, sources, filter and holder; what is unknown is a dash", () => {
  const rows = (known) => Object.fromEntries(sections(known).flatMap(({ rows: each }) => each));
  const nothing = rows({ robot: {}, detail: null, lease: undefined, behaviours: {}, filter: undefined });
  assert.equal(nothing.position, "–");
  assert.equal(nothing["held by"], "nobody");
  const detail = {
    pose: { x_m: 1, y_m: 2.345, heading_rad: Math.PI / 2, source: "fixes", note: "", sigma_m: 0.012, heading_sigma_rad: null,
      sources: [{ sensor: "ceiling", used: true, residual_m: 0.004, age_s: 0.1 }, { sensor: "gnss", refused: "too far off", age_s: 2 }] },
    order: { behaviour: "flocking_bc", parameters: { cruise_m_s: 0.3 }, operator: "anna", request_id: "a1b2" }, dropped: {},
  };
  const robot = { behaviour: "flocking_bc", contacts: 0, collisions: 2, state_word: "moving" };
  const known = rows({ robot, detail, lease: { mine: true }, behaviours: BEHAVIOURS, filter: [0, 0.2, "r4"] });
  assert.equal(known.position, "1.00 m, 2.35 m, heading 90°");
  assert.equal(known.ceiling, "used, 0.004 m off, 0.1 s old");
  assert.equal(known.gnss, "not used: too far off, 2.0 s old");
  assert.equal(known.cruise, "0.3 m/s");
  assert.equal(known.changes, "0.20 m/s towards 90°, because of r4");
  assert.ok(!JSON.stringify(known).includes("a1b2"), "no id of a request");
});
