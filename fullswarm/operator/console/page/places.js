/** Places on the map that all consoles share: their list, keeping a new one, and how they are drawn. */

import { byId, make, setText } from "./dom.js";
import { makeField } from "./field.js";
import { parseEntry } from "./forms.js";
import { nameProblem } from "./groups.js";

/** @import { Scene } from "./ground.js" */
/** @import { Answer } from "./link.js" */
/** @import { Place, Point } from "./types.d.ts" */

const MARK_PX = 6;

const WHERE = {
  point: { type: "point", label: "Where", doc: "x, y in metres", required: true },
  area: { type: "points", label: "Corners", doc: "two opposite corners, or all corners in order", required: true },
};

export class Places {
  /**
   * @param {{store: import("./store.js").Store, selection: import("./selection.js").Selection,
   *   commands: import("./commands.js").Commands, tools: import("./tools.js").Tools}} parts
   */
  constructor({ store, selection, commands, tools }) {
    this.store = store;
    this.selection = selection;
    this.commands = commands;
    this.tools = tools;
    this.name = /** @type {HTMLInputElement} */ (byId("place-name"));
    this.kind = /** @type {HTMLSelectElement} */ (byId("place-kind"));
    this.kind.addEventListener("change", () => this.#points());
    byId("place-form").addEventListener("submit", (event) => void this.#keep(event));
    store.on("world", () => this.#list());
    selection.on("change", () => this.#list());
    this.#points();
    this.#list();
  }

  #shown = "";
  #field = /** @type {import("./field.js").Field | null} */ (null);

  #list() {
    const places = Object.entries(this.store.places);
    const count = this.selection.list().length;
    const shown = JSON.stringify([places, count]);
    if (shown === this.#shown) return;
    this.#shown = shown;
    setText(byId("places-count"), places.length ? `(${places.length})` : "");
    const items = places.map(([name, place]) => this.#item(name, place, count));
    const empty = make("li", { class: "empty", text: "None yet: name a point or an area, and pick it on the map." });
    byId("place-list").replaceChildren(...(items.length ? items : [empty]));
  }

  /**
   * @param {string} name
   * @param {Place} place
   * @param {number} count of the selected robots
   */
  #item(name, place, count) {
    const go = make("button", {
      type: "button", class: "small", text: "Send here", testid: `place-go-${name}`, disabled: count === 0,
      title: count ? `Send ${count} selected to ${name}` : "Select robots first",
      on: { click: () => void this.commands.goal(this.selection.list(), middle(place)) },
    });
    const away = make("button", {
      type: "button", class: "small", text: "×", testid: `place-delete-${name}`, "aria-label": `Delete the place ${name}`, title: `Delete the place ${name}`,
      on: { click: () => void this.#delete(name) },
    });
    const words = make("span", { class: "quiet", text: placeWords(place) });
    return make("li", { testid: `place-${name}` }, make("strong", { text: name }), words, go, away);
  }

  #points() {
    const parameter = WHERE[/** @type {"point" | "area"} */ (this.kind.value)];
    this.#field = makeField("points", parameter, (onPoint, points) => this.tools.pick(points, onPoint));
    byId("place-points").replaceChildren(this.#field.element);
  }

  /** @param {SubmitEvent} event */
  async #keep(event) {
    event.preventDefault();
    const kind = /** @type {"point" | "area"} */ (this.kind.value);
    const name = this.name.value.trim();
    const parsed = parseEntry(this.#field?.entry() ?? "", WHERE[kind]);
    this.#field?.showError(parsed.ok ? "" : parsed.reason);
    const problem = nameProblem(name, [], "place");
    if (problem) return this.#problem(problem);
    if (!parsed.ok) return this.#field?.focus();
    const points = /** @type {Point[]} */ (kind === "point" ? [parsed.value] : parsed.value);
    const answer = await this.commands.keep("save", "place", name, { kind, points });
    if (!answer.ok) return this.#problem(answer.reason ?? "not kept");
    this.name.value = "";
    this.#problem("");
    if (this.tools.mode === "pick") this.tools.use("select");
    return this.#points();
  }

  /** @param {string} name */
  async #delete(name) {
    const answer = await this.commands.keep("delete", "place", name);
    this.#problem(answer.ok ? "" : answer.reason ?? "not deleted");
  }

  /** @param {string} words */
  #problem(words) {
    setText(byId("place-problem"), words);
    this.name.setAttribute("aria-invalid", String(Boolean(words)));
  }
}

/**
 * Return the middle of a place.
 * @param {{points: Point[]}} place
 * @returns {Point}
 */
export function middle({ points }) {
  const [x0, y0, x1, y1] = box(points);
  return [(x0 + x1) / 2, (y0 + y1) / 2];
}

/**
 * Return the corners of an area, all in order.
 * @param {Point[]} points
 * @returns {Point[]}
 */
export function corners(points) {
  if (points.length !== 2) return points;
  const [x0, y0, x1, y1] = box(points);
  return [[x0, y0], [x1, y0], [x1, y1], [x0, y1]];
}

/**
 * Return what a place can be for a parameter: in words, and its points.
 * @param {Record<string, Place>} places
 * @param {boolean} many
 * @returns {{words: string, points: Point[]}[]}
 */
export function choices(places, many) {
  return Object.entries(places).flatMap(([name, place]) => {
    if (!many) return [{ words: name, points: [middle(place)] }];
    if (place.kind === "point") return [{ words: name, points: place.points }];
    const [x0, y0, x1, y1] = box(place.points);
    return [
      { words: `${name}: two opposite corners`, points: /** @type {Point[]} */ ([[x0, y0], [x1, y1]]) },
      { words: `${name}: all corners`, points: corners(place.points) },
    ];
  });
}

/** @param {Point[]} points */
function box(points) {
  const xs = points.map(([x]) => x), ys = points.map(([, y]) => y);
  return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
}

/** @param {Place} place */
function placeWords({ kind, points }) {
  const [x0, y0, x1, y1] = box(points);
  if (kind === "point") return `${x0.toFixed(2)}, ${y0.toFixed(2)}`;
  const more = points.length > 2 ? `, ${points.length} corners` : "";
  return `${(x1 - x0).toFixed(1)} × ${(y1 - y0).toFixed(1)} m${more}`;
}

/**
 * Draw the places, below the robots; CSS pixels.
 * @param {Scene} scene
 */
export function drawPlaces({ context, view, dpr, colours, store }) {
  context.setTransform(dpr, 0, 0, dpr, 0, 0);
  context.font = "600 13px system-ui, sans-serif";
  context.lineWidth = 2;
  context.strokeStyle = colours.goal;
  for (const [name, place] of Object.entries(store.places)) {
    const [x, y] = view.toScreen(...middle(place));
    context.beginPath();
    if (place.kind === "point") {
      context.moveTo(x, y - MARK_PX);
      for (const [dx, dy] of [[MARK_PX, 0], [0, MARK_PX], [-MARK_PX, 0]]) context.lineTo(x + dx, y + dy);
    } else for (const [px, py] of corners(place.points)) context.lineTo(...view.toScreen(px, py));
    context.closePath();
    context.setLineDash(place.kind === "area" ? [8, 5] : []);
    context.stroke();
    const wide = context.measureText(name).width;
    context.fillStyle = colours.ink;
    context.fillText(name, x - wide / 2, place.kind === "point" ? y - MARK_PX - 5 : y + 4);
  }
  context.setLineDash([]);
}
