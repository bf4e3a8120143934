/** Banners in a row above the map: the state of the link, robots taken over, the question whether to take over. */

import { Emitter, byId, setText } from "./dom.js";
import { short } from "./fleet.js";
import { LINK_ADVICE, judgeLink } from "./link.js";

/** @import { Question } from "./commands.js" */

const CHECK_MS = 100;
const LOST_MS = 12000;
const TOLD_MS = 6000;

/**
 * Emits "level" when the state of the link changes.
 * @extends {Emitter<{level: string}>}
 */
export class Banners extends Emitter {
  /**
   * @param {{link: import("./link.js").Link, store: import("./store.js").Store,
   *   commands: import("./commands.js").Commands, map: import("./map.js").SwarmMap}} parts
   */
  constructor({ link, store, commands, map }) {
    super();
    this.link = link;
    this.store = store;
    this.map = map;
    this.level = "";
    setInterval(() => this.#check(), CHECK_MS);
    store.on("fleet", () => this.#check());
    store.on("lost", ({ robots, by }) => this.#lost(robots, by));
    store.on("timeline", ({ recording }) => (this.#recording = Boolean(recording)));
    store.on("hello", ({ read_only }) => (byId("read-only").hidden = !read_only));
    commands.on("question", (question) => this.#ask(question));
    store.on("leases", () => this.#stillHeld());
    commands.on("requested", () => (byId("question").hidden = true));
    commands.on("refused", ({ behaviour, reason }) => this.hint(`Refused. ${behaviour}: ${reason}`));
    byId("question-no").addEventListener("click", () => (byId("question").hidden = true));
    byId("question-yes").addEventListener("click", () => this.#take());
    byId("lost-close").addEventListener("click", () => (byId("lost").hidden = true));
    inRows(byId("banners"));
    this.#check();
  }

  #takeOver = /** @type {(() => void) | null} */ (null);
  #questioned = /** @type {string[]} */ ([]);
  #lostTimer = 0;
  #recording = false;
  #toldTimer = 0;

  /**
   * Show a text above the map for a few seconds.
   * @param {string} words
   */
  hint(words) {
    setText(byId("hint"), words);
    byId("hint").title = words;
    byId("hint").hidden = false;
    clearTimeout(this.#toldTimer);
    this.#toldTimer = setTimeout(() => (byId("hint").hidden = true), TOLD_MS);
  }

  #check() {
    const { level, text } = judgeLink({
      open: this.link.open, now_s: performance.now() / 1000, heard_s: this.link.heard_s, fleet_s: this.link.fleet_s,
      hub: this.store.hub, core_age_s: this.store.core_age_s, refused: this.link.refused, recording: this.#recording,
    });
    setText(byId("link-state"), text);
    setText(byId("link-words"), text);
    if (level === this.level) return;
    this.level = level;
    document.body.dataset.link = level;
    byId("link-banner").hidden = level === "live" || level === "start";
    setText(byId("link-advice"), LINK_ADVICE[level]);
    setText(byId("link-spoken"), level === "live" ? "link live" : `${text}. ${LINK_ADVICE[level]}`);
    this.map.old = level === "old" || level === "hub" || level === "refused";
    this.map.touch();
    this.emit("level", level);
  }

  /**
   * @param {string[]} robots
   * @param {string} by
   */
  #lost(robots, by) {
    setText(byId("lost-words"), `${short(robots)} taken over by ${by}. You no longer drive ${robots.length === 1 ? "it" : "them"}.`);
    byId("lost").hidden = false;
    clearTimeout(this.#lostTimer);
    this.#lostTimer = setTimeout(() => (byId("lost").hidden = true), LOST_MS);
  }

  /** @param {Question} question */
  #ask({ holders, take }) {
    const robots = [...holders.keys()];
    const names = [...new Set(holders.values())].join(", ");
    const verb = robots.length === 1 ? "is" : "are";
    setText(byId("question-words"), `${short(robots)} ${verb} held by ${names}`);
    this.#takeOver = take;
    this.#questioned = robots;
    byId("hint").hidden = true; // that it was refused goes without saying
    byId("question").hidden = false;
  }

  /** The question is void when the holder has released the robots meanwhile. */
  #stillHeld() {
    if (byId("question").hidden || this.store.heldByOthers(this.#questioned).size) return;
    byId("question").hidden = true;
    this.hint(`${short(this.#questioned)} released: request again.`);
  }

  #take() {
    byId("question").hidden = true;
    this.#takeOver?.();
    this.#takeOver = null;
  }
}

/**
 * Give each child that appears the first free row, and leave it there: what is being read, or about to be clicked, stays
 * where it is when another one appears or goes.
 * @param {HTMLElement} container
 */
function inRows(container) {
  const place = (/** @type {HTMLElement} */ shown) => {
    const others = [...container.children].filter((each) => each !== shown && each instanceof HTMLElement && !each.hidden);
    const taken = new Set(others.map((each) => /** @type {HTMLElement} */ (each).style.gridRow));
    let row = 1;
    while (taken.has(String(row))) row += 1;
    shown.style.gridRow = String(row);
  };
  const watch = new MutationObserver((changes) => {
    for (const { target, oldValue } of changes) {
      const appears = target instanceof HTMLElement && target.parentElement === container && oldValue !== null && !target.hidden;
      if (appears) place(target);
    }
  });
  watch.observe(container, { subtree: true, attributeFilter: ["hidden"], attributeOldValue: true });
}
