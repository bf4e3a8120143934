/** The timeline below the map: the moment that is shown, events as ticks, play, steps, speed, and back to live. */

import { byId, make, setFlag, setText } from "./dom.js";
import { seconds } from "./link.js";

/** @import { Bookmark, TimeEvent } from "./types.d.ts" */

const SHOW_MS = 250;
const MOST_EVENTS = 2000;
const APART_PX = 4; // ticks closer together are one
const STEP_S = 1;
const SAME_S = 0.05; // an event so near is the one that is shown
const NAMES = /** @type {Record<string, string>} */ ({
  request: "request", refused: "refused", stop: "stop", estop: "e-stop", mission: "mission", lease: "lease", link: "link",
  reload: "reload", fault: "fault", bookmark: "bookmark",
});
const WEIGHT = ["request", "reload", "lease", "link", "mission", "refused", "stop", "fault", "estop", "bookmark"]; // the last one is shown
export const WITHHELD = "you are looking at the past: go back to live first (key L)";

export class TimeBar {
  /**
   * @param {{past: import("./past.js").Past, present: import("./store.js").Store,
   *   commands: import("./commands.js").Commands}} parts
   */
  constructor({ past, present, commands }) {
    this.past = past;
    this.commands = commands;
    this.bar = byId("timeline");
    this.slider = /** @type {HTMLInputElement} */ (byId("time-at"));
    this.ticks = byId("time-ticks");
    this.events = /** @type {TimeEvent[]} */ ([]);
    this.marks = /** @type {TimeEvent[]} */ ([]);
    present.on("timeline", (span) => past.update(span));
    present.on("history", (history) => past.receive(history));
    present.on("events", (events) => this.#all(events));
    present.on("event", (event) => this.#add(event));
    past.on("mode", (live) => this.#mode(live));
    past.on("change", () => this.#later());
    this.#listen();
    new ResizeObserver(() => this.#measure()).observe(this.slider);
    setInterval(() => this.#show(), SHOW_MS);
  }

  #dirty = true;
  #due = false;
  #width = 0; // of the ticks: reading it each time would lay the page out anew

  #measure() {
    this.#width = this.ticks.clientWidth;
    this.#drawTicks();
  }

  /** Go from live to the past and back. */
  live() {
    this.past.toLive();
  }

  #listen() {
    const { past } = this;
    byId("time-play").addEventListener("click", () => this.play());
    byId("time-back").addEventListener("click", () => past.step(-STEP_S));
    byId("time-forward").addEventListener("click", () => past.step(STEP_S));
    byId("time-live").addEventListener("click", () => past.toLive());
    const speed = /** @type {HTMLSelectElement} */ (byId("time-speed"));
    speed.addEventListener("change", () => (past.speed = Number(speed.value)));
    this.slider.addEventListener("input", () => past.look(past.from_s + Number(this.slider.value)));
    byId("time-more").addEventListener("click", () => this.more(byId("time-panel").hidden));
    byId("time-close").addEventListener("click", () => this.more(false));
    this.ticks.addEventListener("click", (event) => this.#jump(event.target));
  }

  /** Play or pause; while live, stand still at this moment. */
  play() {
    if (this.past.live) this.past.step(-STEP_S);
    else this.past.toggle();
  }

  /**
   * Go to the next event or bookmark, or the one before, and say what it is.
   * @param {1 | -1} direction
   */
  event(direction) {
    const { past } = this;
    const at_s = past.live ? past.to_s : past.at_s;
    const ahead = [...this.events, ...this.marks].filter((event) => event.at >= past.from_s && direction * (event.at - at_s) > SAME_S);
    if (!ahead.length) return;
    const found = ahead.reduce((one, other) => (direction * (other.at - one.at) < 0 ? other : one));
    past.look(found.at);
    setText(byId("time-spoken"), line(past, found));
  }

  /** @param {boolean} open */
  more(open) {
    byId("time-panel").hidden = !open;
    this.bar.dataset.more = open ? "open" : "";
    setFlag(byId("time-more"), "aria-expanded", open);
    if (!open) byId("time-more").focus({ preventScroll: true });
  }

  /** @param {EventTarget | null} target */
  #jump(target) {
    const at_s = target instanceof HTMLElement ? Number(target.dataset.at) : NaN;
    if (Number.isFinite(at_s)) this.past.look(at_s);
  }

  /** @param {boolean} live */
  #mode(live) {
    document.body.dataset.time = live ? "live" : this.past.recording ? "recording" : "past";
    this.commands.withheld = live ? "" : this.past.recording ? "this is a recording: there are no robots to command" : WITHHELD;
    for (const element of document.querySelectorAll("[data-commands]")) element.toggleAttribute("inert", !live);
    for (const name of ["stop", "estop"]) /** @type {HTMLButtonElement} */ (byId(name)).disabled = this.past.recording;
    byId("past-banner").hidden = live || this.past.recording;
    this.#show();
  }

  #later() {
    if (this.#due) return;
    this.#due = true;
    requestAnimationFrame(() => {
      this.#due = false;
      this.#show();
    });
  }

  #show() {
    const { past } = this;
    if (!past.span) return;
    this.bar.hidden = !past.span.offered;
    const length_s = Math.max(0.1, past.to_s - past.from_s);
    const at_s = past.live ? past.to_s : past.at_s;
    this.slider.max = length_s.toFixed(1);
    this.slider.value = (at_s - past.from_s).toFixed(1);
    const words = this.#words(at_s);
    setFlag(this.slider, "aria-valuetext", words);
    setText(byId("time-words"), this.#short(at_s));
    byId("time-words").title = words;
    setText(byId("past-words"), words);
    setText(byId("time-live"), past.live ? "LIVE" : "Go live");
    setFlag(byId("time-live"), "aria-pressed", past.live);
    byId("time-live").hidden = past.recording;
    setText(byId("time-play"), past.playing ? "❚❚" : past.live ? "❚❚" : "▶");
    setFlag(byId("time-play"), "aria-label", past.live ? "Stand still here" : past.playing ? "Pause" : "Play");
    this.#place(length_s);
  }

  /** @param {number} at_s */
  #short(at_s) {
    const { past } = this;
    return past.live || !past.recording ? past.clock(at_s) : `${length(at_s - past.from_s)} / ${length(past.to_s - past.from_s)}`;
  }

  /** @param {number} at_s */
  #words(at_s) {
    const { past } = this;
    if (past.live) return `live, ${past.clock(at_s)}`;
    const waiting = past.ready ? "" : " · loading";
    if (past.recording) {
      const read = past.span?.read ?? null;
      const reading = read === null ? "" : ` · reading the file: ${Math.floor(100 * read)} %`;
      return `${past.clock(at_s)}, ${length(at_s - past.from_s)} of ${length(past.to_s - past.from_s)}${reading}${waiting}`;
    }
    return `looking at ${past.clock(at_s)}, ${seconds(past.to_s - at_s)} ago${waiting}`;
  }

  // ------------------------------------------------------------------ events
  /** @param {TimeEvent[]} events */
  #all(events) {
    this.events = [...events];
    this.#drawTicks();
  }

  /** @param {TimeEvent} event */
  #add(event) {
    this.events.push(event);
    if (this.events.length > MOST_EVENTS) this.events.shift();
    this.#dirty = true;
  }

  /**
   * Show bookmarks on the bar, in place of those before.
   * @param {Bookmark[]} marks
   */
  mark(marks) {
    this.marks = marks.map(({ at, name }) => ({ at, kind: "bookmark", text: name }));
    this.#drawTicks();
  }

  #drawTicks() {
    this.#dirty = true;
    this.#show();
  }

  /**
   * Put the ticks where they belong; in a live session they move to the left as time passes.
   * @param {number} length_s
   */
  #place(length_s) {
    const width = this.#width;
    if (!width || (!this.#dirty && !this.past.live && !this.past.span?.recording)) return;
    this.#dirty = false;
    const events = [...this.events, ...this.marks].sort((one, other) => one.at - other.at);
    const groups = grouped(events, (event) => (width * (event.at - this.past.from_s)) / length_s);
    while (this.ticks.children.length > groups.length) this.ticks.lastElementChild?.remove();
    for (const [number, { px, events }] of groups.entries()) {
      const tick = /** @type {HTMLElement} */ (this.ticks.children[number] ?? this.ticks.appendChild(make("span", { class: "time-tick" })));
      const [heaviest] = [...events].sort((one, other) => WEIGHT.indexOf(other.kind) - WEIGHT.indexOf(one.kind));
      setFlag(tick, "data-kind", heaviest.kind);
      setFlag(tick, "data-at", String(heaviest.at));
      tick.style.transform = `translateX(${px.toFixed(1)}px)`;
      setFlag(tick, "title", events.slice(-8).map((event) => line(this.past, event)).join("\n"));
    }
  }
}

/**
 * Write an event as a line.
 * @param {import("./past.js").Past} past
 * @param {TimeEvent} event
 */
function line(past, { at, kind, text }) {
  return `${past.clock(at)} ${NAMES[kind] ?? kind}: ${text}`;
}

/**
 * Return events that are drawn as one tick, with its place.
 * @param {TimeEvent[]} events
 * @param {(event: TimeEvent) => number} place
 */
function grouped(events, place) {
  const groups = /** @type {{px: number, events: TimeEvent[]}[]} */ ([]);
  for (const event of events) {
    const px = place(event);
    if (!(px >= 0)) continue;
    const last = groups.at(-1);
    if (last && px - last.px < APART_PX) last.events.push(event);
    else groups.push({ px, events: [event] });
  }
  return groups;
}

/**
 * Write a length of time: 0:07, 12:30, 1:02:03.
 * @param {number} time_s
 */
export function length(time_s) {
  const whole = Math.max(0, Math.floor(time_s));
  const parts = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60];
  const shown = parts[0] ? parts : parts.slice(1);
  return shown.map((each, number) => (number ? String(each).padStart(2, "0") : String(each))).join(":");
}
