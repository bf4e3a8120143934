/** What the detail pane says of a robot, as sections of labelled values. Pure. */

import { entryText } from "./forms.js";
import { titleOf } from "./words.js";

/** @import { Behaviour, Detail, Lease, Robot } from "./types.d.ts" */

/** @typedef {{title: string, rows: [label: string, words: string][]}} Section */

/**
 * Write a number with its unit; a dash if it is not known.
 * @param {number | null | undefined} value
 * @param {string} unit
 * @param {number} [digits]
 */
export function quantity(value, unit, digits = 2) {
  return typeof value === "number" ? `${value.toFixed(digits)} ${unit}` : "–";
}

/** @param {number | null | undefined} value in rad */
const degrees = (value) => (typeof value === "number" ? `${Math.round((value * 180) / Math.PI)}°` : "–");

/** Ends of the names of parameters → their units. */
const UNITS = /** @type {[string, string][]} */ ([
  ["_rad_s2", "rad/s²"], ["_m_s2", "m/s²"], ["_rad_s", "rad/s"], ["_m_s", "m/s"], ["_per_s", "1/s"], ["_rad", "rad"],
  ["_hz", "Hz"], ["_m", "m"], ["_s", "s"],
]);

/**
 * Return the name of a parameter for people, and its unit: of its description, or else as its name says.
 * @param {string} name
 * @param {import("./types.d.ts").Parameter} [described]
 */
export function parameterWords(name, described) {
  const [end, stated] = UNITS.find(([each]) => name.endsWith(each)) ?? ["", ""];
  const words = name.slice(0, name.length - end.length).replaceAll("_", " ");
  return { label: described?.label ?? words, unit: described?.unit ?? stated };
}

/**
 * Return the sections of the pane.
 * @param {{robot: Partial<Robot>, detail: Detail | null, lease: Lease | undefined,
 *   behaviours: Record<string, Behaviour>, filter: [number, number, string] | undefined}} known
 * @returns {Section[]}
 */
export function sections({ robot, detail, lease, behaviours, filter }) {
  return [
    { title: "State", rows: state(robot, lease) },
    { title: "What it runs", rows: runs(robot, detail, behaviours) },
    { title: "Pose", rows: pose(detail) },
    { title: "Safety filter", rows: filterRows(robot, detail, filter, behaviours) },
    { title: "Driver", rows: driver(robot) },
    { title: "Computer", rows: computer(robot, detail) },
  ];
}

/**
 * @param {Partial<Robot>} robot
 * @param {Lease | undefined} lease
 * @returns {Section["rows"]}
 */
function state(robot, lease) {
  const { state_word: word = "no health report", state_why: why = "", advice = "", battery, contacts = 0, collisions = 0 } = robot;
  const rows = /** @type {Section["rows"]} */ ([["state", word]]);
  if (why) rows.push(["because", why]);
  if (advice) rows.push(["what to do", advice]);
  rows.push(["battery", typeof battery === "number" ? `${Math.round(100 * battery)} %` : "not reported"]);
  rows.push(["contacts", `${contacts ? `touches ${contacts} now` : "touches nothing"}, ${collisions} since its start`]);
  const holder = lease ? (lease.mine ? "you" : lease.operator) : "nobody";
  rows.push(["held by", lease?.taken_from ? `${holder}, taken from ${lease.taken_from}` : holder]);
  return rows;
}

/**
 * @param {Partial<Robot>} robot
 * @param {Detail | null} detail
 * @param {Record<string, Behaviour>} behaviours
 * @returns {Section["rows"]}
 */
function runs(robot, detail, behaviours) {
  if (!robot.behaviour || robot.ended) return [["behaviour", robot.ended ? `none: ${robot.ended}` : "none"]];
  const order = detail?.order;
  const rows = /** @type {Section["rows"]} */ ([["behaviour", titleOf(behaviours, robot.behaviour)]]);
  if (order?.operator) rows.push(["requested by", order.operator]);
  const described = behaviours[robot.behaviour]?.parameters ?? {};
  for (const [name, value] of Object.entries(order?.parameters ?? {})) {
    const { label, unit } = parameterWords(name, described[name]);
    rows.push([label, `${entryText(value)} ${unit}`.trim()]);
  }
  if (robot.memory) rows.push(["remembers", robot.memory]);
  return rows;
}

/**
 * @param {Detail | null} detail
 * @returns {Section["rows"]}
 */
function pose(detail) {
  if (!detail) return [["position", "–"]];
  const { x_m, y_m, heading_rad, source, note, sigma_m, sources } = detail.pose;
  const rows = /** @type {Section["rows"]} */ ([
    ["position", `${quantity(x_m, "m")}, ${quantity(y_m, "m")}, heading ${degrees(heading_rad)}`],
    ["measured by", source || "not stated"],
    ["uncertainty", sigma_m === null ? "not stated" : `${quantity(sigma_m, "m", 3)} (1 σ)`],
  ]);
  if (note) rows.push(["note", note]);
  for (const each of sources) {
    const used = each.used ? "used" : `not used: ${each.refused || "silent"}`;
    const residual = (each.residual_m ?? -1) >= 0 ? `, ${quantity(each.residual_m, "m", 3)} off` : "";
    const name = each.marker ? `${each.sensor} (${each.marker})` : each.sensor;
    rows.push([name, `${used}${residual}, ${quantity(each.age_s ?? 0, "s", 1)} old`]);
  }
  return rows;
}

/**
 * @param {Partial<Robot>} robot
 * @param {Detail | null} detail
 * @param {[number, number, string] | undefined} change
 * @param {Record<string, Behaviour>} behaviours
 * @returns {Section["rows"]}
 */
function filterRows(robot, detail, change, behaviours) {
  const behind = robot.behaviour ? Boolean(behaviours[robot.behaviour]?.filtered) : null;
  const rows = /** @type {Section["rows"]} */ ([]);
  if (behind === false) rows.push(["filter", "this behaviour is not behind it"]);
  if (change) {
    const [dx, dy, why] = change;
    rows.push(["changes", `${quantity(Math.hypot(dx, dy), "m/s")} towards ${degrees(Math.atan2(dy, dx))}${why ? `, because of ${why}` : ""}`]);
  } else rows.push(["changes", "nothing now"]);
  if (robot.filter_note) rows.push(["brakes", robot.filter_note]);
  rows.push(["changed so far", quantity(detail?.deviation_m, "m")]);
  return rows;
}

/**
 * @param {Partial<Robot>} robot
 * @returns {Section["rows"]}
 */
function driver({ driver: url = "", make = "", model = "", firmware = "", lifecycle = "", capabilities = [] }) {
  return [
    ["address", url || "–"], ["make, model", [make, model].filter(Boolean).join(", ") || "–"],
    ["firmware", firmware || "not stated"], ["state", lifecycle || "–"], ["can", capabilities.join(", ") || "drive"],
  ];
}

/**
 * @param {Partial<Robot>} robot
 * @param {Detail | null} detail
 * @returns {Section["rows"]}
 */
function computer({ host = "", version = "" }, detail) {
  const round = detail?.round_trip_s;
  const rows = /** @type {Section["rows"]} */ ([["host", host || "–"], ["fullswarm", version || "–"]]);
  rows.push(["round trip to the core", typeof round === "number" ? `${(1000 * round).toFixed(1)} ms` : "not known"]);
  const dropped = Object.entries(detail?.dropped ?? {}).filter(([, count]) => count > 0);
  if (dropped.length) rows.push(["dropped messages", dropped.map((each) => each.join(" ")).join(", ")]);
  return rows;
}
