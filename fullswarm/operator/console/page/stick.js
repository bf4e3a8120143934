/** The stick on the screen: a finger on it is the dead-man; whatever takes the finger away sends zeros at once. */

import { byId, setFlag, setText } from "./dom.js";
import { SLOW_SHARE, deadZone } from "./drive.js";

const REACH = 0.42; // of the width: so far from the middle the stick is pushed fully

export class Stick {
  /** @param {import("./drive.js").Driver} driver */
  constructor(driver) {
    this.driver = driver;
    this.base = byId("stick");
    this.knob = byId("stick-knob");
    this.base.addEventListener("pointerdown", (event) => this.#down(event));
    this.base.addEventListener("pointermove", (event) => this.#move(event));
    for (const name of /** @type {const} */ (["pointerup", "pointercancel", "lostpointercapture"])) {
      this.base.addEventListener(name, (event) => this.#up(event));
    }
    this.base.addEventListener("contextmenu", (event) => event.preventDefault()); // of a long press
    driver.on("change", (words) => this.#changed(words));
  }

  #pointer = /** @type {number | null} */ (null); // the finger that owns the stick, until it is lifted
  #drives = false;

  /** End driving by this stick; it must be touched anew. */
  end() {
    if (this.#drives) this.driver.release();
  }

  /** @param {PointerEvent} event */
  #down(event) {
    if (this.#pointer !== null || event.button !== 0) return;
    event.preventDefault();
    if (this.driver.held) return; // by keys or a gamepad: two controls must not mix
    this.#pointer = event.pointerId;
    this.base.setPointerCapture(event.pointerId);
    this.#drives = this.driver.begin();
    setFlag(this.base, "data-held", this.#drives);
    this.#move(event);
  }

  /** @param {PointerEvent} event */
  #move(event) {
    if (event.pointerId !== this.#pointer || !this.#drives) return;
    const box = this.base.getBoundingClientRect();
    const { x, y } = readStick(event.clientX - box.left - box.width / 2, event.clientY - box.top - box.height / 2, REACH * box.width);
    this.knob.style.transform = `translate(${(x * REACH * box.width).toFixed(1)}px, ${(y * REACH * box.width).toFixed(1)}px)`;
    this.driver.set({ linear: axis(y), angular: axis(x) });
  }

  /** @param {PointerEvent} event */
  #up({ pointerId }) {
    if (pointerId !== this.#pointer) return;
    this.#pointer = null;
    this.end();
  }

  /** @param {string} words */
  #changed(words) {
    setText(byId("stick-words"), words);
    byId("stick-words").title = words;
    if (!this.#drives || this.driver.held) return;
    this.#drives = false;
    setFlag(this.base, "data-held", false);
    this.knob.style.transform = "";
  }
}

/** @param {number} value  pushed to the right or down: both are negative for a robot */
function axis(value) {
  return -SLOW_SHARE * deadZone(value) || 0; // || 0: no minus zero
}

/**
 * Return how far a stick is pushed, -1 to 1 to the right and down, within a circle of radius 1.
 * @param {number} dx_px from its middle
 * @param {number} dy_px
 * @param {number} reach_px
 */
export function readStick(dx_px, dy_px, reach_px) {
  const far = Math.max(1, Math.hypot(dx_px, dy_px) / reach_px);
  return { x: dx_px / reach_px / far, y: dy_px / reach_px / far };
}
