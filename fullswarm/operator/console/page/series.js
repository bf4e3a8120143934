/** What is charted: a field of robots, or a quantity of the swarm; and how the page's address states it. Pure. */

/** @import { Catalogue } from "./types.d.ts" */

/**
 * One chart. `group` is the name of one (see Selection.groups); without it `robots`; without both all robots.
 * @typedef {{of: string, robots: string[], group: string}} Choice
 */

export const DEFAULT = ["work.total_m", "coverage.fraction", "collisions.events"].map((of) => parse(of));
const ADDRESS = "chart";
const OF = /^[A-Za-z0-9_.-]{1,128}$/;
const ROBOT = /^[A-Za-z0-9_-]{1,64}$/;
const MOST_ROBOTS = 1024;

/**
 * Read a choice: "battery", "battery@west", "speed:r1,r2".
 * @param {string} text
 * @returns {Choice}
 */
export function parse(text) {
  const [, of, kind, who] = /^([^@:]*)([@:]?)(.*)$/s.exec(text) ?? ["", text, "", ""];
  return { of, robots: kind === ":" ? who.split(",") : [], group: kind === "@" ? who : "" };
}

/**
 * Write a choice as `parse` reads it.
 * @param {Choice} choice
 */
export function format({ of, robots, group }) {
  if (group) return `${of}@${group}`;
  return robots.length ? `${of}:${robots.join(",")}` : of;
}

/**
 * Return the charts that an address states; without any those of the start.
 * @param {string} search
 * @returns {Choice[]}
 */
export function fromAddress(search) {
  const stated = new URLSearchParams(search).getAll(ADDRESS);
  return stated.length ? stated.filter(Boolean).map(parse) : [...DEFAULT];
}

/**
 * Return the query of an address with these charts, and all else as it was. Those of the start need no mention.
 * @param {string} search
 * @param {Choice[]} choices
 */
export function toAddress(search, choices) {
  const query = new URLSearchParams(search);
  query.delete(ADDRESS);
  const stated = choices.map(format);
  if (stated.join(" ") !== DEFAULT.map(format).join(" ")) for (const text of stated.length ? stated : [""]) query.append(ADDRESS, text);
  const text = query.toString().replaceAll("%40", "@").replaceAll("%3A", ":").replaceAll("%2C", ",");
  return text && `?${text}`;
}

/**
 * Return the robots of a choice (none: all), or why they cannot be charted.
 * @param {Choice} choice
 * @param {Map<string, string[]>} groups
 * @returns {{robots: string[], problem: string}}
 */
export function resolve({ of, robots, group }, groups) {
  const refuse = (/** @type {string} */ problem) => ({ robots: [], problem });
  if (!OF.test(of)) return refuse(`'${of.slice(0, 40)}' is not the name of a field or a metric: choose another one`);
  if (group === "all") return { robots: [], problem: "" };
  const found = group ? groups.get(group) : robots;
  if (!found?.length && group) return refuse(`there is no group '${group.slice(0, 64)}' now`);
  const wrong = (found ?? []).find((robot) => !ROBOT.test(robot));
  if (wrong !== undefined) return refuse(`'${wrong.slice(0, 40)}' is not the name of a robot`);
  if ((found ?? []).length > MOST_ROBOTS) return refuse(`${MOST_ROBOTS} robots at most`);
  return { robots: found ?? [], problem: "" };
}

/**
 * Return title, unit, scale and meaning of what is charted; of an unknown name that name.
 * @param {Catalogue} catalogue
 * @param {string} of
 */
export function aboutOf({ fields, metrics }, of) {
  const found = fields.find(({ name }) => name === of) ?? metrics.find(({ name }) => name === of);
  return found ?? { name: of, title: of, unit: "", doc: "", scale: 1 };
}

/**
 * Name the robots of a choice: "all robots", "west", "r1, r2"; empty for a quantity of the swarm.
 * @param {Catalogue} catalogue
 * @param {Choice} choice
 */
export function whoOf({ fields }, { of, robots, group }) {
  if (group) return group === "all" ? "all robots" : group;
  if (robots.length) return robots.length > 3 ? `${robots.slice(0, 2).join(", ")} and ${robots.length - 2} more` : robots.join(", ");
  return fields.some(({ name }) => name === of) ? "all robots" : "";
}

/**
 * Write a value with its unit, with as many digits as are of use.
 * @param {number | null | undefined} value
 * @param {string} unit
 */
export function figure(value, unit) {
  if (typeof value !== "number") return "unknown";
  const size = Math.abs(value);
  const text = String(Number(value.toFixed(size < 1 ? 3 : size < 10 ? 2 : 1)));
  return unit ? `${text} ${unit}` : text;
}
