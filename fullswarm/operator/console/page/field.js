/** One parameter of a behaviour as a labelled control: number with slider, flag, choice, point. */

import { make } from "./dom.js";
import { entryText, fromSlider, number, parseEntry, rangeText, toSlider } from "./forms.js";

/** @import { Bounds } from "./forms.js" */
/** @import { Parameter, Point } from "./types.d.ts" */

/** @typedef {{words: string, points: Point[]}[]} Known places that a field of points offers */

let counted = 0;

/**
 * A field: its element, its entry, and how to show its error.
 * @typedef {{element: HTMLElement, entry: () => string | boolean, showError: (reason: string) => void,
 *   focus: () => void}} Field
 * @typedef {(onPoint: (point: Point) => boolean, points: Point[]) => void} Pick starts picking on the map
 */

/**
 * Make the field of a parameter.
 * @param {string} name
 * @param {Parameter} parameter
 * @param {Pick} pick
 * @param {Known} [known]
 * @returns {Field}
 */
export function makeField(name, parameter, pick, known = []) {
  const id = `field-${(counted += 1)}`;
  const error = make("p", { class: "field-error", id: `${id}-error` });
  const doc = make("p", { class: "field-doc", id: `${id}-doc`, text: docText(parameter) });
  const control = makeControl(id, name, parameter, pick, known);
  control.input.setAttribute("aria-describedby", `${id}-doc ${id}-error`);
  const star = parameter.required ? make("span", { class: "required", text: "required" }) : "";
  const label = make("label", { for: id, class: "field-label" }, make("span", { text: parameter.label ?? name }), star);
  const element = make("div", { class: `field field-${parameter.type}` }, label, control.element, doc, error);
  return {
    element,
    entry: control.entry,
    focus: () => control.input.focus(),
    showError: (reason) => {
      error.textContent = reason;
      control.input.setAttribute("aria-invalid", String(Boolean(reason)));
    },
  };
}

/** @param {Parameter} parameter */
function docText(parameter) {
  const range = ["number", "integer"].includes(parameter.type) ? rangeText(parameter) : "";
  return [parameter.doc, range].filter(Boolean).join(" · ");
}

/**
 * @param {string} id
 * @param {string} name
 * @param {Parameter} parameter
 * @param {Pick} pick
 * @param {Known} known
 */
function makeControl(id, name, parameter, pick, known) {
  if (parameter.type === "flag") return makeFlag(id, name, parameter);
  if (parameter.choices?.length) return makeChoice(id, name, parameter);
  if (parameter.type === "point" || parameter.type === "points") return makePoints(id, name, parameter, pick, known);
  if (parameter.type === "number" || parameter.type === "integer") return makeNumber(id, name, parameter);
  const input = make("input", { id, name, type: "text", value: entryText(parameter.default), autocomplete: "off" });
  return { element: input, input, entry: () => input.value };
}

/**
 * @param {string} id
 * @param {string} name
 * @param {Parameter} parameter
 */
function makeFlag(id, name, parameter) {
  const input = make("input", { id, name, type: "checkbox" });
  input.checked = parameter.default === true;
  return { element: make("span", { class: "flag" }, input), input, entry: () => input.checked };
}

/**
 * @param {string} id
 * @param {string} name
 * @param {Parameter} parameter
 */
function makeChoice(id, name, parameter) {
  const none = parameter.default === undefined || parameter.default === null ? [make("option", { value: "", text: parameter.unset ?? "not set" })] : [];
  const options = (parameter.choices ?? []).map((word) => make("option", { value: word, text: parameter.words?.[word] ?? word }));
  const input = make("select", { id, name }, ...none, ...options);
  input.value = entryText(parameter.default);
  return { element: input, input, entry: () => input.value };
}

/**
 * @param {string} id
 * @param {string} name
 * @param {Parameter} parameter
 */
function makeNumber(id, name, parameter) {
  const input = make("input", {
    id, name, type: "number", step: parameter.type === "integer" ? 1 : "any", value: entryText(parameter.default),
    inputmode: "decimal", autocomplete: "off",
  });
  const unit = make("span", { class: "unit", text: parameter.unit ?? "" });
  const { min, max } = parameter;
  const bounded = typeof min === "number" && typeof max === "number";
  const slider = bounded ? makeSlider(name, { ...parameter, min, max }, input) : "";
  const entry = () => (input.validity.badInput ? "not a number" : input.value);
  return { element: make("div", { class: "number" }, slider, input, unit), input, entry };
}

/**
 * @param {string} name
 * @param {Parameter & Bounds} parameter
 * @param {HTMLInputElement} input
 */
function makeSlider(name, parameter, input) {
  const slider = make("input", { type: "range", min: 0, max: 1000, "aria-label": `${name}, slider` });
  const follow = () => {
    const parsed = parseEntry(input.value, parameter);
    const value = parsed.ok && typeof parsed.value === "number" ? parsed.value : parameter.min;
    slider.value = String(toSlider(value, parameter));
    slider.setAttribute("aria-valuetext", `${number(value)} ${parameter.unit ?? ""}`.trim());
  };
  slider.addEventListener("input", () => {
    input.value = String(fromSlider(Number(slider.value), parameter));
    slider.setAttribute("aria-valuetext", `${input.value} ${parameter.unit ?? ""}`.trim());
  });
  input.addEventListener("input", follow);
  follow();
  return slider;
}

/**
 * @param {string} id
 * @param {string} name
 * @param {Parameter} parameter
 * @param {Pick} pick
 * @param {Known} known
 */
function makePoints(id, name, parameter, pick, known) {
  const many = parameter.type === "points";
  const placeholder = many ? "x, y; x, y; …" : "x, y";
  const input = make("input", { id, name, type: "text", value: entryText(parameter.default), placeholder, autocomplete: "off" });
  const button = make("button", { type: "button", class: "small", text: "Pick on the map", "aria-label": `Pick on the map: ${name}` });
  button.addEventListener("click", () => {
    const parsed = parseEntry(input.value, parameter);
    const points = /** @type {Point[]} */ (many && parsed.ok && Array.isArray(parsed.value) ? [...parsed.value] : []);
    pick((point) => {
      const rounded = /** @type {Point} */ (point.map((metres) => Math.round(metres * 100) / 100));
      points.push(rounded);
      input.value = entryText(many ? points : rounded);
      return many;
    }, [...points]);
  });
  const places = known.length ? makeKnown(name, known, many, input) : "";
  return { element: make("div", { class: "points" }, input, button, places), input, entry: () => input.value };
}

/**
 * Make the choice of a known place, which fills in its points.
 * @param {string} name
 * @param {Known} known
 * @param {boolean} many
 * @param {HTMLInputElement} input
 */
function makeKnown(name, known, many, input) {
  const options = known.map(({ words }, k) => make("option", { value: k, text: words }));
  const select = make("select", { "aria-label": `Place: ${name}` }, make("option", { value: "", text: "Place…" }), ...options);
  select.addEventListener("change", () => {
    const place = known[Number(select.value)];
    if (select.value !== "" && place) input.value = entryText(many ? place.points : place.points[0]);
    select.value = "";
  });
  return select;
}
