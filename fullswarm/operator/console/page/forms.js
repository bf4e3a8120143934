/**
 * Parameters of behaviours and the other terms of a request: text to value with a reason where it does not fit, sliders,
 * order of the list. Pure.
 * @typedef {{ok: true, value: unknown} | {ok: false, reason: string}} Parsed `value` undefined: left to its default
 * @typedef {{min: number, max: number}} Bounds
 */

/** @import { Behaviour, Parameter, Terms } from "./types.d.ts" */

const WIDE_RANGE = 50; // above this ratio a slider is logarithmic

const fail = (/** @type {string} */ reason) => ({ ok: /** @type {const} */ (false), reason });

/**
 * @template T
 * @param {T} value
 */
const good = (value) => ({ ok: /** @type {const} */ (true), value });

/**
 * Write a number without the noise of binary fractions.
 * @param {unknown} value
 * @param {number} [digits]
 */
export function number(value, digits = 4) {
  return String(Number(Number(value).toPrecision(digits)));
}

/**
 * Write the range of a parameter: "0.05 to 5 1/s".
 * @param {Parameter} parameter
 */
export function rangeText(parameter) {
  const { min, max, unit } = parameter;
  const known = (/** @type {unknown} */ bound) => bound !== null && bound !== undefined;
  const of = unit ? ` ${unit}` : "";
  if (known(min) && known(max)) return `${number(min)} to ${number(max)}${of}`;
  if (known(min)) return `at least ${number(min)}${of}`;
  if (known(max)) return `at most ${number(max)}${of}`;
  return unit ?? "";
}

/**
 * @param {string} text
 * @param {Parameter} parameter
 */
function parseNumber(text, parameter) {
  const value = Number(text.replace(",", "."));
  if (!Number.isFinite(value)) return fail(`"${text}" is not a number`);
  if (parameter.type === "integer" && !Number.isInteger(value)) return fail(`${text} is not a whole number`);
  const { min, max } = parameter;
  if ((typeof min === "number" && value < min) || (typeof max === "number" && value > max)) {
    return fail(`${number(value)} is out of range: ${rangeText(parameter)}`);
  }
  return good(value);
}

/** @param {string} text */
function parsePoint(text) {
  const parts = text.replace(/[[\]()]/g, " ").trim().split(/[\s,]+/);
  const point = parts.map(Number);
  if (point.length !== 2 || parts.includes("") || !point.every(Number.isFinite)) {
    return fail(`"${text.trim()}" is not a point: write x, y in metres, or pick it on the map`);
  }
  return good(point);
}

/** @param {string} text */
function parsePoints(text) {
  const points = [];
  for (const part of text.split(";").filter((each) => each.trim() !== "")) {
    const parsed = parsePoint(part);
    if (!parsed.ok) return parsed;
    points.push(parsed.value);
  }
  return good(points);
}

/** @param {string} text */
const namesIn = (text) => text.split(/[\s,;]+/).filter(Boolean);

/** @param {string} text such as "carrier: r1, +gripper; scout: @west" */
function parseRoles(text) {
  const roles = /** @type {Record<string, string[]>} */ ({});
  for (const part of text.split(";").filter((each) => each.trim() !== "")) {
    const [role, names, more] = part.split(":");
    const found = namesIn(names ?? "");
    if (!role.trim() || found.length === 0 || more !== undefined) {
      return fail(`"${part.trim()}" gives no role: write carrier: r1, +gripper; scout: @west`);
    }
    roles[role.trim()] = [...(roles[role.trim()] ?? []), ...found];
  }
  return good(roles);
}

/**
 * Read what was typed for one parameter.
 * @param {string | boolean} entry
 * @param {Parameter} parameter
 * @returns {Parsed}
 */
export function parseEntry(entry, parameter) {
  if (typeof entry === "boolean") return good(entry);
  const text = entry.trim();
  if (text === "") return parameter.required ? fail("is required") : good(undefined);
  if (parameter.type === "number" || parameter.type === "integer") return parseNumber(text, parameter);
  if (parameter.type === "point") return parsePoint(text);
  if (parameter.type === "points") return parsePoints(text);
  if (parameter.type === "names") return good(namesIn(text));
  if (parameter.type === "roles") return parseRoles(text);
  if (parameter.choices?.length && !parameter.choices.includes(text)) {
    return fail(`"${text}" is none of ${parameter.choices.join(", ")}`);
  }
  return good(text);
}

/**
 * Read a whole form.
 * @param {Record<string, string | boolean>} entries
 * @param {Record<string, Parameter>} parameters
 * @returns {{values: Record<string, unknown>, errors: Record<string, string>}}
 */
export function parseForm(entries, parameters) {
  const values = /** @type {Record<string, unknown>} */ ({});
  const errors = /** @type {Record<string, string>} */ ({});
  for (const [name, parameter] of Object.entries(parameters)) {
    const parsed = parseEntry(entries[name] ?? "", parameter);
    if (!parsed.ok) errors[name] = parsed.reason;
    else if (parsed.value !== undefined) values[name] = parsed.value;
  }
  return { values, errors };
}

/**
 * Write a value for a field.
 * @param {unknown} value
 * @returns {string}
 */
export function entryText(value) {
  if (value === null || value === undefined) return "";
  if (!Array.isArray(value)) return typeof value === "number" ? number(value, 6) : String(value);
  if (value.every((each) => Array.isArray(each))) return value.map(entryText).join("; ");
  return value.map((each) => number(each, 6)).join(", ");
}

const byPowers = (/** @type {Bounds} */ { min, max }) => min > 0 && max / min > WIDE_RANGE;

/**
 * Return the position in 0..1000 of a parameter's slider for a value.
 * @param {number} value
 * @param {Bounds} bounds
 */
export function toSlider(value, { min, max }) {
  const share = byPowers({ min, max }) ? Math.log(value / min) / Math.log(max / min) : (value - min) / (max - min);
  return Math.round(Math.min(1, Math.max(0, share)) * 1000);
}

/**
 * Return the value for a slider's position in 0..1000.
 * @param {number} place
 * @param {Bounds & {type: string}} bounds
 */
export function fromSlider(place, { min, max, type }) {
  const share = place / 1000;
  const value = byPowers({ min, max }) ? min * (max / min) ** share : min + (max - min) * share;
  if (type === "integer") return Math.round(value);
  return Number(value.toPrecision(3));
}

const ORDER = ["filtered", "plain", "stick"];

/**
 * Return the group of a behaviour in the list: filtered ones first, those that expire without a stick last.
 * @param {Behaviour} record
 * @returns {"filtered" | "plain" | "stick"}
 */
export function behaviourGroup(record) {
  if ((record.expires_s ?? 0) > 0) return "stick";
  return record.filtered ? "filtered" : "plain";
}

/**
 * Return [name, record] of the behaviours that fit a search, in the order of the list.
 * @param {Record<string, Behaviour>} behaviours
 * @param {string} search
 */
export function listed(behaviours, search = "") {
  const words = search.toLowerCase().split(/\s+/).filter(Boolean);
  const fits = (/** @type {[string, Behaviour]} */ [name, record]) => words.every((word) => `${name} ${record.summary}`.toLowerCase().includes(word));
  const rank = (/** @type {[string, Behaviour]} */ [, record]) => ORDER.indexOf(behaviourGroup(record));
  return Object.entries(behaviours)
    .filter(fits)
    .sort((a, b) => rank(a) - rank(b) || a[0].localeCompare(b[0]));
}

const TEAMS = { request: "the robots of this request", group: "the robots of their group", swarm: "all robots" };

/** What robots must be able to do to take part. */
const NEEDS = /** @type {Record<string, Parameter>} */ ({
  speed_m_s: { label: "Speed", type: "number", unit: "m/s", min: 0, doc: "they can drive at least so fast" },
  turn_rad_s: { label: "Turn rate", type: "number", unit: "rad/s", min: 0, doc: "they can turn at least so fast" },
  accel_m_s2: { label: "Acceleration", type: "number", unit: "m/s²", min: 0, doc: "they can accelerate at least so hard" },
  radius_m: { label: "Radius", type: "number", unit: "m", min: 0, doc: "they are at most so large" },
  battery: { label: "Charge", type: "number", unit: "%", min: 0, max: 100, doc: "their battery has at least so much left" },
  capabilities: { label: "Capabilities", type: "names", doc: "they have all of these, for example gripper, lamp" },
  makes: { label: "Makes", type: "names", doc: "they are of one of these, for example create, rover" },
});

/**
 * Return the fields for what a request of a behaviour can say beside its parameters, by section; see `parseTerms`.
 * @param {Behaviour} record
 * @param {string[]} groups
 * @returns {{title: string, fields: Record<string, Parameter>}[]}
 */
export function termFields(record, groups) {
  const stick = (record.expires_s ?? 0) > 0;
  const named = Object.fromEntries(groups.map((name) => [`@${name}`, `the robots of group ${name}`]));
  const words = /** @type {Record<string, string>} */ ({ ...TEAMS, ...named });
  let choices = ["request", "group", ...Object.keys(named), "swarm"];
  if (stick) choices = ["request", "swarm"];
  if (record.centralised) choices = ["request"];
  const unset = `as usual: ${words[record.team ?? "request"]}`;
  const team = { label: "Neighbours", type: "word", choices, words, unset, doc: "which robots each robot reacts to; the safety filter considers all" };
  const sections = [
    { title: "Team", fields: { team } },
    { title: "Only robots that fit", fields: Object.fromEntries(Object.entries(NEEDS).map(([name, field]) => [`needs.${name}`, field])) },
  ];
  if (!stick) sections.push({ title: "Roles", fields: roleFields(record) });
  return sections;
}

/**
 * @param {Behaviour} record
 * @returns {Record<string, Parameter>}
 */
function roleFields({ roles = {} }) {
  const who = "robots, @groups or +capabilities, e.g. r1, @west, +gripper";
  const found = Object.entries(roles).map(([role, { doc, needs = [], at_least = 0, at_most }]) => {
    const terms = [at_least > 0 && `at least ${at_least}`, at_most && `at most ${at_most}`, needs.length && `with ${needs.join(", ")}`];
    return [`roles.${role}`, { label: role, type: "names", doc: [doc, ...terms, who].filter(Boolean).join(" · ") }];
  });
  if (found.length) return Object.fromEntries(found);
  const doc = `the behaviour names no roles of its own; ${who.replace(", e.g. r1, @west, +gripper", "")}, e.g. carrier: r1, +gripper; scout: @west`;
  return { roles: { label: "Who has which role", type: "roles", doc } };
}

/**
 * Read the fields of `termFields`.
 * @param {Record<string, string | boolean>} entries
 * @param {Record<string, Parameter>} fields
 * @returns {{terms: Terms, errors: Record<string, string>}}
 */
export function parseTerms(entries, fields) {
  const { values, errors } = parseForm(entries, fields);
  const terms = /** @type {Record<string, unknown>} */ ({});
  for (const [name, value] of Object.entries(values)) {
    const [table, key] = name.split(".");
    const given = name === "needs.battery" ? Number(value) / 100 : value;
    terms[table] = key === undefined ? given : { .../** @type {object} */ (terms[table]), [key]: given };
  }
  return { terms: /** @type {Terms} */ (terms), errors };
}

/**
 * Write terms for the fields of `termFields`: what `parseTerms` reads.
 * @param {Terms} terms
 * @param {Record<string, Parameter>} fields
 * @returns {Record<string, string>}
 */
export function termEntries({ team = "", needs = {}, roles = {} }, fields) {
  const listed = (/** @type {unknown} */ value) => (Array.isArray(value) ? value.join(", ") : entryText(value));
  const entries = Object.entries(needs).map(([key, value]) => [`needs.${key}`, listed(key === "battery" ? Number(value) * 100 : value)]);
  const given = Object.entries(roles).map(([role, names]) => [`roles.${role}`, names.join(", ")]);
  const all = Object.entries(roles).map(([role, names]) => `${role}: ${names.join(", ")}`).join("; ");
  const found = Object.fromEntries([["team", team], ...entries, ...given, ["roles", all]]);
  return Object.fromEntries(Object.keys(fields).map((name) => [name, found[name] ?? ""]));
}
