/** Light or dark: as the system, or as chosen by the button. */

import { Emitter, setText } from "./dom.js";

/**
 * Emits "change".
 * @extends {Emitter<{change: undefined}>}
 */
export class Theme extends Emitter {
  /** @param {HTMLElement} button */
  constructor(button) {
    super();
    this.button = button;
    this.#system = matchMedia("(prefers-color-scheme: dark)");
    this.#chosen = localStorage.getItem("theme");
    this.#system.addEventListener("change", () => this.update());
    button.addEventListener("click", () => this.toggle());
    this.#apply();
  }

  #system;
  #chosen;
  #shown = /** @type {boolean | null} */ (null);

  /** Follow the system if it has changed. The map calls it at each frame: the system's event does not always come. */
  update() {
    if (this.dark !== this.#shown) this.#apply();
  }

  get dark() {
    return this.#chosen ? this.#chosen === "dark" : this.#system.matches;
  }

  toggle() {
    this.#chosen = this.dark ? "light" : "dark";
    localStorage.setItem("theme", this.#chosen);
    this.#apply();
  }

  #apply() {
    this.#shown = this.dark;
    if (this.#chosen) document.documentElement.dataset.theme = this.#chosen;
    setText(this.button, this.dark ? "Light" : "Dark");
    this.button.setAttribute("aria-label", `Change to ${this.dark ? "light" : "dark"} colours`);
    this.emit("change");
  }
}
