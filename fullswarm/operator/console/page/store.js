/** What is known of the swarm, kept up to date from the messages. Everything that is shown is read from here. */

import { Emitter } from "./emitter.js";
import { OLD_S } from "./linkstate.js";
import { Looks } from "./palette.js";
import { ServerClock, Track } from "./tracks.js";

const LOG_KEPT = 500;
const CHART_KEPT = 1200;

/**
 * Emits the name of what changed: world, robots (somebody new), states, fleet, filter, goals, charts, coverage,
 * obstacles, log, request, estop, stop, leases, lost.
 */
export class Store extends Emitter {
  constructor() {
    super();
    this.hello = /** @type {any} */ (null);
    this.icons = /** @type {Record<string, [string, string]>} */ ({});
    this.arena = /** @type {[number, number, number, number] | null} */ (null);
    this.boxes = /** @type {number[][]} */ ([]);
    this.sensing_radius_m = /** @type {number | null} */ (null);
    this.behaviours = /** @type {Record<string, any>} */ ({});
    this.groups = /** @type {Record<string, string[]>} */ ({});
    this.looks = new Looks();
    this.tracks = /** @type {Map<string, Track>} */ (new Map());
    this.clock = new ServerClock();
    this.at_s = 0;
    this.fleet = /** @type {Map<string, any>} */ (new Map());
    this.hub = true;
    this.core_age_s = /** @type {number | null} */ (null);
    this.nodes = [];
    this.missing = /** @type {string[]} */ ([]);
    this.filter = /** @type {Map<string, [number, number, string]>} */ (new Map());
    this.goals = /** @type {Map<string, any>} */ (new Map());
    this.charts = /** @type {number[][]} */ ([]);
    this.coverage = /** @type {any} */ (null);
    this.obstacles = /** @type {number[][]} */ ([]);
    this.log = /** @type {any[]} */ ([]);
    this.leases = /** @type {Map<string, any>} */ (new Map());
    this.estop = /** @type {any} */ (null);
    this.stop = /** @type {any} */ (null);
  }

  /** Take in one message; what this page does not know is left alone. */
  apply(message) {
    this.#handlers[message.t]?.(message);
  }

  /** Return all robots known, by id as people count: r2 before r10. */
  ids() {
    return [...new Set([...this.tracks.keys(), ...this.fleet.keys()])].sort(byNumber);
  }

  /** Return what the table knows of a robot; an empty record if nothing. */
  info(id) {
    return this.fleet.get(id) ?? {};
  }

  /** Return a robot's radius in metres. */
  radius(id) {
    return this.info(id).radius_m ?? 0.17;
  }

  /** Return robot → operator for those of `ids` that somebody else holds. */
  heldByOthers(ids) {
    const held = ids.map((id) => this.leases.get(id)).filter((lease) => lease && !lease.mine);
    return new Map(held.map((lease) => [lease.robot, lease.operator]));
  }

  /** Return what may keep robots (none: all of them) from obeying now, as words that can be compared. */
  hindrances(ids) {
    const found = new Set();
    if (!this.hub) found.add("hub");
    if (this.core_age_s === null || this.core_age_s > OLD_S) found.add("core");
    for (const id of ids.length ? ids : this.ids()) {
      const { estop, silent, fault, stop_reason: stopped, lifecycle } = this.info(id);
      const lease = this.leases.get(id);
      if (estop) found.add(`${id} e-stop`);
      if (silent) found.add(`${id} silent`);
      if (fault || lifecycle === "FAULT") found.add(`${id} fault`);
      if (stopped) found.add(`${id} ${stopped}`);
      if (lease && !lease.mine) found.add(`${id} held`);
    }
    return found;
  }

  #handlers = {
    hello: (message) => this.#hello(message),
    world: (message) => this.#world(message),
    state: (message) => this.#states(message),
    fleet: (message) => this.#fleet(message),
    filter: ({ robots }) => this.#set("filter", new Map(robots.map(([id, dx, dy, why]) => [id, [dx, dy, why]]))),
    goals: ({ robots }) => this.#set("goals", new Map(Object.entries(robots))),
    chart: ({ row }) => this.#chart(row),
    coverage: (message) => this.#set("coverage", message),
    obstacles: ({ rows }) => this.#set("obstacles", rows),
    log: ({ entry }) => this.#log(entry),
    request: (message) => this.emit("request", message),
    estop: (message) => this.#set("estop", message),
    stop: (message) => this.#set("stop", message),
    leases: ({ leases }) => this.#set("leases", new Map(leases.map((lease) => [lease.robot, lease]))),
    lost: (message) => this.emit("lost", message),
  };

  #set(name, value) {
    this[name] = value;
    this.emit(name, value);
  }

  #hello(message) {
    this.hello = message;
    this.icons = message.icons ?? {};
    this.clock = new ServerClock();
    const history = message.history ?? {};
    this.charts = [...(history.charts ?? [])];
    this.log = [...(history.log ?? [])];
    this.#world(message);
    const recalled = Object.entries(history.trails ?? {});
    for (const [id, points] of recalled) this.#track(id).trail = [];
    this.pending = recalled.length ? new Map(recalled) : null;
    this.emit("hello", message);
    this.emit("charts", null);
    this.emit("log", null);
  }

  #world(message) {
    for (const name of ["arena", "boxes", "sensing_radius_m", "behaviours", "groups"]) {
      if (message[name] !== undefined && message[name] !== null) this[name] = message[name];
    }
    this.looks = new Looks(Object.keys(this.behaviours));
    this.emit("world", message);
  }

  #track(id) {
    let track = this.tracks.get(id);
    if (!track) this.tracks.set(id, (track = new Track()));
    return track;
  }

  #states({ at, robots }) {
    this.at_s = at;
    this.clock.heard(at, performance.now() / 1000);
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

  #fleet(message) {
    const known = this.fleet.size;
    this.fleet = new Map(message.robots.map((robot) => [robot.robot, robot]));
    this.hub = message.hub;
    this.core_age_s = message.core_age_s;
    this.nodes = message.nodes ?? [];
    this.missing = message.missing ?? [];
    if (this.fleet.size !== known) this.emit("robots", null);
    this.emit("fleet", message);
  }

  #chart(row) {
    this.charts.push(row);
    if (this.charts.length > CHART_KEPT) this.charts.shift();
    this.emit("charts", row);
  }

  #log(entry) {
    this.log.push(entry);
    if (this.log.length > LOG_KEPT) this.log.shift();
    this.emit("log", entry);
  }
}

/** Order ids as people count. */
export function byNumber(a, b) {
  return a.localeCompare(b, "en", { numeric: true });
}
