/** The frames that the console sends, with the fields that the page reads. Only for the type check. */

export type Point = [x_m: number, y_m: number];
export type Box = [x0_m: number, y0_m: number, x1_m: number, y1_m: number];

export interface Robot {
  robot: string;
  age_s: number;
  silent: boolean;
  host: string;
  version: string;
  make: string;
  model: string;
  driver: string;
  firmware: string;
  lifecycle: string;
  behaviour: string;
  moving: boolean;
  estop: boolean;
  state: string;
  state_word: string;
  state_why: string;
  attention: boolean;
  brief: string; // what is wrong, in a word or two; empty: nothing
  ended: string; // how its last behaviour has ended, as was intended; empty: otherwise
  stop_reason: string;
  stop_code: string;
  fault: string;
  advice: string;
  battery: number | null;
  contacts: number;
  collisions: number;
  radius_m: number | null;
  filter_note: string;
  pose_by: string;
  capabilities: string[];
  actuators: Record<string, string>;
  memory: string;
}

export interface Parameter {
  type: string;
  unit?: string;
  doc?: string;
  default?: unknown;
  min?: number | null;
  max?: number | null;
  choices?: string[];
  required?: boolean;
  label?: string; // instead of its name
  words?: Record<string, string>; // of the choices
  unset?: string; // of no choice
}

export interface Behaviour {
  title?: string;
  summary?: string;
  filtered?: boolean;
  expires_s?: number;
  centralised?: boolean;
  team?: string;
  roles?: Record<string, { needs?: string[]; at_least?: number; at_most?: number; doc?: string }>;
  parameters?: Record<string, Parameter>;
}

/** A place on the map. An area has two opposite corners, or all of its corners in order. */
export interface Place {
  kind: "point" | "area";
  points: Point[];
}

/** A request as it was asked; no robots: whichever are selected. */
export interface SavedRequest extends Terms {
  behaviour: string;
  parameters?: Record<string, unknown>;
  robots?: string[];
}

export interface Shown {
  arena: Box | null;
  boxes: number[][];
  origin: [latitude_deg: number, longitude_deg: number] | null;
  sensing_radius_m: number | null;
  behaviours: Record<string, Behaviour>;
  groups: Record<string, string[]>;
  own_groups: string[];
  places: Record<string, Place>;
  saved: Record<string, SavedRequest>;
}

/** What is drawn under the map. `place`: size of a pixel (m), lower left corner (m), yaw; null: it fills the arena. */
export type UnderlayFrame = { t: "underlay"; name: string; address: string } & (
  | { kind: "picture"; width: number; height: number; place: [number, number, number, number] | null }
  | { kind: "tiles"; zooms: [number, number]; attribution: string }
);

export interface World extends Partial<Shown> {
  t: "world" | "hello";
}

export interface Hello extends World {
  t: "hello";
  swarm: string;
  operator: string;
  read_only: boolean;
  icons?: Record<string, [shape: string, letter: string]>;
  history?: { trails?: Record<string, Point[]>; log?: Entry[] };
}

export interface Entry {
  at: number;
  clock: string;
  kind: string;
  text: string;
  robots: string[];
  request_id: string;
  by: string; // the operator that caused it; empty: none did
  severity: string; // info, warning, error
  mine: boolean;
  number: number; // the same if the line is repeated
  count: number;
}

export interface NodeState {
  node: string;
  age_s: number;
  active: boolean;
}

export interface Dock {
  dock: string;
  x: number;
  y: number;
  heading: number; // of a robot that is docked there
  approach_m: number;
  robot: string;
  phase: string;
  reason: string;
}

export interface Fleet {
  t: "fleet";
  hub: boolean;
  core_age_s: number | null;
  nodes: NodeState[];
  robots: Robot[];
  missing: string[];
  docks?: Dock[];
}

export interface States {
  t: "state";
  at: number;
  robots: [id: string, x_m: number | null, y_m: number | null, heading_rad: number | null, speed_m_s: number | null][];
}

export interface Goal {
  request_id: string;
  goal: Point | null;
  target: Point | null;
  radius_m: number | null;
}

export interface Lease {
  robot: string;
  operator: string;
  taken_from: string;
  mine: boolean;
}

export interface Coverage {
  t: "coverage";
  origin: Point;
  cell_m: number;
  rows: number;
  columns: number;
  bits: string;
}

export interface RequestStatus {
  t: "request";
  request_id: string;
  behaviour: string;
  phase: string;
  reason: string;
  code: string;
  about: Record<string, string>;
  robots: string[];
  running: string[];
  missing: string[];
  refused_by: string[];
  left_out: string[];
  roles: Record<string, string>;
  mine: boolean;
}

/** What a request says beside its parameters. */
export interface Terms {
  team?: string;
  needs?: Record<string, number | string[]>;
  roles?: Record<string, string[]>;
}

export interface Receipt {
  robot: string;
  standing: boolean;
  rolled_m: number | null;
  after_s: number | null;
  engaged: boolean;
}

export interface Estop {
  t: "estop";
  id: string;
  engaged: boolean;
  done: boolean;
  receipts: Receipt[];
  waiting: string[];
  silent: string[];
}

export interface Stop {
  t: "stop";
  standing: string[];
  moving: string[];
  silent: string[];
  done: boolean;
}

/** A place on the map that a step names: of an area two opposite corners or all, of a formation a target per robot. */
export interface StepPlace {
  parameter: string;
  kind: "point" | "points" | "area" | "formation";
  points: Point[];
}

export interface Step {
  name: string;
  behaviour: string;
  phase: string;
  robots: string[];
  elapsed_s: number;
  waits_for: string[];
  confirm: string;
  reason: string;
  places?: StepPlace[]; // none in the past of an older version
}

export interface Mission {
  mission: string;
  name: string;
  phase: string;
  operator: string;
  reason: string;
  silent: boolean;
  tracks: { name: string; steps: Step[] }[];
}

export interface MissionReply {
  t: "mission";
  op: string;
  mission: string;
  request_id: string;
  ok: boolean;
  reason: string;
  code: string;
}

export interface Lost {
  t: "lost";
  robots: string[];
  by: string;
}

export interface AnswerFrame {
  t: "answer";
  ref: number | null;
  ok: boolean;
  reason: string;
  request_id: string;
}

export interface Camera {
  name: string;
  problem: string;
}

/** Where a picture lies on the floor: a grid of its points, row by row from the upper left. */
export interface FloorMesh {
  columns: number; // of cells: there is one point more
  rows: number;
  places: (Point | null)[];
  eye_m: [x_m: number, y_m: number, z_m: number]; // of the camera
  tops_m: number; // height of the robots' tags
}

export interface Picture {
  t: "picture";
  camera: string;
  jpeg: string;
  mesh: FloorMesh | null; // null: it is not known where the camera is
}

export interface StudyProbe {
  id: string;
  question: string;
  choices: string[];
  freeze: boolean;
}

export interface Study {
  t: "study";
  phase: "briefing" | "running" | "tlx" | "done";
  mine: boolean;
  title: string;
  task: string;
  briefing: string;
  consent: string;
  duration_s: number;
  left_s: number;
  hide: string[];
  probe: StudyProbe | null;
  tlx: { scales: { name: string; title: string; question: string; low: string; high: string }[]; pairs: [string, string][] } | null;
  reason: string;
}

export interface TimeEvent {
  at: number;
  kind: string;
  text: string;
}

export interface TimelineFrame {
  t: "timeline";
  at: number; // the present, on the clock of all frames
  clock_s: number; // the same as seconds of the day at the console
  from: number;
  to: number;
  recording: string; // its name; empty: a live session
  offered: boolean; // whether pages may look back
  read: number | null; // share of a recording that is read so far; null: all
}

export interface Bookmark {
  id: string;
  at: number;
  name: string;
  by: string;
}

export interface ClipFrame {
  t: "clip";
  state: "running" | "done" | "failed";
  words: string;
  url: string;
  name: string;
}

/** One scan of a range sensor: rays at equal angles, counter-clockwise. */
export interface Scan {
  at: [x_m: number, y_m: number, heading_rad: number]; // of the sensor, in the world, when it measured
  first_rad: number; // from the sensor's own x axis
  step_rad: number;
  cone_rad: number; // each ray's field of view; 0: a narrow ray
  max_m: number;
  age_s: number; // when it was sent
  mm: string; // base64: distances, two bytes each
}

/** What undoes the newest request; words and refusal empty: there is nothing to undo. */
export interface UndoFrame {
  t: "undo";
  id: string;
  words: string; // what it would do
  refusal: string; // why it cannot be undone
}

/** One robot, whose pane is open. Times of samples are relative to now. */
export interface Detail {
  t: "detail";
  robot: string;
  pose: {
    x_m: number | null;
    y_m: number | null;
    heading_rad: number | null;
    source: string;
    note: string;
    sigma_m: number | null;
    heading_sigma_rad: number | null;
    sources: { sensor: string; marker?: string; used?: boolean; refused?: string; age_s?: number; residual_m?: number }[];
  };
  motion: [ago_s: number, speed_m_s: number, command_m_s: number][];
  battery: [ago_s: number, share: number][];
  messages: { clock: string; text: string }[];
  turn_rad_s: number | null;
  command_rad_s: number | null;
  deviation_m_s: number | null;
  deviation_m: number | null;
  round_trip_s: number | null;
  dropped: Record<string, number>;
  order: { behaviour: string; parameters: Record<string, unknown>; operator: string; request_id: string } | null;
  requests: { clock: string; behaviour: string; operator: string; outcome: string; code: string; reason: string }[];
}

/** What can be charted: title, unit, meaning; a value times `scale` is in the unit. */
export interface About {
  name: string;
  title: string;
  unit: string;
  doc: string;
  scale: number;
}

export interface Catalogue {
  t: "catalogue";
  fields: About[]; // of robots
  metrics: About[]; // of the swarm
  lines: number; // of more robots there are the least, the median and the largest value
  most: number; // charts
  seconds: number; // length of a chart
}

/** A chart: a time and a value per sample and line; `why`: there are none, or none is known. */
export interface Drawn {
  lines: string[];
  band: boolean;
  robots: number;
  why: string;
  times: number[];
  values: (number | null)[][];
}

/** The charts that the frame `charts` with this number has asked for, as a whole; `at`: null: of now. */
export interface Series {
  t: "series";
  ref: number;
  number: number; // of the whole, if the console sends it anew
  at: number | null;
  to: number | null;
  charts: Drawn[];
}

/** What was sampled since. */
export interface Rows {
  t: "rows";
  ref: number;
  number: number; // of the whole that they continue
  to: number;
  charts: { times: number[]; values: (number | null)[][] }[];
}

/** Which experiment runs, for all pages. */
export interface ExperimentsFrame {
  t: "experiments";
  refusal: string;
  running: { id: string; name: string; by: string; done: number | null; of: number | null } | null;
}

export interface ExperimentCell {
  behaviour: string;
  scenario: string;
  robots: number;
  words: string;
  trials: number;
  failed: number;
  collisions: number | null;
  expected: boolean;
  arrived: number | null;
}

export interface ExperimentEntry {
  id: string;
  kind: "package" | "file" | "folder";
  name: string;
  description: string;
  fault: string;
  trials: number;
  small_trials: number;
  seeds: string;
  small_seeds: string;
  can_start: boolean;
  state: "new" | "faulty" | "running" | "elsewhere" | "stopped" | "ended";
  by: string;
  stopping: boolean;
  words: string; // what became of it when it ran last
  bad: boolean;
  report: string; // its address; empty: there is none now
  results: {
    trials: number | null;
    finished: number;
    failed: number;
    collisions: number;
    unexpected: number;
    left_s: number | null;
    older: number;
    unreadable: number;
    cells: ExperimentCell[];
    more_cells: number;
    failures: string[];
  } | null;
}

export interface ExperimentList {
  t: "experiment_list";
  folder: string;
  problem: string;
  entries: ExperimentEntry[] | null; // null: not read yet
}

/** A part of the past. Its first frames are the newest of each kind when it began. */
export interface History {
  t: "history";
  from: number;
  to: number;
  open: boolean; // it still grows
  log: Entry[];
  frames: [at_s: number, frame: Message | { t: "trails"; robots: Record<string, number[][]> }][];
}

/** An operator: on this console with some pages, or elsewhere (none) and holding robots. */
export interface Person {
  name: string;
  role: string;
  pages: number;
  clock: string; // since when
  holds: string[]; // the first of `holding`
  holding: number;
  drives: string[];
}

export type PresenceFrame = { t: "presence"; people: Person[]; here: number; more: number };

/** Robots that one operator offers to another; `runs`: what they do, in words. */
export interface Offer {
  id: string;
  from: string;
  to: string;
  robots: string[];
  runs: string;
  left_s: number;
  mine: boolean; // made by this operator
}

export type OffersFrame = { t: "offers"; offers: Offer[] };
export type HandOverFrame = { t: "handover"; outcome: string; words: string }; // how an offer has ended

export type Message =
  | Hello
  | (World & { t: "world" })
  | States
  | Fleet
  | { t: "filter"; robots: [id: string, dx_m_s: number, dy_m_s: number, reason: string][] }
  | { t: "goals"; robots: Record<string, Goal> }
  | Coverage
  | { t: "obstacles"; rows: number[][] }
  | { t: "log"; entry: Entry }
  | RequestStatus
  | Estop
  | Stop
  | { t: "leases"; leases: Lease[] }
  | { t: "missions"; missions: Mission[] }
  | MissionReply
  | Study
  | UnderlayFrame
  | { t: "cameras"; cameras: Camera[] }
  | Picture
  | { t: "scans"; robot: string; scans: Scan[] }
  | TimelineFrame
  | History
  | { t: "events"; events: TimeEvent[] }
  | { t: "event"; event: TimeEvent }
  | { t: "bookmarks"; bookmarks: Bookmark[]; clips: string } // clips: why there can be none now; empty: there can
  | ClipFrame
  | UndoFrame
  | Detail
  | PresenceFrame
  | OffersFrame
  | HandOverFrame
  | Catalogue
  | Series
  | Rows
  | ExperimentsFrame
  | ExperimentList
  | Lost;

declare global {
  interface Window {
    /** For tests: see the end of main.js. */
    fullswarm: object;
  }
}
