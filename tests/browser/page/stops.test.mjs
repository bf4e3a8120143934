import assert from "node:assert/strict";
import { test } from "node:test";
import { Bench } from "./browser.mjs";

const READ_ONLY = { ok: false, reason: "this console is read-only: it was started with --read-only" };

function panel(bench) {
  const box = bench.element("stop-panel");
  return { words: bench.element("stop-receipts").textContent, mood: box.dataset.mood, shown: !box.hidden };
}

// -------------------------------------------------------------------- receipts
test("all stand: that is good, and the panel goes by itself", async () => {
  const bench = await Bench.with("r1", "r2");
  bench.hear({ t: "stop", standing: ["r1"], moving: ["r2"], silent: [], done: false });
  assert.deepEqual(panel(bench), { words: "1 of 2 standing · still moving: r2", mood: "", shown: true });
  bench.hear({ t: "stop", standing: ["r1", "r2"], moving: [], silent: [], done: true });
  assert.deepEqual(panel(bench), { words: "2 of 2 standing", mood: "good", shown: true });
  await bench.clock.pass(20_000);
  assert.equal(panel(bench).shown, false);
});

test("a robot that is not heard counts, by name, and the panel stays", async () => {
  const bench = await Bench.with("r1", "r2", "r10");
  bench.hear({ t: "stop", standing: ["r1"], moving: [], silent: ["r10", "r2"], done: false });
  assert.deepEqual(panel(bench), { words: "1 of 3 standing, r2, r10 silent", mood: "bad", shown: true });
  await bench.clock.pass(20_000);
  assert.equal(panel(bench).shown, true);
});

test("it is never good while somebody is silent or nobody is there, whatever the console says", async () => {
  const bench = await Bench.with();
  for (const done of [false, true]) {
    bench.hear({ t: "stop", standing: ["r1"], moving: [], silent: ["r2"], done });
    assert.equal(panel(bench).mood, "bad");
    bench.hear({ t: "stop", standing: [], moving: [], silent: [], done });
    assert.deepEqual(panel(bench), { words: "0 of 0 standing: no robot has reported", mood: "bad", shown: true });
  }
});

// -------------------------------------------------------------------- what did not get through
test("without a link a stop waits for it, and goes out", async () => {
  const bench = await Bench.with("r1");
  bench.breakLine();
  bench.stops.stop();
  await bench.clock.pass(1);
  assert.match(panel(bench).words, /^NOT SENT: no link to the console. It goes out if the link is back within 10 s/);
  assert.equal(panel(bench).mood, "bad");
  await bench.clock.pass(1000);
  assert.equal(bench.sent("stop").length, 1);
});

test("a link that breaks before the answer: the stop goes out again", async () => {
  const bench = await Bench.with("r1");
  bench.stops.stop();
  bench.breakLine();
  await bench.clock.pass(1);
  assert.match(panel(bench).words, /^NOT CONFIRMED: the link to the console broke. It goes out again/);
  await bench.clock.pass(1000);
  assert.equal(bench.sent("stop").length, 2);
});

test("a console that refuses is quoted, and nothing is said to wait", async () => {
  const bench = await Bench.with("r1");
  bench.answers(() => READ_ONLY);
  bench.stops.stop();
  await bench.clock.pass(100);
  assert.match(panel(bench).words, /^NOT DONE: this console is read-only.* Use the switches on the robots/);
  assert.doesNotMatch(panel(bench).words, /link/);
  assert.equal(panel(bench).mood, "bad");
  assert.deepEqual(bench.refused, [READ_ONLY.reason]);
});

test("a console that does not answer is said not to", async () => {
  const bench = await Bench.with("r1");
  bench.answers(({ t }) => (t === "ping" ? { ok: true } : undefined));
  bench.stops.stop();
  for (let k = 0; k < 10; k += 1) {
    bench.link.post({ t: "ping" }); // the line itself is alive
    await bench.clock.pass(500);
  }
  assert.match(panel(bench).words, /^NOT CONFIRMED: the console gave no answer. Press again/);
  assert.equal(bench.sent("stop").length, 1);
  assert.deepEqual(bench.refused, []);
});

test("why an e-stop was refused stands until another one is heard of", async () => {
  const bench = await Bench.with("r1");
  const title = () => bench.element("estop-title").textContent;
  bench.answers(() => READ_ONLY);
  bench.stops.estop();
  await bench.clock.pass(100);
  assert.match(title(), /^NOT DONE: this console is read-only/);
  bench.fleet(["r1"]);
  assert.match(title(), /^NOT DONE/, "the next look at the fleet does not wipe it off");
  const receipts = [{ robot: "r1", standing: true, engaged: true, rolled_m: 0, after_s: 0.1 }];
  bench.hear({ t: "estop", id: "e1", engaged: true, done: true, receipts, waiting: [], silent: [] });
  assert.equal(title(), "E-STOP: 1 of 1 confirmed standing");
});

test("why an e-stop was refused does not come up again with a later latch", async () => {
  const bench = await Bench.with("r1");
  bench.answers(() => READ_ONLY);
  bench.stops.estop();
  await bench.clock.pass(20_000);
  bench.hear({ t: "fleet", hub: true, core_age_s: 0.1, robots: [{ robot: "r1", estop: true }] });
  assert.equal(bench.element("estop-title").textContent, "E-STOP latched on 1");
});
