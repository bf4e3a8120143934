/** Small helpers for making and changing elements; text only ever goes in as text. */

/** Return the element with an id; its absence is a mistake of the page. */
export function byId(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the page has no element #${id}`);
  return found;
}

/**
 * Make an element. `options`: text, class, testid, on (event → handler); everything else is an attribute.
 * @param {string} tag
 * @param {Record<string, any>} options
 * @param {(Node | string)[]} children
 */
export function make(tag, options = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(options)) {
    if (value === undefined || value === null || value === false) continue;
    if (name === "text") element.textContent = value;
    else if (name === "on") for (const [event, handler] of Object.entries(value)) element.addEventListener(event, handler);
    else if (name === "testid") element.dataset.testid = value;
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children);
  return element;
}

/** Set a text only if it changed: the browser does no work for what stays. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Set or remove an attribute only if it changed. */
export function setFlag(element, name, value) {
  const text = String(value);
  if (element.getAttribute(name) !== text) element.setAttribute(name, text);
}

/** Whether keys typed now belong to a text field. `letters`: also a number, which may be 1e-3. */
export function typing(element, letters = false) {
  if (!(element instanceof HTMLElement)) return false;
  if (element.isContentEditable || element instanceof HTMLTextAreaElement) return true;
  if (!(element instanceof HTMLInputElement)) return false;
  if (["text", "search", "email", "url", "password"].includes(element.type)) return true;
  return letters && element.type === "number";
}

/** Whether a control uses letters or arrows itself: a choice, a slider. */
export function steered(element) {
  return element instanceof HTMLSelectElement || (element instanceof HTMLInputElement && element.type === "range");
}

/** Write "1 robot", "3 robots". */
export function robots(count) {
  return count === 1 ? "1 robot" : `${count} robots`;
}
