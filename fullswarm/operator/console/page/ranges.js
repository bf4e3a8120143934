/**
 * Draws what the range sensors of a few robots measure: of the one whose details are open, and of selected ones. The
 * page asks for scans only while it shows them; one that is older than a second is drawn no more.
 */

import { byId, setFlag } from "./dom.js";

/** @import { Scene } from "./ground.js" */
/** @import { Scan } from "./types.d.ts" */

const MOST = 4; // robots
const OLD_S = 1;
const NOTHING = 0xfffe; // in place of a distance: nothing within range; above: not measured
const DOT_PX = 2; // whole, and placed so: edges between pixels take longer to draw
const APART_PX = 2; // dots are no closer than this: zoomed out, a wall is a line of fewer of them
const FAN_ALPHA = 0.1, DOT_ALPHA = 0.9;

/** @typedef {Omit<Scan, "mm"> & {mm: Uint16Array}} Decoded  distances in mm */

export class Ranges {
  /**
   * @param {{store: import("./store.js").Store, link: import("./link.js").Link, map: import("./map.js").SwarmMap,
   *   selection: import("./selection.js").Selection, detail: import("./detail.js").DetailPane,
   *   past: import("./past.js").Past}} parts  `store`: of the present
   */
  constructor({ store, link, map, selection, detail, past }) {
    this.store = store;
    this.link = link;
    this.map = map;
    this.selection = selection;
    this.detail = detail;
    this.past = past;
    this.button = byId("layer-ranges");
    this.shown = true;
    this.offered = true; // not in a study
    this.button.addEventListener("click", () => this.toggle());
    store.on("scans", ({ robot, scans }) => this.#take(robot, scans));
    store.on("fleet", () => this.#update()); // four times a second: the pane may show another robot by then
    store.on("study", () => ((this.offered = false), this.#update()));
    store.on("hello", () => ((this.#asked = ""), this.#update())); // a new connection knows nothing of what was asked
    selection.on("change", () => this.#update());
    past.on("mode", () => this.#update());
    document.addEventListener("visibilitychange", () => this.#update());
  }

  #asked = "";
  #scans = /** @type {Map<string, {at_ms: number, scans: Decoded[]}>} */ (new Map());
  #fading = 0;

  /** How many rays of each robot are drawn now that end at something, for tests. */
  get hits() {
    const counts = /** @type {Record<string, number>} */ ({});
    for (const [robot, { scans }] of this.#present()) {
      counts[robot] = scans.reduce((sum, { mm }) => sum + mm.filter((each) => each < NOTHING).length, 0);
    }
    return counts;
  }

  toggle() {
    this.shown = !this.shown;
    setFlag(this.button, "aria-pressed", this.shown);
    this.#update();
  }

  #update() {
    const able = (/** @type {string} */ id) => this.store.info(id).capabilities?.includes("ranges") ?? false;
    const offered = this.offered && this.store.ids().some(able);
    this.button.toggleAttribute("data-unknown", !offered); // it keeps its room: nothing moves when it appears
    const live = this.shown && this.offered && this.past.live && !document.hidden;
    const wanted = live ? [...new Set([this.detail.robot, ...this.selection.list()])].filter(able).slice(0, MOST) : [];
    for (const id of this.#scans.keys()) if (!wanted.includes(id)) this.#scans.delete(id);
    if (this.#asked !== wanted.join(" ")) {
      this.#asked = wanted.join(" ");
      this.link.post({ t: "scans", robots: wanted });
      this.map.touch();
    }
  }

  /**
   * @param {string} robot
   * @param {Scan[]} scans
   */
  #take(robot, scans) {
    if (!this.#asked.split(" ").includes(robot)) return; // one that was under way
    const decoded = scans.map((scan) => ({ ...scan, mm: distances(scan.mm) }));
    this.#scans.set(robot, { at_ms: performance.now(), scans: decoded });
    this.map.touch();
    clearTimeout(this.#fading);
    this.#fading = setTimeout(() => this.map.touch(), 1000 * OLD_S + 50); // the last ones are to vanish
  }

  /** The robots whose scans are not old. */
  #present() {
    const now_ms = performance.now();
    return [...this.#scans].filter(([, { at_ms }]) => now_ms - at_ms < 1000 * OLD_S);
  }

  /** @param {Scene} scene */
  draw(scene) {
    const now_ms = performance.now();
    for (const [, { at_ms, scans }] of this.#present()) {
      for (const scan of scans) {
        const left = 1 - ((now_ms - at_ms) / 1000 + scan.age_s) / OLD_S;
        if (left <= 0) continue;
        scene.context.globalAlpha = FAN_ALPHA;
        drawFan(scene, scan);
        scene.context.globalAlpha = DOT_ALPHA * Math.min(1, 2 * left);
        drawHits(scene, scan);
      }
    }
    scene.context.globalAlpha = 1;
  }
}

/**
 * Read two bytes for each distance, the low one first.
 * @param {string} base64
 */
function distances(base64) {
  const bytes = Uint8Array.from(atob(base64), (character) => character.charCodeAt(0));
  const view = new DataView(bytes.buffer);
  return Uint16Array.from({ length: bytes.length >> 1 }, (_, k) => view.getUint16(2 * k, true));
}

/**
 * Fill what the rays have passed through: a sector for each ray, as wide as its cone or the step to the next one.
 * @param {Scene} scene
 * @param {Decoded} scan
 */
function drawFan({ context, view, colours }, { at, first_rad, step_rad, cone_rad, max_m, mm }) {
  const [x_px, y_px] = view.toScreen(at[0], at[1]);
  const half_rad = Math.max(step_rad, cone_rad) / 2;
  context.fillStyle = colours.seen;
  context.beginPath();
  for (let k = 0; k < mm.length; k += 1) {
    if (mm[k] > NOTHING) continue;
    const reach_px = (mm[k] === NOTHING ? max_m : mm[k] / 1000) * view.scale;
    const angle = at[2] + first_rad + k * step_rad; // y points up in the world and down on the screen
    if (cone_rad > 0) {
      context.moveTo(x_px, y_px);
      context.arc(x_px, y_px, reach_px, -angle - half_rad, -angle + half_rad);
      continue;
    }
    // Of narrow rays, one outline through the ends of neighbours: an arc for each takes several times as long.
    if (k === 0 || mm[k - 1] > NOTHING) context.moveTo(x_px, y_px);
    for (const side_rad of [angle - half_rad, angle + half_rad]) {
      context.lineTo(x_px + reach_px * Math.cos(side_rad), y_px - reach_px * Math.sin(side_rad));
    }
    if (mm[k + 1] > NOTHING) context.closePath();
  }
  context.fill();
}

/**
 * Draw where rays ended: a dot, or the arc of a cone, in which the thing is somewhere.
 * @param {Scene} scene
 * @param {Decoded} scan
 */
function drawHits({ context, view, colours }, { at, first_rad, step_rad, cone_rad, mm }) {
  let [last_x, last_y] = [-Infinity, -Infinity];
  context.fillStyle = context.strokeStyle = colours.seen;
  context.lineWidth = DOT_PX;
  for (let k = 0; k < mm.length; k += 1) {
    if (mm[k] >= NOTHING) continue;
    const reach_m = mm[k] / 1000, angle = at[2] + first_rad + k * step_rad;
    if (cone_rad > 0) {
      const [x_px, y_px] = view.toScreen(at[0], at[1]);
      context.beginPath();
      context.arc(x_px, y_px, reach_m * view.scale, -angle - cone_rad / 2, -angle + cone_rad / 2);
      context.stroke();
      continue;
    }
    const [x, y] = view.toScreen(at[0] + reach_m * Math.cos(angle), at[1] + reach_m * Math.sin(angle));
    if (Math.abs(x - last_x) < APART_PX && Math.abs(y - last_y) < APART_PX) continue;
    [last_x, last_y] = [x, y];
    context.fillRect(Math.round(x - DOT_PX / 2), Math.round(y - DOT_PX / 2), DOT_PX, DOT_PX);
  }
}
