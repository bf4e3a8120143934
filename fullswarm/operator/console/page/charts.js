/** Work, coverage and collisions over time. */

import uPlot from "./uplot.js";
import { byId, setText } from "./dom.js";

/** @typedef {{title: string, unit: string, column: number, colour: string[], show: (value: number) => string,
 *   scale: number}} Chart */

/** @type {Chart[]} */
const CHARTS = [
  { title: "Work", unit: "m", column: 1, colour: ["#0072B2", "#56B4E9"], show: (v) => `${v.toFixed(1)} m`, scale: 1 },
  { title: "Coverage", unit: "%", column: 2, colour: ["#00704F", "#2BC493"], show: (v) => `${v.toFixed(1)} %`, scale: 100 },
  { title: "Collisions", unit: "", column: 3, colour: ["#B3470A", "#FF9A5C"], show: (v) => v.toFixed(0), scale: 1 },
];
const EVERY_MS = 500;
const STEPS_S = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600];

export class Charts {
  /**
   * @param {import("./store.js").Store} store
   * @param {import("./theme.js").Theme} theme
   */
  constructor(store, theme) {
    this.store = store;
    this.theme = theme;
    this.plots = /** @type {{chart: Chart, holder: HTMLElement, plot: uPlot}[]} */ ([]);
    this.#box = byId("charts");
    store.on("charts", () => this.#later());
    theme.on("change", () => this.#build());
    new ResizeObserver(() => this.#resize()).observe(this.#box);
    this.#build();
  }

  #box;
  #due = 0;

  #later() {
    if (this.#due) return;
    this.#due = setTimeout(() => {
      this.#due = 0;
      this.#draw();
    }, EVERY_MS);
  }

  #build() {
    for (const { plot } of this.plots) plot.destroy();
    const which = this.theme.dark ? 1 : 0;
    this.plots = CHARTS.map((chart, k) => {
      const holder = /** @type {HTMLElement} */ (this.#box.querySelectorAll(".chart-plot")[k]);
      const here = () => (this.store.still ? "then" : "now");
      return { chart, holder, plot: new uPlot(options(chart, holder, which, here), [[], []], holder) };
    });
    this.#draw();
  }

  #resize() {
    for (const { holder, plot } of this.plots) {
      if (holder.clientWidth) plot.setSize({ width: holder.clientWidth, height: holder.clientHeight });
    }
  }

  #draw() {
    if (!this.#box.clientWidth) return;
    const rows = this.store.charts;
    const last_s = rows.at(-1)?.[0] ?? 0;
    const times = rows.map((row) => row[0] - last_s);
    for (const [k, { chart, plot }] of this.plots.entries()) {
      const values = rows.map((row) => {
        const value = row[chart.column];
        return value === null ? null : value * chart.scale;
      });
      plot.setData([times, values]);
      const newest = values.at(-1);
      const words = typeof newest === "number" ? chart.show(newest) : "no data yet";
      setText(this.#box.querySelectorAll(".chart-value")[k], words);
    }
  }
}

/**
 * @param {Chart} chart
 * @param {HTMLElement} holder
 * @param {number} which
 * @param {() => string} here  what the newest time is called
 * @returns {uPlot.Options}
 */
function options({ unit, colour }, holder, which, here) {
  const ink = which ? "#C3CED8" : "#3C4854";
  const axis = {
    stroke: ink, font: "13px system-ui, sans-serif", grid: { stroke: which ? "#2A343E" : "#E2E6EA", width: 1 },
    ticks: { stroke: which ? "#2A343E" : "#E2E6EA", width: 1, size: 4 },
  };
  return {
    width: Math.max(50, holder.clientWidth), height: Math.max(50, holder.clientHeight),
    legend: { show: false }, cursor: { show: false }, pxAlign: true,
    scales: { x: { time: false }, y: { range: (_plot, low, high) => [0, high > low || high > 0 ? (high ?? 1) * 1.1 : 1] } },
    series: [{}, { stroke: colour[which], width: 2, fill: `${colour[which]}22`, points: { show: false } }],
    axes: [
      { ...axis, size: 28, space: 56, incrs: STEPS_S, values: (_plot, ticks) => ticks.map((tick) => ago(tick, here())) },
      { ...axis, size: 54, space: 24, values: (_plot, ticks) => ticks.map((tick) => `${Number(tick.toPrecision(3))}${unit === "%" ? " %" : ""}`) },
    ],
  };
}

/**
 * @param {number} time_s
 * @param {string} here
 */
function ago(time_s, here) {
  if (time_s === 0) return here;
  return time_s % 60 === 0 ? `${time_s / 60} min` : `${Math.round(time_s)} s`;
}
