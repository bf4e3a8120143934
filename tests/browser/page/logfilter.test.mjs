import assert from "node:assert/strict";
import { test } from "node:test";
import { page } from "./page.mjs";

const { NO_FILTER, fitting, isSet, readFilter, writeFilter } = await page("logfilter.js");
const { offerWords, personWords } = await page("people.js");

const swarm = { selected: [], groups: { east: ["r4", "r5"] } };
const entry = (more) => ({ kind: "request", severity: "info", by: "anna", robots: ["r1"], text: "anna: Flocking", mine: false, request_id: "", ...more });
const fits = (filter, more = {}, seen = swarm) => fitting({ ...NO_FILTER, ...filter }, seen)(entry(more));

test("no filter hides nothing, and is not in the address", () => {
  assert.ok(fits({}));
  assert.equal(isSet(NO_FILTER), false);
  const query = new URLSearchParams("robot=r4&log_by=ben");
  writeFilter(query, NO_FILTER);
  assert.equal(String(query), "robot=r4");
});

test("a filter is the same after the address", () => {
  const filter = { kind: "stop", level: "warning", by: "console anna@lab 3f2a", robots: "@east", text: "a&b=c #" };
  const query = new URLSearchParams();
  writeFilter(query, filter);
  assert.deepEqual(readFilter(new URLSearchParams(String(query))), filter);
});

test("an address that a stranger made is bounded, and an unknown value hides what it does not fit", () => {
  assert.deepEqual(readFilter(new URLSearchParams({ log_text: "x".repeat(9999) })), NO_FILTER);
  assert.equal(fits({ by: "nobody" }), false);
  assert.ok(fits({ level: "loud" }), "an unknown severity is none");
  assert.equal(fits({ robots: "@__proto__" }), false);
});

test("each severity includes the worse ones", () => {
  assert.deepEqual(["info", "warning", "error"].map((severity) => fits({ level: "warning" }, { severity })), [false, true, true]);
  assert.equal(fits({ level: "error" }, { severity: undefined }), false, "a line without one is information");
});

test("what names no robots is about all of them if it is an order, and about none if it is not", () => {
  assert.ok(fits({ robots: "r9" }, { kind: "estop", robots: [] }));
  assert.equal(fits({ robots: "r9" }, { kind: "link", robots: [] }), false);
  assert.ok(fits({ robots: "@east" }, { robots: ["r1", "r5"] }));
  assert.ok(fits({ robots: "selected" }, {}), "nothing selected: robots do not matter");
  assert.equal(fits({ robots: "selected" }, {}, { ...swarm, selected: ["r2"] }), false);
});

test("an operator in words", () => {
  const ben = { name: "ben", role: "driver", pages: 2, clock: "12:03", holds: ["r1"], holding: 30, drives: ["r1"] };
  assert.equal(personWords(ben), "driver, since 12:03 · 2 pages · holds r1 and 29 more · drives r1");
  const away = { name: "x", role: "", pages: 0, clock: "", holds: ["r2", "r3"], holding: 2, drives: [] };
  assert.equal(personWords(away), "elsewhere: a shell, a program or another console · holds r2, r3");
});

test("an offer in words, for both", () => {
  const offer = { id: "1", from: "anna", to: "ben", robots: ["r2", "r1"], runs: "Flocking", left_s: 9, mine: false };
  assert.equal(offerWords(offer, 0), "anna offers you r1, r2, running Flocking.");
  assert.equal(offerWords({ ...offer, runs: "", mine: true }, 2), "r1, r2 offered to ben. 2 more offers wait.");
});
