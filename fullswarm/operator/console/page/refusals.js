/** When a refusal's cause is gone: by its code, so that the page shows it no longer than it holds. Pure. */

/** @import { Robot } from "./types.d.ts" */

/** @typedef {{info: (id: string) => Partial<Robot>, heldByOthers: (ids: string[]) => Map<string, string>}} Facts */

export const SEEN_WITHIN_S = 3;

const latched = (/** @type {Facts} */ facts, /** @type {string[]} */ ids) => ids.some((id) => facts.info(id).estop);
const faulty = (/** @type {Facts} */ facts, /** @type {string[]} */ ids) => ids.some((id) => facts.info(id).fault || facts.info(id).lifecycle === "FAULT");
const held = (/** @type {Facts} */ facts, /** @type {string[]} */ ids) => facts.heldByOthers(ids).size > 0;

/** Code → whether its cause holds now. Codes that are not here have causes that the page does not see. */
const CAUSES = /** @type {Record<string, (facts: Facts, ids: string[]) => boolean>} */ ({
  estop: latched, estop_latched: latched, held,
  cliff: faulty, wheel_drop: faulty, overcurrent: faulty, charger: faulty, motors_off: faulty, driver_failed: faulty,
});

/**
 * Return whether the cause of a refusal holds now; null if the page cannot tell.
 * @param {string} code
 * @param {string[]} ids the robots that it concerns
 * @param {Facts} facts
 * @returns {boolean | null}
 */
export function causeHolds(code, ids, facts) {
  const cause = Object.hasOwn(CAUSES, code) ? CAUSES[code] : null;
  return cause && ids.length ? cause(facts, ids) : null;
}
