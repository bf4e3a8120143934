/** How old is what the page shows, and why? Pure: the same words on the map, in the bar and for a screen reader. */

export const OLD_S = 1.0;

/**
 * @typedef {{open: boolean, now_s: number, heard_s: number | null, fleet_s: number | null, hub: boolean,
 *   core_age_s: number | null, refused: string}} LinkFacts
 *   heard_s: arrival of the newest message; fleet_s: of the newest "fleet"; core_age_s: as that one told
 */

/**
 * Judge the data.
 * @param {LinkFacts} facts
 * @returns {{level: "live" | "old" | "core" | "hub" | "refused" | "start", text: string}}
 */
export function judgeLink({ open, now_s, heard_s, fleet_s, hub, core_age_s, refused }) {
  if (refused) return { level: "refused", text: refused };
  if (heard_s === null || fleet_s === null) return { level: "start", text: open ? "no data yet" : "connecting" };
  const age_s = now_s - heard_s;
  if (!open || age_s > OLD_S) return { level: "old", text: `no data for ${seconds(age_s)}` };
  if (!hub) return { level: "hub", text: "hub lost" };
  if (core_age_s === null) return { level: "core", text: "core is silent" };
  const core_s = core_age_s + now_s - fleet_s;
  if (core_s > OLD_S) return { level: "core", text: `core is silent for ${seconds(core_s)}` };
  return { level: "live", text: "live" };
}

/**
 * Write an age: tenths while they matter.
 * @param {number} age_s
 */
export function seconds(age_s) {
  if (age_s < 10) return `${Math.max(0, age_s).toFixed(1)} s`;
  return age_s < 120 ? `${Math.round(age_s)} s` : `${Math.round(age_s / 60)} min`;
}

/** What each state means for the operator. */
export const LINK_ADVICE = {
  old: "The console does not answer. What you see is old. Robots stop by themselves if the hub is gone too.",
  core: "Requests cannot be answered. Most behaviours stop by themselves. Stop and e-stop still reach the robots.",
  hub: "Nothing reaches the robots from here. They stop by themselves. Start the hub: fullswarm up.",
  refused: "Open the address that the command fullswarm console prints.",
  start: "",
  live: "",
};
