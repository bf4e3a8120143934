/**
 * Plane geometry of the map: what a lasso contains, places of a formation, assignment of robots. Metres; no page needed.
 */

/** @import { Point } from "./types.d.ts" */

/**
 * Return whether a point lies within a polygon (even-odd rule).
 * @param {Point} point
 * @param {Point[]} polygon
 */
export function insidePolygon([x, y], polygon) {
  let inside = false;
  for (let i = 0, j = polygon.length - 1; i < polygon.length; j = i, i += 1) {
    const [xi, yi] = polygon[i];
    const [xj, yj] = polygon[j];
    if (yi > y !== yj > y && x < ((xj - xi) * (y - yi)) / (yj - yi) + xi) inside = !inside;
  }
  return inside;
}

/**
 * Return the ids of the robots within a lasso.
 * @param {Iterable<{id: string, x: number, y: number}>} robots
 * @param {Point[]} lasso
 */
export function lassoed(robots, lasso) {
  if (lasso.length < 3) return [];
  return [...robots].filter((robot) => insidePolygon([robot.x, robot.y], lasso)).map((robot) => robot.id);
}

/**
 * Return the robot nearest to a point, or null if none is within its own radius plus `slack_m`.
 * @template {{id: string, x: number, y: number, radius: number}} R
 * @param {Iterable<R>} robots
 * @param {Point} point
 * @param {number} slack_m
 * @returns {R | null}
 */
export function robotAt(robots, [x, y], slack_m) {
  let best = /** @type {R | null} */ (null);
  let bestGap = slack_m;
  for (const robot of robots) {
    const gap = Math.hypot(robot.x - x, robot.y - y) - robot.radius;
    if (gap <= bestGap) [best, bestGap] = [robot, gap];
  }
  return best;
}

/**
 * Return `count` places on a ring through `edge`.
 * @param {Point} centre
 * @param {Point} edge
 * @param {number} count
 * @returns {Point[]}
 */
function ring(centre, edge, count) {
  const radius = Math.hypot(edge[0] - centre[0], edge[1] - centre[1]);
  const start = Math.atan2(edge[1] - centre[1], edge[0] - centre[0]);
  return Array.from({ length: count }, (_, k) => {
    const angle = start + (2 * Math.PI * k) / count;
    return [centre[0] + radius * Math.cos(angle), centre[1] + radius * Math.sin(angle)];
  });
}

/**
 * Return `count` places on a line through `centre`, one end at `edge`.
 * @param {Point} centre
 * @param {Point} edge
 * @param {number} count
 * @returns {Point[]}
 */
function line(centre, edge, count) {
  return Array.from({ length: count }, (_, k) => {
    const share = count === 1 ? 0 : 1 - (2 * k) / (count - 1);
    return [centre[0] + share * (edge[0] - centre[0]), centre[1] + share * (edge[1] - centre[1])];
  });
}

/**
 * Return `count` places of a square grid around `centre`, turned towards `edge`, which is near one corner.
 * @param {Point} centre
 * @param {Point} edge
 * @param {number} count
 * @returns {Point[]}
 */
function grid(centre, edge, count) {
  const columns = Math.ceil(Math.sqrt(count));
  const rows = Math.ceil(count / columns);
  const [dx, dy] = [edge[0] - centre[0], edge[1] - centre[1]];
  const turn = Math.atan2(dy, dx) - Math.PI / 4;
  const spacing = (Math.SQRT2 * Math.hypot(dx, dy)) / Math.max(1, columns - 1);
  return Array.from({ length: count }, (_, k) => {
    const u = ((k % columns) - (columns - 1) / 2) * spacing;
    const v = (Math.floor(k / columns) - (rows - 1) / 2) * spacing;
    return [
      centre[0] + u * Math.cos(turn) - v * Math.sin(turn),
      centre[1] + u * Math.sin(turn) + v * Math.cos(turn),
    ];
  });
}

const SHAPES = { ring, line, grid };

/**
 * Return the places of a formation dragged from its centre outwards.
 * @param {"ring" | "line" | "grid"} shape
 * @param {Point} centre
 * @param {Point} edge where the drag is now
 * @param {number} count
 * @returns {Point[]}
 */
export function places(shape, centre, edge, count) {
  return SHAPES[shape](centre, edge, count);
}

/**
 * Return the smallest distance between any two places; Infinity for fewer than two.
 * @param {Point[]} points
 */
export function closestPair(points) {
  let least = Infinity;
  for (let i = 0; i < points.length; i += 1) {
    for (let j = i + 1; j < points.length; j += 1) {
      least = Math.min(least, Math.hypot(points[i][0] - points[j][0], points[i][1] - points[j][1]));
    }
  }
  return least;
}

/**
 * Assign targets so that the sum of squared distances is least (Hungarian method, O(n^3), Kuhn 1955).
 * @param {Point[]} from
 * @param {Point[]} targets as many as `from`
 * @returns {Point[]} a target for each of `from`
 */
export function assign(from, targets) {
  const n = from.length;
  const cost = (/** @type {number} */ i, /** @type {number} */ j) => (from[i][0] - targets[j][0]) ** 2 + (from[i][1] - targets[j][1]) ** 2;
  const u = new Float64Array(n + 1);
  const v = new Float64Array(n + 1);
  const owner = new Int32Array(n + 1).fill(-1); // of each column; column n is the unassigned row's
  const way = new Int32Array(n + 1);
  for (let i = 0; i < n; i += 1) {
    const least = new Float64Array(n + 1).fill(Infinity);
    const used = new Uint8Array(n + 1);
    let column = n;
    owner[n] = i;
    do {
      used[column] = 1;
      const row = owner[column];
      let delta = Infinity;
      let next = -1;
      for (let j = 0; j < n; j += 1) {
        if (used[j]) continue;
        const reduced = cost(row, j) - u[row] - v[j];
        if (reduced < least[j]) [least[j], way[j]] = [reduced, column];
        if (least[j] < delta) [delta, next] = [least[j], j];
      }
      for (let j = 0; j <= n; j += 1) {
        if (used[j]) [u[owner[j]], v[j]] = [u[owner[j]] + delta, v[j] - delta];
        else least[j] -= delta;
      }
      column = next;
    } while (owner[column] !== -1);
    while (column !== n) {
      owner[column] = owner[way[column]];
      column = way[column];
    }
  }
  const given = /** @type {Point[]} */ (new Array(n));
  for (let j = 0; j < n; j += 1) given[owner[j]] = targets[j];
  return given;
}

/**
 * Return the radius around one goal within which `count` discs have room: one alone drives right to it.
 * @param {number} count
 * @param {number} radius_m of a robot
 */
export function goalRadius(count, radius_m) {
  return count <= 1 ? 0.05 : Math.round((radius_m + 0.1) * (1 + 1.2 * Math.sqrt(count)) * 100) / 100;
}

/**
 * Return the box around points, or null without any.
 * @param {Point[]} points
 * @returns {[number, number, number, number] | null} x0, y0, x1, y1
 */
export function bounds(points) {
  if (points.length === 0) return null;
  const xs = points.map((p) => p[0]);
  const ys = points.map((p) => p[1]);
  return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
}

/**
 * Turn from angle `a` towards `b` by a share of the shorter way; radians.
 * @param {number} a
 * @param {number} b
 * @param {number} share
 */
export function mixAngle(a, b, share) {
  const turn = Math.atan2(Math.sin(b - a), Math.cos(b - a));
  return a + turn * share;
}
