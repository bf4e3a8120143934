/** The experiments: what can be run, starting and stopping one, how far it is, and its report. */

import { byId, make, setFlag, setText } from "./dom.js";

/** @import { ExperimentCell, ExperimentEntry, ExperimentList, ExperimentsFrame } from "./types.d.ts" */

const KEPT_AS = "experiments";
const TABS = "(width < 1420px), (height < 800px)"; // as in the style sheet: one panel at a time
const READING = "Reading the experiments …";
const HEADS = ["Behaviour, world", "Robots", "Trials", "Coll.", "Arrived"];

/** The panel: a list, and in its place one experiment that was chosen. */
export class Experiments {
  /** @param {{store: import("./store.js").Store, link: import("./link.js").Link}} parts */
  constructor({ store, link }) {
    this.store = store;
    this.link = link;
    this.panel = byId("experiments");
    this.toggle = byId("experiments-toggle");
    this.list = byId("experiment-list");
    this.one = new One((message) => this.#send(message));
    this.#place();
    byId("experiment-one").append(this.one.element);
    this.toggle.addEventListener("click", () => this.#toggled());
    byId("experiments-close").addEventListener("click", () => this.#close(true));
    byId("experiment-back").addEventListener("click", () => this.#choose("", true));
    // Another panel is wanted in its place.
    byId("tabs").addEventListener("click", () => this.#close());
    byId("time-more").addEventListener("click", () => this.#close());
    this.panel.addEventListener("keydown", ({ key }) => key === "Escape" && this.#back());
    store.on("hello", () => this.#greeted());
    store.on("experiments", (frame) => this.#offered(frame));
    store.on("experiment_list", (frame) => this.#update(frame));
  }

  #chosen = "";
  #rows = /** @type {Map<string, Row>} */ (new Map());
  #entries = /** @type {ExperimentEntry[]} */ ([]);

  /** The header of a wide screen has no room for it. */
  #place() {
    const query = matchMedia(TABS);
    const place = () => (query.matches ? byId("signals").before(this.toggle) : byId("behaviours-title").after(this.toggle));
    query.addEventListener("change", place);
    place();
  }

  /** After a reload of the page, or of the console, what was open is open again. */
  #greeted() {
    const kept = sessionStorage.getItem(KEPT_AS);
    if (!this.panel.hidden) this.#watch(true);
    else if (kept !== null) this.#open(kept);
  }

  /** @param {ExperimentsFrame} frame */
  #offered({ running }) {
    this.toggle.removeAttribute("data-unknown");
    const of = running?.of ? ` of ${running.of}` : "";
    const words = running ? `${running.name} is running: ${running.done ?? 0}${of} trials` : "Run experiments";
    if (this.toggle.title !== words) this.toggle.title = words;
    setFlag(this.toggle, "data-running", running !== null);
  }

  #toggled() {
    const fold = byId("bar-fold");
    if (fold.parentElement?.dataset.menu === "open") fold.click();
    if (!this.panel.hidden) return this.#close(true);
    this.#open();
    return this.panel.focus({ preventScroll: true }); // where the button was hidden by the panel
  }

  #open(chosen = this.#chosen) {
    if (!byId("time-panel").hidden) byId("time-close").click();
    this.panel.hidden = false;
    setFlag(this.toggle, "aria-expanded", true);
    this.#choose(chosen);
    this.#watch(true);
  }

  /** @param {boolean} [focus] */
  #close(focus = false) {
    if (this.panel.hidden) return;
    this.panel.hidden = true;
    setFlag(this.toggle, "aria-expanded", false);
    sessionStorage.removeItem(KEPT_AS);
    this.#watch(false);
    if (!focus) return;
    const shown = this.toggle.checkVisibility();
    (shown ? this.toggle : byId("bar-fold")).focus({ preventScroll: true });
  }

  #back() {
    if (this.#chosen) this.#choose("", true);
    else this.#close(true);
  }

  /** @param {boolean} on */
  #watch(on) {
    this.link.post({ t: "experiment", op: on ? "watch" : "unwatch" });
  }

  /** @param {object} message */
  async #send(message) {
    setText(byId("experiment-refusal"), "");
    const answer = await this.link.ask({ t: "experiment", ...message });
    if (!answer.ok) setText(byId("experiment-refusal"), answer.reason ?? "not done");
  }

  /**
   * Show one experiment, or the list.
   * @param {string} id  empty: the list
   * @param {boolean} [focus]
   */
  #choose(id, focus = false) {
    const before = this.#chosen;
    this.#chosen = id;
    sessionStorage.setItem(KEPT_AS, id);
    byId("experiment-one").hidden = !id;
    byId("experiment-back").hidden = !id;
    byId("experiment-all").hidden = id !== "";
    setText(byId("experiment-refusal"), "");
    this.#showOne();
    this.panel.scrollTop = 0;
    if (focus) (id ? byId("experiment-back") : (this.#rows.get(before)?.button ?? this.panel)).focus({ preventScroll: !id });
  }

  #showOne() {
    const entry = this.#entries.find(({ id }) => id === this.#chosen);
    const title = byId("experiments-title");
    setText(title, entry?.name ?? "Experiments");
    title.title = entry?.name ?? "";
    if (!this.#chosen) return;
    if (entry) this.one.update(entry, this.store.hello?.read_only ?? false);
    else if (this.#entries.length) this.#choose(""); // its file is gone
  }

  /** @param {ExperimentList} frame */
  #update({ folder, problem, entries }) {
    setText(byId("experiment-problem"), problem);
    byId("experiment-problem").hidden = !problem;
    setText(byId("experiment-reading"), entries === null ? READING : `Files and results are in ${folder}.`);
    byId("experiment-reading").hidden = entries === null && problem !== "";
    this.#entries = entries ?? [];
    const ids = new Set(this.#entries.map(({ id }) => id));
    for (const [id, row] of this.#rows) {
      if (ids.has(id)) continue;
      row.element.remove();
      this.#rows.delete(id);
    }
    this.#entries.forEach((entry, place) => {
      let row = this.#rows.get(entry.id);
      if (!row) this.#rows.set(entry.id, (row = new Row(entry, () => this.#choose(entry.id, true))));
      row.update(entry);
      if (this.list.children[place] !== row.element) this.list.insertBefore(row.element, this.list.children[place] ?? null);
    });
    this.#showOne();
  }
}

/** An experiment in the list; its elements are made once and then changed, so that nothing loses the focus. */
class Row {
  /**
   * @param {ExperimentEntry} entry
   * @param {() => void} click
   */
  constructor(entry, click) {
    this.name = make("strong");
    this.what = make("span", { class: "experiment-what" });
    this.state = make("span", { class: "experiment-state", testid: `experiment-state-${entry.name}` });
    this.button = make(
      "button", { type: "button", class: "experiment-row", testid: `experiment-${entry.name}`, on: { click } },
      this.name, this.state, this.what,
    );
    this.element = make("li", {}, this.button);
  }

  /** @param {ExperimentEntry} entry */
  update(entry) {
    setText(this.name, entry.name);
    setText(this.what, entry.fault || entry.description || (entry.kind === "folder" ? "started from a shell" : ""));
    setText(this.state, briefly(entry));
    setFlag(this.state, "data-state", entry.bad ? "bad" : entry.state);
  }
}

/** The experiment that is chosen. */
class One {
  /** @param {(message: object) => void} send */
  constructor(send) {
    this.send = send;
    this.what = make("p", { class: "experiment-text" });
    this.fault = make("p", { class: "experiment-fault", testid: "experiment-fault" });
    this.state = make("p", { class: "experiment-now", testid: "experiment-now", role: "status" });
    this.bar = make("progress", { "aria-label": "Trials that have ended" });
    this.facts = make("dl", { class: "experiment-facts", testid: "experiment-facts" });
    this.stop = make("button", { type: "button", testid: "experiment-stop", text: "Stop the experiment", on: { click: () => send({ op: "stop", id: this.id }) } });
    this.report = make("a", { class: "experiment-report", testid: "experiment-report", target: "_blank", rel: "noopener", text: "Open the report" });
    const { form, part, seeds, begin } = makeForm(() => this.#hint(), (event) => this.#start(event));
    this.form = form;
    this.part = part;
    this.seeds = seeds;
    this.begin = begin;
    this.rows = make("tbody");
    this.more = make("p", { class: "quiet" });
    this.table = make(
      "div", { class: "experiment-cells", tabindex: "0", role: "region", "aria-label": "Newest results" },
      make("table", { testid: "experiment-cells" },
        make("thead", {}, make("tr", {}, ...HEADS.map((text) => make("th", { text, scope: "col" })))), this.rows),
      this.more,
    );
    this.failures = make("ul", { class: "experiment-failures", "aria-label": "Failures" });
    this.element = make(
      "div", { class: "experiment-body" },
      this.what, this.fault, this.state, this.bar,
      make("div", { class: "experiment-acts" }, this.stop, this.report), this.form, this.facts, this.table, this.failures,
    );
  }

  id = "";
  #entry = /** @type {ExperimentEntry | null} */ (null);
  #shown = "";

  /** @param {Event} event */
  #start(event) {
    event.preventDefault();
    this.send({ op: "start", id: this.id, small: this.part.value === "small", seeds: this.seeds.value.trim() });
  }

  /** Say how many trials a choice means. */
  #hint() {
    if (!this.#entry) return;
    const { seeds, small_seeds } = this.#entry;
    this.seeds.placeholder = `of the file: ${this.part.value === "small" ? small_seeds : seeds}`;
  }

  /**
   * @param {ExperimentEntry} entry
   * @param {boolean} readOnly
   */
  update(entry, readOnly) {
    if (entry.id !== this.id) {
      this.id = entry.id;
      this.seeds.value = "";
      this.part.value = "small";
      this.#shown = "";
    }
    this.#entry = entry;
    const { results, state } = entry;
    setText(this.what, entry.description);
    setText(this.fault, entry.fault);
    setText(this.state, atLength(entry));
    setFlag(this.state, "data-state", entry.bad ? "bad" : state);
    setText(this.part.options[0], `small: ${entry.small_trials} trials`);
    setText(this.part.options[1], `full: ${entry.trials} trials`);
    this.#hint();
    setText(this.begin, state === "stopped" ? "Continue" : "Start");
    this.form.hidden = readOnly || !entry.can_start || state === "running" || state === "elsewhere";
    this.stop.hidden = readOnly || state !== "running";
    this.stop.disabled = entry.stopping;
    this.report.hidden = !entry.report;
    if (entry.report) setFlag(this.report, "href", entry.report);
    this.bar.hidden = !results?.trials;
    if (results?.trials) Object.assign(this.bar, { max: results.trials, value: results.finished });
    this.#results(entry);
  }

  /** @param {ExperimentEntry} entry */
  #results({ results, state }) {
    const text = JSON.stringify([results, state]);
    if (text === this.#shown) return;
    this.#shown = text;
    this.facts.hidden = this.table.hidden = !results?.finished;
    this.failures.hidden = !results?.failures.length;
    if (!results) return;
    const { failed, collisions, unexpected, left_s, older, unreadable } = results;
    const facts = /** @type {[string, string, boolean][]} */ ([
      ["Failed", `${failed}`, failed > 0],
      ["Collisions, not expected", `${unexpected}`, unexpected > 0],
    ]);
    if (collisions > unexpected) facts.push(["Collisions, expected", `${collisions - unexpected}`, false]);
    if (left_s && (state === "running" || state === "elsewhere")) facts.push(["Time left", `about ${span(left_s)}`, false]);
    if (older) facts.push(["Of older settings", `${older} trials, not counted`, false]);
    if (unreadable) facts.push(["Unreadable", `${unreadable} trials`, true]);
    this.facts.replaceChildren(...facts.flatMap(([name, value, bad]) => [
      make("dt", { text: name }), make("dd", { text: value, "data-bad": bad || undefined }),
    ]));
    this.rows.replaceChildren(...results.cells.map(cellRow));
    setText(this.more, results.more_cells ? `and ${results.more_cells} more: see the report` : "");
    this.failures.replaceChildren(...results.failures.map((each) => make("li", { text: each })));
  }
}

/**
 * Make the form that starts an experiment.
 * @param {() => void} changed
 * @param {(event: Event) => void} submit
 */
function makeForm(changed, submit) {
  const part = make(
    "select", { testid: "experiment-part", on: { change: changed } },
    make("option", { value: "small", text: "small" }), make("option", { value: "full", text: "full" }),
  );
  const seeds = make("input", {
    type: "text", testid: "experiment-seeds", inputmode: "numeric", autocomplete: "off", maxlength: "40",
    pattern: "[0-9]+(-[0-9]+)?", title: "A seed or a range: 7, or 0-19",
  });
  const begin = make("button", { type: "submit", class: "start", testid: "experiment-start", text: "Start" });
  const form = make(
    "form", { class: "experiment-form", "aria-label": "Start", on: { submit } },
    make("label", {}, "Part", part), make("label", {}, "Seeds", seeds), begin,
  );
  return { form, part, seeds, begin };
}

/** @param {ExperimentCell} cell */
function cellRow(cell) {
  const { behaviour, scenario, robots, trials, failed, collisions, expected, arrived, words } = cell;
  const bad = failed > 0 || (collisions !== null && collisions > 0 && !expected);
  const counts = failed ? `${trials}, ${failed} failed` : `${trials}`;
  const share = arrived === null ? "–" : `${Math.round(100 * arrived)} %`;
  const cells = [`${robots}`, counts, collisions === null ? "–" : `${collisions}`, share];
  return make(
    "tr", { title: words, "data-bad": bad || undefined },
    make("th", { scope: "row", text: `${behaviour}, ${scenario}` }), ...cells.map((text) => make("td", { text })),
  );
}

/** @param {ExperimentEntry} entry */
function counted({ results }) {
  if (!results) return "";
  return results.trials ? `${results.finished} of ${results.trials} trials` : `${results.finished} trials`;
}

/** @param {ExperimentEntry} entry */
function briefly(entry) {
  const { state, results } = entry;
  if (state === "faulty") return "faulty";
  if (state === "new") return entry.words ? "not run" : "not run yet";
  const word = { running: "running", elsewhere: "running elsewhere", stopped: "stopped", ended: "ended" }[state];
  const trouble = results ? results.failed + results.unexpected : 0;
  return `${word}: ${counted(entry)}${state === "ended" && trouble ? ", with trouble" : ""}`.replace(/: $/, "");
}

/** @param {ExperimentEntry} entry */
function atLength(entry) {
  const { state, by, stopping, words } = entry;
  const count = counted(entry);
  if (state === "running") {
    const begin = stopping ? "Stopping" : `Running, started by ${by}`;
    return count ? `${begin}: ${count}` : `${begin}; the first trial takes up to a minute`;
  }
  if (state === "elsewhere") return `Running, started from a shell: ${count}`;
  const past = words && `It ${words}`;
  if (state === "stopped") return `${past ? `${past}. ` : ""}${count} are kept; "Continue" goes on from there`;
  if (state === "ended") return `${past || "All have ended"}: ${count}`;
  return state === "new" ? past || "Not run yet" : past;
}

/** @param {number} seconds */
function span(seconds) {
  if (seconds < 100) return `${Math.round(seconds)} s`;
  return seconds < 6000 ? `${Math.round(seconds / 60)} min` : `${(seconds / 3600).toFixed(1)} h`;
}
