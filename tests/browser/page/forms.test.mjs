import assert from "node:assert/strict";
import { test } from "node:test";
import { page } from "./page.mjs";

const { behaviourGroup, entryText, fromSlider, listed, parseEntry, parseForm, parseTerms, rangeText, termFields, toSlider } =
  await page("forms.js");

const GAIN = { type: "number", unit: "1/s", min: 0.05, max: 5 };

test("a number is read, with a comma as well", () => {
  assert.deepEqual(parseEntry(" 1.5 ", GAIN), { ok: true, value: 1.5 });
  assert.deepEqual(parseEntry("0,5", GAIN), { ok: true, value: 0.5 });
});

test("what is no number or out of range is refused with the range", () => {
  assert.match(parseEntry("fast", GAIN).reason, /"fast" is not a number/);
  assert.match(parseEntry("7", GAIN).reason, /7 is out of range: 0.05 to 5 1\/s/);
  assert.ok(!parseEntry("Infinity", { type: "number" }).ok);
  assert.match(parseEntry("1.5", { type: "integer" }).reason, /whole/);
});

test("nothing typed is the default, unless it is required", () => {
  assert.deepEqual(parseEntry("", GAIN), { ok: true, value: undefined });
  assert.match(parseEntry("", { ...GAIN, required: true }).reason, /required/);
});

test("points are read as they are written, with or without brackets", () => {
  for (const text of ["1, 2.5", "1 2.5", "[1, 2.5]", " (1,2.5) "]) {
    assert.deepEqual(parseEntry(text, { type: "point" }), { ok: true, value: [1, 2.5] }, text);
  }
  for (const text of ["1", "1, 2, 3", "a, b", "1,"]) assert.ok(!parseEntry(text, { type: "point" }).ok, text);
  assert.deepEqual(parseEntry("1, 2; 3, 4;", { type: "points" }), { ok: true, value: [[1, 2], [3, 4]] });
  assert.ok(!parseEntry("1, 2; 3", { type: "points" }).ok);
});

test("what is written into a field reads back as the same value", () => {
  for (const [value, type] of [[[1, -2.25], "point"], [[[0, 1], [2, 3.5]], "points"], [0.05, "number"]]) {
    assert.deepEqual(parseEntry(entryText(value), { type }).value, value);
  }
  assert.equal(entryText(null), "");
});

test("a word must be one of the choices", () => {
  const parameter = { type: "word", choices: ["circle", "line"] };
  assert.equal(parseEntry("line", parameter).value, "line");
  assert.match(parseEntry("star", parameter).reason, /none of circle, line/);
});

test("a form gives all its mistakes at once, and leaves out what was not set", () => {
  const parameters = { goal: { type: "point", required: true }, gain: GAIN, on: { type: "flag" }, note: { type: "word" } };
  const { values, errors } = parseForm({ goal: "", gain: "9", on: true, note: "" }, parameters);
  assert.deepEqual(Object.keys(errors), ["goal", "gain"]);
  assert.deepEqual(values, { on: true });
});

test("a slider reaches both ends and comes back to where it was put", () => {
  for (const range of [GAIN, { type: "number", min: -1, max: 1 }, { type: "number", min: 0.05, max: 100 }]) {
    assert.equal(fromSlider(0, range), range.min);
    assert.equal(fromSlider(1000, range), range.max);
    for (const place of [1, 250, 777]) assert.ok(Math.abs(toSlider(fromSlider(place, range), range) - place) <= 3);
  }
  assert.ok(Number.isInteger(fromSlider(333, { type: "integer", min: 0, max: 10 })));
});

test("a range is told in words", () => {
  assert.equal(rangeText(GAIN), "0.05 to 5 1/s");
  assert.equal(rangeText({ type: "number", min: 0, max: null, unit: "m" }), "at least 0 m");
});

test("the list starts behind the filter and ends with what only sticks can hold", () => {
  const behaviours = {
    drive: { summary: "sticks", expires_s: 0.3, filtered: false }, stop: { summary: "stand", filtered: false },
    flocking_bc: { summary: "flock", filtered: true }, drive_bc: { summary: "sticks", expires_s: 0.3, filtered: true },
  };
  assert.deepEqual(listed(behaviours).map(([name]) => name), ["flocking_bc", "stop", "drive", "drive_bc"]);
  assert.deepEqual(listed(behaviours, "FLOCK").map(([name]) => name), ["flocking_bc"]);
  assert.deepEqual(listed(behaviours, "drive stand"), []);
  assert.equal(behaviourGroup(behaviours.stop), "plain");
});

const fieldsOf = (record, groups = []) => Object.assign({}, ...termFields(record, groups).map(({ fields }) => fields));

test("the terms of a request are read from their fields", () => {
  const fields = fieldsOf({ summary: "" }, ["west"]);
  assert.deepEqual(fields.team.choices, ["request", "group", "@west", "swarm"]);
  assert.deepEqual(parseTerms({}, fields), { terms: {}, errors: {} });
  const entries = { team: "@west", "needs.speed_m_s": "0,3", "needs.battery": "40", "needs.capabilities": "gripper, lamp", roles: "carrier: r1, +gripper; scout: @west" };
  assert.deepEqual(parseTerms(entries, fields), {
    terms: {
      team: "@west",
      needs: { speed_m_s: 0.3, battery: 0.4, capabilities: ["gripper", "lamp"] },
      roles: { carrier: ["r1", "+gripper"], scout: ["@west"] },
    },
    errors: {},
  });
});

test("roles that a behaviour declares have a field each", () => {
  const fields = fieldsOf({ roles: { carrier: { needs: ["carry"], at_least: 1, doc: "drives to the goal" }, scout: {} } });
  assert.match(fields["roles.carrier"].doc, /^drives to the goal · at least 1 · with carry · /);
  assert.deepEqual(parseTerms({ "roles.carrier": "r1 r2", "roles.scout": "" }, fields).terms, { roles: { carrier: ["r1", "r2"] } });
});

test("sticks and centralised behaviours offer what they can", () => {
  assert.deepEqual(fieldsOf({ expires_s: 0.5 }, ["west"]).team.choices, ["request", "swarm"]);
  assert.equal(fieldsOf({ expires_s: 0.5 }).roles, undefined);
  assert.deepEqual(fieldsOf({ centralised: true }, ["west"]).team.choices, ["request"]);
  assert.equal(fieldsOf({ team: "swarm" }).team.unset, "as usual: all robots");
});

test("what is no term is refused with what to write", () => {
  const { errors } = parseTerms({ "needs.speed_m_s": "-1", "needs.battery": "140", roles: "carrier r1" }, fieldsOf({}));
  assert.match(errors["needs.speed_m_s"], /at least 0 m\/s/);
  assert.match(errors["needs.battery"], /0 to 100 %/);
  assert.match(errors.roles, /"carrier r1" gives no role: write carrier: r1/);
  for (const roles of ["carrier:", ": r1", "a: r1: r2"]) assert.ok(parseTerms({ roles }, fieldsOf({})).errors.roles, roles);
});
