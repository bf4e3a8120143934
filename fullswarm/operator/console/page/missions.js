/** The missions: what their steps wait for, and the buttons that pause, resume, abort and confirm. */

import { byId, make, setFlag, setText } from "./dom.js";

/** @import { Pointed, Routes } from "./routes.js" */
/** @import { Mission, Step } from "./types.d.ts" */

const SIGNS = /** @type {Record<string, string>} */ ({
  waiting: "○", running: "▶", paused: "‖", done: "✓", failed: "✕", skipped: "–",
});
const ENDED = ["done", "failed", "aborted"];

export class Missions {
  /** @param {{store: import("./store.js").Store, commands: import("./commands.js").Commands, routes: Routes}} parts */
  constructor({ store, commands, routes }) {
    this.commands = commands;
    this.routes = routes;
    routes.onPoint = (pointed) => this.#mark(pointed);
    this.list = byId("missions");
    this.toggle = byId("missions-toggle");
    this.toggle.addEventListener("click", () => this.#open(document.body.dataset.lower !== "missions"));
    this.#open(false);
    store.on("missions", (missions) => this.#update(missions));
    this.#update([]);
  }

  #cards = /** @type {Map<string, Card>} */ (new Map());
  #seen = /** @type {Set<string>} */ (new Set());

  /**
   * Show the missions in place of the charts, on wide screens.
   * @param {boolean} open
   */
  #open(open) {
    document.body.dataset.lower = open ? "missions" : "charts";
    setFlag(this.toggle, "aria-pressed", open);
  }

  /**
   * Mark the step whose place on the map is pointed at.
   * @param {Pointed | null} pointed
   */
  #mark(pointed) {
    for (const [key, card] of this.#cards) card.mark(pointed?.mission === key ? pointed : null);
  }

  /** @param {Mission[]} missions */
  #update(missions) {
    const keys = new Set(missions.map(({ mission }) => mission));
    for (const [key, card] of this.#cards) {
      if (keys.has(key)) continue;
      card.element.remove();
      this.#cards.delete(key);
    }
    for (const mission of [...missions].reverse()) {
      let card = this.#cards.get(mission.mission);
      if (!card) {
        card = new Card(mission, this.commands, this.routes);
        this.#cards.set(mission.mission, card);
        this.list.prepend(card.element);
      }
      card.update(mission);
      if (!this.#seen.has(mission.mission) && !ENDED.includes(mission.phase)) this.#open(true);
      this.#seen.add(mission.mission);
    }
    byId("mission-empty").hidden = missions.length > 0;
    this.list.hidden = !missions.length;
    const going = missions.filter(({ phase }) => !ENDED.includes(phase));
    const asked = going.flatMap(({ tracks }) => tracks.flatMap(({ steps }) => steps.filter(({ confirm }) => confirm)));
    const names = going.length > 1 ? going.map(({ name, phase }) => `${name} ${phase}`).join(", ") : "";
    const words = asked.length ? `waits for you: ${asked[0].confirm}` : names;
    setText(byId("mission-summary"), words);
    byId("mission-summary").title = words; // the step shows a long question whole
    setFlag(byId("missions-toggle"), "data-asks", asked.length > 0);
  }
}

/** One mission; its elements are made once and then changed, so that nothing loses the focus. */
class Card {
  /**
   * @param {Mission} mission
   * @param {import("./commands.js").Commands} commands
   * @param {Routes} routes
   */
  constructor(mission, commands, routes) {
    this.mission = mission;
    const act = (/** @type {"pause" | "resume" | "abort"} */ op) => () => commands.mission(this.mission, op);
    const button = (/** @type {string} */ text, /** @type {string} */ name, /** @type {() => void} */ click) =>
      make("button", { type: "button", class: "small", text, testid: `mission-${name}`, on: { click } });
    this.phase = make("span", { class: "mission-phase", testid: "mission-phase" });
    this.reason = make("p", { class: "mission-reason", testid: "mission-reason", role: "status" });
    this.pause = button("Pause", "pause", act("pause"));
    this.resume = button("Resume", "resume", act("resume"));
    this.abort = button("Abort…", "abort", () => this.#ask(true));
    this.sure = make(
      "span", { class: "mission-sure", hidden: true }, "Abort for good? ",
      button("Abort", "abort-sure", () => (this.#ask(false), commands.mission(this.mission, "abort"))),
      button("No", "abort-no", () => this.#ask(false)),
    );
    this.show = button("On the map", "show", () => routes.show(this.mission));
    this.steps = mission.tracks.map((track) => track.steps.map((step, index) => new StepRow(step, index + 1, {
      confirm: () => commands.mission(this.mission, "confirm", { track: track.name, step: step.name }),
      point: (on) => routes.point(on ? { mission: this.mission.mission, track: track.name, step: step.name } : null),
    })));
    this.element = make(
      "article", { class: "mission", testid: `mission-${mission.name}`, "aria-label": `Mission ${mission.name}` },
      make(
        "div", { class: "mission-head" },
        make("h3", { text: mission.name }), this.phase,
        make("div", { class: "mission-acts" }, this.show, this.pause, this.resume, this.abort, this.sure),
      ),
      this.reason,
      make("div", { class: "mission-tracks" }, ...mission.tracks.map((track, index) => make(
        "div", { class: "mission-track" },
        make("h4", { text: track.name }),
        make("ol", {}, ...this.steps[index].map(({ element }) => element)),
      ))),
    );
  }

  /** @param {boolean} asking */
  #ask(asking) {
    this.sure.hidden = !asking;
    this.abort.hidden = asking;
  }

  /** @param {Pointed | null} pointed */
  mark(pointed) {
    this.mission.tracks.forEach(({ name }, track) => this.steps[track].forEach((row) => {
      row.mark(name === pointed?.track && row.name === pointed.step);
    }));
  }

  /** @param {Mission} mission */
  update(mission) {
    this.mission = mission;
    this.show.hidden = !mission.tracks.some(({ steps }) => steps.some(({ places }) => places?.length));
    setFlag(this.element, "data-phase", mission.phase);
    setText(this.phase, words(mission));
    setText(this.reason, mission.silent ? "The core has not reported it for some seconds." : mission.reason);
    this.reason.hidden = !this.reason.textContent;
    const ended = ENDED.includes(mission.phase);
    this.pause.hidden = mission.phase !== "running";
    this.resume.hidden = mission.phase !== "paused";
    if (ended) this.#ask(false);
    this.abort.hidden ||= ended;
    mission.tracks.forEach(({ steps }, track) => steps.forEach((step, index) => this.steps[track][index]?.update(step)));
  }
}

class StepRow {
  /**
   * @param {Step} step
   * @param {number} number  as on the map
   * @param {{confirm: () => void, point: (on: boolean) => void}} acts
   */
  constructor(step, number, { confirm, point }) {
    this.name = step.name;
    this.sign = make("span", { class: "step-sign", "aria-hidden": "true" });
    this.phase = make("span", { class: "step-phase" });
    this.notes = make("span", { class: "step-notes" });
    this.confirm = make("button", { type: "button", class: "step-confirm", testid: "mission-confirm", on: { click: confirm } });
    const robots = step.robots.length ? step.robots.join(", ") : "all robots";
    const what = step.behaviour ? `${step.behaviour} for ${robots}` : "no behaviour";
    this.element = make(
      "li", {
        class: "step", testid: `step-${step.name}`, title: what,
        on: { pointerenter: () => point(true), pointerleave: () => point(false), focusin: () => point(true), focusout: () => point(false) },
      },
      this.sign, make("strong", { text: `${number} ${step.name}` }), this.phase, this.notes, this.confirm,
    );
  }

  /** @param {boolean} pointed  its place on the map */
  mark(pointed) {
    setFlag(this.element, "data-pointed", pointed);
  }

  /** @param {Step} step */
  update(step) {
    if (step.places?.length) setFlag(this.element, "tabindex", 0); // the focus shows it on the map
    setFlag(this.element, "data-phase", step.phase);
    setText(this.sign, SIGNS[step.phase] ?? "·");
    const time = step.elapsed_s && step.phase !== "waiting" ? ` ${Math.round(step.elapsed_s)} s` : "";
    setText(this.phase, `${step.phase}${time}`);
    const waits = step.waits_for.filter((text) => !step.confirm || !text.includes(step.confirm));
    setText(this.notes, [...waits, ...(step.reason ? [step.reason] : [])].join("; "));
    setText(this.confirm, `Confirm: ${step.confirm}`);
    this.confirm.hidden = !step.confirm;
  }
}

/** @param {Mission} mission */
function words({ phase, operator }) {
  return phase === "running" && operator ? `running for ${operator}` : phase;
}
