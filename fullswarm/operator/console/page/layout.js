/** The frame of the page: tabs, menus that fold away, the side for the hand that drives, links that skip to map and fleet. */

import { byId, setFlag, setText } from "./dom.js";

const KEPT_AS = "hand";

/** The same conditions as in the style sheets. */
const SHORT = "(width < 1000px), (height < 640px)"; // the timeline
const FOLDED = "(width < 740px), (height < 640px)"; // the toolbar, which then has a menu
const NARROW = "(width < 900px), (height < 640px)";

/** Whether a screen is so narrow or low that the receipts of an e-stop take the place of a panel. */
export function narrow() {
  return typeof matchMedia === "function" && matchMedia(NARROW).matches;
}

export class Layout {
  /** @param {() => void} onChange  called when another panel is shown, or the panels are arranged anew */
  constructor(onChange) {
    this.onChange = onChange;
    this.tabs = /** @type {HTMLElement[]} */ ([...byId("tabs").querySelectorAll("button")]);
    for (const button of this.tabs) button.addEventListener("click", () => this.#chosen(button));
    byId("drive-toggle").addEventListener("click", () => this.#drive(document.body.dataset.drive !== "open"));
    byId("hand").addEventListener("click", () => this.#hand(document.body.dataset.hand === "left" ? "right" : "left"));
    this.#menus();
    this.#skips();
    this.#steps();
    this.#camera();
    addEventListener("resize", () => this.onChange()); // a tablet that is turned
    this.show("fleet");
    this.#drive(false);
    this.#hand(localStorage.getItem(KEPT_AS) ?? "right");
  }

  /**
   * Show a panel, where there is room for one at a time.
   * @param {string} name
   */
  show(name) {
    document.body.dataset.tab = name;
    for (const button of this.tabs) setFlag(button, "aria-pressed", button.dataset.tab === name);
    this.onChange();
  }

  /** @param {HTMLElement} button */
  #chosen(button) {
    if (!byId("time-panel").hidden) byId("time-close").click(); // it would cover the panel
    this.show(button.dataset.tab ?? "");
    button.focus({ preventScroll: true });
  }

  /**
   * On wide screens the stick takes the place of the charts.
   * @param {boolean} open
   */
  #drive(open) {
    document.body.dataset.drive = open ? "open" : "";
    setFlag(byId("drive-toggle"), "aria-pressed", open);
    this.onChange();
  }

  /** @param {string} side */
  #hand(side) {
    document.body.dataset.hand = side;
    localStorage.setItem(KEPT_AS, side);
    setText(byId("hand"), side === "left" ? "For the right hand" : "For the left hand");
    this.onChange();
  }

  #menus() {
    const bar = /** @type {HTMLElement} */ (byId("bar-fold").parentElement);
    const menus = /** @type {const} */ ([[byId("bar-fold"), bar], [byId("tool-more"), byId("toolbar")]]);
    const set = (/** @type {HTMLElement} */ button, /** @type {HTMLElement} */ holder, /** @type {boolean} */ open) => {
      holder.dataset.menu = open ? "open" : "";
      setFlag(button, "aria-expanded", open);
    };
    for (const [button, holder] of menus) {
      button.addEventListener("click", () => set(button, holder, holder.dataset.menu !== "open"));
      addEventListener("pointerdown", ({ target }) => target instanceof Node && !holder.contains(target) && set(button, holder, false));
      addEventListener("keydown", ({ key }) => {
        if (key !== "Escape" || holder.dataset.menu !== "open") return;
        set(button, holder, false);
        button.focus();
      });
    }
  }

  #skips() {
    byId("skips").addEventListener("click", (event) => {
      event.preventDefault(); // the address keeps no part after #: a token would be looked for there
      const to = event.target instanceof HTMLElement ? event.target.dataset.to ?? "" : "";
      if (to === "fleet-region") this.show("fleet");
      byId(to).focus();
    });
  }

  /** Where the timeline is short, its steps and speed are with the bookmarks. */
  #steps() {
    const query = matchMedia(SHORT);
    const steps = /** @type {HTMLElement} */ (document.querySelector(".time-steps"));
    const place = () => (query.matches ? byId("mark-form").before(steps) : byId("time-play").after(steps));
    query.addEventListener("change", place);
    place();
  }

  /** Where the toolbar folds there is no room for the camera's button above the zoom buttons: it is in the toolbar's menu. */
  #camera() {
    const query = matchMedia(FOLDED);
    const toggle = byId("camera-toggle");
    const place = () => (query.matches ? byId("layer-routes") : byId("zoom")).after(toggle);
    query.addEventListener("change", place);
    place();
  }
}
