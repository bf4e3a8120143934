/** Where the page's modules lie, for the tests beside this file. */

/** Import a module of the page. */
export function page(name) {
  return import(new URL(`../../../fullswarm/operator/console/page/${name}`, import.meta.url).href);
}
