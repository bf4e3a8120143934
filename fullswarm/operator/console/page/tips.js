/** Tooltips: what only a name for screen readers tells of a button with an icon is shown to a mouse as well. */

/**
 * Give each button with an accessible name the same as its title, unless it has one.
 * @param {ParentNode} root
 */
export function addTips(root) {
  for (const button of root.querySelectorAll("button[aria-label]:not([title])")) {
    button.setAttribute("title", button.getAttribute("aria-label") ?? "");
  }
}
