/** Plays the past into the store that is shown: segments of the console's history, at a speed, forwards. */

import { Emitter } from "./dom.js";
import { Track } from "./tracks.js";

/** @import { Entry, History, Message, TimelineFrame } from "./types.d.ts" */

const AHEAD_S = 0.25; // states this far ahead are known, so that a robot moves between two of them
const LIVE_S = 0.4; // so near to the present it is the present
const AGAIN_MS = 3000; // a segment that does not come is asked for again
const REFRESH_MS = 1000; // how often the newest, growing segment is asked for
const LOG_SHOWN = 200;

/** The clock of the map while the past is shown: the moment that is looked at. */
class StillClock {
  constructor() {
    this.at_s = 0;
  }

  /** The past has its own time: live states do not move it. */
  update() {}

  drawn() {
    return this.at_s;
  }
}

/**
 * Emits "change" when the moment or what plays has changed, and "mode" when it goes to the past or to live.
 * @extends {Emitter<{change: undefined, mode: boolean}>}
 */
export class Past extends Emitter {
  /** @param {{store: import("./store.js").Store, present: import("./store.js").Store, link: import("./link.js").Link}} parts */
  constructor({ store, present, link }) {
    super();
    this.store = store;
    this.present = present;
    this.link = link;
    this.live = true;
    this.playing = false;
    this.speed = 1;
    this.at_s = 0;
    this.span = /** @type {TimelineFrame | null} */ (null);
    link.on("closed", () => (this.#asked_ms = 0));
    requestAnimationFrame((now_ms) => this.#frame(now_ms));
  }

  #clock = new StillClock();
  #segment = /** @type {Segment | null} */ (null);
  #next = /** @type {Segment | null} */ (null);
  #state = 0; // how many of the segment's states and of its other frames are shown
  #other = 0;
  #last_ms = 0;
  #heard_ms = 0; // when the span was received
  #asked_ms = 0; // since when a segment is waited for; 0: none is
  #refreshed_ms = 0;
  #due = true; // what is shown is not yet that of `at_s`

  /** Whether this is a recording: there is no live then. */
  get recording() {
    return Boolean(this.span?.recording);
  }

  get from_s() {
    return this.span?.from ?? 0;
  }

  /** The end of what can be looked at: in a live session the present. */
  get to_s() {
    if (!this.span) return 0;
    return this.recording ? this.span.to : this.span.at + (performance.now() - this.#heard_ms) / 1000;
  }

  /** Whether the moment that is wanted is shown. */
  get ready() {
    return this.live || !this.#due;
  }

  /**
   * Return a moment as the time of day at the console, like 12:03:14.
   * @param {number} at_s
   */
  clock(at_s) {
    if (!this.span) return "";
    const day_s = (((this.span.clock_s + at_s - this.span.at) % 86400) + 86400) % 86400;
    return [day_s / 3600, (day_s / 60) % 60, day_s % 60].map((each) => String(Math.floor(each)).padStart(2, "0")).join(":");
  }

  /**
   * Note what there is to see; a recording is looked at from its beginning.
   * @param {TimelineFrame} span
   */
  update(span) {
    const first = !this.span;
    this.span = span;
    this.#heard_ms = performance.now();
    if (first && span.recording) this.look(span.from);
    this.emit("change");
  }

  /**
   * Show a moment; the present is live.
   * @param {number} at_s
   */
  look(at_s) {
    if (!this.span?.offered) return;
    if (!this.recording && at_s >= this.to_s - LIVE_S) return void this.toLive();
    this.at_s = Math.min(this.to_s, Math.max(this.from_s, at_s));
    this.#due = true;
    if (this.live) {
      this.live = false;
      [this.store.clock, this.store.still] = [this.#clock, true];
      this.emit("mode", false);
    }
    this.#show();
    this.emit("change");
  }

  /** Show what is now, and what comes. */
  toLive() {
    this.playing = false;
    if (this.live || this.recording) return this.emit("change");
    this.live = true;
    this.#segment = this.#next = null;
    this.store.still = false;
    this.store.adopt(this.present);
    this.emit("mode", true);
    return this.emit("change");
  }

  toggle() {
    if (this.live && !this.playing) return; // live plays anyway
    this.playing = !this.playing;
    if (this.playing && this.recording && this.at_s >= this.to_s - LIVE_S) this.look(this.from_s);
    this.emit("change");
  }

  /**
   * Go forth or back and stand there.
   * @param {number} step_s
   */
  step(step_s) {
    this.playing = false;
    this.look((this.live ? this.to_s : this.at_s) + step_s);
  }

  /**
   * Take in a segment that was asked for.
   * @param {History} history
   */
  receive(history) {
    this.#asked_ms = 0;
    if (this.live) return;
    const segment = new Segment(history);
    if (this.#segment?.from === segment.from && !this.#due) this.#segment = segment; // the same, longer now
    else if (segment.holds(this.at_s) || this.#due) [this.#segment, this.#next, this.#due] = [segment, null, true];
    else if (this.#segment && segment.from >= this.#segment.to - 0.001) this.#next = segment;
    this.#show();
  }

  /** Bring the store to `at_s`, or ask for the segment that has it. */
  #show() {
    this.#clock.at_s = this.at_s;
    const segment = this.#segment;
    if (!segment || (!segment.holds(this.at_s) && !segment.edge(this.at_s, this.from_s, this.to_s))) return this.#ask(this.at_s);
    if (this.#due) this.#rebuild(segment);
    else this.#advance(segment);
    return undefined;
  }

  /** @param {number} at_s */
  #ask(at_s) {
    const now_ms = performance.now();
    if (this.#asked_ms && now_ms - this.#asked_ms < AGAIN_MS) return;
    if (this.link.post({ t: "look", at: at_s }) !== null) this.#asked_ms = now_ms;
  }

  /** @param {Segment} segment */
  #rebuild(segment) {
    const tracks = /** @type {Map<string, Track>} */ (new Map());
    for (const [id, points] of Object.entries(segment.trails)) {
      const track = new Track();
      track.trail = points.map((point) => [...point]);
      tracks.set(id, track);
    }
    this.#state = push(tracks, segment, 0, this.at_s + AHEAD_S);
    this.#other = segment.others.findIndex(([at_s]) => at_s > this.at_s);
    if (this.#other < 0) this.#other = segment.others.length;
    const newest = /** @type {Map<string, Message>} */ (new Map());
    const log = [...segment.log];
    for (const [, message] of segment.others.slice(0, this.#other)) {
      if (message.t === "log") log.push(message.entry);
      else newest.set(message.t, message);
    }
    this.store.rewind({ tracks, log: log.slice(-LOG_SHOWN), at_s: this.at_s });
    for (const message of newest.values()) this.store.apply(message);
    this.#due = false;
    this.emit("change");
  }

  /** @param {Segment} segment */
  #advance(segment) {
    this.#state = push(this.store.tracks, segment, this.#state, this.at_s + AHEAD_S);
    this.store.at_s = this.at_s;
    while (this.#other < segment.others.length && segment.others[this.#other][0] <= this.at_s) {
      this.store.apply(segment.others[this.#other][1]);
      this.#other += 1;
    }
    this.store.emit("states", null);
  }

  /** @param {number} now_ms */
  #frame(now_ms) {
    const passed_s = Math.min(0.5, (now_ms - this.#last_ms) / 1000);
    this.#last_ms = now_ms;
    if (!this.live) this.#play(this.playing ? passed_s * this.speed : 0);
    requestAnimationFrame((next_ms) => this.#frame(next_ms));
  }

  /** @param {number} passed_s */
  #play(passed_s) {
    const segment = this.#segment;
    if (this.#due || !segment) return void this.#ask(this.at_s);
    if (!passed_s) return;
    if (!this.recording && this.at_s + passed_s >= this.to_s - LIVE_S) return this.toLive();
    this.#prefetch(segment);
    const until_s = this.at_s + passed_s;
    if (until_s <= segment.to) this.at_s = until_s;
    else if (this.#next && until_s <= this.#next.to) this.#turn(until_s);
    else this.at_s = Math.max(this.at_s, segment.to); // wait for the next segment
    if (this.recording && this.at_s >= this.to_s && this.span?.read === null) this.playing = false;
    this.#show();
    this.emit("change");
  }

  /**
   * Ask for what follows in time.
   * @param {Segment} segment
   */
  #prefetch(segment) {
    const left_s = segment.to - this.at_s;
    if (left_s > Math.max(2, 2 * this.speed) || this.#next) return;
    if (!segment.open) return this.#ask(segment.to + 0.01);
    const now_ms = performance.now();
    if (now_ms - this.#refreshed_ms < REFRESH_MS) return;
    this.#refreshed_ms = now_ms;
    this.#ask(this.at_s);
  }

  /**
   * Go on in the next segment: what this one still holds is applied first.
   * @param {number} until_s
   */
  #turn(until_s) {
    if (this.#segment) {
      this.at_s = this.#segment.to;
      this.#advance(this.#segment);
    }
    [this.#segment, this.#next, this.#state, this.#other] = [this.#next, null, 0, 0];
    this.at_s = until_s;
  }
}

/** One segment, its frames by kind in the order of time. */
class Segment {
  /** @param {History} history */
  constructor({ from, to, open, log, frames }) {
    this.from = from;
    this.to = to;
    this.open = open;
    this.trails = /** @type {Record<string, number[][]>} */ ({});
    this.states = /** @type {Extract<Message, {t: "state"}>[]} */ ([]);
    this.others = /** @type {[number, Message][]} */ ([]);
    this.log = /** @type {Entry[]} */ (log.filter(({ at }) => at <= from));
    for (const [at_s, message] of frames) {
      if (message.t === "trails") this.trails = message.robots;
      else if (message.t === "state") this.states.push(message);
      else this.others.push([at_s, message]);
    }
    for (const entry of log) if (entry.at > from) this.others.push([entry.at, { t: "log", entry }]);
    this.others.sort((one, other) => one[0] - other[0]);
  }

  /** @param {number} at_s */
  holds(at_s) {
    return at_s >= this.from && at_s <= this.to;
  }

  /**
   * Whether a moment beside this segment has no other one: before the first, or after the newest one so far.
   * @param {number} at_s
   * @param {number} from_s
   * @param {number} to_s
   */
  edge(at_s, from_s, to_s) {
    return (at_s < this.from && this.from <= from_s + 0.01) || (at_s > this.to && (this.open ? at_s < this.to + 2 : this.to >= to_s - 0.01));
  }
}

/**
 * Give tracks the states of a segment, from number `first` up to a time; return how many that makes.
 * @param {Map<string, Track>} tracks
 * @param {Segment} segment
 * @param {number} first
 * @param {number} until_s
 */
function push(tracks, segment, first, until_s) {
  let number = first;
  while (number < segment.states.length && segment.states[number].at <= until_s) {
    const { at, robots } = segment.states[number];
    for (const [id, x, y, heading, speed] of robots) {
      if (x === null || y === null) continue;
      let track = tracks.get(id);
      if (!track) tracks.set(id, (track = new Track()));
      track.push(at, x, y, heading ?? 0, speed ?? 0);
    }
    number += 1;
  }
  return number;
}
