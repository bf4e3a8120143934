/** What lies under the map: a picture in the swarm's frame, or tiles around the swarm's origin on earth. */

import { byId, setText } from "./dom.js";

/** @import { Box, UnderlayFrame } from "./types.d.ts" */
/** @import { Viewport } from "./viewport.js" */

const TILE_PX = 256;
const MOST_TILES = 64; // drawn at once: a larger screen gets a coarser zoom
const KEPT_TILES = 256;
const CIRCLE_M = 2 * Math.PI * 6378137;
const ALPHA = 0.75;

/** @typedef {{image: HTMLImageElement, ready: boolean, failed: boolean}} Loaded */

export class Underlay {
  /**
   * @param {{store: import("./store.js").Store, map: import("./map.js").SwarmMap}} parts
   */
  constructor({ store, map }) {
    this.store = store;
    this.map = map;
    this.shown = true;
    this.source = /** @type {UnderlayFrame | null} */ (null);
    store.on("underlay", (source) => this.#take(source));
    store.on("world", () => this.#tell());
    byId("layer-underlay").addEventListener("click", () => this.toggle());
  }

  #loaded = /** @type {Map<string, Loaded>} */ (new Map());

  toggle() {
    if (!this.source) return;
    this.shown = !this.shown;
    byId("layer-underlay").setAttribute("aria-pressed", String(this.shown));
    this.map.touch(true);
  }

  /** @param {UnderlayFrame} source */
  #take(source) {
    if (this.source?.address !== source.address) this.#loaded.clear(); // another console, another address
    this.source = source;
    byId("layer-underlay").hidden = false;
    this.#tell();
    this.map.touch(true);
  }

  /** Say what is drawn, and why it cannot be. */
  #tell() {
    const { source } = this;
    if (!source) return;
    const homeless = source.kind === "tiles" && !this.store.origin;
    const words = homeless ? "not drawn: the fleet file has no [world] origin" : source.name;
    byId("layer-underlay").title = words;
    setText(byId("underlay-words"), homeless ? `${source.name}: ${words}` : source.kind === "tiles" ? source.attribution : "");
  }

  /**
   * Draw it; the context counts in metres, y up.
   * @param {CanvasRenderingContext2D} context
   * @param {Viewport} view
   * @param {Box | null} arena
   */
  draw(context, view, arena) {
    const { source } = this;
    if (!source || !this.shown) return;
    context.save();
    context.globalAlpha = ALPHA;
    if (source.kind === "picture") this.#picture(context, source, arena);
    else if (this.store.origin) this.#tiles(context, view, source, this.store.origin);
    context.restore();
  }

  /**
   * @param {CanvasRenderingContext2D} context
   * @param {Extract<UnderlayFrame, {kind: "picture"}>} source
   * @param {Box | null} arena
   */
  #picture(context, source, arena) {
    const loaded = this.#image(`${source.address}picture`);
    const place = source.place ?? (arena && contained(source.width, source.height, arena));
    if (!loaded.ready || !place) return;
    const [cell_m, x_m, y_m, yaw] = place;
    context.translate(x_m, y_m);
    context.rotate(yaw);
    context.imageSmoothingEnabled = true;
    upright(context, loaded.image, 0, 0, source.width * cell_m, source.height * cell_m);
  }

  /**
   * @param {CanvasRenderingContext2D} context
   * @param {Viewport} view
   * @param {Extract<UnderlayFrame, {kind: "tiles"}>} source
   * @param {[number, number]} origin
   */
  #tiles(context, view, source, origin) {
    const wanted = tilesIn(view, origin, source.zooms, window.devicePixelRatio || 1);
    for (const { zoom, column, row, x_m, y_m, size_m } of wanted) {
      const loaded = this.#image(`${source.address}${zoom}/${column}/${row}`);
      if (loaded.ready) upright(context, loaded.image, x_m, y_m, size_m, size_m);
    }
    for (const [address] of this.#loaded) {
      if (this.#loaded.size <= KEPT_TILES) break;
      this.#loaded.delete(address); // the one that was asked for longest ago
    }
  }

  /** @param {string} address */
  #image(address) {
    let loaded = this.#loaded.get(address);
    if (loaded) {
      this.#loaded.delete(address); // to the end: it is in use
    } else {
      const image = new Image();
      loaded = { image, ready: false, failed: false };
      const made = loaded;
      image.onload = () => {
        made.ready = true;
        this.map.touch(true);
      };
      image.onerror = () => (made.failed = true);
      image.src = address;
    }
    this.#loaded.set(address, loaded);
    return loaded;
  }
}

/**
 * Draw a picture whose lower left corner is at (x, y), in a context whose y points up.
 * @param {CanvasRenderingContext2D} context
 * @param {CanvasImageSource} image
 * @param {number} x
 * @param {number} y
 * @param {number} wide
 * @param {number} high
 */
function upright(context, image, x, y, wide, high) {
  context.save();
  context.translate(x, y + high);
  context.scale(1, -1);
  context.drawImage(image, 0, 0, wide, high);
  context.restore();
}

/**
 * Place a picture in the middle of the arena, as large as fits: size of a pixel (m), lower left corner (m), yaw.
 * @param {number} width
 * @param {number} height
 * @param {Box} arena
 * @returns {[number, number, number, number]}
 */
export function contained(width, height, [x0, y0, x1, y1]) {
  const cell_m = Math.min((x1 - x0) / width, (y1 - y0) / height);
  return [cell_m, (x0 + x1 - width * cell_m) / 2, (y0 + y1 - height * cell_m) / 2, 0];
}

/**
 * Return the tiles of Web Mercator that a view shows, with their lower left corner and size in metres from the origin.
 *
 * Mercator's scale is taken as that of the origin: 5 km north of it, at 50 degrees, tiles are 5 m off.
 * @param {Pick<Viewport, "toWorld" | "width" | "height" | "scale">} view
 * @param {[number, number]} origin latitude, longitude, degrees
 * @param {[number, number]} zooms
 * @param {number} dpr
 */
export function tilesIn(view, [latitude_deg, longitude_deg], [lowest, deepest], dpr = 1) {
  const latitude = (latitude_deg * Math.PI) / 180;
  const shrink = Math.cos(latitude); // metres on the ground per metre of the map
  const east = longitude_deg / 360 + 0.5; // of the whole map, from the west
  const south = 0.5 - Math.log(Math.tan(Math.PI / 4 + latitude / 2)) / (2 * Math.PI);
  const [left, top] = view.toWorld(0, 0), [right, bottom] = view.toWorld(view.width, view.height);
  const ideal = Math.log2((CIRCLE_M * shrink * view.scale * dpr) / TILE_PX);
  let zoom = Math.min(deepest, Math.max(lowest, Math.round(ideal)));
  for (; ; zoom -= 1) {
    const size_m = (CIRCLE_M * shrink) / 2 ** zoom, count = 2 ** zoom;
    const column = (/** @type {number} */ x_m) => Math.floor(east * count + x_m / size_m);
    const row = (/** @type {number} */ y_m) => Math.floor(south * count - y_m / size_m);
    const [first, last, upper, lower] = [column(left), column(right), row(top), row(bottom)];
    if ((last - first + 1) * (lower - upper + 1) > MOST_TILES && zoom > lowest) continue;
    const found = [];
    for (let y = Math.max(0, upper); y <= Math.min(count - 1, lower) && found.length < MOST_TILES; y += 1) {
      for (let x = Math.max(0, first); x <= Math.min(count - 1, last) && found.length < MOST_TILES; x += 1) {
        found.push({ zoom, column: x, row: y, x_m: (x - east * count) * size_m, y_m: (south * count - y - 1) * size_m, size_m });
      }
    }
    return found;
  }
}
