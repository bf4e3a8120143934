/** What is known of the swarm, kept up to date from the messages. Everything that is shown is read from here. */

import { Emitter } from "./dom.js";
import { OLD_S } from "./link.js";
import { Looks } from "./palette.js";
import { ServerClock, Track } from "./tracks.js";

/** @import { HandOverFrame, OffersFrame, PresenceFrame } from "./types.d.ts" */
/** @import { Behaviour, Bookmark, Box, Camera, Catalogue, ClipFrame, Coverage, Detail, Dock, Entry, Estop, ExperimentList, ExperimentsFrame, Fleet, Goal, Hello, History, Lease, Lost, Message, Mission, MissionReply, NodeState, Picture, Place, Point, RequestStatus, Robot, Rows, SavedRequest, Scan, Series, States, Stop, Study, TimeEvent, TimelineFrame, UnderlayFrame, UndoFrame, World } from "./types.d.ts" */

const COUNTED = new Intl.Collator("en", { numeric: true }); // ten times as fast as localeCompare
const LOG_KEPT = 500;

/**
 * Emits the name of what changed: world, robots (a new one), states, fleet, filter, goals, coverage,
 * obstacles, log, request, estop, stop, leases, missions, mission (an answer), lost, study,
 * underlay, cameras, picture, scans, undo, detail, presence, offers, handover, catalogue, series, rows, experiments,
 * experiment_list; timeline, history,
 * events (all), event, bookmarks, clip.
 * @extends {Emitter<{hello: Hello, world: World, robots: null, states: null, fleet: Fleet, filter: Store["filter"],
 *   goals: Store["goals"], docks: Dock[], coverage: Coverage | null, obstacles: number[][], log: Entry | null,
 *   request: RequestStatus, estop: Estop, stop: Stop, leases: Store["leases"],
 *   missions: Mission[], mission: MissionReply, lost: Lost, study: Study,
 *   underlay: UnderlayFrame, cameras: Camera[], picture: Picture,
 *   scans: {t: "scans", robot: string, scans: Scan[]},
 *   undo: UndoFrame, detail: Detail, timeline: TimelineFrame, history: History, events: TimeEvent[], event: TimeEvent,
 *   bookmarks: {bookmarks: Bookmark[], clips: string}, clip: ClipFrame,
 *   experiments: ExperimentsFrame, experiment_list: ExperimentList, catalogue: Catalogue, series: Series, rows: Rows, presence: PresenceFrame, offers: OffersFrame, handover: HandOverFrame}>}
 */
export class Store extends Emitter {
  constructor() {
    super();
    this.hello = /** @type {Hello | null} */ (null);
    this.icons = /** @type {Record<string, [string, string]>} */ ({});
    this.arena = /** @type {Box | null} */ (null);
    this.boxes = /** @type {number[][]} */ ([]);
    this.origin = /** @type {[number, number] | null} */ (null); // on earth: latitude, longitude, degrees
    this.sensing_radius_m = /** @type {number | null} */ (null);
    this.behaviours = /** @type {Record<string, Behaviour>} */ ({});
    this.groups = /** @type {Record<string, string[]>} */ ({});
    this.own_groups = /** @type {string[]} */ ([]); // those that consoles have made
    this.places = /** @type {Record<string, Place>} */ ({});
    this.saved = /** @type {Record<string, SavedRequest>} */ ({});
    this.looks = new Looks();
    this.tracks = /** @type {Map<string, Track>} */ (new Map());
    this.clock = /** @type {{update: (at_s: number, now_s: number) => void, drawn: (now_s: number) => number}} */ (new ServerClock());
    this.at_s = 0;
    this.still = false; // it holds a moment of the past
    this.fleet = /** @type {Map<string, Robot>} */ (new Map());
    this.hub = true;
    this.core_age_s = /** @type {number | null} */ (null);
    this.nodes = /** @type {NodeState[]} */ ([]);
    this.missing = /** @type {string[]} */ ([]);
    this.docks = /** @type {Dock[]} */ ([]);
    this.filter = /** @type {Map<string, [number, number, string]>} */ (new Map());
    this.goals = /** @type {Map<string, Goal>} */ (new Map());
    this.coverage = /** @type {Coverage | null} */ (null);
    this.obstacles = /** @type {number[][]} */ ([]);
    this.log = /** @type {Entry[]} */ ([]);
    this.leases = /** @type {Map<string, Lease>} */ (new Map());
    this.missions = /** @type {Mission[]} */ ([]);
    this.estop = /** @type {Estop | null} */ (null);
    this.stop = /** @type {Stop | null} */ (null);
    this.pending = /** @type {Map<string, Point[]> | null} */ (null); // trails, until the first states give the time
  }

  /**
   * Take in one message; what this page does not know is left alone.
   * @param {Message} message
   */
  apply(message) {
    const handler = /** @type {((message: Message) => void) | undefined} */ (this.#handlers[message.t]);
    handler?.(message);
  }

  /** Return all robots known, by id as people count: r2 before r10. */
  ids() {
    return [...new Set([...this.tracks.keys(), ...this.fleet.keys()])].sort(byNumber);
  }

  /**
   * Return what the table knows of a robot; an empty record if nothing.
   * @param {string} id
   * @returns {Partial<Robot>}
   */
  info(id) {
    return this.fleet.get(id) ?? {};
  }

  /**
   * Return a robot's radius in metres.
   * @param {string} id
   */
  radius(id) {
    return this.info(id).radius_m ?? 0.17;
  }

  /**
   * Return robot → operator for those of `ids` that another operator holds.
   * @param {string[]} ids
   */
  heldByOthers(ids) {
    const held = /** @type {Map<string, string>} */ (new Map());
    for (const id of ids) {
      const lease = this.leases.get(id);
      if (lease && !lease.mine) held.set(id, lease.operator);
    }
    return held;
  }

  /**
   * Return what may keep robots (none: all of them) from obeying now, as text that can be compared.
   * @param {string[]} ids
   */
  hindrances(ids) {
    const found = /** @type {Set<string>} */ (new Set());
    if (!this.hub) found.add("hub");
    if (this.core_age_s === null || this.core_age_s > OLD_S) found.add("core");
    for (const id of ids.length ? ids : this.ids()) {
      const { estop, silent, fault, stop_reason: stopped, lifecycle, ended, attention } = this.info(id);
      const lease = this.leases.get(id);
      if (estop) found.add(`${id} e-stop`);
      if (silent) found.add(`${id} silent`);
      if (fault || lifecycle === "FAULT") found.add(`${id} fault`);
      if (stopped && attention && !ended) found.add(`${id} ${stopped}`);
      if (lease && !lease.mine) found.add(`${id} held`);
    }
    return found;
  }

  #handlers = /** @type {{[T in Message["t"]]: (message: Extract<Message, {t: T}>) => void}} */ ({
    hello: (message) => this.#hello(message),
    world: (message) => this.#world(message),
    state: (message) => this.#states(message),
    fleet: (message) => this.#fleet(message),
    filter: ({ robots }) => this.#set("filter", new Map(robots.map(([id, dx, dy, why]) => [id, [dx, dy, why]]))),
    goals: ({ robots }) => this.#set("goals", new Map(Object.entries(robots))),
    coverage: (message) => this.#set("coverage", message),
    obstacles: ({ rows }) => this.#set("obstacles", rows),
    log: ({ entry }) => this.#log(entry),
    request: (message) => this.emit("request", message),
    estop: (message) => this.#set("estop", message),
    stop: (message) => this.#set("stop", message),
    leases: ({ leases }) => this.#set("leases", new Map(leases.map((lease) => [lease.robot, lease]))),
    missions: ({ missions }) => this.#set("missions", missions),
    mission: (message) => this.emit("mission", message),
    lost: (message) => this.emit("lost", message),
    study: (message) => this.emit("study", message),
    underlay: (message) => this.emit("underlay", message),
    cameras: ({ cameras }) => this.emit("cameras", cameras),
    picture: (message) => this.emit("picture", message),
    scans: (message) => this.emit("scans", message),
    timeline: (message) => this.emit("timeline", message),
    history: (message) => this.emit("history", message),
    events: ({ events }) => this.emit("events", events),
    event: ({ event }) => this.emit("event", event),
    bookmarks: (message) => this.emit("bookmarks", message),
    clip: (message) => this.emit("clip", message),
    undo: (message) => this.emit("undo", message),
    detail: (message) => this.emit("detail", message),
    presence: (message) => this.emit("presence", message),
    offers: (message) => this.emit("offers", message),
    handover: (message) => this.emit("handover", message),
    catalogue: (message) => this.emit("catalogue", message),
    series: (message) => this.emit("series", message),
    rows: (message) => this.emit("rows", message),
    experiments: (message) => this.emit("experiments", message),
    experiment_list: (message) => this.emit("experiment_list", message),
  });

  /**
   * Go to another time: robots and log are those of then. What else there was follows as messages.
   * @param {{tracks: Map<string, Track>, log: Entry[], at_s: number}} then
   */
  rewind({ tracks, log: lines, at_s }) {
    const log = newestOfEach(lines);
    Object.assign(this, { tracks, log, at_s, pending: null, filter: new Map(), goals: new Map(), coverage: null, obstacles: [] });
    this.#emitAll();
  }

  /**
   * Show what another store holds, from now on by itself.
   * @param {Store} other
   */
  adopt(other) {
    const tracks = new Map([...other.tracks].map(([id, track]) => [id, track.copy()]));
    const { arena, boxes, behaviours, groups, own_groups, places, saved, sensing_radius_m, icons, looks, at_s, filter, goals, coverage, obstacles } = other;
    const { hub, core_age_s, nodes, missing, docks, leases, missions, clock } = other;
    Object.assign(this, {
      arena, boxes, behaviours, groups, own_groups, places, saved, sensing_radius_m, icons, looks, at_s, filter, goals, coverage, obstacles, hub,
      core_age_s, nodes, missing, docks, leases, missions, clock, tracks, fleet: new Map(other.fleet),
      log: [...other.log], pending: null,
    });
    this.#emitAll();
    this.emit("docks", this.docks);
    this.emit("leases", this.leases);
    this.emit("missions", this.missions);
  }

  #emitAll() {
    this.emit("world", { t: "world" });
    this.emit("robots", null);
    this.emit("states", null);
    this.emit("coverage", this.coverage);
    this.emit("obstacles", this.obstacles);
    this.emit("goals", this.goals);
    this.emit("filter", this.filter);
    this.emit("log", null);
  }

  /**
   * @template {"filter" | "goals" | "coverage" | "obstacles" | "estop" | "stop" | "leases" | "missions" | "docks"} T
   * @param {T} name
   * @param {Store[T]} value
   */
  #set(name, value) {
    Object.assign(this, { [name]: value });
    this.emit(name, /** @type {never} */ (value));
  }

  /** @param {Hello} message */
  #hello(message) {
    this.hello = message;
    this.icons = message.icons ?? {};
    this.clock = new ServerClock();
    const history = message.history ?? {};
    this.log = [...(history.log ?? [])];
    this.#world(message);
    const recalled = Object.entries(history.trails ?? {});
    for (const [id] of recalled) this.#track(id).trail = [];
    this.pending = recalled.length ? new Map(recalled) : null;
    this.emit("hello", message);
    this.emit("log", null);
  }

  /** @param {World} message */
  #world(message) {
    this.arena = message.arena ?? this.arena;
    this.boxes = message.boxes ?? this.boxes;
    this.origin = message.origin ?? this.origin;
    this.sensing_radius_m = message.sensing_radius_m ?? this.sensing_radius_m;
    this.behaviours = message.behaviours ?? this.behaviours;
    this.groups = message.groups ?? this.groups;
    this.own_groups = message.own_groups ?? this.own_groups;
    this.places = message.places ?? this.places;
    this.saved = message.saved ?? this.saved;
    this.looks = new Looks(Object.keys(this.behaviours));
    this.emit("world", message);
  }

  /** @param {string} id */
  #track(id) {
    let track = this.tracks.get(id);
    if (!track) this.tracks.set(id, (track = new Track()));
    return track;
  }

  /** @param {States} states */
  #states({ at, robots }) {
    this.at_s = at;
    this.clock.update(at, performance.now() / 1000);
    if (this.pending) {
      for (const [id, points] of this.pending) this.#track(id).recall(points, at);
      this.pending = null;
    }
    const known = this.tracks.size;
    for (const [id, x, y, heading, speed] of robots) {
      if (x !== null && y !== null) this.#track(id).push(at, x, y, heading ?? 0, speed ?? 0);
    }
    if (this.tracks.size !== known) this.emit("robots", null);
    this.emit("states", null);
  }

  /** @param {Fleet} message */
  #fleet(message) {
    const known = this.fleet.size;
    this.fleet = new Map(message.robots.map((robot) => [robot.robot, robot]));
    this.hub = message.hub;
    this.core_age_s = message.core_age_s;
    this.nodes = message.nodes ?? [];
    this.missing = message.missing ?? [];
    const docks = message.docks ?? [];
    if (JSON.stringify(docks) !== JSON.stringify(this.docks)) this.#set("docks", docks);
    if (this.fleet.size !== known) this.emit("robots", null);
    this.emit("fleet", message);
  }

  /** @param {Entry} entry */
  #log(entry) {
    if ((entry.count ?? 1) > 1) this.log = this.log.filter(({ number }) => number !== entry.number);
    this.log.push(entry);
    if (this.log.length > LOG_KEPT) this.log.shift();
    this.emit("log", entry);
  }
}

/**
 * Leave out the lines that a later one with the same number repeats, with a count.
 * @param {Entry[]} log
 */
export function newestOfEach(log) {
  const last = new Map(log.map((entry, k) => [entry.number ?? -k - 1, k]));
  return log.filter((entry, k) => last.get(entry.number ?? -k - 1) === k);
}

/**
 * Order ids as people count.
 * @param {string} a
 * @param {string} b
 */
export function byNumber(a, b) {
  return COUNTED.compare(a, b);
}
