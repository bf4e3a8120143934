/**
 * The charts: any field of robots and any metric of the swarm, as the person has chosen. The choice is in the page's
 * address, so that a reload and a link show the same; the console sends what is shown, and nothing else.
 */

import { byId, setText } from "./dom.js";
import { ChartForm } from "./chartform.js";
import { Plot } from "./plot.js";
import { aboutOf, DEFAULT, format, fromAddress, resolve, toAddress, whoOf } from "./series.js";

/** @import { Catalogue, Rows, Series } from "./types.d.ts" */
/** @import { Choice } from "./series.js" */

const DRAW_MS = 500;
const AGAIN_MS = 500; // between two questions for a moment of the past
const MOST_EARLY = 100; // rows that may come before the whole that they continue

export class Charts {
  /**
   * @param {{store: import("./store.js").Store, present: import("./store.js").Store, link: import("./link.js").Link,
   *   theme: import("./theme.js").Theme, selection: import("./selection.js").Selection, past: import("./past.js").Past}} parts
   */
  constructor({ store, present, link, theme, selection, past }) {
    this.store = store;
    this.link = link;
    this.theme = theme;
    this.selection = selection;
    this.past = past;
    this.catalogue = /** @type {Catalogue} */ ({ t: "catalogue", fields: [], metrics: [], lines: 8, most: 6, seconds: 600 });
    this.choices = fromAddress(location.search);
    this.plots = /** @type {Plot[]} */ ([]);
    this.box = byId("charts");
    this.add = byId("chart-add");
    this.add.addEventListener("click", () => this.#open(null));
    this.form = new ChartForm({ selection, done: (choice) => this.#chosen(choice), remove: () => this.#remove() });
    present.on("catalogue", (catalogue) => this.#learn(catalogue));
    present.on("series", (series) => this.#whole(series));
    present.on("rows", (rows) => this.#rows(rows));
    present.on("study", () => this.#fix());
    for (const topic of /** @type {const} */ (["world", "robots", "fleet"])) store.on(topic, () => this.#ask());
    store.on("states", () => store.still && this.#later());
    link.on("open", () => this.#ask(true));
    past.on("mode", () => this.#ask(true));
    past.on("change", () => this.#follow());
    theme.on("change", () => this.#draw());
    new ResizeObserver(() => this.#resize()).observe(this.box);
    this.#build();
  }

  #due = 0;
  #asked = ""; // the last question, and its number
  #ref = /** @type {number | null} */ (null);
  #asked_ms = 0;
  #order = /** @type {Plot[]} */ ([]); // of the charts in the console's frames
  #series = /** @type {Series | null} */ (null); // the whole that is shown
  #early = /** @type {Rows[]} */ ([]);
  #to_s = 0;
  #fixed = false; // a study shows the same to all

  /** For tests. */
  get shown() {
    return this.plots.map(({ shown }) => shown);
  }

  /**
   * Show one more chart, unless it is there.
   * @param {Choice} choice
   */
  show(choice) {
    this.#bringUp();
    const there = this.choices.findIndex((each) => format(each) === format(choice));
    if (there < 0 && this.choices.length >= this.catalogue.most) return this.#note(`${this.catalogue.most} charts at most: remove or change one`);
    if (there < 0) this.#set([...this.choices, choice]);
    const plot = this.plots[there < 0 ? this.choices.length - 1 : there];
    plot.element.scrollIntoView({ block: "nearest", inline: "nearest" });
    return this.#note(`Charted: ${plot.title}`);
  }

  /** Where there are tabs, show that of the charts; on wide screens put them in place of missions and stick. */
  #bringUp() {
    const tab = /** @type {HTMLElement | null} */ (document.querySelector('#tabs [data-tab="charts"]'));
    if (tab?.checkVisibility()) return tab.click();
    if (document.body.dataset.lower === "missions") byId("missions-toggle").click();
    if (document.body.dataset.drive === "open") byId("drive-toggle").click();
    return undefined;
  }

  // -------------------------------------------------------------- the person's choice
  /** @param {Plot | null} plot  to change; null: another one */
  #open(plot) {
    if (!plot && this.choices.length >= this.catalogue.most) return this.#note(`${this.catalogue.most} charts at most: remove or change one`);
    return this.form.open(this.catalogue, plot ? this.choices[plot.number] : null, plot ? plot.number : -1);
  }

  /** @param {Choice} choice */
  #chosen(choice) {
    const { number } = this.form;
    this.#set(number < 0 ? [...this.choices, choice] : this.choices.map((each, k) => (k === number ? choice : each)));
    const plot = this.plots[number < 0 ? this.plots.length - 1 : number];
    plot.button.focus();
    plot.element.scrollIntoView({ block: "nearest", inline: "nearest" });
  }

  #remove() {
    const { number } = this.form;
    this.#set(this.choices.filter((_choice, k) => k !== number));
    (this.plots[Math.min(number, this.plots.length - 1)]?.button ?? this.add).focus();
  }

  /** @param {Choice[]} choices */
  #set(choices) {
    this.choices = choices;
    history.replaceState(null, "", location.pathname + toAddress(location.search, choices) + location.hash);
    this.#build();
    this.#ask(true);
  }

  #fix() {
    if (this.#fixed) return;
    this.#fixed = true;
    this.choices = [...DEFAULT];
    this.#build();
    this.#ask(true);
  }

  /** @param {string} words */
  #note(words) {
    setText(byId("chart-note"), words);
  }

  // -------------------------------------------------------------- what is shown
  /** @param {Catalogue} catalogue */
  #learn(catalogue) {
    this.catalogue = catalogue;
    this.#name();
    this.#draw();
  }

  #build() {
    for (const plot of this.plots) plot.remove();
    const shown = this.choices.slice(0, this.catalogue.most);
    this.plots = shown.map((_choice, k) => new Plot(k, (plot) => this.#open(plot)));
    this.box.replaceChildren(...this.plots.map(({ element }) => element));
    this.add.hidden = this.#fixed;
    this.#note(this.choices.length > shown.length ? `The address states more charts than ${shown.length}: the others are left out` : "");
    this.#name();
    this.#draw();
  }

  #name() {
    for (const plot of this.plots) {
      const choice = this.choices[plot.number];
      plot.name(aboutOf(this.catalogue, choice.of), whoOf(this.catalogue, choice), this.#fixed);
    }
  }

  #resize() {
    for (const plot of this.plots) plot.resize();
    this.#later();
  }

  #later() {
    if (this.#due) return;
    this.#due = setTimeout(() => {
      this.#due = 0;
      this.#draw();
    }, DRAW_MS);
  }

  #draw() {
    if (!this.box.clientWidth) return;
    const { still, at_s } = this.store;
    for (const plot of this.plots) plot.draw(still ? at_s : this.#to_s, this.catalogue.seconds, this.theme.dark, still ? "then" : "now");
  }

  // -------------------------------------------------------------- the console's frames
  /**
   * Ask for what is shown, if that has changed, or again: after the link was lost, for another moment.
   * @param {boolean} [again]
   */
  #ask(again = false) {
    if (!again && this.#asked && !this.choices.some(({ group }) => group)) return; // only groups change by themselves
    this.#asked_ms = performance.now();
    const groups = this.selection.groups();
    const charts = [];
    this.#order = [];
    for (const plot of this.plots) {
      const { robots, problem } = resolve(this.choices[plot.number], groups);
      if (problem) plot.set({ lines: [], band: false, robots: 0, why: problem, times: [], values: [] });
      else this.#order.push(plot);
      if (!problem) charts.push({ of: this.choices[plot.number].of, robots });
    }
    const at = this.past.live ? null : this.past.at_s;
    const question = JSON.stringify(charts);
    if (!again && question === this.#asked) return;
    const ref = this.link.post({ t: "charts", charts, at }, (answer) => this.#answered(answer));
    if (ref === null) return;
    [this.#asked, this.#ref, this.#early] = [question, ref, []];
    this.#later();
  }

  /** @param {import("./link.js").Answer} answer */
  #answered({ ok, reason = "" }) {
    if (!ok) for (const plot of this.#order) plot.set({ lines: [], band: false, robots: 0, why: reason, times: [], values: [] });
  }

  /** @param {Series} series */
  #whole(series) {
    if (series.ref !== this.#ref) return;
    this.#series = series;
    this.#to_s = series.to ?? 0;
    for (const [k, data] of series.charts.entries()) this.#order[k]?.set(data);
    for (const rows of this.#early.splice(0)) if (rows.number === series.number) this.#append(rows);
    this.#draw();
  }

  /** @param {Rows} rows */
  #rows(rows) {
    if (rows.ref !== this.#ref) return;
    const shown = this.#series?.ref === rows.ref && this.#series.number === rows.number;
    if (!shown) return void (this.#early.length < MOST_EARLY && this.#early.push(rows));
    this.#append(rows);
    this.#later();
  }

  /** @param {Rows} rows */
  #append({ to, charts }) {
    this.#to_s = to;
    for (const [k, each] of charts.entries()) this.#order[k]?.add(each, to - this.catalogue.seconds);
  }

  /** While the past is shown: ask for samples that are not there yet. */
  #follow() {
    if (this.past.live) return;
    const { at = null, to = null, ref } = this.#series ?? {};
    const { at_s } = this.past;
    const here = ref === this.#ref && at !== null && at_s >= at && at_s <= (to ?? -Infinity);
    if (!here && performance.now() - this.#asked_ms >= AGAIN_MS) this.#ask(true);
    this.#later();
  }
}

