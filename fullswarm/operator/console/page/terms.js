/** The folded part of the behaviour form: which robots count as neighbours, which take part, and their roles. */

import { make, setText } from "./dom.js";
import { makeField } from "./field.js";
import { parseTerms, termEntries, termFields } from "./forms.js";

/** @import { Behaviour, Terms } from "./types.d.ts" */

const TITLE = "More: team, who takes part, roles";

/**
 * Its element, and how to read it: what is wrong is shown at its field, which gets the focus, and returned in words.
 * @typedef {{element: HTMLElement, read: () => {terms: Terms, wrong: string[]}}} TermsPart
 */

/**
 * Make the part for a behaviour.
 * @param {Behaviour} record
 * @param {string[]} groups
 * @param {Terms} [given] what the fields say at first
 * @returns {TermsPart}
 */
export function makeTerms(record, groups, given = {}) {
  const sections = termFields(record, groups);
  const parameters = Object.assign({}, ...sections.map(({ fields }) => fields));
  const begun = termEntries(given, parameters);
  const fields = Object.fromEntries(
    Object.keys(parameters).map((name) => [name, makeField(name, { ...parameters[name], default: begun[name] || undefined }, () => {})]),
  );
  const entries = () => Object.fromEntries(Object.entries(fields).map(([name, field]) => [name, field.entry()]));
  const summary = make("summary", { testid: "terms", text: TITLE });
  const element = make("details", { class: "terms" }, summary);
  for (const { title, fields: own } of sections) {
    const elements = Object.keys(own).map((name) => fields[name].element);
    element.append(make("fieldset", {}, make("legend", { text: title }), ...elements));
  }
  const count = () => {
    const said = Object.values(entries()).filter((entry) => String(entry).trim() !== "").length;
    setText(summary, said ? `${TITLE} (${said} set)` : TITLE); // also where it is folded again
  };
  for (const event of ["input", "change"]) element.addEventListener(event, count);
  const read = () => {
    const { terms, errors } = parseTerms(entries(), parameters);
    for (const [name, field] of Object.entries(fields)) field.showError(errors[name] ?? "");
    const [first] = Object.keys(errors);
    if (first !== undefined) {
      element.open = true;
      fields[first].focus();
    }
    return { terms, wrong: Object.entries(errors).map(([name, error]) => `${parameters[name].label}: ${error}`) };
  };
  count();
  return { element, read };
}
