import assert from "node:assert/strict";
import { test } from "node:test";
import { page } from "./page.mjs";

const { DELAY_S, ServerClock, Track } = await page("tracks.js");
const { Viewport, scaleBar } = await page("viewport.js");
const { judgeLink, seconds } = await page("link.js");
const { Looks, kindOf } = await page("palette.js");

test("between two states a robot is in between, and its heading turns the short way", () => {
  const track = new Track();
  track.push(10, 0, 0, 3, 0);
  track.push(10.1, 1, 2, -3, 1);
  const [x, y, heading, speed] = track.pose(10.05);
  assert.ok(Math.abs(x - 0.5) < 1e-9 && Math.abs(y - 1) < 1e-9 && Math.abs(speed - 0.5) < 1e-9);
  assert.ok(Math.abs(Math.abs(heading) - Math.PI) < 1e-9);
});

test("a robot is never drawn further than it was heard of", () => {
  const track = new Track();
  assert.equal(track.pose(1), null);
  track.push(10, 0, 0, 0, 1);
  track.push(10.1, 1, 0, 0, 1);
  assert.deepEqual(track.pose(99), [1, 0, 0, 1]);
  assert.deepEqual(track.pose(1), [0, 0, 0, 1]);
});

test("a console started anew has another clock; the track begins again", () => {
  const track = new Track();
  track.push(1000, 5, 5, 0, 0);
  track.push(3, 6, 6, 0, 0);
  assert.deepEqual(track.pose(3), [6, 6, 0, 0]);
});

test("a trail keeps one minute, and standing still adds nothing", () => {
  const track = new Track();
  for (let k = 0; k < 3000; k += 1) track.push(k * 0.05, Math.min(k, 2000) * 0.02, 0, 0, 0);
  const [first, last] = [track.trail[0], track.trail.at(-1)];
  assert.ok(first[0] >= 3000 * 0.05 - 60.1, `${first[0]}`);
  assert.ok(last[0] > 99 && last[0] <= 2000 * 0.05 + 0.3, `${last[0]}`);
});

test("the trail of before a reload is put before the new one", () => {
  const track = new Track();
  track.push(100, 9, 9, 0, 0);
  track.recall([[1, 1], [2, 2]], 100);
  assert.deepEqual(track.trail.map((point) => point.slice(1)), [[1, 1], [2, 2], [9, 9]]);
  assert.ok(track.trail[0][0] < track.trail[1][0] && track.trail[1][0] < 100);
});

test("the fastest message tells the server's clock", () => {
  const clock = new ServerClock();
  for (const [at, delay] of [[1, 0.05], [2, 0.01], [3, 0.2]]) clock.update(at, at + 500 + delay);
  assert.ok(Math.abs(clock.drawn(510) - (10 - 0.01 - DELAY_S)) < 0.002);
  clock.update(1, 520); // a new console
  assert.ok(Math.abs(clock.drawn(520) - (1 - DELAY_S)) < 1e-9);
});

test("the map is drawn as far in the past as states are apart, so that it always knows both ends", () => {
  const clock = new ServerClock();
  for (let k = 0; k < 100; k += 1) clock.update(k * 0.05, 500 + k * 0.05);
  assert.ok(Math.abs(clock.drawn(504.95) - (4.95 - DELAY_S)) < 1e-6, "20 a second");
  for (let k = 0; k < 100; k += 1) clock.update(5 + k * 0.1, 505 + k * 0.1);
  const drawn_s = clock.drawn(514.9);
  assert.ok(drawn_s < 14.8 && drawn_s > 14.7, `10 a second: ${drawn_s}`);
  clock.update(60, 560); // a pause is not a rate
  assert.ok(clock.drawn(560) > 59.8);
});

test("zooming leaves the point under the mouse where it is, and screen and world agree", () => {
  const view = new Viewport();
  [view.width, view.height] = [800, 600];
  view.fit([0, 0, 20, 10]);
  const before = view.toWorld(100, 120);
  view.zoomAt(1.7, 100, 120);
  const after = view.toWorld(100, 120);
  assert.ok(Math.hypot(after[0] - before[0], after[1] - before[1]) < 1e-9);
  const [x, y] = view.toWorld(...view.toScreen(3, 4));
  assert.ok(Math.hypot(x - 3, y - 4) < 1e-9);
  assert.ok(view.toScreen(0, 5)[1] < view.toScreen(0, 4)[1], "north is up");
});

test("the bar of the scale is a round length that fits", () => {
  for (const px_per_m of [3, 22, 40, 333]) {
    const metres = scaleBar(px_per_m, 120);
    assert.ok(metres * px_per_m <= 120 && metres * px_per_m > 40, `${px_per_m}`);
  }
});

const FRESH = { open: true, now_s: 100, heard_s: 99.9, fleet_s: 99.9, hub: true, core_age_s: 0.1, refused: "" };

test("fresh data is live; each loss is named", () => {
  assert.equal(judgeLink(FRESH).text, "live");
  assert.equal(judgeLink({ ...FRESH, now_s: 103.1 }).text, "no data for 3.2 s");
  assert.equal(judgeLink({ ...FRESH, open: false }).level, "old");
  assert.equal(judgeLink({ ...FRESH, hub: false }).text, "hub lost");
  assert.equal(judgeLink({ ...FRESH, core_age_s: null }).text, "core is silent");
  assert.match(judgeLink({ ...FRESH, core_age_s: 2 }).text, /^core is silent for 2.1 s/);
  assert.equal(judgeLink({ ...FRESH, refused: "wrong token" }).text, "wrong token");
  assert.equal(judgeLink({ ...FRESH, heard_s: null, fleet_s: null, open: false }).text, "connecting");
});

test("the core's silence goes on growing between two messages", () => {
  assert.equal(judgeLink({ ...FRESH, now_s: 100.2, core_age_s: 0.8 }).level, "core");
});

test("ages are told as finely as it matters", () => {
  assert.deepEqual([0.04, 3.24, 42.4, 600].map(seconds), ["0.0 s", "3.2 s", "42 s", "10 min"]);
});

test("a behaviour and its filtered variant look the same, different laws do not", () => {
  const names = ["flocking", "flocking_bc", "move_to_goal", "navigate", "formation", "rendezvous", "voronoi_coverage", "drive", "orbit"];
  const looks = new Looks(names);
  assert.deepEqual(looks.of("flocking"), looks.of("flocking_bc"));
  const seen = new Set(names.map((name) => JSON.stringify(looks.of(name))));
  assert.equal(seen.size, 8);
});

test("the icon of a robot is that of its make's record, else a circle and its make's initial", () => {
  const icons = { create: ["circle", "C"], "mavlink+udp": ["square", "M"], "can+odrive": ["hexagon", "B"], null: ["circle", ""] };
  assert.deepEqual(kindOf("iRobot", "create:///dev/ttyUSB0?model=create2", icons), { shape: "circle", letter: "C" });
  assert.equal(kindOf("", "mavlink+udp://127.0.0.1:14550", icons).shape, "square");
  assert.equal(kindOf("", "can+odrive://vcan0", icons).shape, "hexagon");
  assert.deepEqual(kindOf("Acme", "acme://x", icons), { shape: "circle", letter: "A" });
  assert.equal(kindOf("Nobody", "null://r1", icons).letter, "N");
  assert.equal(kindOf("", "").letter, "?");
});
