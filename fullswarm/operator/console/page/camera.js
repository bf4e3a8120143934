/** The cameras that see the robots: their pictures, with what they have found drawn in. Sent only to pages that show one. */

import { byId, make, setFlag, setText } from "./dom.js";
import { FloorPicture } from "./floorpicture.js";

/** @import { Camera } from "./types.d.ts" */

export class CameraView {
  /**
   * @param {{store: import("./store.js").Store, link: import("./link.js").Link, map: import("./map.js").SwarmMap,
   *   past: import("./past.js").Past}} parts
   */
  constructor({ store, link, map, past }) {
    this.link = link;
    this.floor = new FloorPicture({ store, map, past, onChange: () => void this.#watch() });
    map.picture = this.floor;
    this.toggle = byId("camera-toggle");
    this.panel = byId("camera-panel");
    this.list = byId("camera-list");
    this.toggle.addEventListener("click", () => this.#open(this.panel.hidden));
    byId("camera-close").addEventListener("click", () => this.#close());
    for (const id of ["tabs", "time-more", "people", "experiments-toggle"]) byId(id).addEventListener("click", () => this.#open(false)); // its place
    store.on("cameras", (cameras) => this.#update(cameras));
    store.on("picture", ({ camera, jpeg }) => this.#show(camera, jpeg));
    // A new connection knows nothing of what was open.
    store.on("hello", () => {
      this.#watching = false;
      void this.#watch();
    });
  }

  #figures = /** @type {Map<string, {element: HTMLElement, image: HTMLImageElement, awaited: HTMLElement, words: HTMLElement}>} */ (new Map());

  #watching = false;

  /** @param {boolean} open */
  #open(open) {
    if (open === !this.panel.hidden) return;
    const others = document.querySelectorAll(".time-panel:not([hidden], .camera-panel) [id$='-close']");
    if (open) for (const close of others) if (close instanceof HTMLElement) close.click(); // they have the same place
    this.panel.hidden = !open;
    setFlag(this.toggle, "aria-expanded", open);
    const more = byId("tool-more");
    if (more.getAttribute("aria-expanded") === "true") more.click(); // the menu lies over the map
    if (open) byId("camera-close").focus({ preventScroll: true });
    void this.#watch();
    if (!open) for (const name of this.#figures.keys()) this.#picture(name, null);
  }

  /** Close it by its button, and give the focus back to what opens it. */
  #close() {
    this.#open(false);
    (this.toggle.offsetParent ? this.toggle : byId("tool-more")).focus(); // it may be in a menu that is folded
  }

  /** Have the console send pictures as long as they are shown, here or under the map. */
  async #watch() {
    const on = !this.panel.hidden || this.floor.camera !== "";
    if (on === this.#watching) return;
    this.#watching = on;
    const answer = await this.link.ask({ t: "watch", on });
    setText(byId("camera-refusal"), on && !answer.ok ? answer.reason ?? "" : "");
  }

  /** @param {Camera[]} cameras */
  #update(cameras) {
    this.toggle.hidden = !cameras.length;
    for (const { name, problem } of cameras) {
      const { element, words } = this.#figure(name);
      setText(words, problem);
      setFlag(element, "data-bad", problem !== "");
    }
    setFlag(this.toggle, "data-bad", cameras.some(({ problem }) => problem !== ""));
  }

  /**
   * @param {string} camera
   * @param {string} jpeg
   */
  #show(camera, jpeg) {
    if (!this.panel.hidden) this.#picture(camera, `data:image/jpeg;base64,${jpeg}`);
  }

  /**
   * Show a picture; null: say that none has come yet, as browsers show an image without one as a broken one.
   * @param {string} camera
   * @param {string | null} url
   */
  #picture(camera, url) {
    const { image, awaited } = this.#figure(camera);
    image.hidden = !url;
    awaited.hidden = Boolean(url);
    if (url) image.src = url;
    else image.removeAttribute("src");
  }

  /** @param {string} name */
  #figure(name) {
    let figure = this.#figures.get(name);
    if (!figure) {
      const image = make("img", { alt: `Picture of camera ${name}`, testid: `camera-${name}`, hidden: true });
      const awaited = make("p", { class: "camera-awaited", text: "No picture yet." });
      const words = make("span", { class: "camera-problem", role: "status" });
      const element = make("figure", {}, image, awaited, make("figcaption", {}, make("strong", { text: name }), " ", words));
      figure = { element, image, awaited, words };
      this.#figures.set(name, figure);
      this.list.append(element);
    }
    return figure;
  }
}
