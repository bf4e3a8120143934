/** What the page's modules find in a browser, as far as they need it: a clock that stands, elements, pads, a line. */

import { page } from "./page.mjs";

const WAY_MS = 5; // from the page to the console, and back

/** Nothing that is timed happens before `pass`. */
class Clock {
  now_ms = 0;

  #timers = new Map();
  #last = 0;

  constructor() {
    const start = (repeated) => (act, ms = 0) => {
      this.#last += 1;
      this.#timers.set(this.#last, { act, at_ms: this.now_ms + ms, every_ms: repeated ? ms : null });
      return this.#last;
    };
    const stop = (id) => void this.#timers.delete(id);
    Object.assign(globalThis, { setTimeout: start(false), setInterval: start(true), clearTimeout: stop, clearInterval: stop });
    performance.now = () => this.now_ms;
  }

  /** Let time pass: what is due happens in its order, and what waits for it goes on. */
  async pass(ms) {
    const end_ms = this.now_ms + ms;
    for (;;) {
      const [next] = [...this.#timers].filter(([, { at_ms }]) => at_ms <= end_ms).sort(([, a], [, b]) => a.at_ms - b.at_ms);
      if (!next) break;
      const [id, timer] = next;
      this.now_ms = timer.at_ms;
      if (timer.every_ms === null) this.#timers.delete(id);
      else timer.at_ms += timer.every_ms;
      timer.act();
      await new Promise(setImmediate);
    }
    this.now_ms = end_ms;
  }
}

/** An element that keeps what is written into it. */
class Element {
  constructor() {
    Object.assign(this, { hidden: false, disabled: false, textContent: "", value: "", dataset: {}, style: {}, attributes: new Map() });
    this.classList = { add() {}, remove() {}, toggle() {} };
  }

  #handlers = new Map();

  addEventListener(name, handler) {
    this.#handlers.set(name, handler);
  }

  fire(name) {
    this.#handlers.get(name)({ preventDefault() {} });
  }

  setAttribute(name, value) {
    this.attributes.set(name, value);
  }

  getAttribute(name) {
    return this.attributes.get(name) ?? null;
  }

  append() {}
  replaceChildren() {}
  focus() {}
}

/** The line to a console that answers what `answer` returns for a frame; undefined: nothing. */
class Line {
  static OPEN = 1;
  static answer = (_frame) => ({ ok: true });
  static newest = /** @type {Line | null} */ (null);
  static frames = /** @type {any[]} */ ([]);

  constructor() {
    this.readyState = Line.OPEN;
    Line.newest = this;
    setTimeout(() => this.onopen(), WAY_MS);
  }

  send(text) {
    const frame = JSON.parse(text);
    if (frame.t === "hello") return this.say({ t: "hello", read_only: false, operator: "anna" });
    Line.frames.push({ ...frame, at_ms: performance.now() });
    const answer = Line.answer(frame);
    return answer && this.say({ t: "answer", ref: frame.ref, reason: "", request_id: "", ...answer });
  }

  say(message) {
    setTimeout(() => this.readyState === Line.OPEN && this.onmessage({ data: JSON.stringify(message) }), 2 * WAY_MS);
  }

  /** Break, in the page's eyes at once. */
  close() {
    if (this.readyState !== Line.OPEN) return;
    this.readyState = 3;
    this.onclose({ code: 1006 });
  }
}

/** The page's parts that give orders, put together as in main.js, with a console that is `Line`. */
export class Bench {
  /** @param {string[]} robots that the console has heard */
  static async with(...robots) {
    const bench = new Bench();
    bench.clock = new Clock();
    bench.elements = new Map();
    bench.handlers = new Map();
    bench.pads = /** @type {any[]} */ ([null, null]);
    Object.assign(Line, { answer: () => ({ ok: true }), frames: [] });
    const kept = new Map();
    const globals = {
      WebSocket: Line,
      location: { protocol: "http:", host: "console" },
      sessionStorage: { getItem: (name) => kept.get(name) ?? null, setItem: (name, text) => kept.set(name, text) },
      navigator: { getGamepads: () => bench.pads },
      document: {
        body: new Element(),
        getElementById: (id) => bench.element(id),
        createElement: () => new Element(),
        querySelectorAll: () => [],
      },
      addEventListener: (name, handler) => bench.handlers.set(name, handler),
    };
    for (const [name, value] of Object.entries(globals)) {
      Object.defineProperty(globalThis, name, { value, configurable: true, writable: true });
    }
    await bench.#build();
    await bench.clock.pass(50);
    bench.hear({ t: "world", behaviours: { flocking_bc: {} } });
    if (robots.length) bench.fleet(robots);
    return bench;
  }

  async #build() {
    const names = ["store", "link", "selection", "commands", "tools", "drive", "stops", "panel", "groups"];
    const [{ Store }, { Link }, { Selection }, { Commands }, { Tools }, { Driver, Pad }, { Stops }, { Panel }, { GroupBar }] =
      await Promise.all(names.map((name) => page(`${name}.js`)));
    this.told = /** @type {string[]} */ ([]);
    this.refused = /** @type {string[]} */ ([]);
    const store = (this.store = new Store());
    const link = (this.link = new Link({ token: "t", session: "session-1" }));
    const selection = (this.selection = new Selection(store));
    const commands = (this.commands = new Commands(link, store));
    link.on("message", (message) => store.apply(message));
    commands.on("refused", ({ reason }) => this.refused.push(reason));
    this.tools = new Tools({ store, selection, commands, hint: (words) => this.told.push(words) });
    this.stops = new Stops(store, commands);
    this.driver = new Driver({ link, store, selection, commands });
    this.pad = new Pad(this.driver, selection, () => this.stops.estop());
    this.panel = new Panel({ store, selection, commands, tools: this.tools });
    new GroupBar(store, selection, commands);
  }

  element(id) {
    if (!this.elements.has(id)) this.elements.set(id, new Element());
    return this.elements.get(id);
  }

  // ---------------------------------------------------------------- the console
  hear(message) {
    this.store.apply(message);
  }

  fleet(robots) {
    this.hear({ t: "fleet", hub: true, core_age_s: 0.1, robots: robots.map((robot) => ({ robot })) });
  }

  /** Let the console answer what a function returns for a frame. */
  answers(answer) {
    Line.answer = answer;
  }

  /** Return the frames that it got, of one kind or all. */
  sent(kind = "") {
    return Line.frames.filter(({ t }) => !kind || t === kind);
  }

  breakLine() {
    Line.newest.close();
  }

  // ---------------------------------------------------------------- the hands
  /** Plug a pad in, with some buttons held down. */
  plug(index, held = []) {
    const buttons = Array.from({ length: 17 }, (_, number) => ({ pressed: held.includes(number), value: 0 }));
    this.pads[index] = { id: `pad ${index}`, index, connected: true, axes: [0, 0, 0, 0], buttons };
    this.handlers.get("gamepadconnected")({ gamepad: this.pads[index] });
  }

  unplug(index) {
    const gamepad = this.pads[index];
    this.pads[index] = null;
    this.handlers.get("gamepaddisconnected")({ gamepad });
  }

  press(index, button, down = true) {
    this.pads[index].buttons[button] = { pressed: down, value: Number(down) };
  }
}
