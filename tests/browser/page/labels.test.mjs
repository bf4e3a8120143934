import assert from "node:assert/strict";
import { test } from "node:test";
import { page } from "./page.mjs";

const { LabelLayout, levelOfDetail } = await page("labels.js");
const VIEW = { width: 600, height: 600, covered: [] };

/** Numbers that are the same in each run (a linear congruential generator). */
function* numbers() {
  for (let seed = 7; ; ) {
    seed = (seed * 1103515245 + 12345) % 2147483648;
    yield seed / 2147483648;
  }
}

function swarm(count, reach = 14) {
  const random = numbers();
  const discs = Array.from({ length: count }, () => ({ x: 40 + 520 * random.next().value, y: 40 + 520 * random.next().value, reach }));
  const labels = discs.map(({ x, y }, k) => ({ key: `r${k}`, rank: k % 3, x, y, reach, width: 38, height: 22, left: 0, top: 0, gap: 0, far: false, shown: false }));
  return { discs, labels };
}

/** Whether a box and a circle have a point in common, by sampling the circle's rim and both middles. */
function touches({ left, top, width, height }, { x, y, reach }) {
  const within = (px, py) => px > left && px < left + width && py > top && py < top + height;
  for (let k = 0; k < 720; k += 1) {
    const angle = (k * Math.PI) / 360;
    if (within(x + 0.98 * reach * Math.cos(angle), y + 0.98 * reach * Math.sin(angle))) return true;
  }
  return within(x, y);
}

for (const count of [8, 32, 100]) {
  test(`of ${count} robots no label covers a robot or another label`, () => {
    const { discs, labels } = swarm(count);
    new LabelLayout().place(labels, discs, discs.length, VIEW);
    const shown = labels.filter((label) => label.shown);
    assert.ok(shown.length >= 0.8 * Math.min(count, 40), `${shown.length} shown`);
    for (const label of shown) {
      assert.ok(!discs.some((disc) => touches(label, disc)), label.key);
      assert.ok(label.left >= 0 && label.top >= 0 && label.left + label.width <= 600 && label.top + label.height <= 600);
      for (const other of shown) {
        if (other === label) continue;
        const apart = other.left >= label.left + label.width || label.left >= other.left + other.width
          || other.top >= label.top + label.height || label.top >= other.top + other.height;
        assert.ok(apart, `${label.key} and ${other.key}`);
      }
    }
  });
}

test("the same robots give the same picture, in whatever order they come", () => {
  const { discs, labels } = swarm(32);
  const again = labels.map((label) => ({ ...label })).reverse();
  new LabelLayout().place(labels, discs, discs.length, VIEW);
  new LabelLayout().place(again, discs, discs.length, VIEW);
  assert.deepEqual(again, labels);
});

test("a label keeps its side while there is room for it", () => {
  const layout = new LabelLayout();
  const label = { key: "r1", rank: 0, x: 100, y: 100, reach: 10, width: 30, height: 20, left: 0, top: 0, gap: 0, far: false, shown: false };
  const neighbour = { x: 125, y: 80, reach: 12 };
  layout.place([label], [{ x: 100, y: 100, reach: 10 }, neighbour], 2, VIEW);
  const side = Math.sign(label.top - 90);
  assert.equal(side, 1, "the other robot is above");
  layout.place([label], [{ x: 100, y: 100, reach: 10 }], 1, VIEW); // it has gone
  assert.equal(Math.sign(label.top - 90), side);
});

test("where there is no room at all, what matters most is shown", () => {
  const make = (key, rank) => ({ key, rank, x: 20, y: 20, reach: 10, width: 26, height: 20, left: 0, top: 0, gap: 0, far: false, shown: false });
  const labels = [make("calm", 3), make("alarm", 1)];
  new LabelLayout().place(labels, [{ x: 20, y: 20, reach: 10 }], 1, { width: 60, height: 42, covered: [] });
  assert.deepEqual(labels.filter(({ shown }) => shown).map(({ key }) => key), ["alarm"]);
});

test("no label is under what lies over the map, and it comes back when that has gone", () => {
  const label = { key: "r1", rank: 0, x: 100, y: 100, reach: 10, width: 30, height: 20, left: 0, top: 0, gap: 0, far: false, shown: false };
  const layout = new LabelLayout();
  const place = (covered) => layout.place([label], [{ x: 100, y: 100, reach: 10 }], 1, { ...VIEW, covered });
  place([{ left: 100, top: 0, right: 200, bottom: 600 }]);
  assert.ok(label.shown && label.left + label.width <= 100, "it is on the other side");
  place([{ left: 0, top: 0, right: 600, bottom: 600 }]);
  assert.ok(!label.shown);
  place([]);
  assert.ok(label.shown);
});

test("small robots have fewer words", () => {
  assert.deepEqual([20, 8, 5, 3, 2.9, 0.5].map(levelOfDetail), ["all", "all", "ids", "ids", "alarms", "alarms"]);
});

test("a label comes back to its robot when there is room", () => {
  const layout = new LabelLayout();
  const label = { key: "r1", rank: 0, x: 100, y: 100, reach: 10, width: 30, height: 20, left: 0, top: 0, gap: 0, far: true, shown: false };
  const around = Array.from({ length: 12 }, (_, k) => ({ x: 100 + 26 * Math.cos(k / 2), y: 100 + 26 * Math.sin(k / 2), reach: 12 }));
  layout.place([label], [{ x: 100, y: 100, reach: 10 }, ...around], 13, VIEW);
  assert.ok(label.shown && label.gap > 20, `${label.gap}`);
  layout.place([label], [{ x: 100, y: 100, reach: 10 }], 1, VIEW);
  assert.ok(label.gap < 20, `${label.gap}`);
});

test("a hundred labels take little of a frame", () => {
  const { discs, labels } = swarm(100);
  const layout = new LabelLayout();
  layout.place(labels, discs, discs.length, VIEW);
  const began_ms = performance.now();
  for (let frame = 0; frame < 100; frame += 1) layout.place(labels, discs, discs.length, VIEW);
  const each_ms = (performance.now() - began_ms) / 100;
  console.log(`labels of 100 robots: ${each_ms.toFixed(3)} ms a frame`);
  assert.ok(each_ms < 50, `${each_ms} ms: a search of all pairs would take as long`); // also on a busy machine
});
