/** Colours of the map after Okabe and Ito, legible for the colour-blind; a pattern and a shape always go with them. */

const COLOURS = ["#56B4E9", "#E69F00", "#009E73", "#F0E442", "#CC79A7", "#D55E00", "#0072B2"];
const FIRST = ["move_to_goal", "flocking", "formation", "rendezvous", "voronoi_coverage", "drive", "navigate"];
const PATTERNS = ["plain", "stripes", "dots", "rings"];

export const IDLE = { colour: "#9AA3AD", pattern: "plain" };

/** @import { Robot } from "./types.d.ts" */

/** @typedef {{colour: string, pattern: string}} Look */
/** @typedef {(typeof MAP_COLOURS)["light"]} Colours */

/**
 * Give each law its colour and pattern: common ones a colour of their own, the others by the order of their names,
 * so that all pages show the same.
 */
export class Looks {
  /** @param {Iterable<string>} names of behaviours */
  constructor(names = []) {
    const laws = [...new Set([...FIRST, ...[...names].map(lawOf).sort()])];
    this.looks = new Map(
      laws.map((law, k) => [law, { colour: COLOURS[k % COLOURS.length], pattern: PATTERNS[k % PATTERNS.length] }]),
    );
  }

  /**
   * @param {string | undefined} behaviour
   * @returns {Look} of a behaviour; grey for a robot without one
   */
  of(behaviour) {
    if (!behaviour || behaviour === "stop") return IDLE;
    return this.looks.get(lawOf(behaviour)) ?? IDLE;
  }
}

/**
 * Return the name that a behaviour and its filtered variant share.
 * @param {string} behaviour
 */
export function lawOf(behaviour) {
  return behaviour.endsWith("_bc") ? behaviour.slice(0, -3) : behaviour;
}

/**
 * Return the outline and the letter of a robot: those of its make's record, or else a circle and its make's initial.
 * @param {string} make
 * @param {string} driver its URL
 * @param {Record<string, [string, string]>} icons of the makes that the console knows, by the schemes of their URLs
 */
export function kindOf(make = "", driver = "", icons = {}) {
  const [shape = "circle", letter = ""] = icons[driver.split(":")[0]] ?? [];
  return { shape, letter: letter || (make[0] ?? "?").toUpperCase() };
}

/** Of the lines of charts, in the order of the lines: at least 3:1 against the panel. Dashes and names go with them. */
export const LINE_COLOURS = {
  light: ["#0072B2", "#B3470A", "#00704F", "#8A3F8C", "#7A5C00", "#A01A58", "#3D5A80", "#4A5561"],
  dark: ["#56B4E9", "#FF9A5C", "#2BC493", "#E0A0DC", "#F0E442", "#FF8FB5", "#A9C4E8", "#C3CED8"],
};

export const MAP_COLOURS = {
  light: {
    dark: false, outside: "#E4E8EC", floor: "#FAFBFC", grid: "#E2E6EA", wall: "#4A5560", box: "#8893A0", seen: "#A35400",
    ink: "#14202B", halo: "#FFFFFF", select: "#0B57D0", goal: "#0B57D0", filter: "#B3261E", cover: [0, 114, 178, 52],
    sensing: "rgba(11, 87, 208, 0.5)", lasso: "rgba(11, 87, 208, 0.14)", alarm: "#C5221F", edge: "#14202B",
    dim: "rgba(228, 232, 236, 0.62)",
  },
  dark: {
    dark: true, outside: "#0B1015", floor: "#161D24", grid: "#212A33", wall: "#9AA7B4", box: "#55616D", seen: "#FFB454",
    ink: "#EAF0F5", halo: "#0B1015", select: "#8AB4F8", goal: "#8AB4F8", filter: "#FF8A80", cover: [86, 180, 233, 56],
    sensing: "rgba(138, 180, 248, 0.5)", lasso: "rgba(138, 180, 248, 0.18)", alarm: "#FF5F52", edge: "#0B1015",
    dim: "rgba(11, 16, 21, 0.62)",
  },
};

const LAMPS = /** @type {Record<string, string>} */ ({
  white: "#FFFFFF", red: "#E5202B", yellow: "#F5D000", green: "#18B13C", blue: "#2A7BFF",
});

/**
 * Return the colour of a robot's lamp; undefined: it is off, or has none.
 * @param {Partial<Robot>} robot
 */
export function lampColour({ actuators = {} }) {
  const lamp = Object.values(actuators).find((value) => Object.hasOwn(LAMPS, value));
  return lamp && LAMPS[lamp];
}

/**
 * Name what was asked last of a robot's actuators: "lamp red, gripper closed".
 * @param {Partial<Robot>} robot
 */
export function actuatorText({ actuators = {} }) {
  return Object.entries(actuators).map((each) => each.join(" ")).join(", ");
}
