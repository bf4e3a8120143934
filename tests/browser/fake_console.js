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
    missions: [], mute: false,
  };
  let line = null;

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
      battery: 0.2 + (k % 8) / 10, radius_m: 0.17, filter_note: "", pose_by: "odometry", capabilities: [], actuators: {}, memory: "",
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
      return setTimeout(() => this.say({ t: "answer", ref: frame.ref, ok: true, reason: "", request_id: "" }), 2);
    }

    #welcome() {
      this.say({ t: "hello", swarm: "lab", operator: "anna", read_only: false, ...world() });
      this.say(timeline());
      this.say({ t: "bookmarks", bookmarks: [{ id: "b1", at: now_s(), name: "the first turn", by: "anna" }], clips: "" });
      this.say({ t: "experiments", refusal: "", running: null });
      this.tick();
    }

    /** What the console sends all the time. */
    tick() {
      this.say(fleet());
      this.say(states());
      this.say({ t: "leases", leases: swarm.leases });
      this.say({ t: "missions", missions: swarm.missions });
      const at = now_s();
      this.say({ t: "chart", row: [at, at, Math.min(1, at / 1000), 2] });
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

  window.fake = { sent, swarm, skip, ids, say: (message) => line.say(message), tick: () => line.tick() };
}
