/** The panel of the timeline: bookmarks, and clips of a part of the past as files. */

import { byId, make, setText } from "./dom.js";

/** @import { Bookmark, ClipFrame } from "./types.d.ts" */

const KINDS = /** @type {Record<string, string>} */ ({ mcap: "MCAP", gif: "GIF", mp4: "MP4" });

export class Marks {
  /**
   * @param {{past: import("./past.js").Past, present: import("./store.js").Store, link: import("./link.js").Link,
   *   bar: import("./timeline.js").TimeBar}} parts
   */
  constructor({ past, present, link, bar }) {
    this.past = past;
    this.link = link;
    this.bar = bar;
    this.name = /** @type {HTMLInputElement} */ (byId("mark-name"));
    this.kind = /** @type {HTMLSelectElement} */ (byId("clip-kind"));
    this.makes = /** @type {HTMLButtonElement} */ (byId("clip-make"));
    present.on("bookmarks", ({ bookmarks, clips }) => this.#show(bookmarks, clips));
    present.on("clip", (clip) => this.#clip(clip));
    byId("mark-form").addEventListener("submit", (event) => this.#add(event));
    byId("clip-from").addEventListener("click", () => this.#set(this.#here(), this.#end_s));
    byId("clip-to").addEventListener("click", () => this.#set(this.#begin_s, this.#here()));
    this.makes.addEventListener("click", () => this.#make());
    this.#set(null, null);
  }

  #shown = "";
  #refusal = "";
  #running = false;
  #begin_s = /** @type {number | null} */ (null);
  #end_s = /** @type {number | null} */ (null);

  #here() {
    return this.past.live ? this.past.to_s : this.past.at_s;
  }

  /** @param {Event} event */
  async #add(event) {
    event.preventDefault();
    const answer = await this.link.ask({ t: "mark", op: "add", at: this.#here(), name: this.name.value });
    setText(byId("mark-refusal"), answer.ok ? "" : (answer.reason ?? "not added"));
    if (answer.ok) this.name.value = "";
  }

  /**
   * @param {Bookmark[]} marks
   * @param {string} refusal
   */
  #show(marks, refusal) {
    if (this.#refusal && !refusal) setText(byId("clip-words"), "");
    this.#refusal = refusal;
    this.#allow();
    const text = JSON.stringify(marks.map(({ id }) => id));
    if (text === this.#shown) return; // it is sent each second
    this.#shown = text;
    this.bar.mark(marks);
    const items = marks.map((mark) => this.#item(mark));
    byId("mark-list").replaceChildren(...items);
    byId("mark-empty").hidden = items.length > 0;
  }

  /** @param {Bookmark} mark */
  #item(mark) {
    const jump = make("button", {
      type: "button", class: "mark-jump", testid: `mark-${mark.name}`, title: mark.by,
      on: { click: () => this.past.look(mark.at) },
    }, make("span", { class: "mark-clock", text: this.past.clock(mark.at) }), ` ${mark.name}`);
    const remove = make("button", {
      type: "button", class: "small", "aria-label": `Delete bookmark ${mark.name}`, text: "Delete",
      on: { click: () => void this.#delete(mark) },
    });
    return make("li", { class: "mark" }, jump, remove);
  }

  /** @param {Bookmark} mark */
  async #delete(mark) {
    const answer = await this.link.ask({ t: "mark", op: "delete", id: mark.id });
    setText(byId("mark-refusal"), answer.ok ? "" : (answer.reason ?? "not deleted"));
  }

  // ------------------------------------------------------------------ clips
  /**
   * @param {number | null} begin_s
   * @param {number | null} end_s
   */
  #set(begin_s, end_s) {
    this.#begin_s = begin_s;
    this.#end_s = end_s;
    setText(byId("clip-range"), `${this.#moment(begin_s)} – ${this.#moment(end_s)}`);
    this.#allow();
  }

  /** @param {number | null} at_s */
  #moment(at_s) {
    return at_s === null ? "not set" : this.past.clock(at_s);
  }

  #allow() {
    const set = this.#begin_s !== null && this.#end_s !== null && this.#begin_s < this.#end_s;
    this.makes.disabled = this.#running || !set || Boolean(this.#refusal);
    if (this.#refusal && !this.#running) setText(byId("clip-words"), this.#refusal);
  }

  async #make() {
    byId("clip-link").hidden = true;
    const answer = await this.link.ask({ t: "clip", begin: this.#begin_s, end: this.#end_s, kind: this.kind.value });
    setText(byId("clip-words"), answer.ok ? `making the ${KINDS[this.kind.value]}` : (answer.reason ?? "not made"));
  }

  /** @param {ClipFrame} clip */
  #clip({ state, words, url, name }) {
    this.#running = state === "running";
    this.#refusal = "";
    setText(byId("clip-words"), state === "running" ? `making ${name}: ${words}` : words);
    const link = /** @type {HTMLAnchorElement} */ (byId("clip-link"));
    link.hidden = state !== "done";
    if (state === "done") {
      link.href = url;
      link.download = name;
    }
    this.#allow();
  }
}
