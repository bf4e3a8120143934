/** A new mission: the selected robots go from point to point; the points are picked on the map, or are places. */

import { byId, make, setFlag, setText } from "./dom.js";
import { short } from "./fleet.js";
import { nameProblem } from "./groups.js";
import { middle } from "./places.js";

/** @import { Point } from "./types.d.ts" */

const MOST_POINTS = 64;

export class MissionForm {
  /**
   * @param {{store: import("./store.js").Store, selection: import("./selection.js").Selection,
   *   commands: import("./commands.js").Commands, tools: import("./tools.js").Tools}} parts
   */
  constructor({ store, selection, commands, tools }) {
    this.store = store;
    this.selection = selection;
    this.commands = commands;
    this.tools = tools;
    this.form = byId("mission-form");
    this.name = /** @type {HTMLInputElement} */ (byId("mission-name"));
    this.way = /** @type {HTMLSelectElement} */ (byId("mission-way"));
    this.place = /** @type {HTMLSelectElement} */ (byId("mission-place"));
    this.start = /** @type {HTMLButtonElement} */ (byId("mission-start"));
    this.picking = byId("mission-pick");
    byId("mission-new").addEventListener("click", () => (this.form.hidden ? this.#open() : this.close()));
    byId("mission-cancel").addEventListener("click", () => this.close());
    this.picking.addEventListener("click", () => this.#pick());
    this.place.addEventListener("change", () => this.#addPlace());
    this.form.addEventListener("submit", (event) => void this.#submit(event));
    selection.on("change", () => this.#show());
    tools.on("change", () => setFlag(this.picking, "aria-pressed", tools.picksFor(this.#onPoint)));
    store.on("world", () => this.#offer());
    store.on("mission", (reply) => this.#replied(reply));
  }

  #points = /** @type {Point[]} */ ([]);
  #onPoint = (/** @type {Point} */ point) => this.#add(point);
  #offered = "";
  #asked = ""; // name of the mission that the core is asked for; it stays in the form until the core has accepted it

  #open() {
    this.form.hidden = false;
    setFlag(byId("mission-new"), "aria-expanded", true);
    this.name.value = this.#freeName();
    this.name.setAttribute("aria-invalid", "false");
    this.#offer();
    this.#problem("");
    this.#pick();
    this.#show();
  }

  /** Forget the points. */
  close() {
    if (this.form.hidden) return;
    const focused = this.form.contains(document.activeElement);
    if (this.tools.picksFor(this.#onPoint)) this.tools.use("select");
    this.form.hidden = true;
    setFlag(byId("mission-new"), "aria-expanded", false);
    this.#points = [];
    this.#asked = "";
    this.#show();
    if (focused) byId("mission-new").focus({ preventScroll: true }); // else the operator is elsewhere by now
  }

  #freeName() {
    const taken = new Set(this.store.missions.map(({ name }) => name));
    let number = 1;
    while (taken.has(`route-${number}`)) number += 1;
    return `route-${number}`;
  }

  /** Offer the places that all consoles share, and the ways that there are. */
  #offer() {
    for (const option of this.way.options) option.disabled = !(option.value in this.store.behaviours);
    const names = Object.keys(this.store.places);
    const shown = JSON.stringify(names);
    if (shown === this.#offered) return;
    this.#offered = shown;
    this.place.hidden = !names.length;
    const options = names.map((name) => make("option", { value: name, text: name }));
    this.place.replaceChildren(make("option", { value: "", text: "Add a place…" }), ...options);
  }

  #pick() {
    if (this.tools.picksFor(this.#onPoint)) this.tools.use("select");
    else this.tools.pick([], this.#onPoint);
  }

  #addPlace() {
    const place = this.store.places[this.place.value];
    this.place.value = "";
    if (place) this.#add(middle(place));
  }

  /**
   * Return whether more points can be added.
   * @param {Point} point
   */
  #add([x, y]) {
    const [x0, y0, x1, y1] = this.store.arena ?? [-Infinity, -Infinity, Infinity, Infinity];
    if (x < x0 || x > x1 || y < y0 || y > y1) { // its step would never be over
      this.#problem("this point is outside the arena: pick one within it");
      return true;
    }
    if (this.#points.length < MOST_POINTS) this.#points = [...this.#points, [round(x), round(y)]];
    this.#problem("");
    this.#show();
    this.form.scrollTop = this.form.scrollHeight; // the newest one and the buttons
    return this.#points.length < MOST_POINTS;
  }

  /** @param {number} index */
  #remove(index) {
    this.#points = this.#points.filter((_, k) => k !== index);
    this.#show();
    this.picking.focus({ preventScroll: true });
  }

  #show() {
    this.tools.route = this.form.hidden ? null : this.#points;
    this.tools.emit("draw");
    if (this.form.hidden) return;
    const robots = this.selection.list();
    setText(byId("mission-robots"), robots.length ? `For ${robots.length} selected: ${short(robots, 6)}` : "Select the robots: click, lasso, or tick them.");
    this.start.disabled = !robots.length || !this.#points.length;
    this.start.title = this.start.disabled ? "Needs selected robots and a point" : "";
    byId("mission-points").replaceChildren(...this.#points.map((point, k) => this.#item(point, k)));
  }

  /**
   * @param {Point} point
   * @param {number} index
   */
  #item([x, y], index) {
    const words = `Remove point ${index + 1}`;
    const away = make("button", {
      type: "button", class: "small", text: "×", "aria-label": words, title: words, on: { click: () => this.#remove(index) },
    });
    return make("li", {}, make("strong", { text: String(index + 1) }), make("span", { text: `${x.toFixed(2)}, ${y.toFixed(2)}` }), away);
  }

  /** @param {SubmitEvent} event */
  async #submit(event) {
    event.preventDefault();
    const name = this.name.value.trim();
    const problem = nameProblem(name, [], "mission");
    this.name.setAttribute("aria-invalid", String(Boolean(problem)));
    if (problem) return this.#problem(problem);
    const robots = this.selection.list();
    if (!robots.length || !this.#points.length) return this.#problem("select robots, and pick a point");
    this.#asked = name;
    this.#problem("");
    const answer = await this.commands.startRoute(name, this.way.value, robots, this.#points);
    return answer && !answer.ok ? this.#problem(answer.reason ?? "not started") : undefined;
  }

  /** @param {import("./types.d.ts").MissionReply} reply */
  #replied({ op, mission, ok, reason }) {
    if (op !== "start" || !this.#asked || mission !== this.#asked) return;
    if (ok) this.close();
    else this.#problem(reason);
  }

  /** @param {string} words */
  #problem(words) {
    setText(byId("mission-problem"), words);
  }
}

const round = (/** @type {number} */ metres) => Math.round(metres * 100) / 100;
