/** One chart: its lines, told apart by dashes and names; the values at the cursor; a table of the newest ones to be read out. */

import uPlot from "./uplot.js";
import { make, setFlag, setText } from "./dom.js";
import { LINE_COLOURS } from "./palette.js";
import { figure } from "./series.js";

/** @import { Drawn, About } from "./types.d.ts" */

const STEPS_S = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600];
const DASHES = [[], [7, 4], [2, 3], [10, 3, 2, 3]];
const LABEL_PX = 13; // height of a line's name
const MARGIN_PX = 54; // for the names, right of the lines
const LONGEST = 7;
const STEP = 0.02; // of the time that is shown, by an arrow key

export class Plot {
  /**
   * @param {number} number  of the chart, from 0
   * @param {(plot: Plot) => void} onChange  called when the person wants to change this chart
   */
  constructor(number, onChange) {
    this.number = number;
    this.title = "";
    this.heading = make("strong", { class: "chart-heading" });
    this.value = make("span", { class: "chart-value", testid: `chart-value-${number}` });
    this.button = make("button", { type: "button", class: "chart-title", testid: `chart-title-${number}`, on: { click: () => onChange(this) } }, this.heading, this.value);
    this.holder = make("div", {
      class: "chart-plot", role: "slider", tabindex: 0, testid: `chart-plot-${number}`, "aria-valuemin": 0, "aria-valuemax": 0, "aria-valuenow": 0,
      on: { keydown: (event) => this.#key(/** @type {KeyboardEvent} */ (event)), blur: () => this.#point(null) },
    });
    this.why = make("p", { class: "chart-why", testid: `chart-why-${number}` });
    this.tip = make("div", { class: "chart-tip", testid: `chart-tip-${number}`, "aria-hidden": "true", hidden: true });
    this.table = make("table", { class: "spoken", testid: `chart-table-${number}` });
    const frame = make("div", { class: "chart-frame" }, this.holder, this.tip, this.why);
    this.element = make("figure", { class: "chart", testid: `chart-${number}` }, make("figcaption", {}, this.button), frame, this.table);
    this.data = /** @type {Drawn} */ ({ lines: [], band: false, robots: 0, why: "", times: [], values: [] });
    this.about = /** @type {About} */ ({ name: "", title: "", unit: "", doc: "", scale: 1 });
  }

  #plot = /** @type {uPlot | null} */ (null);
  #drawnAs = ""; // what the lines of the plot were made for
  #dark = false;
  #now = "now";
  #drawn = /** @type {{times: (number | null)[], values: (number | null)[][]}} */ ({ times: [], values: [] });
  #pointed = /** @type {number | null} */ (null); // seconds before the end that the cursor is at, by keys

  /** What is drawn, for tests: times in s of the console's clock, values in the unit. */
  get shown() {
    const { lines, why } = this.data;
    return { of: this.about.name, title: this.title, unit: this.about.unit, lines, ...this.#drawn, why: this.why.hidden ? "" : why };
  }

  /**
   * Show what it is of.
   * @param {About} about
   * @param {string} who
   * @param {boolean} fixed
   */
  name(about, who, fixed) {
    this.about = about;
    this.title = who ? `${about.title} · ${who}` : about.title;
    setText(this.heading, this.title);
    this.heading.title = `${this.title}: ${about.doc}`;
    this.button.disabled = fixed;
    setFlag(this.holder, "aria-label", `${this.title} over time`);
  }

  /** @param {Drawn} data */
  set(data) {
    this.data = data;
  }

  /**
   * Add newer samples, and drop those that are too old.
   * @param {{times: number[], values: (number | null)[][]}} rows
   * @param {number} from_s
   */
  add({ times, values }, from_s) {
    const { data } = this;
    data.times.push(...times);
    for (const [k, line] of data.values.entries()) line.push(...(values[k] ?? []));
    const old = data.times.findIndex((time) => time > from_s);
    if (old > 0) for (const each of [data.times, ...data.values]) each.splice(0, old);
  }

  /**
   * Draw up to a moment.
   * @param {number} end_s
   * @param {number} long_s
   * @param {boolean} dark
   * @param {string} now  what the newest time is called
   */
  draw(end_s, long_s, dark, now) {
    this.#now = now;
    const { lines, why, times } = this.data;
    const first = times.findIndex((time) => time > end_s - long_s);
    let last = times.length;
    while (last > 0 && times[last - 1] > end_s) last -= 1;
    const cut = (/** @type {(number | null)[]} */ line) => (first < 0 ? [] : line.slice(first, last));
    const values = this.#scaled().map(cut);
    this.#drawn = { times: cut(times), values };
    const known = values.some((line) => line.some((value) => value !== null));
    this.why.hidden = known;
    setText(this.why, why || "no data yet");
    this.holder.hidden = !known;
    this.#words(values, known);
    if (!known || !this.holder.clientWidth) return;
    this.#build(dark);
    const seconds = this.#drawn.times.map((time) => /** @type {number} */ (time) - end_s);
    this.#plot?.setData(/** @type {uPlot.AlignedData} */ ([seconds, ...values]));
    setFlag(this.holder, "aria-valuemin", Math.round(seconds[0] ?? 0));
    if (this.#pointed !== null) this.#point(this.#pointed);
    else if (lines.length) this.#tell();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.holder;
    if (this.#plot && width && (width !== this.#plot.width || height !== this.#plot.height)) this.#plot.setSize({ width, height });
  }

  remove() {
    this.#plot?.destroy();
    this.element.remove();
  }

  #scaled() {
    const { scale } = this.about;
    const { values } = this.data;
    return scale === 1 ? values : values.map((line) => line.map((value) => (value === null ? null : Number((value * scale).toPrecision(12)))));
  }

  /**
   * The newest values: beside the title in short, and all of them in the table.
   * @param {(number | null)[][]} values
   * @param {boolean} known
   */
  #words(values, known) {
    const { unit } = this.about;
    const newest = values.map((line) => line.at(-1));
    const numbers = newest.filter((value) => typeof value === "number");
    const [least, most] = [Math.min(...numbers), Math.max(...numbers)];
    let words = known ? "unknown now" : "";
    if (this.data.band && numbers.length) words = `median ${figure(newest[1], unit)}`;
    else if (numbers.length) words = figure(least, "") === figure(most, "") ? figure(most, unit) : `${figure(least, "")} to ${figure(most, unit)}`;
    setText(this.value, words);
    const rows = this.data.lines.map((line, k) => [this.#lineName(line), figure(newest[k], unit)]);
    const text = JSON.stringify([this.title, known ? rows : []]);
    if (this.table.dataset.shown === text) return;
    this.table.dataset.shown = text;
    const caption = make("caption", { text: `${this.title}: newest values` });
    const lines = known ? rows.map(([name, value]) => make("tr", {}, make("th", { scope: "row", text: name }), make("td", { text: value }))) : [];
    this.table.replaceChildren(caption, make("tbody", {}, ...lines));
  }

  /** @param {string} line */
  #lineName(line) {
    return this.data.band ? `${line} of ${this.data.robots}` : line;
  }

  /** @param {boolean} dark */
  #build(dark) {
    const { lines, band } = this.data;
    const { unit } = this.about;
    const key = JSON.stringify([lines, band, unit, dark]);
    if (this.#plot && this.#drawnAs === key) return;
    this.#plot?.destroy();
    [this.#drawnAs, this.#dark] = [key, dark];
    this.#plot = new uPlot(this.#options(), /** @type {uPlot.AlignedData} */ ([[], ...lines.map(() => [])]), this.holder);
  }

  /** @returns {uPlot.Options} */
  #options() {
    const { lines, band } = this.data;
    const { unit } = this.about;
    const colours = LINE_COLOURS[this.#dark ? "dark" : "light"];
    const [ink, grid] = this.#dark ? ["#C3CED8", "#2A343E"] : ["#3C4854", "#E2E6EA"];
    const axis = { stroke: ink, font: "13px system-ui, sans-serif", grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1, size: 4 } };
    const single = lines.length === 1;
    const series = lines.map((_line, k) => {
      const colour = colours[(band ? 0 : single ? this.number : k) % colours.length];
      const dash = DASHES[(band ? (k === 1 ? 0 : 1) : k) % DASHES.length];
      return { stroke: colour, width: band && k !== 1 ? 1 : 2, dash, points: { show: false }, ...(single ? { fill: `${colour}22` } : {}) };
    });
    return {
      width: Math.max(50, this.holder.clientWidth), height: Math.max(50, this.holder.clientHeight), pxAlign: true,
      legend: { show: false }, padding: [6, single ? 20 : MARGIN_PX, 0, 0],
      cursor: { x: true, y: false, drag: { x: false, y: false }, points: { size: 6 } },
      scales: { x: { time: false }, y: { range: (_plot, low, high) => range(low, high) } },
      series: [{}, ...series],
      bands: band ? [{ series: [3, 1], fill: `${colours[0]}2E` }] : [],
      axes: [
        { ...axis, size: 28, space: 56, incrs: STEPS_S, values: (_plot, ticks) => ticks.map((tick) => ago(tick, this.#now)) },
        { ...axis, size: 54, space: 24, values: (_plot, ticks) => ticks.map((tick) => `${Number(tick.toPrecision(3))}${unit === "%" ? " %" : ""}`) },
      ],
      hooks: { draw: single ? [] : [(plot) => this.#labels(plot, ink)], setCursor: [() => this.#tell()] },
    };
  }

  /**
   * Write each line's name at its end; names that would overlap go apart.
   * @param {uPlot} plot
   * @param {string} ink
   */
  #labels(plot, ink) {
    const { ctx, bbox } = plot;
    const ratio = devicePixelRatio;
    const high = LABEL_PX * ratio;
    const names = /** @type {{text: string, y: number}[]} */ ([]);
    for (const [k, line] of this.data.lines.entries()) {
      const value = plot.data[k + 1]?.at(-1);
      if (typeof value === "number") names.push({ text: line.length > LONGEST ? `${line.slice(0, LONGEST - 1)}…` : line, y: plot.valToPos(value, "y", true) });
    }
    names.splice(Math.max(1, Math.floor(bbox.height / high) + 1)); // the cursor names all of them
    names.sort((one, other) => one.y - other.y);
    for (const [k, each] of names.entries()) if (k > 0) each.y = Math.max(each.y, names[k - 1].y + high);
    let most = bbox.top + bbox.height + high / 2;
    for (const each of names.reverse()) {
      each.y = Math.min(each.y, most);
      most = each.y - high;
    }
    ctx.save();
    Object.assign(ctx, { fillStyle: ink, font: `${12 * ratio}px system-ui, sans-serif`, textAlign: "left", textBaseline: "middle" });
    for (const { text, y } of names) ctx.fillText(text, bbox.left + bbox.width + 4 * ratio, y);
    ctx.restore();
  }

  /** Show the values at the cursor, and without one none; a reader of screens is told them, else the newest. */
  #tell() {
    const plot = this.#plot;
    const times = plot?.data[0] ?? [];
    if (!plot || !times.length) return;
    const at = plot.cursor.idx ?? null;
    const pointed = at !== null && (plot.cursor.left ?? -1) >= 0;
    const place = pointed ? at : times.length - 1;
    const when = ago(Math.round(times[place] * 2) / 2, this.#now);
    const rows = this.data.lines.map((line, k) => [this.#lineName(line), figure(plot.data[k + 1][place], this.about.unit)]);
    setFlag(this.holder, "aria-valuenow", Math.round(times[place]));
    setFlag(this.holder, "aria-valuetext", `${when}: ${rows.map((row) => (rows.length === 1 ? row[1] : row.join(" "))).join(", ")}`);
    this.tip.hidden = !pointed;
    if (!pointed) return;
    const colours = LINE_COLOURS[this.#dark ? "dark" : "light"];
    this.tip.replaceChildren(
      make("strong", { text: when }),
      ...rows.map(([name, value], k) => {
        const key = make("i", { class: "chart-key" });
        key.style.borderTopColor = colours[(this.data.band ? 0 : rows.length === 1 ? this.number : k) % colours.length];
        key.dataset.dash = String((this.data.band ? (k === 1 ? 0 : 1) : k) % DASHES.length);
        return make("span", {}, key, rows.length === 1 ? value : `${name} ${value}`);
      }),
    );
    this.tip.dataset.side = (plot.cursor.left ?? 0) > plot.bbox.width / devicePixelRatio / 2 ? "left" : "right";
  }

  /**
   * Put the cursor so many seconds before the end; null: nowhere.
   * @param {number | null} seconds
   */
  #point(seconds) {
    this.#pointed = seconds;
    const plot = this.#plot;
    if (!plot) return;
    const times = plot.data[0];
    // What was the oldest time has left the chart by now.
    const shown = seconds === null || !times.length ? null : Math.min(times[times.length - 1], Math.max(times[0], seconds));
    plot.setCursor(shown === null ? { left: -10, top: -10 } : { left: Math.max(0, plot.valToPos(shown, "x")), top: 10 });
  }

  /** @param {KeyboardEvent} event */
  #key(event) {
    const times = this.#plot?.data[0] ?? [];
    if (!times.length || event.shiftKey || event.ctrlKey || event.altKey) return;
    const step = Math.max(1, Math.round(times.length * STEP));
    const here = this.#pointed ?? 0;
    const place = times.findIndex((time) => time >= here);
    const at = place < 0 ? times.length - 1 : place;
    const to = { ArrowLeft: at - step, ArrowDown: at - step, ArrowRight: at + step, ArrowUp: at + step, Home: 0, End: times.length - 1 }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    this.#point(times[Math.min(times.length - 1, Math.max(0, to))]);
  }
}

/**
 * From zero where all values are above it; with some room around them.
 * @param {number | null} low
 * @param {number | null} high
 * @returns {[number, number]}
 */
function range(low, high) {
  const [least, most] = [low ?? 0, high ?? 0];
  if (least >= 0) return [0, most > 0 ? most * 1.1 : 1];
  const room = 0.1 * (most - least || Math.abs(least));
  return [least - room, most + room];
}

/**
 * @param {number} time_s
 * @param {string} now
 */
function ago(time_s, now) {
  if (time_s === 0) return now;
  return time_s % 60 === 0 ? `${time_s / 60} min` : `${Math.round(time_s)} s`;
}
