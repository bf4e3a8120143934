/**
 * Assembles the page. A panel is a class that gets what it needs here, listens to the store, and fills an element of
 * index.html: see log.js for the smallest.
 *
 * data      link.js (WebSocket), store.js (the newest of everything), tracks.js (positions between two states), types.d.ts
 * commands  commands.js, drive.js (gamepad, arrows), stops.js (stop, e-stop), keyboard.js (all keys), selection.js,
 *           stick.js (a finger on the screen), signals.js (sound, vibration)
 * panels    fleet.js (table), attention.js (the strip above it), groups.js, detail.js (one robot; facts.js), panel.js
 *           (behaviours; field.js, forms.js, refusals.js, saved.js, places.js), missions.js (missionform.js),
 *           charts.js (plot.js, series.js, chartform.js), log.js, legend.js, camera.js, banners.js,
 *           study.js (the dialogs of a study); words.js (words for people), summary.js (the fleet in words, spoken),
 *           layout.js (tabs, menus), logfilter.js (which lines of the log), people.js (operators, hand-over), guide.js (the first
 *           minute), tips.js (tooltips), experiments.js (in place of a panel)
 * map       map.js (the loop), routes.js (missions), underlay.js, ranges.js (scans), ground.js (below the robots), robots.js, labels.js, sprites.js, tools.js,
 *           pointer.js, toolbar.js, viewport.js, geometry.js, palette.js, theme.js
 * time      past.js (plays the past into the store that is shown), timeline.js (the bar below the map),
 *           marks.js (bookmarks, clips)
 *
 * There are two stores. `store` holds what is shown, now or in the past: map, fleet, charts, log, missions. `present` holds what
 * is now, always: stops, driving, requests and the link read that one.
 */

import { Banners } from "./banners.js";
import { CameraView } from "./camera.js";
import { Charts } from "./charts.js";
import { Commands } from "./commands.js";
import { byId, setText } from "./dom.js";
import { DetailPane } from "./detail.js";
import { ArrowDrive, Driver, Pad } from "./drive.js";
import { FleetTable } from "./fleet.js";
import { Experiments } from "./experiments.js";
import { GroupBar } from "./groups.js";
import { Guide } from "./guide.js";
import { Keyboard } from "./keyboard.js";
import { Layout } from "./layout.js";
import { Legend } from "./legend.js";
import { identity, Link } from "./link.js";
import { LogView } from "./log.js";
import { SwarmMap } from "./map.js";
import { Marks } from "./marks.js";
import { MissionForm } from "./missionform.js";
import { Missions } from "./missions.js";
import { Panel } from "./panel.js";
import { Past } from "./past.js";
import { Places } from "./places.js";
import { People } from "./people.js";
import { Pointer } from "./pointer.js";
import { Ranges } from "./ranges.js";
import { Routes } from "./routes.js";
import { SavedRequests } from "./saved.js";
import { Selection } from "./selection.js";
import { Signals } from "./signals.js";
import { Stick } from "./stick.js";
import { Stops } from "./stops.js";
import { Store } from "./store.js";
import { Study } from "./study.js";
import { Summary } from "./summary.js";
import { Theme } from "./theme.js";
import { TimeBar } from "./timeline.js";
import { addTips } from "./tips.js";
import { Toolbar } from "./toolbar.js";
import { rulerWords, Tools } from "./tools.js";
import { Underlay } from "./underlay.js";
import { fleetWords } from "./words.js";

const FIT_MS = 200;
const REASON_MS = 8000; // how long the header says why driving by hand has ended

const store = new Store();
const present = new Store();
const link = new Link(identity());
const past = new Past({ store, present, link });
const selection = new Selection(store);
const commands = new Commands(link, present);
const theme = new Theme(byId("theme"));
const ground = /** @type {HTMLCanvasElement} */ (byId("map-ground"));
const live = /** @type {HTMLCanvasElement} */ (byId("map"));
const map = new SwarmMap({ ground, live, store, selection, theme });
const banners = new Banners({ link, store: present, commands, map });
const tools = new Tools({ store, selection, commands, hint: (words) => banners.hint(words) });
map.tool = tools;
map.underlay = new Underlay({ store: present, map });
const toolbar = new Toolbar({ map, tools, commands, store });
const stops = new Stops(present, commands);
const driver = new Driver({ link, store: present, selection, commands });
const arrows = new ArrowDrive(driver);
const stick = new Stick(driver);
const pad = new Pad(driver, selection, () => stops.estop());
new Pointer(map, tools);
const panel = new Panel({ store: present, selection, commands, tools });
new SavedRequests({ store: present, selection, commands, panel });
new Places({ store: present, selection, commands, tools });
new GroupBar(store, selection, commands);
const detail = new DetailPane({ store, present, link, theme });
const openDetail = (/** @type {string} */ id) => {
  document.querySelector('#tabs [data-tab="fleet"]')?.dispatchEvent(new MouseEvent("click"));
  detail.open(id);
};
tools.on("open", openDetail);
new FleetTable({ store, selection, commands, link, open: openDetail });
new Legend(store);
const charts = new Charts({ store, present, link, theme, selection, past });
detail.on("chart", (choice) => charts.show(choice));
new LogView(store, selection);
new Summary(store);
new Signals(present, banners);
const routes = new Routes({ store, map });
map.routes = routes;
new Missions({ store, commands, routes });
const missionForm = new MissionForm({ store: present, selection, commands, tools });
new CameraView({ store: present, link, map, past });
new Experiments({ store: present, link });
map.ranges = new Ranges({ store: present, link, map, selection, detail, past });
new Study({ store: present, link, selection, map, tools });
const timeBar = new TimeBar({ past, present, commands });
new Marks({ past, present, link, bar: timeBar });
new Layout(() => stick.end());
new People({ store: present, selection, commands, hint: (words) => banners.hint(words) });
const guide = new Guide({ present, selection, stops });
addTips(document);

link.on("message", (message) => {
  if (past.live) store.apply(message);
  present.apply(message);
});
past.on("mode", (live) => {
  if (!live) releaseDriving();
  if (!live && tools.mode !== "select") tools.use("select");
  if (!live) missionForm.close();
});
let placed = false;
past.on("change", () => {
  if (placed || !past.recording || !past.ready) return;
  placed = true;
  setTimeout(() => map.fit(), FIT_MS); // a recording may name no arena: when its robots are drawn
});
present.on("hello", ({ swarm, operator }) => {
  setText(byId("swarm"), swarm);
  setText(byId("operator"), operator);
  byId("operator").title = operator;
  document.title = `${swarm} · fullswarm`;
});

let reasonUntil_ms = 0;
/** Driving by hand, or why it has ended, goes before what the fleet does. */
const showDriving = () => {
  const reason = driver.words !== "not driving" && performance.now() < reasonUntil_ms;
  const source = pad.name ? " · gamepad ready, hold LB" : "";
  const words = driver.held || reason ? driver.words : fleetWords(present.fleet.values()) + source;
  setText(byId("driving"), words);
  byId("driving").title = words; // a long reason is cut off in the pill
  byId("driving").dataset.on = String(driver.held);
};
driver.on("change", () => {
  reasonUntil_ms = performance.now() + REASON_MS;
  showDriving();
});
present.on("fleet", showDriving);
pad.on("change", showDriving);

const releaseDriving = () => {
  arrows.end();
  stick.end();
  driver.release();
};
document.addEventListener("visibilitychange", () => document.hidden && releaseDriving());
for (const name of ["blur", "pagehide"]) addEventListener(name, releaseDriving);
stops.on("pressed", (what) => {
  stick.end();
  if (what === "estop") releaseDriving();
});

const help = byId("help-panel");
function toggleHelp(open = help.hidden) {
  help.hidden = !open;
  byId("help").setAttribute("aria-expanded", String(open));
  if (open) byId("help-close").focus();
  else byId("help").focus({ preventScroll: true });
}
byId("help").addEventListener("click", () => toggleHelp());
byId("help-close").addEventListener("click", () => toggleHelp(false));

function escape() {
  if (!help.hidden) toggleHelp(false);
  else if (guide.open) guide.close();
  else if (charts.form.focused) charts.form.cancel();
  else if (detail.focused) detail.close();
  else if (tools.mode !== "select") tools.use("select");
  else selection.clear();
}

function debug() {
  byId("debug").hidden = !byId("debug").hidden;
}
setInterval(() => {
  if (byId("debug").hidden) return;
  const { fps, frame_ms_p95, interval_ms_p95 } = map.stats;
  setText(byId("debug"), `${fps} frames/s · work ${frame_ms_p95} ms · interval ${interval_ms_p95} ms (p95)`);
}, 500);

new Keyboard({ map, tools, toolbar, theme, selection, stops, arrows, past, timeBar, help: () => toggleHelp(), debug, escape });

/** For tests: copies, nothing that could be changed. */
window.fullswarm = Object.freeze({
  get state() {
    const robots = Object.fromEntries(
      map.placed.map(({ id, x, y, heading, info }) => [id, { ...structuredClone(info), x, y, heading }]),
    );
    return {
      robots, docks: structuredClone(store.docks), selection: selection.list(),
      goals: structuredClone(Object.fromEntries(store.goals)), link: banners.level,
      ranges: map.ranges?.hits ?? {},
      ruler: tools.ruler && rulerWords(tools.ruler.from, tools.ruler.to),
      labels: map.robots.labels.filter(({ shown }) => shown).map(({ key, words, left, top, width, height }) => ({ key, words, left, top, width, height })),
      operator: present.hello?.operator ?? null, driving: driver.held, trails: trailLengths(), log: store.log.length,
      routes: routes.seen(), picture: map.picture?.seen(),
      time: { live: past.live, at_s: past.live ? map.drawn_s : past.at_s, from_s: past.from_s, to_s: past.to_s, ready: past.ready, playing: past.playing },
    };
  },
  get charts() {
    return structuredClone(charts.shown);
  },
  look: (/** @type {number} */ at_s) => past.look(at_s),
  toScreen: (/** @type {number} */ x_m, /** @type {number} */ y_m) => map.toPage(x_m, y_m),
  stats: map.stats,
});

function trailLengths() {
  return Object.fromEntries([...store.tracks].map(([id, track]) => [id, track.trail.length]));
}
