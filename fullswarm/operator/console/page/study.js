/**
 * The dialogs of a study: briefing, questions, NASA-TLX. They lie beside or below the header, never over it: stop and
 * e-stop work in each of them. Also tells the console what is clicked, for the log of the study.
 */

import { byId, make, setFlag, setText } from "./dom.js";

/** @import { Answer } from "./link.js" */
/** @import { Study as Frame, StudyProbe } from "./types.d.ts" */

const VIEW_MS = 500;
const STEP = 5;

export class Study {
  /**
   * @param {{store: import("./store.js").Store, link: import("./link.js").Link,
   *   selection: import("./selection.js").Selection, map: import("./map.js").SwarmMap,
   *   tools: import("./tools.js").Tools}} parts
   */
  constructor({ store, link, selection, map, tools }) {
    this.link = link;
    this.map = map;
    this.page = byId("study-page");
    this.form = /** @type {HTMLFormElement} */ (byId("study-probe"));
    store.on("study", (frame) => this.#update(frame));
    selection.on("change", () => this.#tell("select", { robots: selection.list() }));
    tools.on("change", () => this.#tool(tools.mode));
    byId("tabs").addEventListener("click", (event) => this.#panel(event));
    byId("missions-toggle").addEventListener("click", (event) => this.#panel(event));
    setInterval(() => this.#view(), VIEW_MS);
  }

  #running = false;
  #shown = ""; // which dialog is open: it is made once, so that nothing loses the focus or what was typed
  #probe = "";
  #mode = "select";
  #seen = "";

  /** @param {Frame} frame */
  #update(frame) {
    this.#running = frame.phase === "running";
    setFlag(document.body, "data-hide", frame.hide.join(" "));
    setText(byId("study-left"), clock(frame.left_s));
    setText(byId("study-task"), frame.task);
    setText(byId("study-title"), frame.title);
    byId("study-strip").hidden = !this.#running;
    const frozen = frame.probe?.freeze && frame.mine ? frame.probe : null;
    const dialog = !frame.mine && frame.phase !== "briefing" ? "" : frozen ? frozen.id : this.#running ? "" : frame.phase;
    if (dialog !== this.#shown) this.#open(dialog, frame, frozen);
    const open = frame.mine && frame.probe && !frame.probe.freeze ? frame.probe : null;
    if ((open?.id ?? "") !== this.#probe) this.#ask(open);
  }

  // ------------------------------------------------------------ the dialogs
  /**
   * @param {string} dialog
   * @param {Frame} frame
   * @param {StudyProbe | null} frozen
   */
  #open(dialog, frame, frozen) {
    this.#shown = dialog;
    setFlag(document.body, "data-study", dialog ? "page" : "");
    this.page.hidden = !dialog;
    if (!dialog) return this.page.replaceChildren();
    const content = frozen ? this.#question(frozen) : this.#contents[frame.phase](frame);
    const title = make("h2", { text: frame.title, tabindex: "-1" });
    this.page.replaceChildren(make("div", { class: "study-sheet" }, title, ...content));
    this.page.scrollTop = 0;
    return title.focus();
  }

  #contents = /** @type {Record<string, (frame: Frame) => HTMLElement[]>} */ ({
    briefing: (frame) => this.#briefing(frame),
    tlx: (frame) => this.#questionnaire(frame),
    done: ({ reason }) => [
      make("p", { testid: "study-done", text: reason ? `The trial has ended: ${reason}.` : "Thank you. This part is complete." }),
      make("p", { text: "Please tell the experimenter." }),
    ],
    running: () => [],
  });

  /** @param {Frame} frame */
  #briefing({ briefing, consent, task, duration_s }) {
    const box = make("input", { type: "checkbox", id: "study-consent", testid: "study-consent" });
    const form = this.#form("Start", "study-start", () => {
      if (consent && !box.checked) return "Tick the box first, or tell the experimenter that you do not take part.";
      return this.link.ask({ t: "study", op: "start" });
    });
    const paragraphs = briefing.split(/\n\s*\n/).filter((text) => text.trim()).map((text) => make("p", { text: text.trim() }));
    if (consent) form.prepend(make("p", { class: "study-consent" }, box, make("label", { for: "study-consent", text: consent })));
    return [
      ...paragraphs,
      make("p", {}, make("strong", { text: "Your task: " }), task),
      make("p", { text: `It takes ${clock(duration_s)} min. Space stops all robots, E is the e-stop, at any time.` }),
      form,
    ];
  }

  /** @param {StudyProbe | null} probe */
  #ask(probe) {
    this.#probe = probe?.id ?? "";
    this.form.hidden = !probe;
    this.form.replaceChildren();
    if (probe) this.form.replaceWith((this.form = this.#answerForm(probe, { id: "study-probe", class: "banner study-probe" })));
  }

  /** @param {StudyProbe} probe */
  #question(probe) {
    return [make("p", { class: "quiet", text: "The simulation stands still. Answer from memory." }), this.#answerForm(probe, {})];
  }

  /**
   * @param {StudyProbe} probe
   * @param {Record<string, string>} attributes
   */
  #answerForm({ id, question, choices }, attributes) {
    const field = make("input", { type: "number", inputmode: "numeric", step: "any", id: "study-answer", testid: "study-answer", autocomplete: "off" });
    const form = this.#form("Answer", "study-send", () => {
      const chosen = /** @type {HTMLInputElement | null} */ (form.querySelector("input:checked"))?.value ?? field.value;
      return chosen === "" ? "Answer the question first." : this.link.ask({ t: "study", op: "answer", probe: id, value: chosen });
    }, { testid: "study-question", "aria-label": "Question", ...attributes });
    if (choices.length) form.prepend(radios(question, "probe", choices.map((text) => [text, text])));
    else form.prepend(make("label", { for: "study-answer", text: question }), field);
    return form;
  }

  /** @param {Frame} frame */
  #questionnaire({ tlx }) {
    if (!tlx) return [];
    const scales = tlx.scales.map((scale) => new Scale(scale));
    const titles = new Map(tlx.scales.map(({ name, title }) => [name, title]));
    const pairs = tlx.pairs.map((pair, index) => radios(
      `Comparison ${index + 1} of ${tlx.pairs.length}`, `pair-${index}`, pair.map((name) => [name, titles.get(name) ?? name]),
    ));
    const form = this.#form("Send", "tlx-send", () => {
      const unrated = scales.find(({ rated }) => !rated);
      if (unrated) return focused(unrated.input, `Rate ${unrated.title} first.`);
      const open = pairs.find((set) => !set.querySelector("input:checked"));
      if (open) return focused(open.querySelector("input"), "Make each comparison first.");
      const ratings = Object.fromEntries(scales.map(({ name, value }) => [name, value]));
      const chosen = pairs.map((set, index) => {
        const won = /** @type {HTMLInputElement} */ (set.querySelector("input:checked")).value;
        return [won, tlx.pairs[index].find((name) => name !== won)];
      });
      return this.link.ask({ t: "study", op: "tlx", ratings, pairs: chosen });
    });
    const more = pairs.length
      ? [make("h3", { text: "Which of the two contributed more to the workload of the task?" }), make("div", { class: "tlx-pairs" }, ...pairs)]
      : [];
    form.prepend(make("h3", { text: "How was the task? Move each slider, or click on it." }), ...scales.map(({ element }) => element), ...more);
    return [form];
  }

  /**
   * A form whose outcome, a text or an answer of the console, is shown beside its button.
   * @param {string} text
   * @param {string} testid
   * @param {() => string | Promise<Answer>} send
   * @param {Record<string, string>} [attributes]
   */
  #form(text, testid, send, attributes = {}) {
    const outcome = make("p", { class: "study-outcome", role: "alert", testid: "study-outcome" });
    const button = make("button", { type: "submit", class: "start", text, testid });
    const submit = async (/** @type {Event} */ event) => {
      event.preventDefault();
      const sent = send();
      if (typeof sent === "string") return setText(outcome, sent);
      button.disabled = true;
      const { ok, reason } = await sent;
      button.disabled = false;
      return setText(outcome, ok ? "" : reason ?? "not accepted");
    };
    return make("form", { novalidate: true, class: "study-form", on: { submit }, ...attributes }, button, outcome);
  }

  // ------------------------------------------------------------ the log of the input
  /**
   * @param {"select" | "view" | "tool" | "panel"} kind
   * @param {{robots?: string[], detail?: string}} more
   */
  #tell(kind, more) {
    if (this.#running) this.link.post({ t: "input", kind, ...more });
  }

  /** @param {string} mode */
  #tool(mode) {
    if (mode === this.#mode) return;
    this.#mode = mode;
    this.#tell("tool", { detail: mode });
  }

  /** @param {Event} event */
  #panel({ target }) {
    if (target instanceof HTMLElement) this.#tell("panel", { detail: (target.dataset.tab ?? target.id).slice(0, 32) });
  }

  /** A view that was moved or zoomed, at most twice a second. */
  #view() {
    const { centre, scale } = this.map.view;
    const now = `${centre.map((metres) => metres.toFixed(2))} ${scale.toFixed(1)}`;
    if (this.#seen && now !== this.#seen) this.#tell("view", { detail: now.slice(0, 32) });
    this.#seen = now;
  }
}

/** A rating from 0 to 100 in steps of 5. It has no rating until it is touched: the middle is no answer. */
class Scale {
  /** @param {{name: string, title: string, question: string, low: string, high: string}} scale */
  constructor({ name, title, question, low, high }) {
    this.name = name;
    this.title = title;
    this.rated = false;
    const rate = () => this.#rate();
    const enter = (/** @type {Event} */ event) => {
      if (!(event instanceof KeyboardEvent) || event.key !== "Enter" || this.rated) return;
      event.preventDefault();
      rate();
    };
    this.input = make("input", {
      type: "range", min: "0", max: "100", step: String(STEP), id: `tlx-${name}`, testid: `tlx-${name}`,
      "aria-valuetext": "not rated", "aria-describedby": `tlx-ends-${name}`, on: { input: rate, pointerup: rate, keydown: enter },
    });
    this.shown = make("output", { for: `tlx-${name}`, text: "not rated" });
    this.element = make(
      "div", { class: "tlx-scale", "data-rated": "false" },
      make("label", { for: `tlx-${name}` }, make("strong", { text: title }), ` ${question}`), this.shown,
      this.input,
      make("p", { class: "tlx-ends", id: `tlx-ends-${name}` }, make("span", { text: low }), " ", make("span", { text: high })),
    );
  }

  get value() {
    return Number(this.input.value);
  }

  #rate() {
    this.rated = true;
    this.element.dataset.rated = "true";
    setText(this.shown, this.input.value);
    this.input.setAttribute("aria-valuetext", this.input.value);
  }
}

/**
 * A choice of one, none to start with.
 * @param {string} legend
 * @param {string} name
 * @param {[value: string, text: string][]} choices
 */
function radios(legend, name, choices) {
  const options = choices.map(([value, text]) => make("label", {}, make("input", { type: "radio", name, value }), ` ${text}`));
  return make("fieldset", { class: "study-choice" }, make("legend", { text: legend }), ...options);
}

/**
 * @param {HTMLElement | null} element
 * @param {string} text
 */
function focused(element, text) {
  element?.focus();
  return text;
}

/** @param {number} left_s */
function clock(left_s) {
  return `${Math.floor(left_s / 60)}:${String(Math.floor(left_s % 60)).padStart(2, "0")}`;
}
