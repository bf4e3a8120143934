import assert from "node:assert/strict";
import { test } from "node:test";
import { Bench } from "./browser.mjs";
import { page } from "./page.mjs";

const { NOT_REPORTED } = await page("selection.js");
const LB = 4;

/** Return a bench with two robots, and a group selected of which none is there. */
async function absent(ids = ["r7", "r8"]) {
  const bench = await Bench.with("r1", "r2");
  bench.hear({ t: "world", groups: { spare: ids } });
  bench.selection.set(bench.selection.groups().get("spare"), "spare");
  return bench;
}

function start(bench) {
  bench.panel.chosen = "flocking_bc";
  bench.element("behaviour-form").fire("submit");
}

for (const [what, ids] of [["that is switched off", ["r7", "r8"]], ["without robots", []]]) {
  test(`a group ${what} starts nobody, and the page says so`, async () => {
    const bench = await absent(ids);
    assert.match(bench.element("start").textContent, new RegExp(NOT_REPORTED, "i"));
    start(bench);
    await bench.clock.pass(100);
    assert.deepEqual(bench.sent("request"), []);
    assert.match(bench.element("refusal").textContent, new RegExp(NOT_REPORTED));
    assert.match(bench.element("selection-names").textContent, /not reported/);
    assert.equal(bench.element("select-none").disabled, false);
  });
}

function robot(id, more = {}) {
  return { robot: id, estop: false, silent: false, fault: "", stop_reason: "", lifecycle: "ACTIVE", attention: false, ...more };
}

function fleet(bench, ...robots) {
  bench.hear({ t: "fleet", at: 1, hub: true, core_age_s: 0.1, nodes: [], robots, missing: [], silent: [] });
}

test("a refusal goes with its cause, and only then", async () => {
  const bench = await Bench.with("r1", "r2");
  fleet(bench, robot("r1"), robot("r2"));
  const said = { t: "request", request_id: "a", behaviour: "flocking_bc", phase: "refused", reason: "its e-stop is latched",
    robots: ["r1"], running: [], missing: [], refused_by: ["r1"], operator: "anna", mine: true };
  bench.hear(said);
  fleet(bench, robot("r1", { estop: true }), robot("r2", { silent: true })); // the cause is seen only now
  fleet(bench, robot("r1", { estop: true }), robot("r2"));
  assert.match(bench.element("refusal").textContent, /its e-stop is latched/);
  fleet(bench, robot("r1"), robot("r2"));
  assert.equal(bench.element("refusal").textContent, "");
});

test("a refusal with a code goes with the cause that the code names, and with the next request", async () => {
  const bench = await Bench.with("r1", "r2");
  const words = () => bench.element("refusal").textContent;
  const refused = { t: "request", request_id: "a", behaviour: "flocking_bc", phase: "refused", reason: "its e-stop is latched", code: "estop_latched",
    robots: ["r1"], running: [], missing: [], refused_by: ["r1"], operator: "anna", mine: true };
  fleet(bench, robot("r1"), robot("r2", { silent: true }));
  bench.hear(refused);
  fleet(bench, robot("r1", { estop: true }), robot("r2")); // another robot's trouble has gone: that is no cause
  assert.match(words(), /its e-stop is latched/);
  fleet(bench, robot("r1"), robot("r2"));
  assert.equal(words(), "");
  bench.hear(refused);
  fleet(bench, robot("r1"), robot("r2")); // its cause has not been reported yet
  assert.match(words(), /its e-stop is latched/);
  await bench.clock.pass(4000);
  fleet(bench, robot("r1"), robot("r2"));
  assert.equal(words(), "", "it was never seen: it has gone meanwhile");
  bench.hear(refused);
  fleet(bench, robot("r1", { estop: true }), robot("r2"));
  assert.match(words(), /its e-stop is latched/);
  void bench.commands.request("flocking_bc", ["r2"]);
  assert.equal(words(), "");
});

test("it gets neither goal nor formation", async () => {
  const bench = await absent();
  bench.tools.use("goal");
  assert.equal(bench.tools.mode, "select");
  bench.tools.goal([1, 2]);
  bench.tools.mode = "formation"; // taken while others were selected
  bench.tools.dragFrom([1, 1]);
  bench.tools.dragTo([2, 2]);
  bench.tools.dragEnd([], false);
  await bench.clock.pass(100);
  assert.deepEqual(bench.sent("request"), []);
  assert.equal(bench.told.length, 3);
  assert.ok(bench.told.every((words) => words.includes(NOT_REPORTED)));
});

test("it is not driven", async () => {
  const bench = await absent();
  bench.plug(0);
  await bench.clock.pass(100);
  bench.press(0, LB);
  await bench.clock.pass(100);
  assert.equal(bench.driver.words, `not driving: ${NOT_REPORTED}`);
  assert.deepEqual(bench.sent("drive"), []);
});

test("a formation dragged while nobody is selected goes to nobody", async () => {
  const bench = await Bench.with("r1", "r2");
  bench.selection.set(["r1"]);
  bench.tools.use("formation");
  bench.tools.dragFrom([1, 1]);
  bench.selection.clear();
  bench.tools.dragEnd([], false);
  await bench.clock.pass(100);
  assert.deepEqual(bench.sent("request"), []);
});

test("those of a group that are there get the order, and nobody selected is still the whole swarm", async () => {
  const bench = await absent(["r2", "r7"]);
  start(bench);
  bench.selection.clear();
  start(bench);
  await bench.clock.pass(100);
  assert.deepEqual(bench.sent("request").map(({ robots }) => robots), [["r2"], []]);
});

test("a group of which somebody is heard at last can be started", async () => {
  const bench = await absent();
  bench.fleet(["r1", "r2", "r8"]);
  assert.equal(bench.element("start").textContent, "Start for 1 robot");
});
