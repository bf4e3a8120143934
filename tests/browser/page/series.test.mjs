import assert from "node:assert/strict";
import { test } from "node:test";
import { page } from "./page.mjs";

const { aboutOf, DEFAULT, figure, format, fromAddress, parse, resolve, toAddress, whoOf } = await page("series.js");

const CATALOGUE = {
  fields: [{ name: "battery", title: "Battery", unit: "%", doc: "charge", scale: 100 }],
  metrics: [{ name: "work.total_m", title: "Work", unit: "m", doc: "distance", scale: 1 }],
};
const GROUPS = new Map([["all", ["r1", "r2", "r3"]], ["west", ["r1", "r2"]], ["make: create", ["r3"]], ["none", []]]);

test("a choice is written as it is read", () => {
  for (const text of ["battery", "battery@west", "speed:r1,r2", "work.total_m", "x@make: create", "", "@", "a@b:c"]) {
    assert.equal(format(parse(text)), text.replace(/@$/, ""), text);
  }
  assert.deepEqual(parse("speed:r1,r2"), { of: "speed", robots: ["r1", "r2"], group: "" });
  assert.deepEqual(parse("x@make: create"), { of: "x", robots: [], group: "make: create" });
});

test("an address has the charts, unless they are those of the start, and all else as it was", () => {
  assert.deepEqual(fromAddress(""), DEFAULT);
  assert.equal(toAddress("", DEFAULT), "");
  assert.equal(toAddress("?robot=r4", DEFAULT), "?robot=r4");
  assert.equal(toAddress("?robot=r4&chart=x", [parse("battery@west"), parse("speed:r1,r2")]), "?robot=r4&chart=battery@west&chart=speed:r1,r2");
  assert.equal(toAddress("", []), "?chart=");
  assert.deepEqual(fromAddress("?chart="), []);
  for (const choices of [[parse("x@make: create"), ...DEFAULT], [parse("a&b=c@<d>#e")], [DEFAULT[0]]]) {
    assert.deepEqual(fromAddress(toAddress("?robot=r1", choices)), choices);
    assert.equal(new URLSearchParams(toAddress("?robot=r1", choices)).get("robot"), "r1");
  }
});

test("a group is its robots now; what cannot be charted says why", () => {
  const robots = (text) => resolve(parse(text), GROUPS);
  assert.deepEqual(robots("x@west"), { robots: ["r1", "r2"], problem: "" });
  assert.deepEqual(robots("x@all"), { robots: [], problem: "" });
  assert.deepEqual(robots("x"), { robots: [], problem: "" });
  assert.deepEqual(robots("x:r7"), { robots: ["r7"], problem: "" });
  assert.match(robots("x@north").problem, /no group 'north'/);
  assert.match(robots("x@none").problem, /no group 'none'/);
  assert.match(robots("x:r1,<i>").problem, /'<i>' is not the name of a robot/);
  assert.match(robots("x:").problem, /'' is not the name of a robot/);
  assert.match(robots("<b>").problem, /not the name of a field/);
  assert.match(robots("y".repeat(500)).problem, /^'y{40}' is not/);
  assert.match(robots(`x:${Array(1025).fill("r1").join(",")}`).problem, /1024 robots at most/);
});

test("titles, robots and values in words", () => {
  assert.equal(aboutOf(CATALOGUE, "battery").unit, "%");
  assert.deepEqual(aboutOf(CATALOGUE, "other"), { name: "other", title: "other", unit: "", doc: "", scale: 1 });
  assert.equal(whoOf(CATALOGUE, parse("battery")), "all robots");
  assert.equal(whoOf(CATALOGUE, parse("battery@west")), "west");
  assert.equal(whoOf(CATALOGUE, parse("battery:r1,r2,r3,r4")), "r1, r2 and 2 more");
  assert.equal(whoOf(CATALOGUE, parse("work.total_m")), "");
  assert.equal(figure(0.12345, "m/s"), "0.123 m/s");
  assert.equal(figure(50, "%"), "50 %");
  assert.equal(figure(1234.56, "m"), "1234.6 m");
  assert.equal(figure(-2.345, ""), "-2.35");
  assert.equal(figure(null, "m"), "unknown");
});
