/** How smooth the map is: for the debug display and for tests. */

const KEPT = 240;

/** Counts frames and their cost. */
export class Stats {
  constructor() {
    this.frames = 0; // drawn since the page was opened
    this.fps = 0; // frames of the browser, over the last seconds
    this.frame_ms_p95 = 0; // work of this page per drawn frame
    this.interval_ms_p95 = 0; // from frame to frame
  }

  #work = /** @type {number[]} */ ([]);
  #intervals = /** @type {number[]} */ ([]);
  #last_ms = 0;
  #counted = 0;

  /**
   * Note a frame of the browser at `now_ms`; `work_ms` is null if nothing had to be drawn.
   * @param {number} now_ms
   * @param {number | null} work_ms
   */
  frame(now_ms, work_ms) {
    if (this.#last_ms) keep(this.#intervals, now_ms - this.#last_ms);
    this.#last_ms = now_ms;
    if (work_ms !== null) {
      this.frames += 1;
      keep(this.#work, work_ms);
    }
    this.#counted += 1;
    if (this.#counted % 30 === 0) this.#sum();
  }

  #sum() {
    const total_ms = this.#intervals.reduce((sum, each) => sum + each, 0);
    this.fps = total_ms ? Math.round((1000 * this.#intervals.length * 10) / total_ms) / 10 : 0;
    this.frame_ms_p95 = p95(this.#work);
    this.interval_ms_p95 = p95(this.#intervals);
  }
}

/**
 * @param {number[]} values
 * @param {number} value
 */
function keep(values, value) {
  values.push(value);
  if (values.length > KEPT) values.shift();
}

/** @param {number[]} values */
function p95(values) {
  const sorted = [...values].sort((a, b) => a - b);
  return Math.round((sorted[Math.floor(0.95 * (sorted.length - 1))] ?? 0) * 100) / 100;
}
