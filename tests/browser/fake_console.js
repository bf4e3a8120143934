/**
 * The WebSocket of a console that is played: it answers what the page sends, notes it, and shows a fleet that a test sets.
 * Runs in the page before its own code.
 */
(options) => {
  const sent = [];
  const now_ms = performance.now.bind(performance);
  let skipped_ms = 0; // time that a test need not wait for
  performance.now = () => now_ms() + skipped_ms;
  const swarm = {
    robots: options.robots, silent: [], trouble: {}, estop: [], behaviour: "flocking_bc", moving: true, leases: [],
    missions: [], people: [], offers: [], ranged: [], mute: false,
  };
  let line = null;
  let asked = null; // the newest frame `charts`

  const ids = () => Array.from({ length: swarm.robots }, (_, k) => `r${k + 1}`);
  const now_s = () => performance.now() / 1000 + 100;

  function robot(id, k) {
    const latched = swarm.estop.includes(id);
    const [word, why] = latched ? ["E-STOP", ""] : swarm.trouble[id] ?? ["driving", ""];
    return {
      robot: id, age_s: 0.1 + (k % 7) / 10, silent: swarm.silent.includes(id), host: "lab", version: "0.1.0",
      make: "create", model: "create2", driver: "sim", firmware: "1", lifecycle: "ACTIVE",
      behaviour: latched ? "" : swarm.behaviour, moving: swarm.moving && !latched, estop: latched,
      state: word, state_word: word, state_why: why, attention: latched || id in swarm.trouble, stop_reason: "", stop_code: "",
      fault: "", advice: latched ? "Look whether the way is free, then clear the e-stop." : why && "Lift it back, then request again.",
      battery: 0.2 + (k % 8) / 10, radius_m: 0.17, filter_note: "", pose_by: "odometry", capabilities: swarm.ranged.includes(id) ? ["ranges"] : [], actuators: {}, memory: "",
    };
  }

  function fleet() {
    return { t: "fleet", hub: true, core_age_s: 0.1, nodes: [], robots: ids().map(robot), missing: [], docks: [] };
  }

  function states() {
    const wide = Math.ceil(Math.sqrt(swarm.robots));
    const place = (k) => [1 + (8 * (k % wide)) / Math.max(1, wide - 1), 1 + (8 * Math.floor(k / wide)) / Math.max(1, wide - 1)];
    return { t: "state", at: now_s(), robots: ids().map((id, k) => [id, ...place(k), 0.3 * k, swarm.moving ? 0.2 : 0]) };
  }

  function world() {
    const { behaviours } = options;
    return {
      arena: [0, 0, 10, 10], boxes: [[4.6, 2.2, 1, 1, 0.3]], sensing_radius_m: 3, behaviours,
      groups: { west: ["r1", "r2", "r3"], east: ["r4", "r5"] },
    };
  }

  const FIELDS = {
    battery: ["Battery", "%", 100, (robot) => robot.battery], speed: ["Speed", "m/s", 1, (robot, at) => 0.2 + 0.05 * Math.sin(at / 20 + robot.age_s * 50)],
    x: ["Position x", "m", 1, (robot, at) => 3 * Math.sin(at / 60 + robot.age_s * 50)], round_trip: ["Round trip", "s", 1, () => null],
  };
  const METRICS = {
    "work.total_m": ["Work", "m", 1, (at) => Math.max(0, at / 4 + 150)], "coverage.fraction": ["Coverage", "%", 100, (at) => Math.min(1, Math.max(0, (at + 600) / 1400))],
    "collisions.events": ["Collisions", "", 1, () => 2], "network.delay_max_s": ["Network, delay max", "s", 1, () => 0.012],
  };

  function catalogue() {
    const list = (table) => Object.entries(table).map(([name, [title, unit, scale]]) => ({ name, title, unit, scale, doc: `what ${title} is` }));
    return { t: "catalogue", fields: list(FIELDS), metrics: list(METRICS), lines: 8, most: 6, seconds: 600 };
  }

  /** A chart of `count` samples, two a second, up to a time. */
  function drawn({ of, robots }, to, count) {
    const times = Array.from({ length: count }, (_, k) => to - (count - 1 - k) / 2);
    if (of in METRICS) return { lines: ["swarm"], band: false, robots: 0, why: "", times, values: [times.map((at) => METRICS[of][3](at))] };
    if (!(of in FIELDS)) return { lines: [], band: false, robots: 0, why: `there is no '${of}', did you mean 'battery'?`, times: [], values: [] };
    const all = ids().map(robot).filter((each) => !robots.length || robots.includes(each.robot));
    const values = all.map((each) => times.map((at) => FIELDS[of][3](each, at)));
    const why = `no robot reports ${FIELDS[of][0].toLowerCase()}`;
    if (all.length <= 8) return { lines: all.map((each) => each.robot), band: false, robots: all.length, why, times, values };
    const columns = times.map((_, k) => values.map((line) => line[k]).sort((a, b) => a - b));
    const parts = [0, 0.5, 1].map((share) => columns.map((column) => column[Math.round(share * (column.length - 1))]));
    return { lines: ["least", "median", "largest"], band: true, robots: all.length, why, times, values: parts };
  }

  function timeline() {
    return { t: "timeline", at: now_s(), clock_s: 40000 + now_s(), from: 0, to: now_s(), recording: "", offered: true, read: null };
  }

  class FakeSocket {
    static OPEN = 1;

    constructor() {
      this.readyState = 0;
      line = this;
      setTimeout(() => {
        this.readyState = 1;
        this.onopen?.();
      }, 5);
    }

    send(text) {
      const frame = JSON.parse(text);
      sent.push({ ...frame, at_ms: performance.now() });
      if (frame.t === "hello") return this.#welcome();
      if (frame.t === "charts") setTimeout(() => this.#chart(frame), 3);
      return setTimeout(() => this.say({ t: "answer", ref: frame.ref, ok: true, reason: "", request_id: "" }), 2);
    }

    #welcome() {
      this.say({ t: "hello", swarm: "lab", operator: "anna", read_only: false, ...world() });
      this.say(timeline());
      this.say(catalogue());
      this.say({ t: "bookmarks", bookmarks: [{ id: "b1", at: now_s(), name: "the first turn", by: "anna" }], clips: "" });
      this.say({ t: "experiments", refusal: "", running: null });
      this.tick();
    }

    #chart(frame) {
      asked = frame;
      const at = frame.at ?? now_s();
      this.say({ t: "series", ref: frame.ref, number: 1, at: frame.at, to: at, charts: frame.charts.map((each) => drawn(each, at, 1200)) });
    }

    /** What the console sends all the time. */
    tick() {
      this.say(fleet());
      this.say(states());
      this.say({ t: "leases", leases: swarm.leases });
      this.say({ t: "missions", missions: swarm.missions });
      this.say({ t: "presence", people: swarm.people, here: swarm.people.filter(({ pages }) => pages).length, more: 0 });
      this.say({ t: "offers", offers: swarm.offers });
      const at = now_s();
      if (asked) this.say({ t: "rows", ref: asked.ref, number: 1, to: at, charts: asked.charts.map((each) => drawn(each, at, 1)) });
      this.say({ t: "event", event: { at, kind: "request", text: "flocking" } });
    }

    say(message) {
      if (this.readyState === 1 && !swarm.mute) this.onmessage?.({ data: JSON.stringify(message) });
    }

    close() {
      if (this.readyState === 3) return;
      this.readyState = 3;
      this.onclose?.({ code: 1006 });
    }
  }

  window.WebSocket = FakeSocket;
  setInterval(() => line?.tick(), 200);
  /** Let time pass for what shows something for a while. */
  function skip(ms) {
    skipped_ms += ms;
    line.tick();
  }

  /** Say the details of a robot. */
  function detail(robot) {
    const pose = { x_m: 1, y_m: 1, heading_rad: 0, source: "", note: "", sigma_m: null, heading_sigma_rad: null, sources: [] };
    const more = { turn_rad_s: 0, command_rad_s: 0, deviation_m_s: 0, deviation_m: 0, round_trip_s: null, dropped: {}, order: null };
    line.say({ t: "detail", robot, at: 1, pose, motion: [[-5, 0.3, 0.3], [0, 0.1, 0.1]], battery: [[-100, 0.6], [0, 0.5]], messages: [], requests: [], ...more });
  }

  window.fake = { detail, sent, swarm, world, skip, ids, say: (message) => line.say(message), tick: () => line.tick() };
}
