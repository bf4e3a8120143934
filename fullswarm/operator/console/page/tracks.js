/** Where robots are between two states: the page draws a little in the past, so it always knows both ends. */

import { mixAngle } from "./geometry.js";

/** @import { Point } from "./types.d.ts" */

const KEPT = 8;
export const DELAY_S = 0.08; // at the usual 20 states a second
const SPARE_S = 0.03; // beside the time between two states
const LONGEST_GAP_S = 0.3; // a longer one is a pause
const TRAIL_S = 60;
const TRAIL_STEP_S = 0.2;
const TRAIL_STEP_M = 0.03;

/** The server's clock as seen from here: the fastest message gives the best offset. */
export class ServerClock {
  constructor() {
    this.offset_s = Infinity;
    this.newest_s = Infinity;
    this.gap_s = 0; // between two states: the console sends fewer of many robots
  }

  /**
   * Note a message stamped `at_s` that arrived at `now_s` of this page's clock.
   * @param {number} at_s
   * @param {number} now_s
   */
  update(at_s, now_s) {
    const offset = now_s - at_s;
    // Drifts slowly, so that a clock which runs differently is followed; jumps when the server was restarted.
    if (offset < this.offset_s || offset > this.offset_s + 2) this.offset_s = offset;
    else this.offset_s += (offset - this.offset_s) * 0.002;
    const gap_s = at_s - this.newest_s;
    if (gap_s > 0 && gap_s < LONGEST_GAP_S) this.gap_s += (gap_s - this.gap_s) * 0.1;
    this.newest_s = at_s;
  }

  /**
   * Return the server's time to draw at `now_s`.
   * @param {number} now_s
   */
  drawn(now_s) {
    return now_s - this.offset_s - Math.max(DELAY_S, this.gap_s + SPARE_S);
  }
}

/** The newest states of one robot, and its trail. */
export class Track {
  constructor() {
    this.states = /** @type {number[][]} */ ([]); // [at_s, x, y, heading, speed]
    this.trail = /** @type {number[][]} */ ([]); // [at_s, x, y]
  }

  /**
   * @param {number} at_s
   * @param {number} x
   * @param {number} y
   * @param {number} heading
   * @param {number} speed
   */
  push(at_s, x, y, heading, speed) {
    const newest = this.states.at(-1);
    if (newest && at_s < newest[0]) this.states.length = 0; // another server
    this.states.push([at_s, x, y, heading, speed]);
    if (this.states.length > KEPT) this.states.shift();
    this.#trace(at_s, x, y);
  }

  /**
   * Return [x, y, heading, speed] at a time of the server; held at the ends.
   * @param {number} at_s
   * @param {number[]} [into] what is filled and returned; by default a new array
   */
  pose(at_s, into = [0, 0, 0, 0]) {
    const states = this.states;
    for (let i = states.length - 1; i > 0; i -= 1) {
      const [from, to] = [states[i - 1], states[i]];
      if (at_s >= to[0]) return held(to, into);
      if (at_s < from[0]) continue;
      const share = (at_s - from[0]) / (to[0] - from[0]);
      into[0] = from[1] + (to[1] - from[1]) * share;
      into[1] = from[2] + (to[2] - from[2]) * share;
      into[2] = mixAngle(from[3], to[3], share);
      into[3] = from[4] + (to[4] - from[4]) * share;
      return into;
    }
    return states.length ? held(states[0], into) : null;
  }

  /** Return the same, to go on by itself. */
  copy() {
    const copy = new Track();
    [copy.states, copy.trail] = [[...this.states], [...this.trail]];
    return copy;
  }

  /**
   * Put a trail of an earlier time before what is known; it is stamped backwards from `before_s`.
   * @param {Point[]} points
   * @param {number} before_s
   */
  recall(points, before_s) {
    const older = points.map(([x, y], k) => [before_s - (points.length - k) * TRAIL_STEP_S, x, y]);
    this.trail = [...older, ...this.trail.filter((point) => point[0] >= before_s)];
  }

  /**
   * @param {number} at_s
   * @param {number} x
   * @param {number} y
   */
  #trace(at_s, x, y) {
    const last = this.trail.at(-1);
    if (last && at_s < last[0] - 1) this.trail.length = 0;
    const far = !last || Math.hypot(x - last[1], y - last[2]) >= TRAIL_STEP_M;
    if (far && (!last || at_s - last[0] >= TRAIL_STEP_S)) this.trail.push([at_s, x, y]);
    while (this.trail.length && this.trail[0][0] < at_s - TRAIL_S) this.trail.shift();
  }
}

/**
 * @param {number[]} state
 * @param {number[]} into
 */
function held(state, into) {
  for (let k = 0; k < 4; k += 1) into[k] = state[k + 1];
  return into;
}
