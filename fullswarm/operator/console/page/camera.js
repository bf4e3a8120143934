/** The cameras that see the robots: their pictures, with what they have found drawn in. Sent only while it is open. */

import { byId, make, setFlag, setText } from "./dom.js";

/** @import { Camera } from "./types.d.ts" */

export class CameraView {
  /** @param {{store: import("./store.js").Store, link: import("./link.js").Link}} parts */
  constructor({ store, link }) {
    this.link = link;
    this.toggle = byId("camera-toggle");
    this.panel = byId("camera-panel");
    this.list = byId("camera-list");
    this.toggle.addEventListener("click", () => this.#open(this.panel.hidden));
    byId("camera-close").addEventListener("click", () => (this.#open(false), this.toggle.focus()));
    store.on("cameras", (cameras) => this.#update(cameras));
    store.on("picture", ({ camera, jpeg }) => this.#show(camera, jpeg));
    // A new connection knows nothing of what was open.
    store.on("hello", () => !this.panel.hidden && this.#watch(true));
  }

  #figures = /** @type {Map<string, {element: HTMLElement, image: HTMLImageElement, words: HTMLElement}>} */ (new Map());

  /** @param {boolean} open */
  #open(open) {
    this.panel.hidden = !open;
    setFlag(this.toggle, "aria-pressed", open);
    this.#watch(open);
    if (!open) for (const { image } of this.#figures.values()) image.removeAttribute("src");
  }

  /** @param {boolean} on */
  async #watch(on) {
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
    if (!this.panel.hidden) this.#figure(camera).image.src = `data:image/jpeg;base64,${jpeg}`;
  }

  /** @param {string} name */
  #figure(name) {
    let figure = this.#figures.get(name);
    if (!figure) {
      const image = make("img", { alt: `Picture of camera ${name}`, testid: `camera-${name}` });
      const words = make("span", { class: "camera-problem", role: "status" });
      const element = make("figure", {}, image, make("figcaption", {}, make("strong", { text: name }), " ", words));
      figure = { element, image, words };
      this.#figures.set(name, figure);
      this.list.append(element);
    }
    return figure;
  }
}
