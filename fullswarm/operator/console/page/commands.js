/** The page's commands and their answers: requests and refusals, leases, stops. */

import { Emitter } from "./dom.js";
import { assign, closestPair, goalRadius } from "./geometry.js";
import { titleOf } from "./words.js";

/** @import { Answer } from "./link.js" */
/** @import { Mission, MissionReply, Point, RequestStatus, Terms } from "./types.d.ts" */

/**
 * @typedef {{behaviour: string, reason?: string, robots?: string[], code?: string}} Refused
 * @typedef {{holders: Map<string, string>, take: () => void}} Question
 * @typedef {{what: string, lost?: Answer["lost"], reason?: string}} Unsent
 */

/**
 * Emits "refused" (robots: those it concerns, none: all or none of them), "requested", "question", and "unsent": a stop that
 * the console has not confirmed, and why (see Answer).
 * @extends {Emitter<{refused: Refused, requested: {behaviour: string, robots: string[]}, question: Question,
 *   unsent: Unsent}>}
 */
export class Commands extends Emitter {
  /**
   * @param {import("./link.js").Link} link
   * @param {import("./store.js").Store} store
   */
  constructor(link, store) {
    super();
    this.link = link;
    this.store = store;
    this.goalBehaviour = "move_to_goal_bc";
    this.withheld = ""; // why nothing but stops is sent now; empty: all is
    store.on("request", (status) => this.#onStatus(status));
    store.on("mission", (reply) => this.#onReply(reply));
  }

  /**
   * People read titles, not keys: those of behaviours come from their records.
   * @template {"refused" | "requested" | "question" | "unsent"} T
   * @param {T} topic
   * @param {{refused: Refused, requested: {behaviour: string, robots: string[]}, question: Question, unsent: Unsent}[T]} value
   */
  emit(topic, value) {
    if (topic !== "refused") return super.emit(topic, value);
    const refused = /** @type {Refused} */ (value);
    return super.emit("refused", { ...refused, behaviour: titleOf(this.store.behaviours, refused.behaviour) });
  }

  // Request id → how to repeat it, and the robots of a mission to start, which is in no list yet.
  #mine = /** @type {Map<string, {again: () => void, robots: string[]}>} */ (new Map());

  /**
   * Request a behaviour; no robots: the whole swarm.
   * @param {string} behaviour
   * @param {string[]} robots
   * @param {Record<string, unknown>} [parameters]
   * @param {Terms} [terms]
   * @param {boolean} [take]
   * @returns {Promise<Answer | void>}
   */
  async request(behaviour, robots, parameters = {}, terms = {}, take = false) {
    if (this.withheld) return this.emit("refused", { behaviour, reason: this.withheld, robots });
    const addressed = robots.length ? robots : this.store.ids();
    const holders = this.store.heldByOthers(addressed);
    const again = () => this.request(behaviour, robots, parameters, terms, true);
    if (holders.size && !take) return this.emit("question", { holders, take: again });
    this.emit("requested", { behaviour, robots });
    const answer = await this.link.ask({ t: "request", behaviour, robots, parameters, ...terms, take });
    if (answer.request_id) this.#remember(answer.request_id, again);
    if (!answer.ok) this.#refuse(behaviour, answer, again, robots);
    return answer;
  }

  /**
   * Send robots to a point; several get room around it.
   * @param {string[]} robots
   * @param {Point} point
   */
  goal(robots, point) {
    return this.request(this.goalBehaviour, robots, this.#toPoint(this.goalBehaviour, robots, point));
  }

  /**
   * Return the parameters that send robots to a point.
   * @param {string} behaviour
   * @param {string[]} robots
   * @param {Point} point
   */
  #toPoint(behaviour, robots, point) {
    const parameters = /** @type {Record<string, unknown>} */ ({ goal: point.map(round) });
    const record = this.store.behaviours[behaviour];
    if (robots.length > 1 && record?.parameters?.arrive_radius_m) {
      const widest = Math.max(...robots.map((id) => this.store.radius(id)));
      parameters.arrive_radius_m = goalRadius(robots.length, widest);
    }
    return parameters;
  }

  /**
   * Send each robot to a place, by the assignment with the shortest ways; refused here if the places are too close.
   * @param {string[]} robots
   * @param {Point[]} places
   */
  formation(robots, places) {
    const least = 2 * Math.max(...robots.map((id) => this.store.radius(id)));
    if (closestPair(places) < least) {
      const reason = `places ${closestPair(places).toFixed(2)} m apart are too close: drag further out`;
      return this.emit("refused", { behaviour: "formation_bc", reason });
    }
    const from = robots.map((id) => this.#place(id));
    const targets = assign(from, places).map((place) => place.map(round));
    return this.request("formation_bc", robots, { targets });
  }

  /**
   * @param {string} id
   * @returns {Point} where a robot was last
   */
  #place(id) {
    const state = this.store.tracks.get(id)?.states.at(-1);
    return state ? [state[1], state[2]] : [0, 0];
  }

  /** Stop all robots at once. */
  stop() {
    this.#urgent({ t: "stop", robots: [] });
  }

  /**
   * Engage the latched e-stop for all robots at once.
   * @param {string} reason
   */
  estop(reason) {
    this.#urgent({ t: "estop", robots: [], reason });
  }

  /**
   * Clear the e-stop; called after a deliberate act only.
   * @param {string[]} [robots]
   */
  async clear(robots = []) {
    const answer = await this.link.ask({ t: "clear", robots });
    if (!answer.ok) this.emit("refused", { behaviour: "clear the e-stop", reason: answer.reason });
    return answer;
  }

  /**
   * Hold or release robots.
   * @param {string[]} robots
   * @param {boolean} hold
   * @param {boolean} [take]
   */
  async lease(robots, hold, take = false) {
    if (this.withheld && hold) return this.emit("refused", { behaviour: "lease", reason: this.withheld });
    const answer = await this.link.ask({ t: "lease", robots, hold, take });
    if (!answer.ok) this.emit("refused", { behaviour: "lease", reason: answer.reason });
    return answer;
  }

  /**
   * Control a mission.
   * @param {Mission} mission
   * @param {"pause" | "resume" | "abort" | "confirm"} op
   * @param {{track?: string, step?: string, take?: boolean}} [more]
   */
  async mission(mission, op, more = {}) {
    if (this.withheld) return this.emit("refused", { behaviour: `${op} of ${mission.name}`, reason: this.withheld });
    const answer = await this.link.ask({ t: "mission", op, mission: mission.mission, ...more });
    const again = () => this.mission(mission, op, { ...more, take: true });
    if (answer.request_id) this.#remember(answer.request_id, again);
    if (!answer.ok) this.#refuse(`${op} of ${mission.name}`, answer, again);
    return answer;
  }

  /**
   * Start a mission that sends robots from point to point: each step is over when all have arrived.
   * @param {string} name
   * @param {string} behaviour
   * @param {string[]} robots
   * @param {Point[]} points
   * @param {boolean} [take]
   * @returns {Promise<Answer | void>}
   */
  async startRoute(name, behaviour, robots, points, take = false) {
    const what = `mission ${name}`;
    if (this.withheld) return this.emit("refused", { behaviour: what, reason: this.withheld, robots });
    const again = () => this.startRoute(name, behaviour, robots, points, true);
    const holders = this.store.heldByOthers(robots);
    if (holders.size && !take) return this.emit("question", { holders, take: again });
    const steps = points.map((point, k) => ({
      name: `point ${k + 1}`, behaviour, robots, parameters: this.#toPoint(behaviour, robots, point), done: { arrived: "all" },
    }));
    const answer = await this.link.ask({ t: "startmission", plan: { name, tracks: [{ name: "main", steps }] }, take });
    if (answer.request_id) this.#remember(answer.request_id, again, robots);
    if (!answer.ok) this.#refuse(what, answer, again, robots);
    return answer;
  }

  /**
   * Undo the newest request, which must still be the one that was shown.
   * @param {string} id
   */
  async undo(id) {
    if (this.withheld) return this.emit("refused", { behaviour: "undo", reason: this.withheld });
    this.emit("requested", { behaviour: "undo", robots: [] });
    const answer = await this.link.ask({ t: "undo", id });
    if (!answer.ok) this.emit("refused", { behaviour: "undo", reason: answer.reason });
    return answer;
  }

  /**
   * Make or delete a group for all consoles.
   * @param {"save" | "delete"} op
   * @param {string} name
   * @param {string[]} robots
   * @returns {Promise<Answer>}
   */
  async group(op, name, robots) {
    if (this.withheld) return { ok: false, reason: this.withheld };
    const answer = await this.link.ask({ t: "group", op, name, robots });
    if (!answer.ok) this.emit("refused", { behaviour: `group ${name}`, reason: answer.reason });
    return answer;
  }

  /**
   * Keep a place or a request for all consoles, or delete it.
   * @param {"save" | "delete"} op
   * @param {"place" | "saved"} what
   * @param {string} name
   * @param {object} [value]
   * @returns {Promise<Answer>}
   */
  async keep(op, what, name, value) {
    if (this.withheld) return { ok: false, reason: this.withheld };
    return this.link.ask({ t: "keep", op, what, name, ...(value && { value }) });
  }

  /** @param {{t: string, robots: string[], reason?: string}} message */
  async #urgent(message) {
    const { ok, lost, reason } = await this.link.ask(message);
    if (ok) return;
    if (lost === "unsent" || lost === "broken") this.link.urge(message);
    this.emit("unsent", { what: message.t, lost, reason });
    if (!lost) this.emit("refused", { behaviour: message.t === "stop" ? "stop" : "e-stop", reason });
  }

  /**
   * @param {string} id
   * @param {() => void} again
   * @param {string[]} [robots]
   */
  #remember(id, again, robots = []) {
    this.#mine.set(id, { again, robots });
    const [oldest] = this.#mine.keys();
    if (this.#mine.size > 50) this.#mine.delete(oldest);
  }

  /** @param {MissionReply} reply */
  #onReply({ ok, op, mission, request_id, reason, code }) {
    if (ok) return;
    const mine = this.#mine.get(request_id);
    const known = this.store.missions.find((each) => each.mission === mission);
    const robots = known ? known.tracks.flatMap(({ steps }) => steps.flatMap((step) => step.robots)) : mine?.robots ?? [];
    const about = Object.fromEntries(this.store.heldByOthers(robots));
    this.#refuse(`${op} of ${known?.name ?? mission}`, { reason, code, about }, mine?.again);
  }

  /** @param {RequestStatus} status */
  #onStatus(status) {
    if (!status.mine || status.phase !== "refused") return;
    this.#refuse(status.behaviour, status, this.#mine.get(status.request_id)?.again, status.robots);
  }

  /**
   * Report a refusal; if another operator holds the robots, ask whether to take them over.
   * @param {string} behaviour
   * @param {{reason?: string, code?: string, about?: Record<string, string>}} given
   * @param {(() => void) | undefined} again
   * @param {string[]} [robots]
   */
  #refuse(behaviour, { reason = "no reason given", code = "", about = {} }, again, robots = []) {
    // The list of all parameters is left out: the form shows them.
    const brief = code === "parameters" ? about.problems ?? reason : reason;
    this.emit("refused", { behaviour, reason: brief, robots, code });
    if (code !== "held" || !again) return;
    this.emit("question", { holders: new Map(Object.entries(about)), take: again });
  }
}

const round = (/** @type {number} */ metres) => Math.round(metres * 1000) / 1000;
