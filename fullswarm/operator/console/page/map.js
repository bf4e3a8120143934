/** The map: two canvases, one for what changes seldom and one for what moves, and the loop that draws them. */

import { context2d } from "./dom.js";
import { bounds } from "./geometry.js";
import { drawFloor, drawTrails } from "./ground.js";
import { MAP_COLOURS } from "./palette.js";
import { RobotLayer, drawGoals } from "./robots.js";
import { Sprites } from "./sprites.js";
import { drawTool } from "./tools.js";
import { Viewport } from "./viewport.js";

/** @import { Scene } from "./ground.js" */

const TRAILS_EVERY_MS = 250;
const TRAILS_SHARE = 15; // with many robots drawn less often: at most a fifteenth of the time goes into trails
const LIVELY_MS = 400;
const OVERLAYS = ".zoom button, .camera-toggle, .legend li, #layer-underlay, #underlay-words"; // elements over the map
const OVERLAYS_EVERY_MS = 500; // interval at which their positions are read
const KEPT = 240; // frames whose cost is known

export class SwarmMap {
  /**
   * @param {{ground: HTMLCanvasElement, live: HTMLCanvasElement, store: import("./store.js").Store,
   *   selection: import("./selection.js").Selection, theme: import("./theme.js").Theme}} parts
   */
  constructor({ ground, live, store, selection, theme }) {
    this.live = live;
    this.store = store;
    this.selection = selection;
    this.theme = theme;
    this.view = new Viewport();
    this.stats = new Stats();
    this.options = { coverage: true, trails: true };
    this.underlay = /** @type {import("./underlay.js").Underlay | null} */ (null);
    this.picture = /** @type {import("./floorpicture.js").FloorPicture | null} */ (null);
    this.routes = /** @type {import("./routes.js").Routes | null} */ (null);
    this.ranges = /** @type {import("./ranges.js").Ranges | null} */ (null);
    this.tool = /** @type {import("./tools.js").Tools | null} */ (null);
    this.hovered = /** @type {string | null} */ (null);
    this.old = false; // data is old: veiled
    this.drawn_s = 0; // the time at which `placed` is
    this.robots = new RobotLayer();
    this.#ground = context2d(ground, { alpha: false });
    this.#live = context2d(live);
    this.#floor = context2d(document.createElement("canvas"), { alpha: false });
    this.#listen();
    new ResizeObserver(() => this.#resize()).observe(live);
    requestAnimationFrame((now_ms) => this.#frame(now_ms));
  }

  #ground;
  #live;
  #floor;
  #sprites = new Sprites();
  #dpr = 1;
  #fitted = false;
  #fit = ""; // what the last fit showed: until the user moves the map, it is fitted again to each new size
  #floorStale = true;
  #groundStale = true;
  #trails_ms = 0;
  #overlays_ms = 0; // when the overlays are read next
  #lively_ms = 0;

  /**
   * Draw again soon; with `all`, the floor too.
   * @param {boolean} [all]
   */
  touch(all = false) {
    this.#lively_ms = performance.now() + LIVELY_MS;
    if (all) this.#floorStale = true;
  }

  /** The robots as they are drawn now. */
  get placed() {
    return this.robots.placed;
  }

  /** Show the arena, or the robots and what they have detected if there is none. */
  fit() {
    const seen = /** @type {import("./types.d.ts").Point[]} */ (this.store.obstacles.map(([x, y]) => [x, y]));
    const box = this.store.arena ?? bounds([...this.placed.map(({ x, y }) => /** @type {[number, number]} */ ([x, y])), ...seen]);
    if (box && this.view.width > 1) this.view.fit(box);
    this.#fit = this.#shown();
    this.touch(true);
  }

  /**
   * Where a point of the world lies on the page, CSS pixels.
   * @param {number} x_m
   * @param {number} y_m
   * @returns {[number, number]}
   */
  toPage(x_m, y_m) {
    const corner = this.live.getBoundingClientRect();
    const [x, y] = this.view.toScreen(x_m, y_m);
    return [corner.left + x, corner.top + y];
  }

  #listen() {
    const { store } = this;
    for (const topic of /** @type {const} */ (["coverage", "obstacles", "docks"])) store.on(topic, () => this.touch(true));
    for (const topic of /** @type {const} */ (["states", "fleet", "filter", "goals", "robots"])) store.on(topic, () => this.touch());
    this.selection.on("change", () => this.touch());
    this.theme.on("change", () => this.#restyle());
    store.on("world", () => {
      if (!this.#fitted && store.arena) this.#fitted = true;
      else return this.touch(true);
      return this.fit();
    });
  }

  #shown() {
    return `${this.view.centre} ${this.view.scale}`;
  }

  #restyle() {
    this.#sprites.clear();
    this.touch(true);
  }

  #resize() {
    const { clientWidth, clientHeight } = this.live;
    if (!clientWidth || !clientHeight) return;
    const fits = this.view.width <= 1 || this.#fit === this.#shown();
    this.#dpr = Math.min(2, window.devicePixelRatio || 1);
    [this.view.width, this.view.height] = [clientWidth, clientHeight];
    for (const { canvas } of [this.#ground, this.#live, this.#floor]) {
      canvas.width = Math.round(clientWidth * this.#dpr);
      canvas.height = Math.round(clientHeight * this.#dpr);
    }
    if (fits) this.fit();
    this.#overlays_ms = 0;
    this.#restyle();
  }

  /** @param {number} now_ms */
  #frame(now_ms) {
    this.theme.update();
    const began_ms = performance.now();
    const draws = began_ms < this.#lively_ms && this.view.width > 1;
    if (draws) this.#draw(began_ms);
    this.stats.frame(now_ms, draws ? performance.now() - began_ms : null);
    requestAnimationFrame((next_ms) => this.#frame(next_ms));
  }

  /** Read where elements lie over the map: labels are not put under them. */
  #readOverlays() {
    const map = this.live.getBoundingClientRect();
    const boxes = [...document.querySelectorAll(OVERLAYS)].map((each) => each.getBoundingClientRect());
    this.view.covered = boxes.filter(({ width }) => width > 0).map(({ left, top, right, bottom }) => ({
      left: left - map.left, top: top - map.top, right: right - map.left, bottom: bottom - map.top,
    }));
  }

  /** @param {number} now_ms */
  #draw(now_ms) {
    if (now_ms > this.#overlays_ms) {
      this.#readOverlays();
      this.#overlays_ms = now_ms + OVERLAYS_EVERY_MS;
    }
    const scene = {
      view: this.view, store: this.store, dpr: this.#dpr, sprites: this.#sprites,
      colours: MAP_COLOURS[this.theme.dark ? "dark" : "light"],
    };
    if (this.#floorStale) {
      drawFloor({ ...scene, context: this.#floor }, { ...this.options, underlay: this.underlay, picture: this.picture });
      this.#floorStale = false;
      this.#groundStale = true;
    }
    if (this.options.trails && now_ms > this.#trails_ms) this.#groundStale = true;
    if (this.#groundStale) this.#drawGround(scene);
    this.#drawLive({ ...scene, context: this.#live });
  }

  /** @param {Omit<Scene, "context">} scene */
  #drawGround(scene) {
    const now_ms = performance.now();
    this.#ground.setTransform(1, 0, 0, 1, 0, 0);
    this.#ground.drawImage(this.#floor.canvas, 0, 0);
    if (this.options.trails) drawTrails({ ...scene, context: this.#ground });
    const took_ms = performance.now() - now_ms;
    this.#trails_ms = now_ms + Math.max(TRAILS_EVERY_MS, TRAILS_SHARE * took_ms);
    this.#groundStale = false;
  }

  /** @param {Scene} scene */
  #drawLive(scene) {
    const { context, colours } = scene;
    context.setTransform(this.#dpr, 0, 0, this.#dpr, 0, 0);
    context.clearRect(0, 0, this.view.width, this.view.height);
    this.drawn_s = this.store.clock.drawn(performance.now() / 1000);
    this.robots.place(this.store, this.view, this.drawn_s);
    this.routes?.draw(scene, this.placed);
    this.ranges?.draw(scene);
    drawGoals(scene, this.placed);
    this.robots.draw(scene, this.selection, this.hovered, this.routes?.labels ?? []);
    if (this.old) {
      context.fillStyle = colours.dim;
      context.fillRect(0, 0, this.view.width, this.view.height);
    }
    if (this.tool) drawTool(scene, this.tool, this.placed, this.selection);
  }
}

/** Counts frames and their cost, for the debug display and for tests. */
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
