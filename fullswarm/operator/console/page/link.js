/** The WebSocket to the console: hello, answers by number, reconnecting; and how old the data is, and why. */

import { Emitter } from "./dom.js";

/** @import { AnswerFrame, Message } from "./types.d.ts" */

const BACKOFF_S = [0.25, 0.5, 1, 2];
const ANSWER_S = 4;
const STALLED_S = 3;
const URGENT_S = 10;
const REFUSED = /** @type {Record<number, string>} */ ({
  4401: "Access denied: wrong or missing token",
  4429: "Access denied: too many pages or messages",
});

/**
 * @typedef {{ok: boolean, reason?: string, request_id?: string, code?: string, about?: Record<string, string>,
 *   lost?: "unsent" | "broken" | "mute"}} Answer
 *   lost: this is not an answer of the console, but of the link: it was not sent, the link broke, no answer came
 */

/**
 * Emits "message" (each message), "open", "closed".
 * @extends {Emitter<{message: Message, open: undefined, closed: undefined}>}
 */
export class Link extends Emitter {
  /** @param {{token: string, session: string, name?: string}} identity */
  constructor(identity) {
    super();
    this.identity = identity;
    this.open = false;
    this.refused = "";
    this.heard_s = /** @type {number | null} */ (null);
    this.fleet_s = /** @type {number | null} */ (null);
    this.#connect();
    setInterval(() => this.#watch(), 500);
  }

  #socket = /** @type {WebSocket | null} */ (null);
  #tries = 0;
  #ref = 0;
  #waiting = /** @type {Map<number | null, {resolve: (answer: Answer) => unknown, timer: number}>} */ (new Map());
  #urgent = /** @type {{message: object, until_s: number}[]} */ ([]);

  /**
   * Send a command and wait for its answer. Never throws: a lost link and a missing answer are answers too.
   * @returns {Promise<Answer>}
   * @param {object} message
   */
  ask(message) {
    const ref = this.post(message);
    if (ref === null) return Promise.resolve({ ok: false, lost: "unsent", reason: "not sent: no link to the console" });
    return new Promise((resolve) => {
      const mute = /** @type {Answer} */ ({ ok: false, lost: "mute", reason: "the console gave no answer" });
      const timer = setTimeout(() => this.#settle(ref, mute), ANSWER_S * 1000);
      this.#waiting.set(ref, { resolve, timer });
    });
  }

  /**
   * Send a command now, or as soon as the link is back: for stops. True: it went out at once.
   * @param {object} message
   */
  urge(message) {
    if (this.post(message) !== null) return true;
    this.#urgent.push({ message, until_s: performance.now() / 1000 + URGENT_S });
    return false;
  }

  /**
   * Send and wait for nothing; null if there is no link. `handler` is called with the answer.
   * @param {object} message
   * @param {(answer: Answer) => unknown} [handler]
   */
  post(message, handler) {
    if (!this.open || this.#socket?.readyState !== WebSocket.OPEN) return null;
    this.#ref += 1;
    if (handler) this.#waiting.set(this.#ref, { resolve: handler, timer: 0 });
    this.#socket.send(JSON.stringify({ ...message, ref: this.#ref }));
    return this.#ref;
  }

  #connect() {
    const address = `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`;
    const socket = new WebSocket(address);
    this.#socket = socket;
    socket.onopen = () => socket.send(JSON.stringify({ t: "hello", ...this.identity }));
    socket.onmessage = (event) => this.#receive(JSON.parse(event.data));
    socket.onclose = (event) => this.#closed(socket, event.code);
  }

  /** @param {Message | AnswerFrame | { t: "pass", token: string }} message */
  #receive(message) {
    const now_s = performance.now() / 1000;
    this.heard_s = now_s;
    if (message.t === "fleet") this.fleet_s = now_s;
    if (message.t === "pass") return this.#keep(message.token);
    if (message.t === "answer") return this.#settle(message.ref, message);
    if (message.t === "hello") this.#opened();
    return this.emit("message", message);
  }

  /**
   * Use a pass from now on, instead of the token of the address: it ends by itself, and a reload finds it.
   * @param {string} token
   */
  #keep(token) {
    this.identity.token = token;
    sessionStorage.setItem("token", token);
  }

  #opened() {
    this.open = true;
    this.refused = "";
    this.#tries = 0;
    const now_s = performance.now() / 1000;
    for (const { message, until_s } of this.#urgent.splice(0)) if (now_s < until_s) this.post(message);
    this.emit("open");
  }

  /**
   * @param {WebSocket | null} socket
   * @param {number} code
   */
  #closed(socket, code) {
    if (socket !== this.#socket) return; // given up before
    this.open = false;
    this.refused = REFUSED[code] ?? "";
    for (const ref of [...this.#waiting.keys()]) this.#settle(ref, { ok: false, lost: "broken", reason: "the link broke" });
    const wait_s = BACKOFF_S[Math.min(this.#tries, BACKOFF_S.length - 1)];
    this.#tries += 1;
    setTimeout(() => this.#connect(), wait_s * 1000);
    this.emit("closed");
  }

  /** A socket without messages for long is dead although it was not closed: reconnect. */
  #watch() {
    const quiet_s = performance.now() / 1000 - (this.heard_s ?? Infinity);
    if (!this.open || quiet_s < STALLED_S) return;
    const socket = this.#socket;
    this.#closed(socket, 0);
    socket?.close();
  }

  /**
   * @param {number | null} ref
   * @param {Answer} answer
   */
  #settle(ref, answer) {
    const waiting = this.#waiting.get(ref);
    if (!waiting) return;
    this.#waiting.delete(ref);
    clearTimeout(waiting.timer);
    waiting.resolve(answer);
  }
}

/** Return token and session: from the address once, then from this tab's storage, so a reload is the same operator. */
export function identity() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    sessionStorage.setItem("token", given);
    history.replaceState(null, "", location.pathname + location.search);
  }
  let session = sessionStorage.getItem("session");
  if (!session) {
    session = Array.from(crypto.getRandomValues(new Uint8Array(12)), (byte) => byte.toString(16).padStart(2, "0")).join("");
    sessionStorage.setItem("session", session);
  }
  return { token: sessionStorage.getItem("token") ?? "", session };
}

/** As SILENT_S of operator/view.py. */
export const OLD_S = 0.8;

/**
 * @typedef {{open: boolean, now_s: number, heard_s: number | null, fleet_s: number | null, hub: boolean,
 *   core_age_s: number | null, refused: string, recording?: boolean}} LinkFacts
 *   heard_s: arrival of the newest message; fleet_s: of the newest "fleet"; core_age_s: as that one reports
 */

/**
 * Return how old the data is, and why.
 * @param {LinkFacts} facts
 * @returns {{level: "live" | "old" | "core" | "hub" | "refused" | "start", text: string}}
 */
export function judgeLink({ open, now_s, heard_s, fleet_s, hub, core_age_s, refused, recording = false }) {
  if (refused) return { level: "refused", text: refused };
  if (recording && open && heard_s !== null && now_s - heard_s <= STALLED_S) return { level: "live", text: "recording" };
  if (heard_s === null || fleet_s === null) return { level: "start", text: open ? "no data yet" : "connecting" };
  const age_s = now_s - heard_s;
  if (!open || age_s > OLD_S) return { level: "old", text: `no data for ${seconds(age_s)}` };
  if (!hub) return { level: "hub", text: "hub lost" };
  if (core_age_s === null) return { level: "core", text: "core is silent" };
  const core_s = core_age_s + now_s - fleet_s;
  if (core_s > OLD_S) return { level: "core", text: `core is silent for ${seconds(core_s)}` };
  return { level: "live", text: "live" };
}

/**
 * Write an age: tenths while they matter.
 * @param {number} age_s
 */
export function seconds(age_s) {
  if (age_s < 10) return `${Math.max(0, age_s).toFixed(1)} s`;
  return age_s < 120 ? `${Math.round(age_s)} s` : `${Math.round(age_s / 60)} min`;
}

/** What each state means for the operator. */
export const LINK_ADVICE = {
  old: "The console does not answer. What you see is old. Robots stop by themselves if the hub is gone too.",
  core: "Requests cannot be answered. Most behaviours stop by themselves. Stop and e-stop still reach the robots.",
  hub: "Nothing reaches the robots from here. They stop by themselves. Start the hub: fullswarm up.",
  refused: "Open the address that the command fullswarm console prints.",
  start: "",
  live: "",
};
