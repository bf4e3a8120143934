/**
 * A camera's picture under the map, drawn to scale. The console sends where a grid of its points lies on the floor; the
 * lens's distortion and the camera's tilt are in that grid, so nothing of a lens is known here.
 */

import { byId, make, setText } from "./dom.js";

/** @import { Laid } from "./floorworker.js" */
/** @import { Camera, Picture } from "./types.d.ts" */

const OLD_MS = 2000; // an older picture is not drawn: robots have moved on
const LOOK_MS = 500;

export class FloorPicture {
  /**
   * @param {{store: import("./store.js").Store, map: import("./map.js").SwarmMap, past: import("./past.js").Past,
   *   onChange: () => void}} parts  onChange: whether pictures are wanted may have changed
   */
  constructor({ store, map, past, onChange }) {
    this.map = map;
    this.past = past;
    this.camera = ""; // whose picture is drawn; empty: none
    this.choice = /** @type {HTMLSelectElement} */ (byId("camera-under"));
    this.plane = /** @type {HTMLSelectElement} */ (byId("camera-plane"));
    this.opacity = /** @type {HTMLInputElement} */ (byId("camera-opacity"));
    this.choice.addEventListener("change", () => {
      this.camera = this.choice.value;
      this.#clear();
      onChange();
    });
    this.plane.addEventListener("change", () => this.#newest && this.#take(this.#newest));
    this.opacity.addEventListener("input", () => this.map.touch(true));
    store.on("cameras", (cameras) => this.#offer(cameras));
    store.on("picture", (picture) => this.#take(picture));
    past.on("mode", () => (this.#tell(), this.map.touch(true)));
    setInterval(() => this.#look(), LOOK_MS);
    this.#tell();
  }

  #newest = /** @type {Picture | null} */ (null);
  #laid = /** @type {Laid | null} */ (null);
  #laid_ms = -Infinity; // when `#laid` was made
  #take_ms = 0; // of the page, for the newest picture
  #shown = false;
  #worker = /** @type {Worker | null} */ (null);
  #job = /** @type {{camera: string, plane: string} | null} */ (null); // what the worker lays now

  /** @param {Camera[]} cameras */
  #offer(cameras) {
    const names = cameras.map(({ name }) => name);
    if (JSON.stringify(names) === JSON.stringify([...this.choice.options].slice(1).map(({ value }) => value))) return;
    this.choice.replaceChildren(make("option", { value: "", text: "no picture" }), ...names.map((name) => make("option", { value: name, text: name })));
    this.choice.value = names.includes(this.camera) ? this.camera : "";
  }

  #clear() {
    this.#newest = null;
    this.#forget();
    this.#look();
  }

  #forget() {
    this.#laid?.image.close();
    this.#laid = null;
    this.#laid_ms = -Infinity;
  }

  /** Draw no picture that is old: robots have moved on. */
  #look() {
    const shown = this.camera !== "" && performance.now() - this.#laid_ms < OLD_MS;
    if (shown !== this.#shown) this.map.touch(true);
    this.#shown = shown;
    this.#tell();
  }

  #tell() {
    const { mesh } = this.#newest ?? {};
    const why = !this.past.live ? "pictures are not kept"
      : !this.#newest ? "it has sent none yet" : !mesh ? "it is not known where the camera looks now" : "it sends none that can be drawn";
    setText(byId("camera-floor-words"), !this.camera || (this.#shown && this.past.live) ? "" : `Not drawn: ${why}.`);
    setText(this.plane.options[1], mesh ? `robots' tags, ${mesh.tops_m.toFixed(2)} m up` : "robots' tags");
  }

  /**
   * Take in a picture; one that comes while another one is laid is left out.
   * @param {Picture} picture
   */
  #take(picture) {
    if (picture.camera !== this.camera) return;
    const began_ms = performance.now();
    this.#newest = picture;
    if (picture.mesh && !this.#job) {
      this.#job = { camera: this.camera, plane: this.plane.value };
      this.#started().postMessage({ jpeg: picture.jpeg, mesh: picture.mesh, height_m: this.plane.value === "tops" ? picture.mesh.tops_m : 0 });
    }
    this.#take_ms = performance.now() - began_ms;
  }

  /** Return the worker; it is made with the first picture, since few pages want one. */
  #started() {
    if (this.#worker) return this.#worker;
    const worker = new Worker(new URL("./floorworker.js", import.meta.url), { type: "module" });
    worker.addEventListener("message", ({ data }) => this.#taken(data));
    worker.addEventListener("error", () => (this.#job = this.#worker = null)); // the next picture makes another one
    return (this.#worker = worker);
  }

  /** @param {Laid | null} laid */
  #taken(laid) {
    const job = this.#job;
    this.#job = null;
    if (laid && job?.camera === this.camera) {
      this.#forget();
      [this.#laid, this.#laid_ms] = [laid, performance.now()];
    } else laid?.image.close();
    if (this.#newest && job?.plane !== this.plane.value) this.#take(this.#newest);
    this.map.touch(true);
    this.#look();
  }

  /** For tests: what is drawn, and how long the newest picture has taken, in the page and beside it. */
  seen() {
    const { cell_m = null, work_ms = null } = this.#laid ?? {};
    return { camera: this.camera, shown: this.#shown && this.past.live, cell_m, work_ms, page_ms: this.#take_ms };
  }

  /**
   * Draw it; the context counts in metres, y up.
   * @param {CanvasRenderingContext2D} context
   */
  draw(context) {
    if (!this.#shown || !this.#laid || !this.past.live) return;
    const { image, left, top, width, height, cell_m } = this.#laid;
    context.save();
    context.globalAlpha = Number(this.opacity.value) / 100;
    context.translate(left, top);
    context.scale(1, -1);
    context.drawImage(image, 0, 0, width * cell_m, height * cell_m);
    context.restore();
  }
}
