/**
 * Measures the page as a person meets it: where things are, what lies on what, what is cut. It knows ids of the parts that
 * matter, and nothing of the style sheets. Returns complaints, one line each.
 */
({ coarse, rows: leastRows }) => {
  const bad = [];
  const wide = innerWidth, high = innerHeight;
  const root = document.documentElement;
  const name = (e) => e.id ? `#${e.id}` : `${e.tagName.toLowerCase()}.${[...e.classList].join(".")} "${e.textContent.trim().slice(0, 30)}"`;
  const shown = (e) => e.checkVisibility({ visibilityProperty: true, opacityProperty: true });
  const spoken = (e) => e.closest(".spoken, .entry-kind, .skips, h1") !== null || getComputedStyle(e).clipPath !== "none";
  const box = (e) => e.getBoundingClientRect();
  const area = (a, b) => Math.max(0, Math.min(a.right, b.right) - Math.max(a.left, b.left)) * Math.max(0, Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top));

  /** The part of an element that its scrolling ancestors let through. */
  function seen(e) {
    let { left, top, right, bottom } = box(e);
    for (let up = e.parentElement; up; up = up.parentElement) {
      const { overflowX, overflowY } = getComputedStyle(up);
      if (overflowX === "visible" && overflowY === "visible") continue;
      const b = box(up);
      [left, top, right, bottom] = [Math.max(left, b.left), Math.max(top, b.top), Math.min(right, b.right), Math.min(bottom, b.bottom)];
    }
    return { left, top, right, bottom, width: right - left, height: bottom - top };
  }

  function scrolls(e) {
    for (let up = e.parentElement; up && up !== document.body; up = up.parentElement) {
      const { overflowY, overflowX } = getComputedStyle(up);
      if (/(auto|scroll)/.test(overflowY) && up.scrollHeight > up.clientHeight + 1) return true;
      if (/(auto|scroll)/.test(overflowX) && up.scrollWidth > up.clientWidth + 1) return true;
    }
    return false;
  }

  if (root.scrollWidth > wide || document.body.scrollWidth > wide) bad.push(`the page is ${root.scrollWidth} px wide`);
  if (document.body.scrollHeight > high + 1) bad.push(`the page is ${document.body.scrollHeight} px high`);

  // The map: its size, and that nothing but its own controls lies on it.
  const map = document.getElementById("map");
  const m = box(map);
  const least = 0.4 * Math.min(wide, high);
  if (m.width < least || m.height < least) bad.push(`the map is ${m.width.toFixed(0)} x ${m.height.toFixed(0)} px, least ${least}`);
  if (m.left < 0 || m.top < 0 || m.right > wide || m.bottom > high) bad.push("the map is not on the screen");
  const own = (e) => e.closest(".zoom, .legend, .camera-toggle, .debug, #map, #map-ground") !== null;
  for (const e of document.body.querySelectorAll("*")) {
    if (!shown(e) || spoken(e) || own(e) || e.contains(map)) continue;
    const over = area(seen(e), m);
    if (over > 2) bad.push(`${name(e)} covers ${over.toFixed(0)} px² of the map`);
  }

  // Stop and e-stop: on the screen, large, and hit at all their corners.
  for (const id of ["stop", "estop"]) {
    const e = document.getElementById(id);
    const b = box(e);
    if (b.left < 0 || b.top < 0 || b.right > wide || b.bottom > high) bad.push(`#${id} is not on the screen`);
    if (b.width < 44 || b.height < 44) bad.push(`#${id} is ${b.width} x ${b.height} px`);
    for (const [u, v] of [[0.1, 0.15], [0.9, 0.15], [0.5, 0.5], [0.1, 0.85], [0.9, 0.85]]) {
      const hit = document.elementFromPoint(b.left + u * b.width, b.top + v * b.height);
      if (!hit || !e.contains(hit)) bad.push(`#${id} is covered by ${hit && name(hit)}`);
    }
  }

  // Controls: on the screen, not covered, large enough for a finger.
  const controls = [...document.querySelectorAll("button, select, input, a[href], summary, [tabindex='0']")];
  for (const e of controls) {
    if (!shown(e) || spoken(e) || e === map) continue;
    const b = box(e);
    const s = seen(e);
    if (b.left < -1 || b.right > wide + 1) if (!scrolls(e)) bad.push(`${name(e)} is beside the screen`);
    if (s.width < b.width - 1 || s.height < b.height - 1 || b.top < -1 || b.bottom > high + 1) {
      if (!scrolls(e)) bad.push(`${name(e)} is cut off`);
      continue;
    }
    const hit = document.elementFromPoint(b.left + b.width / 2, b.top + b.height / 2);
    if (hit && !e.contains(hit) && !hit.contains(e)) bad.push(`${name(e)} lies under ${name(hit)}`);
    if (!coarse) continue;
    const target = box(e.closest(".cell-check, label, .flag, .estop-panel li") ?? e);
    if (Math.min(target.width, target.height) < 43.5 && e.tabIndex === 0) {
      bad.push(`${name(e)} is ${target.width.toFixed(0)} x ${target.height.toFixed(0)} px for a finger`);
    }
  }

  // Controls do not lie on each other.
  const plain = controls.filter((e) => shown(e) && !spoken(e) && e !== map && !e.closest(".fleet-rows, .rows") && e.matches("button, select, input"));
  plain.forEach((one, k) => plain.slice(k + 1).forEach((other) => {
    if (!one.contains(other) && !other.contains(one) && area(seen(one), seen(other)) > 4) bad.push(`${name(one)} and ${name(other)} overlap`);
  }));

  // Words: not cut, unless the whole of it is in a title or can be scrolled to.
  for (const e of document.querySelectorAll("button, h2, h3, p, label, .pill, strong, .drive-notes, kbd, dt, dd")) {
    if (!shown(e) || spoken(e) || e.closest(".row")) continue;
    const { overflowX, overflowY } = getComputedStyle(e);
    const cut = (overflowX !== "visible" || e.tagName === "BUTTON") && e.scrollWidth > e.clientWidth + 1;
    const clipped = overflowY !== "visible" && !/(auto|scroll)/.test(overflowY) && e.scrollHeight > e.clientHeight + 2;
    if ((cut || clipped) && !e.title && !/(auto|scroll)/.test(overflowX)) bad.push(`the words of ${name(e)} are cut`);
  }

  if (document.body.matches(":has(kbd)") && coarse) {
    for (const e of document.querySelectorAll("kbd")) if (shown(e)) bad.push(`the key cap ${e.textContent} is shown to a finger`);
  }

  // Rows of the fleet that are seen whole.
  const rows = [...document.querySelectorAll("#fleet-rows > [role=row]")].filter((e) => {
    if (!shown(e)) return false;
    const b = box(e);
    const s = seen(e);
    return s.height >= b.height - 1.5 && b.top >= 0 && b.bottom <= high + 1;
  }).length;
  if (rows < leastRows) bad.push(`${rows} rows of the fleet are seen, least ${leastRows}`);
  return bad;
}
