/** Helpers for elements and events; text is only ever inserted as text. */

/**
 * Return the element with an id; its absence is an error in the page.
 * @param {string} id
 */
export function byId(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the page has no element #${id}`);
  return found;
}

/**
 * Make an element. `options`: text, class, testid, on (event → handler); everything else is an attribute.
 * @template {keyof HTMLElementTagNameMap} T
 * @param {T} tag
 * @param {{text?: string, testid?: string, on?: Record<string, (event: Event) => void>, [attribute: string]: unknown}} options
 * @param {(Node | string)[]} children
 */
export function make(tag, { text, testid, on = {}, ...attributes } = {}, ...children) {
  const element = document.createElement(tag);
  if (text !== undefined) element.textContent = text;
  if (testid !== undefined) element.dataset.testid = testid;
  for (const [event, handler] of Object.entries(on)) element.addEventListener(event, handler);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === undefined || value === null || value === false) continue;
    element.setAttribute(name, value === true ? "" : String(value));
  }
  element.append(...children);
  return element;
}

/**
 * Return the drawing context of a canvas.
 * @param {HTMLCanvasElement} canvas
 * @param {CanvasRenderingContext2DSettings} [settings]
 */
export function context2d(canvas, settings) {
  const context = canvas.getContext("2d", settings);
  if (!context) throw new Error("this browser has no 2D canvas");
  return context;
}

/**
 * Set a text only if it changed, which saves the browser work.
 * @param {Element} element
 * @param {string} text
 */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/**
 * Set or remove an attribute only if it changed.
 * @param {Element} element
 * @param {string} name
 * @param {unknown} value
 */
export function setFlag(element, name, value) {
  const text = String(value);
  if (element.getAttribute(name) !== text) element.setAttribute(name, text);
}

/**
 * Whether keys typed now belong to a text field. `letters`: also a number, which may be 1e-3 unless it is of digits only.
 * @param {EventTarget | null} element
 * @param {boolean} [letters]
 */
export function typing(element, letters = false) {
  if (!(element instanceof HTMLElement)) return false;
  if (element.isContentEditable || element instanceof HTMLTextAreaElement) return true;
  if (!(element instanceof HTMLInputElement)) return false;
  if (["text", "search", "email", "url", "password"].includes(element.type)) return true;
  return letters && element.type === "number" && element.inputMode !== "numeric";
}

/**
 * Whether a control uses letters or arrows itself: a choice, a slider.
 * @param {EventTarget | null} element
 */
export function steered(element) {
  return element instanceof HTMLSelectElement || (element instanceof HTMLInputElement && element.type === "range");
}

/** Whether fingers are what the page is used with: then its words say "tap". */
export function touched() {
  return typeof matchMedia === "function" && matchMedia("(pointer: coarse)").matches;
}

/**
 * Write "1 robot", "3 robots".
 * @param {number} count
 */
export function robots(count) {
  return count === 1 ? "1 robot" : `${count} robots`;
}

/**
 * Calls the handlers of topics.
 * @template {object} Topics topic → what its handlers are called with
 */
export class Emitter {
  #handlers = /** @type {Map<keyof Topics, ((value: unknown) => void)[]>} */ (new Map());

  /**
   * Call `handler` on each emit of `topic`.
   * @template {keyof Topics} T
   * @param {T} topic
   * @param {(value: Topics[T]) => void} handler
   */
  on(topic, handler) {
    const handlers = this.#handlers.get(topic) ?? [];
    this.#handlers.set(topic, [...handlers, /** @type {(value: unknown) => void} */ (handler)]);
  }

  /**
   * @template {keyof Topics} T
   * @param {T} topic
   * @param {Topics[T]} [value]
   */
  emit(topic, value) {
    for (const handler of this.#handlers.get(topic) ?? []) handler(value);
  }
}
