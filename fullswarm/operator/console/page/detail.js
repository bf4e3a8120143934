/**
 * The detail pane: one robot, in place of the table of robots. The console sends its frame only while it is open. Its
 * robot is in the page's address, so that a reload and a link show the same.
 */

import uPlot from "./uplot.js";
import { needsAttention } from "./attention.js";
import { byId, Emitter, make, setText } from "./dom.js";
import { sections } from "./facts.js";
import { titleOf } from "./words.js";

/** @import { Detail } from "./types.d.ts" */
/** @import { Section } from "./facts.js" */

const ADDRESS = "robot";
const CHART_PX = 96;
const COLOURS = { speed: ["#0072B2", "#56B4E9"], command: ["#B3470A", "#FF9A5C"], battery: ["#00704F", "#2BC493"] };

/**
 * Emits "chart" with what the person wants to have charted.
 * @extends {Emitter<{chart: import("./series.js").Choice}>}
 */
export class DetailPane extends Emitter {
  /**
   * @param {{store: import("./store.js").Store, present: import("./store.js").Store, link: import("./link.js").Link,
   *   theme: import("./theme.js").Theme}} parts
   */
  constructor({ store, present, link, theme }) {
    super();
    this.store = store;
    this.link = link;
    this.theme = theme;
    this.pane = byId("detail");
    this.robot = new URLSearchParams(location.search).get(ADDRESS) ?? "";
    byId("detail-close").addEventListener("click", () => this.close());
    byId("detail-previous").addEventListener("click", () => this.#step(-1));
    byId("detail-next").addEventListener("click", () => this.#step(1));
    for (const button of /** @type {NodeListOf<HTMLElement>} */ (this.pane.querySelectorAll("[data-chart]"))) {
      button.addEventListener("click", () => this.emit("chart", { of: button.dataset.chart ?? "", robots: [this.robot], group: "" }));
    }
    present.on("detail", (detail) => this.#take(detail));
    for (const topic of /** @type {const} */ (["fleet", "leases", "filter", "world"])) store.on(topic, () => this.#fill());
    link.on("open", () => this.#ask());
    theme.on("change", () => this.#charts());
    new ResizeObserver(() => this.#resize()).observe(byId("detail-body")); // it is shown later than the pane, too
    this.#charts();
    this.#show();
  }

  #detail = /** @type {Detail | null} */ (null);
  #plots = /** @type {{plot: uPlot, holder: HTMLElement}[]} */ ([]);
  #drawnStill = false; // whether the charts are those of the past: empty
  #opener = /** @type {HTMLElement | null} */ (null);

  /** Whether the focus is in it. */
  get focused() {
    return !this.pane.hidden && this.pane.contains(document.activeElement);
  }

  /**
   * Show a robot.
   * @param {string} robot
   */
  open(robot) {
    if (!this.robot && document.activeElement instanceof HTMLElement) this.#opener = document.activeElement;
    if (this.robot !== robot) this.#detail = null;
    this.robot = robot;
    this.#show();
    this.#ask();
    byId("detail-title").focus({ preventScroll: true });
  }

  /** Show the table again; the focus goes back to what opened the pane. */
  close() {
    if (!this.robot) return;
    this.robot = "";
    this.#detail = null;
    this.#show();
    this.#ask();
    this.#opener?.focus({ preventScroll: true });
    this.#opener = null;
  }

  /** @param {1 | -1} step */
  #step(step) {
    const ids = this.store.ids();
    if (!ids.length) return;
    const at = ids.indexOf(this.robot);
    this.robot = ids[(at + step + ids.length) % ids.length];
    this.#detail = null;
    this.#show();
    this.#ask();
  }

  /** What the console sends of the robot is of now: while the past is shown, the pane has what the table has. */
  get #known() {
    return this.store.still ? null : this.#detail;
  }

  #ask() {
    this.link.post({ t: "inspect", robot: this.robot });
  }

  #show() {
    const address = new URL(location.href);
    if (this.robot) address.searchParams.set(ADDRESS, this.robot);
    else address.searchParams.delete(ADDRESS);
    if (address.href !== location.href) history.replaceState(null, "", address);
    this.pane.hidden = !this.robot;
    document.body.dataset.detail = this.robot ? "open" : "";
    setText(byId("detail-title"), this.robot);
    this.#fill();
    this.#draw();
  }

  /** @param {Detail} detail */
  #take(detail) {
    if (detail.robot !== this.robot) return;
    this.#detail = detail;
    this.#fill();
    this.#draw();
  }

  #fill() {
    if (!this.robot) return;
    const { store, robot: id } = this;
    if (this.#drawnStill !== store.still) this.#draw();
    const known = store.fleet.has(id);
    const robot = store.info(id);
    const words = sections({
      robot, detail: this.#known, lease: store.leases.get(id), behaviours: store.behaviours, filter: store.filter.get(id),
    });
    byId("detail-unknown").hidden = known;
    byId("detail-body").hidden = !known;
    const [first, ...others] = words;
    byId("detail-state").classList.toggle("attention", needsAttention(robot));
    renew(byId("detail-state"), JSON.stringify(first), () => [section(first)]);
    renew(byId("detail-facts"), JSON.stringify(others), () => others.map(section));
    const { messages = [], requests = [] } = this.#known ?? {};
    renew(byId("detail-requests"), JSON.stringify(requests), () => requests.map((each) => {
      const outcome = `${each.outcome}${each.reason ? `: ${each.reason}` : ""}`;
      const text = `${titleOf(store.behaviours, each.behaviour)} of ${each.operator}: ${outcome}`;
      return item(each.clock, text, each.code);
    }));
    renew(byId("detail-messages"), JSON.stringify(messages), () => messages.map((each) => item(each.clock, each.text)));
  }

  #charts() {
    for (const { plot } of this.#plots) plot.destroy();
    const which = this.theme.dark ? 1 : 0;
    const [speed, battery] = ["detail-speed", "detail-battery"].map(byId);
    const lines = [{ stroke: COLOURS.command[which], dash: [4, 3] }, { stroke: COLOURS.speed[which] }];
    this.#plots = [
      { holder: speed, plot: new uPlot(options(speed, which, lines, -60), [[], [], []], speed) },
      { holder: battery, plot: new uPlot(options(battery, which, [{ stroke: COLOURS.battery[which] }], -1800), [[], []], battery) },
    ];
    this.#draw();
  }

  #resize() {
    for (const { holder, plot } of this.#plots) if (holder.clientWidth) plot.setSize({ width: holder.clientWidth, height: CHART_PX });
  }

  #draw() {
    const { motion = [], battery = [], turn_rad_s = null, command_rad_s = null } = this.#known ?? {};
    const [speeds, charges] = this.#plots;
    if (!speeds) return;
    this.#drawnStill = this.store.still;
    speeds.plot.setData([motion.map((row) => row[0]), motion.map((row) => row[2]), motion.map((row) => row[1])]);
    charges.plot.setData([battery.map((row) => row[0] / 60), battery.map((row) => 100 * row[1])]);
    byId("detail-battery-figure").hidden = battery.length === 0;
    const newest = motion.at(-1);
    const turn = typeof turn_rad_s === "number" ? `; turns ${turn_rad_s.toFixed(2)} of ${(command_rad_s ?? 0).toFixed(2)} rad/s` : "";
    setText(byId("detail-speed-words"), newest ? `${newest[1].toFixed(2)} m/s, commanded ${newest[2].toFixed(2)} m/s${turn}` : "no data yet");
  }
}

/**
 * Replace what an element shows, only if it changed: a selection of text and the place of the scroll bar stay.
 * @param {HTMLElement} element
 * @param {string} key
 * @param {() => HTMLElement[]} build
 */
function renew(element, key, build) {
  if (element.dataset.shown === key) return;
  element.dataset.shown = key;
  element.replaceChildren(...build());
}

/** @param {Section} given */
function section({ title, rows }) {
  const list = make("dl", { class: "detail-rows" });
  for (const [label, words] of rows) list.append(make("dt", { text: label }), make("dd", { text: words }));
  return make("section", { testid: `detail-${title.toLowerCase().replaceAll(" ", "-")}` }, make("h4", { text: title }), list);
}

/**
 * @param {string} clock
 * @param {string} text
 * @param {string} [code]
 */
function item(clock, text, code) {
  return make("li", {}, make("time", { text: clock }), make("span", { text }), code ? make("code", { text: code }) : "");
}

/**
 * @param {HTMLElement} holder
 * @param {number} which
 * @param {{stroke: string, dash?: number[]}[]} lines
 * @param {number} from_s
 * @returns {uPlot.Options}
 */
function options(holder, which, lines, from_s) {
  const ink = which ? "#C3CED8" : "#3C4854";
  const grid = which ? "#2A343E" : "#E2E6EA";
  const minutes = from_s <= -600;
  const axis = { stroke: ink, font: "12px system-ui, sans-serif", grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1, size: 4 } };
  return {
    width: Math.max(50, holder.clientWidth), height: CHART_PX, legend: { show: false }, cursor: { show: false },
    scales: {
      x: { time: false, range: [minutes ? from_s / 60 : from_s, 0] },
      y: minutes ? { range: [0, 100] } : { range: (_plot, low, high) => [Math.min(0, low ?? 0), Math.max(0.1, (high ?? 0) * 1.1)] },
    },
    series: [{}, ...lines.map((line) => ({ ...line, width: 2, points: { show: false } }))],
    axes: [
      { ...axis, size: 24, space: 60, values: (_plot, ticks) => ticks.map((tick) => (tick === 0 ? "now" : `${tick} ${minutes ? "min" : "s"}`)) },
      { ...axis, size: 44, space: 18, values: (_plot, ticks) => ticks.map((tick) => (minutes ? `${tick} %` : String(Number(tick.toPrecision(2))))) },
    ],
  };
}
