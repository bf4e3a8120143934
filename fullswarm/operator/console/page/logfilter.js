/** Which lines of the log are shown: by kind, severity, operator, robots and text; kept in the page's address. Pure. */

/** @import { Entry } from "./types.d.ts" */

/**
 * @typedef {{kind: string, level: string, by: string, robots: string, text: string}} LogFilter
 *   Empty: all. by: an operator, or "me"; robots: a robot, "@group" or "selected"; level: the least severity
 */

export const NO_FILTER = Object.freeze({ kind: "", level: "", by: "", robots: "", text: "" });
export const ME = "me";
export const SELECTED = "selected";
const LEVELS = ["info", "warning", "error"];
/** A line of these kinds that names no robots is about the whole swarm. */
const OF_ALL = ["request", "refused", "stop", "estop"];
const PREFIX = "log_";
const LONGEST = 128;
const NAMES = /** @type {(keyof LogFilter)[]} */ (Object.keys(NO_FILTER));

/**
 * Read a filter from the query of an address; what is too long counts as absent.
 * @param {URLSearchParams} query
 * @returns {LogFilter}
 */
export function readFilter(query) {
  const given = (/** @type {string} */ name) => query.get(PREFIX + name) ?? "";
  const found = Object.fromEntries(NAMES.map((name) => [name, given(name).length > LONGEST ? "" : given(name)]));
  return { ...NO_FILTER, ...found };
}

/**
 * Write a filter into the query of an address.
 * @param {URLSearchParams} query
 * @param {LogFilter} filter
 */
export function writeFilter(query, filter) {
  for (const name of NAMES) {
    if (filter[name]) query.set(PREFIX + name, filter[name]);
    else query.delete(PREFIX + name);
  }
}

/** @param {LogFilter} filter */
export function isSet(filter) {
  return NAMES.some((name) => filter[name] !== "");
}

/**
 * Return the test whether a line is shown.
 * @param {LogFilter} filter
 * @param {{selected: string[], groups: Record<string, string[]>}} swarm  selected: none means that robots do not matter
 * @returns {(entry: Entry) => boolean}
 */
export function fitting({ kind, level, by, robots, text }, { selected, groups }) {
  const least = LEVELS.indexOf(level);
  const words = text.trim().toLowerCase();
  const wanted = wantedRobots(robots, selected, groups);
  return (entry) => {
    if (kind && entry.kind !== kind) return false;
    if (least > 0 && LEVELS.indexOf(entry.severity ?? "info") < least) return false;
    if (by && (by === ME ? !entry.mine : entry.by !== by)) return false;
    if (wanted && !concerns(entry, wanted)) return false;
    return !words || `${entry.text} ${(entry.robots ?? []).join(" ")} ${entry.request_id ?? ""}`.toLowerCase().includes(words);
  };
}

/**
 * Return the robots that a filter names; null: it names none.
 * @param {string} robots
 * @param {string[]} selected
 * @param {Record<string, string[]>} groups
 */
function wantedRobots(robots, selected, groups) {
  if (robots === SELECTED) return selected.length ? new Set(selected) : null;
  if (robots.startsWith("@")) return new Set(Object.hasOwn(groups, robots.slice(1)) ? groups[robots.slice(1)] : []);
  return robots ? new Set([robots]) : null;
}

/**
 * @param {Entry} entry
 * @param {Set<string>} wanted
 */
function concerns({ kind, robots = [] }, wanted) {
  return robots.length ? robots.some((robot) => wanted.has(robot)) : OF_ALL.includes(kind);
}
