/** From a gamepad's axes and buttons to what it asks for (W3C standard mapping). Pure; no page needed. */

export const DEAD_ZONE = 0.12;
const SLOW_SHARE = 0.5;
const BUTTON = { estop: 1, deadman: 4, turbo: 5, up: 12, down: 13, left: 14, right: 15 };

/**
 * Rescale an axis so that it starts from zero at the edge of the dead zone; not a number counts as zero.
 * @param {number} value -1 to 1
 */
export function deadZone(value, zone = DEAD_ZONE) {
  const size = Math.min(1, Math.abs(value));
  if (!(size > zone)) return 0;
  return Math.sign(value) * ((size - zone) / (1 - zone));
}

/**
 * Read one pad.
 * @param {{axes: readonly number[], buttons: readonly {pressed: boolean, value: number}[]}} pad
 */
export function readPad(pad) {
  const down = (/** @type {number} */ index) => Boolean(pad.buttons[index]?.pressed);
  const share = down(BUTTON.turbo) ? 1 : SLOW_SHARE;
  const stick = (/** @type {number} */ index) => -share * deadZone(pad.axes[index] ?? 0) || 0; // || 0: no minus zero
  return {
    deadman: down(BUTTON.deadman),
    turbo: down(BUTTON.turbo),
    estop: down(BUTTON.estop),
    linear: stick(1),
    angular: stick(0),
    step: { left: down(BUTTON.left), right: down(BUTTON.right), up: down(BUTTON.up), down: down(BUTTON.down) },
  };
}

/**
 * Return the names of the d-pad's buttons that went down between two readings.
 * @param {Record<string, boolean> | undefined} before
 * @param {Record<string, boolean>} now
 */
export function pressed(before, now) {
  return Object.keys(now).filter((name) => now[name] && !before?.[name]);
}

/**
 * Turn held arrow keys into sticks.
 * @param {Set<string>} keys
 */
export function readArrows(keys) {
  const axis = (/** @type {string} */ plus, /** @type {string} */ minus) => (Number(keys.has(plus)) - Number(keys.has(minus))) * SLOW_SHARE;
  return { linear: axis("ArrowUp", "ArrowDown"), angular: axis("ArrowLeft", "ArrowRight") };
}

/**
 * Return the item after (or before) the current one, in a circle.
 * @template T
 * @param {T[]} items
 * @param {T | undefined} current
 * @param {1 | -1} step
 * @returns {T | undefined}
 */
export function neighbour(items, current, step) {
  if (items.length === 0) return undefined;
  const at = current === undefined ? -1 : items.indexOf(current);
  if (at < 0) return step > 0 ? items[0] : items.at(-1);
  return items[(at + step + items.length) % items.length];
}
