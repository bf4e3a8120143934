/** Stop and e-stop: one key, receipts of every robot, and clearing as an act of its own. */

import { Emitter, byId, make, setFlag, setText } from "./dom.js";
import { narrow } from "./layout.js";
import { byNumber } from "./store.js";

/** @import { Unsent } from "./commands.js" */
/** @import { Estop, Receipt, Stop } from "./types.d.ts" */

const HOLD_MS = 1500;
const SHOWN_MS = 15000;
const AFTER_MS = 5000;
const CLICK_MS = 1000; // after a press its click means nothing more
const UNSENT = /** @type {Record<string, string>} */ ({
  unsent: "NOT SENT: no link to the console. It goes out if the link is back within 10 s.",
  broken: "NOT CONFIRMED: the link to the console broke. It goes out again if the link is back within 10 s.",
  mute: "NOT CONFIRMED: the console gave no answer. Press again.",
});

/**
 * Emits "pressed" with what was pressed, before it is sent.
 * @extends {Emitter<{pressed: "stop" | "estop"}>}
 */
export class Stops extends Emitter {
  /**
   * @param {import("./store.js").Store} store
   * @param {import("./commands.js").Commands} commands
   */
  constructor(store, commands) {
    super();
    this.store = store;
    this.commands = commands;
    atOnce(/** @type {HTMLButtonElement} */ (byId("stop")), () => this.stop());
    atOnce(/** @type {HTMLButtonElement} */ (byId("estop")), () => this.estop());
    byId("stop-close").addEventListener("click", () => this.#closeStop());
    byId("estop-clear").addEventListener("click", () => this.#openClear());
    byId("estop-fold").addEventListener("click", () => this.#fold());
    this.#holdToClear(byId("estop-clear-hold"));
    this.#unfold(!narrow());
    store.on("stop", (message) => this.#showStop(message));
    store.on("estop", (order) => this.#onEstop(order));
    store.on("fleet", () => this.#showEstop());
    commands.on("unsent", (what) => this.#unsent(what));
  }

  #hideTimer = 0;
  #order = /** @type {string | null} */ (null); // the newest one
  #upUntil_ms = 0;
  #failed = ""; // why the last e-stop was not sent, until another one is received

  stop() {
    this.emit("pressed", "stop");
    this.#showState("Stop sent to all robots: waiting for receipts", "");
    this.commands.stop();
  }

  estop() {
    this.emit("pressed", "estop");
    this.#order ??= "";
    this.#failed = "";
    this.#upUntil_ms = performance.now() + AFTER_MS;
    this.#showPanel(true);
    this.#unfold(!narrow());
    setText(byId("estop-title"), "E-stop sent to all robots");
    this.commands.estop("pressed on the console");
  }

  /** @param {Unsent} unsent */
  #unsent({ what, lost, reason }) {
    const words = unsentWords(lost, reason);
    if (what === "stop") return this.#showState(words, "bad");
    this.#failed = words;
    this.#upUntil_ms = performance.now() + SHOWN_MS;
    return setText(byId("estop-title"), words);
  }

  /**
   * @param {string} words
   * @param {string} mood
   */
  #showState(words, mood) {
    const box = byId("stop-panel");
    box.hidden = false;
    box.dataset.mood = mood;
    setText(byId("stop-receipts"), words);
    clearTimeout(this.#hideTimer);
  }

  #closeStop() {
    byId("stop-panel").hidden = true;
  }

  /** @param {Stop} message */
  #showStop(message) {
    const { words, mood } = stopWords(message);
    this.#showState(words, mood);
    if (mood === "good") this.#hideTimer = setTimeout(() => this.#closeStop(), SHOWN_MS);
  }

  #latched() {
    return [...this.store.fleet.values()].filter((robot) => robot.estop).map((robot) => robot.robot).sort(byNumber);
  }

  /**
   * A change of an order keeps the panel open for a while; an order that ended before this page was opened does not.
   * @param {Estop} order
   */
  #onEstop(order) {
    const old = order.done && this.#order === null;
    if (!old) this.#upUntil_ms = performance.now() + AFTER_MS;
    if (order.id !== this.#order) this.#failed = "";
    if (order.id !== this.#order && !old) this.#unfold(!narrow());
    this.#order = order.id;
    this.#showEstop();
  }

  #showEstop() {
    const order = this.store.estop;
    const latched = this.#latched();
    const unconfirmed = Boolean(order?.engaged && order.waiting.length > 0);
    const up = latched.length > 0 || unconfirmed || performance.now() < this.#upUntil_ms;
    this.#showPanel(up);
    if (!up || latched.length === 0) this.#closeClear(up);
    if (performance.now() >= this.#upUntil_ms) this.#failed = "";
    if (!up) return;
    setText(byId("estop-title"), this.#failed || title(order, latched));
    this.#receipts(order, latched);
    /** @type {HTMLButtonElement} */ (byId("estop-clear")).disabled = latched.length === 0;
  }

  /**
   * The panel is beside or below the map, never over it.
   * @param {boolean} up
   */
  #showPanel(up) {
    byId("estop-panel").hidden = !up;
    document.body.dataset.estop = up ? "up" : "";
  }

  /**
   * @param {Estop | null} order
   * @param {string[]} latched
   */
  #receipts(order, latched) {
    const rows = new Map(latched.map((id) => [id, "e-stop latched"]));
    for (const receipt of order?.receipts ?? []) rows.set(receipt.robot, receiptText(receipt));
    for (const id of order?.waiting ?? []) if (!rows.has(id)) rows.set(id, "not confirmed yet");
    for (const id of order?.silent ?? []) rows.set(id, "SILENT: not confirmed");
    const sure = new Set((order?.receipts ?? []).map((receipt) => receipt.robot));
    const ids = [...rows.keys()].sort((a, b) => Number(sure.has(a)) - Number(sure.has(b)) || byNumber(a, b));
    const words = ids.map((id) => `${id}|${rows.get(id)}`).join("\n");
    const list = byId("estop-receipts");
    if (list.dataset.words === words) return;
    list.dataset.words = words;
    const items = ids.map((id) => {
      const open = order && !sure.has(id) && !latched.includes(id);
      return make("li", { class: open ? "open" : "" }, make("strong", { text: id }), ` ${rows.get(id)}`);
    });
    list.replaceChildren(...items);
  }

  #fold() {
    if (narrow()) this.#closeClear();
    this.#unfold(byId("estop-body").hidden);
  }

  /**
   * Show or hide the receipts; on small screens they take the place of a panel, so that they wait until they are asked for.
   * @param {boolean} open
   */
  #unfold(open) {
    byId("estop-body").hidden = !open;
    setFlag(byId("estop-fold"), "aria-expanded", open);
    this.#mark();
  }

  #openClear() {
    byId("estop-clear-act").hidden = false;
    setFlag(byId("estop-clear"), "aria-expanded", true);
    this.#mark();
    byId("estop-clear-hold").focus({ preventScroll: true });
  }

  /**
   * When others clear the e-stop, the panel keeps its size as long as it is shown: it must not move under a pointer.
   * @param {boolean} [keep]
   */
  #closeClear(keep = false) {
    byId("estop-clear-act").hidden = true;
    setFlag(byId("estop-clear"), "aria-expanded", false);
    if (!keep) this.#mark();
  }

  /** Tell the style sheet whether there is more than one line. */
  #mark() {
    byId("estop-panel").dataset.open = String(!byId("estop-body").hidden || !byId("estop-clear-act").hidden);
  }

  /**
   * Only a press of 1.5 s counts, of the mouse, a finger or Enter.
   * @param {HTMLElement} button
   */
  #holdToClear(button) {
    let timer = 0;
    const begin = () => {
      if (timer) return;
      button.classList.add("holding");
      timer = setTimeout(() => {
        end();
        this.commands.clear();
      }, HOLD_MS);
    };
    const end = () => {
      clearTimeout(timer);
      timer = 0;
      button.classList.remove("holding");
    };
    button.addEventListener("pointerdown", begin);
    button.addEventListener("keydown", (event) => event.key === "Enter" && begin());
    for (const name of ["pointerup", "pointerleave", "pointercancel", "blur"]) button.addEventListener(name, end);
    button.addEventListener("keyup", end);
    button.addEventListener("contextmenu", (event) => event.preventDefault());
  }
}

/**
 * Act when a button is pressed, not when it is released: a finger counts too while another one drives, which makes no
 * click. A click without a press is one of the keyboard, or of a screen reader.
 * @param {HTMLButtonElement} button
 * @param {() => void} act
 */
function atOnce(button, act) {
  let pressed_ms = -Infinity;
  button.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 || button.disabled) return;
    pressed_ms = performance.now();
    act();
  });
  button.addEventListener("click", (event) => {
    if (event.detail === 0 || performance.now() - pressed_ms > CLICK_MS) act();
  });
}

/**
 * Return the text for a stop that the console has not confirmed.
 * @param {string | undefined} lost
 * @param {string | undefined} reason
 */
export function unsentWords(lost, reason) {
  return `${UNSENT[lost ?? ""] ?? `NOT DONE: ${reason}.`} Use the switches on the robots.`;
}

/**
 * Return the text on a stop; it is good only if all robots report, and if there are any.
 * @param {Stop} stop
 */
export function stopWords({ standing, moving, silent, done }) {
  const all = standing.length + moving.length + silent.length;
  if (all === 0) return { words: "0 of 0 standing: no robot has reported", mood: "bad" };
  const names = (/** @type {string[]} */ ids) => [...ids].sort(byNumber).join(", ");
  let words = `${standing.length} of ${all} standing`;
  if (silent.length) words += `, ${names(silent)} silent`;
  if (moving.length) words += ` · still moving: ${names(moving)}`;
  if (silent.length) return { words, mood: "bad" };
  return { words, mood: done && !moving.length ? "good" : "" };
}

/**
 * @param {Estop | null} order
 * @param {string[]} latched
 */
function title(order, latched) {
  if (order && !order.engaged && !order.done) return "Clearing the e-stop";
  const sure = (order?.receipts ?? []).filter((receipt) => receipt.engaged && receipt.standing).length;
  const open = new Set([...(order?.waiting ?? []), ...(order?.silent ?? [])]);
  for (const receipt of order?.receipts ?? []) open.delete(receipt.robot);
  const all = sure + open.size;
  if (order && !order.engaged && latched.length === 0) return "E-stop cleared";
  if (order?.engaged) return `E-STOP: ${sure} of ${Math.max(all, latched.length)} confirmed standing`;
  return `E-STOP latched on ${latched.length}`;
}

/** @param {Receipt} receipt */
function receiptText({ standing, rolled_m, after_s, engaged }) {
  const after = typeof after_s === "number" ? ` after ${after_s.toFixed(2)} s` : "";
  if (!engaged) return `cleared${after}`;
  if (!standing) return `engaged${after}, still rolling`;
  return `standing${after}, rolled ${(rolled_m ?? 0).toFixed(2)} m`;
}
