/** The behaviour panel: a list to search, and a form made from the chosen behaviour's parameters. */

import { byId, Emitter, make, robots, setText } from "./dom.js";
import { makeField } from "./field.js";
import { behaviourGroup, listed, parseForm } from "./forms.js";
import { choices } from "./places.js";
import { SEEN_WITHIN_S, causeHolds } from "./refusals.js";
import { NOT_REPORTED } from "./selection.js";
import { makeTerms } from "./terms.js";
import { progressWords, titleOf } from "./words.js";

/** @import { Behaviour, RequestStatus, SavedRequest, Terms, UndoFrame } from "./types.d.ts" */

const GROUPS = {
  filtered: "Behind the safety filter",
  plain: "Without the safety filter",
  stick: "For sticks: they end when the stick is released",
};

/**
 * Emits "choose" when another form, or none, is shown.
 * @extends {Emitter<{choose: undefined}>}
 */
export class Panel extends Emitter {
  /**
   * @param {{store: import("./store.js").Store, selection: import("./selection.js").Selection,
   *   commands: import("./commands.js").Commands, tools: import("./tools.js").Tools}} parts
   */
  constructor({ store, selection, commands, tools }) {
    super();
    this.store = store;
    this.selection = selection;
    this.commands = commands;
    this.tools = tools;
    this.chosen = /** @type {string | null} */ (null);
    this.savedAs = ""; // the name of the saved request that the form was opened from
    this.search = /** @type {HTMLInputElement} */ (byId("behaviour-search"));
    this.start = byId("start");
    this.refusal = byId("refusal");
    this.search.addEventListener("input", () => this.#list());
    byId("behaviour-form").addEventListener("submit", (event) => this.#submit(event));
    byId("form-back").addEventListener("click", () => this.#choose(null));
    store.on("world", () => this.#world());
    store.on("robots", () => this.#label());
    selection.on("change", () => this.#label());
    commands.on("refused", ({ behaviour, reason, robots, code }) => this.#refuse(`${behaviour}: ${reason}`, robots, code));
    commands.on("requested", () => this.#refuse(""));
    store.on("request", (status) => status.mine && this.#progress(status));
    for (const topic of /** @type {const} */ (["fleet", "leases"])) store.on(topic, () => this.#stillHindered());
    byId("form-fields").addEventListener("input", () => this.#code === "parameters" && this.#refuse(""));
    store.on("undo", (undo) => this.#offerUndo(undo));
    byId("undo").addEventListener("click", () => void commands.undo(this.#undo));
  }

  #undo = ""; // the id of the request that would be undone
  #refused = /** @type {string[]} */ ([]); // the robots that the words on a refusal concern
  #code = ""; // of the refusal
  #seen = false; // whether its cause was seen here
  #refused_ms = 0;
  #partly = false; // the progress names robots that refused
  #hindered = /** @type {Set<string>} */ (new Set()); // what kept them from obeying since
  #fields = /** @type {Record<string, import("./field.js").Field>} */ ({});
  #terms = /** @type {import("./terms.js").TermsPart | null} */ (null);
  #shown = "";

  #world() {
    const records = JSON.stringify(this.store.behaviours);
    if (records === this.#shown) return; // a form that is being filled in stays
    this.#shown = records;
    if (this.chosen && !this.store.behaviours[this.chosen]) this.chosen = null;
    this.#list();
    this.#choose(this.chosen);
  }

  #list() {
    const items = [];
    let group = "";
    for (const [name, record] of listed(this.store.behaviours, this.search.value)) {
      const its = behaviourGroup(record);
      if (its !== group) items.push(make("li", { class: "group" }, make("h3", { text: GROUPS[its] })));
      group = its;
      items.push(make("li", {}, this.#item(name, record)));
    }
    if (items.length === 0) items.push(make("li", { class: "empty", text: this.#emptyText() }));
    byId("behaviour-list").replaceChildren(...items);
  }

  #emptyText() {
    if (Object.keys(this.store.behaviours).length) return "No behaviour fits this search.";
    return "No behaviours yet: the core lists them, and has not been received. If the state at the top left stays at “core is silent”, start the swarm in a shell: fullswarm up FILE.toml.";
  }

  /**
   * @param {string} name
   * @param {Behaviour} record
   */
  #item(name, record) {
    const button = make("button", {
      type: "button", class: "behaviour", testid: `behaviour-${name}`, "aria-pressed": String(name === this.chosen),
      on: { click: () => this.#choose(name) },
    });
    button.title = name;
    button.append(make("span", { class: "behaviour-name", text: titleOf(this.store.behaviours, name) }));
    button.append(make("span", { class: "behaviour-summary", text: record.summary ?? "" }));
    return button;
  }

  /**
   * Show the form of a behaviour as a request was filled in.
   * @param {SavedRequest} saved
   * @param {string} name that it is kept under
   */
  open(saved, name) {
    const { behaviour, parameters = {}, team, needs, roles } = saved;
    if (!this.store.behaviours[behaviour]) return this.#refuse(`${name}: there is no behaviour ${behaviour} any more`);
    this.#choose(behaviour, { parameters, terms: { team, needs, roles }, name });
    return this.start.focus({ preventScroll: true });
  }

  /**
   * @param {string | null} name
   * @param {{parameters: Record<string, unknown>, terms: Terms, name: string}} [given] what the form says at first
   */
  #choose(name, given = { parameters: {}, terms: {}, name: "" }) {
    this.chosen = name;
    this.savedAs = given.name;
    this.emit("choose");
    const form = byId("behaviour-form");
    form.hidden = name === null;
    byId("behaviour-choice").hidden = name !== null;
    byId("form-back").hidden = name === null;
    for (const button of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll(".behaviour"))) {
      button.setAttribute("aria-pressed", String(button.dataset.testid === `behaviour-${name}`));
    }
    this.#refuse("");
    if (name === null) return;
    const record = this.store.behaviours[name];
    setText(byId("form-title"), titleOf(this.store.behaviours, name));
    setText(byId("form-key"), name);
    setText(byId("form-summary"), record.summary ?? "");
    setText(byId("form-filter"), record.filtered ? "behind the safety filter" : "without the safety filter");
    byId("form-filter").dataset.filtered = String(Boolean(record.filtered));
    /** @type {import("./field.js").Pick} */
    const pick = (onPoint, points) => this.tools.pick(points, onPoint);
    const parameters = Object.entries(record.parameters ?? {});
    const { places } = this.store;
    const first = (/** @type {string} */ each, /** @type {unknown} */ usual) => given.parameters[each] ?? usual;
    this.#fields = Object.fromEntries(
      parameters.map(([each, parameter]) => [
        each, makeField(each, { ...parameter, default: first(each, parameter.default) }, pick, choices(places, parameter.type === "points")),
      ]),
    );
    const elements = Object.values(this.#fields).map((field) => field.element);
    if (elements.length === 0) elements.push(make("p", { class: "empty", text: "It has no parameters." }));
    this.#terms = makeTerms(record, Object.keys(this.store.groups), given.terms);
    byId("form-fields").replaceChildren(...elements, this.#terms.element);
    this.#label();
  }

  #label() {
    const count = this.selection.list().length;
    const all = this.store.ids().length;
    if (this.selection.absent) return setText(this.start, `${NOT_REPORTED[0].toUpperCase()}${NOT_REPORTED.slice(1)}`);
    return setText(this.start, count ? `Start for ${robots(count)}` : `Start for the whole swarm (${all})`);
  }

  /** @param {SubmitEvent} event */
  #submit(event) {
    event.preventDefault();
    if (this.selection.absent) return this.#refuse(`not sent: ${NOT_REPORTED}`);
    const filled = this.filled();
    if (!filled) return undefined;
    const { behaviour, parameters, ...terms } = filled;
    return this.commands.request(behaviour, this.selection.list(), parameters, terms);
  }

  /**
   * Return what the form says; null: something is wrong with it, which is shown.
   * @returns {{behaviour: string, parameters: Record<string, unknown>} & Terms | null}
   */
  filled() {
    const { chosen } = this;
    if (chosen === null) return null;
    const { parameters = {} } = this.store.behaviours[chosen];
    const entries = Object.fromEntries(Object.entries(this.#fields).map(([name, field]) => [name, field.entry()]));
    const { values, errors } = parseForm(entries, parameters);
    for (const [name, field] of Object.entries(this.#fields)) field.showError(errors[name] ?? "");
    const { terms = {}, wrong: more = [] } = this.#terms?.read() ?? {};
    const wrong = Object.keys(errors);
    const words = [...wrong.map((name) => `${name} ${errors[name]}`), ...more];
    if (words.length === 0) return { behaviour: chosen, parameters: values, ...terms };
    this.#refuse(`not sent: ${words.join("; ")}`);
    if (wrong.length) this.#fields[wrong[0]].focus();
    return null;
  }

  /** @param {RequestStatus} status */
  #progress(status) {
    const { behaviour, refused_by = [], code = "" } = status;
    if (this.store.behaviours[behaviour]?.expires_s) {
      if (refused_by.length) this.#remember(refused_by, code);
      return undefined; // a stick's progress is the robot's motion
    }
    if (status.phase === "refused") return this.#noProgress(); // the refusal says it
    setText(byId("progress"), progressWords(status, titleOf(this.store.behaviours, behaviour)));
    this.#partly = refused_by.length > 0;
    if (this.#partly) this.#remember(refused_by, code);
    return undefined;
  }

  /** @param {UndoFrame} frame */
  #offerUndo({ id, words, refusal }) {
    const button = /** @type {HTMLButtonElement} */ (byId("undo"));
    this.#undo = id;
    button.hidden = !words && !refusal;
    button.disabled = !words;
    setText(button, words || `Nothing to undo: ${refusal}`);
    button.title = words || refusal;
  }

  /**
   * @param {string} reason
   * @param {string[]} [robots]
   * @param {string} [code]
   */
  #refuse(reason, robots = [], code = "") {
    setText(this.refusal, reason ? `Refused. ${reason}` : "");
    if (reason) this.#noProgress();
    this.#remember(reason ? robots : null, code);
  }

  /**
   * @param {string[] | null} robots
   * @param {string} [code]
   */
  #remember(robots, code = "") {
    this.#refused = robots ?? [];
    this.#hindered = robots ? this.store.hindrances(robots) : new Set();
    [this.#code, this.#seen, this.#refused_ms] = [code, false, performance.now()];
  }

  /** The text of a refusal is removed when its cause is gone; the log keeps it. */
  #stillHindered() {
    if (!this.refusal.textContent && !this.#partly) return;
    if (this.#mayHold()) return;
    this.#refuse("");
    this.#noProgress();
  }

  /** By its code if that names a cause that is seen here; else by what hindered the robots then. */
  #mayHold() {
    const holds = causeHolds(this.#code, this.#refused.length ? this.#refused : this.store.ids(), this.store);
    if (holds === null) {
      const now = this.store.hindrances(this.#refused);
      if (![...this.#hindered].every((each) => now.has(each))) return false;
      this.#hindered = now;
      return true;
    }
    this.#seen ||= holds;
    // A robot reports its cause a little later than it refuses.
    return holds || (!this.#seen && performance.now() - this.#refused_ms < 1000 * SEEN_WITHIN_S);
  }

  #noProgress() {
    setText(byId("progress"), "");
    this.#partly = false;
  }
}
