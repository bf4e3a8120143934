/** Words for people: titles of behaviours, what the fleet does, how a request goes. Pure. */

import { robots as counted } from "./dom.js";

/** @import { Behaviour, RequestStatus, Robot } from "./types.d.ts" */

export const STOP = "stop";

/**
 * Return the title of a behaviour, for people; its key if its record is not known.
 * @param {Record<string, Behaviour>} behaviours
 * @param {string | undefined} name
 */
export function titleOf(behaviours, name) {
  if (!name) return "";
  return name === STOP ? "Stop" : behaviours[name]?.title || name;
}

/**
 * Say what the fleet does: "8 active · 6 moving". Active: it runs a behaviour. Silent robots are neither.
 * @param {Iterable<Partial<Robot>>} fleet
 */
export function fleetWords(fleet) {
  let [all, active, moving, silent] = [0, 0, 0, 0];
  for (const robot of fleet) {
    all += 1;
    if (robot.silent) silent += 1;
    else if (robot.behaviour && robot.behaviour !== STOP && !robot.ended) active += 1;
    if (!robot.silent && robot.moving) moving += 1;
  }
  if (all === 0) return "no robots";
  const parts = [active ? `${active} active` : "none active", moving ? `${moving} moving` : "all standing"];
  if (silent === all) return `${counted(all)} silent`;
  if (silent && !moving) parts[1] = "none moving";
  return parts.join(" · ");
}

/**
 * Say how a request goes.
 * @param {RequestStatus} status
 * @param {string} title
 */
export function progressWords(status, title) {
  const { phase, running = [], missing = [], refused_by = [], left_out = [], roles = {}, reason } = status;
  const parts = [phaseWords(status, title)];
  if (phase !== "refused" && status.behaviour !== STOP && running.length < status.robots.length && running.length > 0) {
    parts[0] += " so far";
  }
  if (missing.length) parts.push(`not present: ${missing.join(", ")}`);
  if (refused_by.length) parts.push(`refused by ${refused_by.join(", ")}${reason ? `: ${reason}` : ""}`);
  if (left_out.length) parts.push(`left out: ${left_out.join(", ")}${reason ? ` (${reason})` : ""}`);
  for (const role of new Set(Object.values(roles))) {
    parts.push(`${role}: ${Object.keys(roles).filter((id) => roles[id] === role).join(", ")}`);
  }
  return parts.join(" · ");
}

/**
 * @param {RequestStatus} status
 * @param {string} title
 */
function phaseWords({ behaviour, phase, robots = [], running = [], reason }, title) {
  if (behaviour === STOP && phase !== "refused") return `stopped, ${running.length} of ${robots.length}`;
  if (phase === "running") return `${title}: ${running.length} of ${robots.length} run it`;
  if (phase === "accepted" || phase === "scheduled") return `${title}: sent to ${counted(robots.length)}`;
  if (phase === "superseded") return `${title}: ${reason || "replaced by another request"}`;
  if (phase === "ended") return `${title}: ended${reason ? `, ${reason}` : ""}`;
  return `${title}: ${phase}`;
}
