/** The missions on the map: where each step sends robots, numbered and joined in the order of the steps. CSS pixels. */

import { byId, setFlag } from "./dom.js";
import { bounds } from "./geometry.js";
import { levelOfDetail } from "./labels.js";
import { corners, middle } from "./places.js";

/** @import { Scene } from "./ground.js" */
/** @import { Placed } from "./robots.js" */
/** @import { Mission, Point, Step, StepPlace } from "./types.d.ts" */

const ENDED = ["done", "failed", "aborted"];
const ROBOT_M = 0.17; // how much detail there is, as of a robot of this radius
const MARK_PX = 11;
const SMALL_PX = 5; // of a mark without its number
const NEAR_PX = 2 * MARK_PX; // nearer marks of a track are one
const REACH_PX = 16; // so near to a mark the pointer is on it
const MOST_LINKS = 16; // robots with a line to their step; more are a tangle
const MOST_SPOKES = 24;
const FAINT = 0.5;
const FONT = "700 12px system-ui, sans-serif";

/**
 * @typedef {{mission: string, track: string, steps: {step: Step, number: number}[], places: StepPlace[], at: Point,
 *   x: number, y: number, phase: string}} Mark  steps that lie at one place; phase: of the one that matters most
 * @typedef {{mission: string, track: string, step: string}} Pointed
 */

export class Routes {
  /**
   * @param {{store: import("./store.js").Store, map: import("./map.js").SwarmMap}} parts
   */
  constructor({ store, map }) {
    this.store = store;
    this.map = map;
    this.shown = true;
    this.marks = /** @type {Mark[]} */ ([]);
    this.labels = /** @type {{mark: Placed, words: string, matters: boolean}[]} */ ([]); // words: none, but nothing covers it
    this.onPoint = /** @type {(pointed: Pointed | null) => void} */ (() => undefined); // a mark is pointed at
    byId("layer-routes").addEventListener("click", () => this.toggle());
    store.on("missions", () => this.map.touch());
    map.live.addEventListener("pointermove", (event) => this.#hover(event));
    map.live.addEventListener("pointerleave", () => this.#hovered(null));
  }

  #pinned = ""; // a mission that is drawn although it has ended
  #pointed = /** @type {Pointed | null} */ (null);
  #underPointer = "";

  toggle(on = !this.shown) {
    this.shown = on;
    setFlag(byId("layer-routes"), "aria-pressed", on);
    this.map.touch();
  }

  /**
   * Emphasise a step of the list, or none.
   * @param {Pointed | null} pointed
   */
  point(pointed) {
    this.#pointed = pointed;
    this.map.touch();
  }

  /**
   * Fit the map to the places of a mission, and draw it from now on even if it has ended.
   * @param {Mission} mission
   */
  show(mission) {
    const box = bounds(mission.tracks.flatMap(({ steps }) => steps.flatMap((step) => (step.places ?? []).flatMap(({ points }) => points))));
    if (!box) return;
    this.#pinned = mission.mission;
    const ROOM_M = 0.5; // for robots that stand at the outermost place
    this.map.view.fit([box[0] - ROOM_M, box[1] - ROOM_M, box[2] + ROOM_M, box[3] + ROOM_M]);
    this.toggle(true);
    this.map.touch(true);
  }

  /**
   * Draw all missions that run or wait, below the robots.
   * @param {Scene} scene
   * @param {Placed[]} placed
   */
  draw(scene, placed) {
    this.marks.length = this.labels.length = 0;
    if (!this.shown) return;
    const missions = this.store.missions.filter(({ mission, phase }) => !ENDED.includes(phase) || mission === this.#pinned);
    const level = levelOfDetail(ROBOT_M * scene.view.scale);
    for (const mission of missions) {
      for (const { name, steps } of mission.tracks) {
        const marks = marksOf(mission.mission, name, steps, scene.view);
        drawLines(scene, marks);
        for (const mark of marks) this.#mark(scene, mark, placed, level);
        const prefix = [...(missions.length > 1 ? [mission.name] : []), ...(mission.tracks.length > 1 ? [name] : [])].join(" ");
        for (const mark of marks) this.#label(mark, prefix, level);
        this.marks.push(...marks);
      }
    }
    scene.context.globalAlpha = 1;
  }

  /**
   * @param {Scene} scene
   * @param {Mark} mark
   * @param {Placed[]} placed
   * @param {"all" | "ids" | "alarms"} level
   */
  #mark(scene, mark, placed, level) {
    const pointed = this.#isPointed(mark);
    scene.context.globalAlpha = isOver(mark.phase) && !pointed ? FAINT : 1;
    for (const place of mark.places) drawPlace(scene, mark, place);
    if (isCurrent(mark.phase) && level !== "alarms") drawLinks(scene, mark, placed);
    drawMark(scene, mark, pointed, level === "alarms" && !pointed && !isCurrent(mark.phase));
  }

  /**
   * Note the words beside a mark.
   * @param {Mark} mark
   * @param {string} prefix  mission and track, where there are several
   * @param {"all" | "ids" | "alarms"} level
   */
  #label(mark, prefix, level) {
    const matters = isCurrent(mark.phase) || this.#isPointed(mark);
    const names = mark.steps.slice(0, 2).map(({ step, number }) => `${number} ${step.name}`).join(", ");
    const words = `${prefix && `${prefix}: `}${names}${mark.steps.length > 2 ? ", …" : ""}`;
    this.labels.push({ mark: asPlaced(mark), words: level === "all" || matters ? words : "", matters });
  }

  /** For tests: a copy of what is drawn. */
  seen() {
    return this.marks.map(({ mission, track, steps, at, phase, x, y }) => ({
      mission, track, numbers: steps.map(({ number }) => number), at: [...at], phase, x, y, pointed: this.#isPointed({ mission, track, steps }),
    }));
  }

  /** @param {Pick<Mark, "mission" | "track" | "steps">} mark */
  #isPointed({ mission, track, steps }) {
    const pointed = this.#pointed;
    return pointed !== null && mission === pointed.mission && track === pointed.track && steps.some(({ step }) => step.name === pointed.step);
  }

  /** @param {PointerEvent} event */
  #hover({ offsetX, offsetY }) {
    const near = this.marks.filter(({ x, y }) => Math.hypot(x - offsetX, y - offsetY) <= REACH_PX);
    this.#hovered(near.at(-1) ?? null);
  }

  /** @param {Mark | null} mark */
  #hovered(mark) {
    const key = mark ? `${mark.mission}/${mark.track}/${mark.steps[0].number}` : "";
    if (key === this.#underPointer) return;
    this.#underPointer = key;
    const pointed = mark && { mission: mark.mission, track: mark.track, step: mark.steps[0].step.name };
    this.point(pointed);
    this.onPoint(pointed);
  }
}

/** @param {string} phase */
function isOver(phase) {
  return phase === "done" || phase === "skipped";
}

/** @param {string} phase */
function isCurrent(phase) {
  return phase === "running" || phase === "paused";
}

/**
 * Return the phase that is shown of steps at one place: what needs a person, then what runs, then what is to come.
 * @param {{step: Step}[]} steps
 */
function phaseOf(steps) {
  const ORDER = ["failed", "paused", "running", "waiting", "skipped", "done"];
  return ORDER.find((phase) => steps.some(({ step }) => step.phase === phase)) ?? "waiting";
}

/**
 * Return the marks of a track in order; steps that follow at the place of another one are in its mark.
 * @param {string} mission
 * @param {string} track
 * @param {Step[]} steps
 * @param {import("./viewport.js").Viewport} view
 */
function marksOf(mission, track, steps, view) {
  const marks = /** @type {Mark[]} */ ([]);
  steps.forEach((step, index) => {
    const places = (step.places ?? []).filter(({ points }) => points.length > 0);
    if (!places.length) return;
    const at = middle(places[0]);
    const [x, y] = view.toScreen(...at);
    const here = marks.find((mark) => Math.hypot(mark.x - x, mark.y - y) < NEAR_PX);
    const numbered = { step, number: index + 1 };
    if (here) {
      here.steps.push(numbered);
      here.places.push(...places);
      here.phase = phaseOf(here.steps);
    } else marks.push({ mission, track, steps: [numbered], places: [...places], at, x, y, phase: step.phase });
  });
  return marks;
}

/**
 * Return the way of a track as pairs of marks, in the order of the steps, with the phase of the step that it leads to.
 * @param {Mark[]} marks
 */
function legs(marks) {
  const all = marks.flatMap((mark) => mark.steps.map(({ step, number }) => ({ mark, step, number })));
  all.sort((a, b) => a.number - b.number);
  return all.slice(1).map(({ mark, step }, k) => ({ from: all[k].mark, to: mark, phase: step.phase })).filter(({ from, to }) => from !== to);
}

/**
 * @param {Scene} scene
 * @param {Mark[]} marks
 */
function drawLines({ context, colours }, marks) {
  context.strokeStyle = context.fillStyle = colours.goal;
  for (const { from, to, phase } of legs(marks)) {
    context.globalAlpha = isOver(phase) ? 0.3 : isCurrent(phase) ? 0.9 : 0.55;
    context.lineWidth = isCurrent(phase) ? 3 : 2;
    context.setLineDash(phase === "waiting" ? [8, 6] : []);
    context.beginPath();
    context.moveTo(from.x, from.y);
    context.lineTo(to.x, to.y);
    context.stroke();
    context.setLineDash([]);
    drawHead(context, from, to);
  }
  context.globalAlpha = 1;
}

/**
 * An arrow head in the middle of a line: the way there and the way back are one line.
 * @param {CanvasRenderingContext2D} context
 * @param {Mark} from
 * @param {Mark} to
 */
function drawHead(context, from, to) {
  const length = Math.hypot(to.x - from.x, to.y - from.y);
  if (length < 4 * MARK_PX) return;
  const [ux, uy] = [(to.x - from.x) / length, (to.y - from.y) / length];
  const [x, y] = [(0.4 * from.x) + (0.6 * to.x), (0.4 * from.y) + (0.6 * to.y)];
  context.beginPath();
  context.moveTo(x + 6 * ux, y + 6 * uy);
  context.lineTo(x - 6 * ux - 5 * uy, y - 6 * uy + 5 * ux);
  context.lineTo(x - 6 * ux + 5 * uy, y - 6 * uy - 5 * ux);
  context.fill();
}

/**
 * What a place is beside its middle: the outline of an area, the targets of a formation, several points.
 * @param {Scene} scene
 * @param {Mark} mark
 * @param {StepPlace} place
 */
function drawPlace({ context, view, colours }, { x, y }, { kind, points }) {
  if (kind === "point") return;
  context.strokeStyle = colours.goal;
  context.lineWidth = 1.5;
  context.beginPath();
  if (kind === "area") {
    for (const point of corners(points)) context.lineTo(...view.toScreen(...point));
    context.closePath();
    context.setLineDash([10, 5]);
    context.stroke();
    context.setLineDash([]);
    return;
  }
  for (const point of points) {
    const [px, py] = view.toScreen(...point);
    context.moveTo(px + SMALL_PX, py);
    context.arc(px, py, SMALL_PX, 0, 2 * Math.PI);
    if (points.length > MOST_SPOKES || kind === "formation") continue;
    context.moveTo(px, py);
    context.lineTo(x, y);
  }
  context.stroke();
}

/**
 * Lines from the robots of a step that runs; those that have a goal of their own have a line to it already.
 * @param {Scene} scene
 * @param {Mark} mark
 * @param {Placed[]} placed
 */
function drawLinks({ context, colours, store }, mark, placed) {
  const ids = new Set(mark.steps.flatMap(({ step }) => (isCurrent(step.phase) ? step.robots : [])));
  const robots = placed.filter(({ id }) => ids.has(id) && !store.goals.has(id));
  if (robots.length > MOST_LINKS) return;
  context.strokeStyle = colours.goal;
  context.lineWidth = 1.5;
  context.setLineDash([2, 5]);
  context.beginPath();
  for (const { px, py } of robots) {
    context.moveTo(px, py);
    context.lineTo(mark.x, mark.y);
  }
  context.stroke();
  context.setLineDash([]);
}

/**
 * A disc with the numbers of its steps: filled while one runs, hollow before, faint after it.
 * @param {Scene} scene
 * @param {Mark} mark
 * @param {boolean} pointed
 * @param {boolean} small
 */
function drawMark({ context, colours }, mark, pointed, small) {
  const { x, y, phase, steps } = mark;
  const failed = phase === "failed";
  const filled = failed || isCurrent(phase);
  const words = steps.map(({ number }) => number).slice(0, 3).join(",") + (steps.length > 3 ? "…" : "");
  context.font = FONT;
  const half = small ? 0 : Math.max(0, context.measureText(words).width / 2 + 5 - MARK_PX); // wider for several numbers
  const high = small ? SMALL_PX : MARK_PX;
  const pill = (/** @type {number} */ more) => {
    context.beginPath();
    context.roundRect(x - half - high - more, y - high - more, 2 * (half + high + more), 2 * (high + more), high + more);
  };
  context.strokeStyle = failed ? colours.alarm : colours.goal;
  if (pointed || isCurrent(phase)) {
    pill(pointed ? 7 : 4);
    context.lineWidth = pointed ? 3 : 1.5;
    context.stroke();
  }
  pill(0);
  context.fillStyle = filled ? context.strokeStyle : colours.halo;
  context.fill();
  context.lineWidth = 2;
  context.stroke();
  if (small) return;
  context.fillStyle = filled ? colours.halo : colours.ink;
  context.textAlign = "center";
  context.fillText(words, x, y + 4.5);
  context.textAlign = "left";
}

/**
 * A mark as labels.js takes robots: what has a label beside it, and is not to be covered by one.
 * @param {Mark} mark
 * @returns {Placed}
 */
function asPlaced({ mission, track, steps, at, x, y }) {
  return {
    id: `mission ${mission}/${track}/${steps[0].number}`, x: at[0], y: at[1], px: x, py: y, heading: 0, radius: 0, radius_px: MARK_PX + 3,
    info: {}, kind: { shape: "circle", letter: "" },
  };
}
