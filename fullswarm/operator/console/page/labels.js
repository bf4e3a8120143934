/**
 * Where labels go: beside their robots, never over a robot or another label, nor under a button. Deterministic and
 * pure; CSS pixels.
 *
 * Greedy: labels are placed one after the other, those that matter most first. Each tries the place it had before, so
 * that it does not jump from side to side, then the eight directions near its robot, then the same farther away: those
 * that matter go farthest, with a line to their robots. A label that fits nowhere is not shown.
 */

/** Directions around a robot, the preferred first: x and y of the label's nearest corner or edge, in units of reach. */
const DIRECTIONS = [[0.71, -0.71], [0.71, 0.71], [1, 0], [-0.71, -0.71], [-0.71, 0.71], [-1, 0], [0, -1], [0, 1]];
const GAPS_PX = [1, 13, 28, 52, 80];
const NEAR_GAPS = 3; // only labels that matter go farther
export const LINE_FROM_PX = 20; // a label with a larger gap has a line to its robot
const FARTHEST_PX = Math.max(...GAPS_PX);
const PLACES = DIRECTIONS.length * GAPS_PX.length;
const STEADY_PLACES = DIRECTIONS.length * GAPS_PX.filter((gap) => gap <= LINE_FROM_PX).length;
const NEAR_PLACES = DIRECTIONS.length * NEAR_GAPS;

/**
 * How much a map shows of each robot, by its radius on the screen: "all" its label in words, "ids" its id alone,
 * "alarms" only labels of those that need attention, are selected alone, or are pointed at.
 * @param {number} radius_px
 * @returns {"all" | "ids" | "alarms"}
 */
export function levelOfDetail(radius_px) {
  if (radius_px >= 8) return "all";
  return radius_px >= 3 ? "ids" : "alarms";
}

/**
 * @typedef {{x: number, y: number, reach: number}} Disc  a robot's body, or a mark beside it
 * @typedef {{key: string, rank: number, x: number, y: number, reach: number, width: number, height: number,
 *   left: number, top: number, gap: number, far: boolean, shown: boolean}} Label
 *   key: the same from frame to frame; rank: the least is placed first; x, y, reach: its robot; far: it may go far; left,
 *   top, gap, shown: the outcome
 * @typedef {Pick<import("./viewport.js").Viewport, "width" | "height" | "covered">} Area
 */

export class LabelLayout {
  #chosen = /** @type {Map<string, number>} */ (new Map());
  #taken = /** @type {Label[]} */ ([]);
  #nearDiscs = /** @type {Disc[]} */ ([]); // of the label that is being placed
  #nearLabels = /** @type {Label[]} */ ([]);

  /**
   * Set `left`, `top` and `shown` of the first `count` labels.
   * @param {Label[]} labels  sorted here
   * @param {Disc[]} discs
   * @param {number} discCount
   * @param {Area} view
   */
  place(labels, discs, discCount, view) {
    labels.sort(byRank);
    this.#taken.length = 0;
    for (const label of labels) {
      const places = label.far ? PLACES : NEAR_PLACES;
      const before = this.#chosen.get(label.key) ?? 0;
      const first = before < STEADY_PLACES ? before : 0; // a line to the robot only as long as it is needed
      this.#look(label, discs, discCount);
      label.shown = this.#fits(label, first, view);
      for (let k = 0; k < places && !label.shown; k += 1) {
        if (k !== first && this.#fits(label, k, view)) {
          label.shown = true;
          this.#chosen.set(label.key, k);
        }
      }
      if (label.shown) this.#taken.push(label);
    }
    if (this.#chosen.size > 4 * labels.length + 64) this.#chosen.clear();
  }

  /**
   * Note what is near enough to be in the way of a label at any of its places.
   * @param {Label} label
   * @param {Disc[]} discs
   * @param {number} discCount
   */
  #look(label, discs, discCount) {
    const { x, y } = label;
    const [wide, high] = [label.reach + FARTHEST_PX + label.width, label.reach + FARTHEST_PX + label.height];
    this.#nearDiscs.length = this.#nearLabels.length = 0;
    for (let k = 0; k < discCount; k += 1) {
      const disc = discs[k];
      if (Math.abs(disc.x - x) < wide + disc.reach && Math.abs(disc.y - y) < high + disc.reach) this.#nearDiscs.push(disc);
    }
    for (const other of this.#taken) {
      const near = other.left < x + wide && other.left + other.width > x - wide && other.top < y + high && other.top + other.height > y - high;
      if (near) this.#nearLabels.push(other);
    }
  }

  /**
   * Put a label at a place; return whether it is free there.
   * @param {Label} label
   * @param {number} place
   * @param {Area} view
   */
  #fits(label, place, view) {
    const [dx, dy] = DIRECTIONS[place % DIRECTIONS.length];
    label.gap = GAPS_PX[Math.floor(place / DIRECTIONS.length)];
    const away = label.reach + label.gap;
    label.left = label.x + dx * away - (dx > 0 ? 0 : dx < 0 ? label.width : label.width / 2);
    label.top = label.y + dy * away - (dy > 0 ? 0 : dy < 0 ? label.height : label.height / 2);
    const [right, bottom] = [label.left + label.width, label.top + label.height];
    if (label.left < 0 || label.top < 0 || right > view.width || bottom > view.height) return false;
    for (const box of view.covered) {
      if (label.left < box.right && right > box.left && label.top < box.bottom && bottom > box.top) return false;
    }
    for (const { x, y, reach } of this.#nearDiscs) {
      const gapX = Math.max(label.left - x, 0, x - right);
      const gapY = Math.max(label.top - y, 0, y - bottom);
      if (gapX * gapX + gapY * gapY < reach * reach) return false;
    }
    for (const other of this.#nearLabels) {
      const apart = other.left >= right || other.left + other.width <= label.left || other.top >= bottom || other.top + other.height <= label.top;
      if (!apart) return false;
    }
    return true;
  }
}

/**
 * Those that matter most first, then in the order of their keys: the same labels always give the same picture.
 * @param {Label} a
 * @param {Label} b
 */
function byRank(a, b) {
  return a.rank - b.rank || (a.key < b.key ? -1 : a.key > b.key ? 1 : 0);
}
