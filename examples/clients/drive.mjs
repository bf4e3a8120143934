// Drives one robot from JavaScript, without any package: node 22 or newer, `node drive.mjs ROBOT X_M Y_M`.
//
// Reads the robot, takes its lease, has it drive to a point by a request, drives it for a second by twists over the
// stream, stops it, and releases it. All of it goes behind the safety filter. Environment: FULLSWARM_API, the address
// that `fullswarm console --api` prints, and FULLSWARM_API_TOKEN, of `fullswarm console tokens add NAME --api`.

const BASE = (process.env.FULLSWARM_API ?? "http://127.0.0.1:8807/api/v1").replace(/\/$/, "");
const TOKEN = process.env.FULLSWARM_API_TOKEN ?? "";
const NEAR_M = 0.3; // so near it counts as arrived: the filter keeps it from a point that another robot has
const PATIENCE_MS = 60_000;
const STEP_MS = 50; // between two twists
const TTL_S = 0.3; // six steps: a late one does not stop the robot, a dead program does

const [robot = "r1", x = "5", y = "3"] = process.argv.slice(2);
const goal = [Number(x), Number(y)];
const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

/** Call an operation; an error has what failed, where, and what to do. */
async function call(path, body) {
  const answer = await fetch(BASE + path, {
    method: body === undefined ? "GET" : "POST",
    headers: { Authorization: `Bearer ${TOKEN}`, "Content-Type": "application/json" },
    body: body === undefined ? undefined : JSON.stringify(body),
  });
  const found = await answer.json();
  if (!answer.ok) throw new Error(`${answer.status} ${found.detail} (${found.where}; ${found.hint})`);
  return found;
}

/** Wait until the robot is near a point. */
async function arrived(goal) {
  const end = Date.now() + PATIENCE_MS;
  for (;;) {
    const { pose, stop } = await call(`/robots/${robot}`);
    if (Math.hypot(pose.x_m - goal[0], pose.y_m - goal[1]) < NEAR_M) return pose;
    if (Date.now() > end) throw new Error(`${robot} has not arrived: ${stop.text || "no reason"}`);
    await pause(200);
  }
}

/** Drive for some milliseconds over the stream; return how many twists were accepted. */
function driveByTwists(linear_m_s, angular_rad_s, forMs) {
  return new Promise((resolve, reject) => {
    const stream = new WebSocket(BASE.replace(/^http/, "ws") + "/stream");
    let sequence = 0;
    let accepted = 0;
    let timer;
    stream.onopen = () => {
      stream.send(JSON.stringify({ type: "hello", token: TOKEN }));
      stream.send(JSON.stringify({ type: "subscribe", robots: [robot], rate_hz: 5 }));
      const end = Date.now() + forMs;
      timer = setInterval(() => {
        if (Date.now() > end) {
          stream.send(JSON.stringify({ type: "release" }));
          stream.close();
          return;
        }
        sequence += 1;
        const twists = { [robot]: [linear_m_s, angular_rad_s] };
        stream.send(JSON.stringify({ type: "twists", sequence, ttl_s: TTL_S, twists }));
      }, STEP_MS);
    };
    stream.onmessage = ({ data }) => {
      const frame = JSON.parse(data);
      if (frame.type === "accepted") accepted += 1;
      if (frame.type === "states") console.log("moves with", frame.robots[0].twist.linear_m_s, "m/s");
      if (frame.type === "refused") {
        stream.close();
        reject(new Error(`${frame.status} ${frame.detail} (${frame.where}; ${frame.hint})`));
      }
    };
    stream.onclose = ({ code, reason }) => {
      clearInterval(timer);
      if (accepted) resolve(accepted);
      else reject(new Error(`the stream was closed: ${code} ${reason}`));
    };
  });
}

async function main() {
  const { pose, battery, state, held_by } = await call(`/robots/${robot}`);
  console.log(`${robot} at`, pose, "battery", battery ?? "unknown", state, "held by", held_by || "no operator");
  await call("/leases", { robots: [robot], seconds: 120 });
  try {
    await call("/requests", { behaviour: "move_to_goal_bc", robots: [robot], parameters: { goal } });
    console.log("arrived at", await arrived(goal));
    console.log("twists accepted:", await driveByTwists(0.3, 0.0, 1000));
    await call("/stop", { robots: [robot] });
    console.log("stopped at", (await call(`/robots/${robot}`)).pose);
  } finally {
    await call("/leases/release", { robots: [robot] });
  }
}

main().catch((error) => {
  console.error(String(error.message ?? error));
  process.exitCode = 1;
});
