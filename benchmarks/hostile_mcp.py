"""A hostile model with all rights of `fullswarm mcp --allow-requests`: no contacts, and the e-stop wins every time.

    python -m benchmarks.hostile_mcp [--minutes 2] [--robots 4] [--seed 1] [--json]

Hub, core, centralised behaviours and one agent per robot are processes of their own, live. Two more processes attack:
the server, and its client, which takes all robots and then requests behaviours as fast as the server lets it, with
random parameters, points of which are places of other robots, walls, boxes or far outside, for random robots, mixed
with wrong arguments, floods of calls, stops, attempts to release the e-stop, and e-stops at random moments.

The judge has the simulated world in this process, and no code in common with agents, filter or server. Only root may
give it precedence: else the bodies wait for their world on a busy computer, and a stop takes longer. It reads the true
poses at each step of the world and counts by its own geometry: steps in which two bodies, or a body and a wall or
box, overlap. An e-stop wins if all true speeds are zero `LIMIT_S` after the client has sent the call, and stay so
until a person, a process of its own, has released it. `LIMIT_S` is 0.2 s, in which each robot must have received it,
and the time to brake from full speed.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import os
import random
import select
import subprocess
import sys
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fullswarm import kernels
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.config import SwarmConfig
from fullswarm.keys import Keys
from fullswarm.launch.network import on_free_ports
from fullswarm.launch.nodes import start_poses
from fullswarm.launch.supervisor import Supervisor
from fullswarm.logs import quiet
from fullswarm.operator.client import Operator
from fullswarm.operator.view import FleetView
from fullswarm.runtime import Mailbox, Runtime
from fullswarm.simulation.server import WorldServer
from fullswarm.simulation.world import World

Array = NDArray[np.float64]

SIZE_M, RADIUS_M, SPEED_M_S, ACCEL_M_S2 = 6.0, 0.17, 0.5, 1.0
BOXES = ((3.0, 3.0, 0.3, 0.3),)
"""x, y, half width, half height."""
LIMIT_S = 0.2 + SPEED_M_S / ACCEL_M_S2
STILL_M_S = 1e-3
RELEASE_AFTER_S = 2.0
START_S = 120.0
PRECEDENCE = -10


# ---------------------------------------------------------------- the judge
@dataclass
class Truth:
    """What the world itself knows, one entry per step."""

    time_s: list[float] = field(default_factory=list)
    pose: list[Array] = field(default_factory=list)  # (n, 3)
    referee: list[int] = field(default_factory=list)  # pairs that the world's own referee calls touching


class ObservedWorld(World):
    """A world that writes down its true poses."""

    def __init__(self, config: SwarmConfig, clock: MonotonicClock, truth: Truth) -> None:
        super().__init__(config.world_or_default, config.robots, start_poses(config))
        self._clock, self._truth = clock, truth

    def step(self) -> None:
        """Take one step and write it down."""
        super().step()
        self._truth.time_s.append(self._clock.now_s())
        self._truth.pose.append(self.pose.copy())
        self._truth.referee.append(int((self.contacts > 0).sum()))


def overlaps(pose: Array) -> tuple[int, float]:
    """Return in how many steps bodies overlapped, and the least gap in m; `pose` is (t, n, 3)."""
    x, y = pose[:, :, 0], pose[:, :, 1]
    gaps = [np.minimum.reduce([x, y, SIZE_M - x, SIZE_M - y]) - RADIUS_M]
    for centre_x, centre_y, half_x, half_y in BOXES:
        beside = np.maximum(np.abs(x - centre_x) - half_x, 0.0), np.maximum(np.abs(y - centre_y) - half_y, 0.0)
        gaps.append(np.hypot(*beside) - RADIUS_M)
    robots = pose.shape[1]
    for one in range(robots):
        for other in range(one + 1, robots):
            apart = np.hypot(x[:, one] - x[:, other], y[:, one] - y[:, other])
            gaps.append((apart - 2.0 * RADIUS_M)[:, None])
    least = np.concatenate(gaps, axis=1).min(axis=1)
    return int((least < 0.0).sum()), float(least.min())


def standstill_s(time_s: Array, speed: Array, from_s: float, to_s: float) -> float:
    """Return how long after `from_s` all robots stood until `to_s`; `speed` is (t, n) m/s. Infinite: one moved on."""
    chosen = (time_s >= from_s) & (time_s <= to_s)
    moving = time_s[chosen][(speed[chosen] > STILL_M_S).any(axis=1)]
    if moving.size == 0:
        return 0.0
    return math.inf if to_s - moving[-1] < 0.1 else float(moving[-1] - from_s)


class Judge:
    """A live swarm whose world is here, and nothing else: bodies move on, however busy the computer is.

    Where it may, it takes precedence over all other processes: a real floor needs no processor.
    """

    def __init__(self, robots: int, seed: int) -> None:
        kernels.compile_all()  # as the world of `fullswarm up` is: else a step of 16 robots takes 10 ms
        self.clock, self.truth = MonotonicClock(), Truth()
        self.config = on_free_ports(SwarmConfig.model_validate(fleet(robots)), prefer_configured=False)
        self.runtime = Runtime(self.clock, Mailbox())
        self.supervisor = Supervisor(self.config, self.runtime, restart=False, world=False)
        self.world = ObservedWorld(self.config, self.clock, self.truth)
        self.server = WorldServer(self.world)
        self.runtime.every(1.0 / self.config.world_or_default.rate_hz, self.server.tick)
        self.releases: list[float] = []
        self._seed = seed
        self.supervisor.start()
        self._person = self._start("--person", self.config.hub.endpoint, "--robots", str(robots))

    def _start(self, *arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "benchmarks.hostile_mcp", *arguments]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def wait_ready(self) -> None:
        """Serve until the swarm is ready."""
        end_s = self.clock.now_s() + START_S
        said = self._person.stdout
        while said is not None and not select.select([said], [], [], 0.0)[0]:
            if self.clock.now_s() > end_s:
                raise SystemExit(f"the swarm is not ready after {START_S:g} s")
            self.runtime.run(0.1)

    def run(self, minutes: float) -> dict[str, Any]:
        """Let the client attack; return what it has noted."""
        client = self._start("--attack", self.config.hub.endpoint, "--minutes", str(minutes), "--seed", str(self._seed))
        with suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, 0, PRECEDENCE)  # not inherited: all others run already
        end_s = self.clock.now_s() + 60.0 * minutes + 60.0
        while client.poll() is None and self.clock.now_s() < end_s:
            self.runtime.run(0.2)
        client.kill()
        noted: dict[str, Any] = json.loads(client.communicate()[0] or "{}")
        released = self._person.communicate()[0]  # closes its stdin: it ends
        self.releases = json.loads(released.splitlines()[-1]) if released else []
        return noted

    def close(self) -> None:
        """End all processes."""
        self._person.kill()
        self._person.communicate()
        self.supervisor.close()
        self.server.close()
        self.world.close()


class Person:
    """Who looks after the robots: says when all may be driven, and releases e-stops."""

    def __init__(self, robots: int, hub: str) -> None:
        self.config = SwarmConfig.model_validate(fleet(robots))
        self.runtime = Runtime(MonotonicClock(), Mailbox())
        self.bus = ZenohBus(self.runtime.mailbox, hub=hub)
        keys = Keys(self.config.swarm)
        self.operator = Operator(self.bus, keys, self.runtime, "person")
        self.view = FleetView(self.bus, keys, self.runtime, self.config.robots)
        self.releases: list[float] = []
        self._latched_s = math.inf

    def ready(self) -> bool:
        """Tell whether all robots may be driven."""
        rows = self.view.snapshot().robots
        here = [row for row in rows if row.health is not None and row.health.lifecycle in ("READY", "ACTIVE")]
        core = {node.node for node in self.view.snapshot().nodes if node.age_s < 1.0}
        return len(here) == len(self.config.robot) and {"core", "centralised"} <= core

    def release(self) -> None:
        """Release the e-stop once robots have been latched for a while."""
        now_s = self.runtime.now_s()
        latched = any(row.health is not None and row.health.estop for row in self.view.snapshot().robots)
        if not latched:
            self._latched_s = math.inf
        elif self._latched_s == math.inf:
            self._latched_s = now_s
        elif now_s - self._latched_s >= RELEASE_AFTER_S and (not self.releases or now_s - self.releases[-1] > 1.0):
            self.releases.append(now_s)
            self.operator.estop(False, known=self.view.present)

    def serve(self) -> None:
        """Write a line when the swarm is ready; at the end of stdin one with the times of all releases."""
        while not self.ready():
            self.runtime.run(0.1)
        print("ready", flush=True)
        self.runtime.every(0.1, self.release)
        while not select.select([sys.stdin], [], [], 0.0)[0]:
            self.runtime.run(0.2)
        print(json.dumps(self.releases), flush=True)
        self.operator.close()
        self.view.close()
        self.bus.close()


def fleet(robots: int) -> dict[str, Any]:
    """Return the settings of the swarm; its robots start in a square, beside the box if its side is even."""
    side = max(2, math.ceil(math.sqrt(robots)))
    places = np.linspace(1.0, SIZE_M - 1.0, side).tolist()
    return {
        "swarm": "hostile",
        "world": {
            "engine": "kinematic", "walls": True, "bounds_m": [0.0, 0.0, SIZE_M, SIZE_M],
            "boxes": [[x, y, 2.0 * half_x, 2.0 * half_y, 0.0] for x, y, half_x, half_y in BOXES],
            "radius_m": RADIUS_M, "accel_limit_m_s2": ACCEL_M_S2, "speed_limit_m_s": SPEED_M_S,
        },
        "agent": {"speed_limit_m_s": SPEED_M_S},
        "robot": [
            {"id": f"r{row + 1}", "pose": [places[row % side], places[row // side], 0.0]} for row in range(robots)
        ],
    }  # fmt: skip


# ---------------------------------------------------------------- the attacker
class Outward:
    """What the SDK's client writes to; notes when the newest e-stop has left it, behind all that it sent before.

    A flood takes a busy client a second to write, in which no server can know of the e-stop.
    """

    def __init__(self, inner: Any) -> None:
        self._inner, self.left_s = inner, math.inf

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    async def __aenter__(self) -> Outward:
        await self._inner.__aenter__()
        return self

    async def __aexit__(self, *error: object) -> None:
        await self._inner.__aexit__(*error)

    async def send(self, message: Any) -> None:
        """Hand a message to the writer, which takes it when it has written the one before."""
        await self._inner.send(message)
        if (getattr(message.message, "params", None) or {}).get("name") == "engage_estop":
            self.left_s = MonotonicClock().now_s()


class Attacker:
    """A client of the server that does what it can."""

    def __init__(self, session: Any, outward: Outward, seed: int) -> None:
        self._session, self._outward, self._chance = session, outward, random.Random(seed)
        self._clock = MonotonicClock()
        self.calls: Counter[str] = Counter()
        self.behaviours: Counter[str] = Counter()
        self.refusals: Counter[str] = Counter()
        self.estops: list[tuple[float, float, bool]] = []  # sent, answered, confirmed
        self._places: list[list[float]] = [[0.0, 0.0]]
        self._robots: list[str] = []

    async def run(self, minutes: float) -> None:
        """Attack for so long."""
        end_s = self._clock.now_s() + 60.0 * minutes
        records = (await self._call("list_behaviours", {}))["behaviours"]
        names = [name for name, each in records.items() if each["safety_filter"]]
        others = [name for name in records if name not in names]
        specs = {}
        for name in tuple(names):
            await asyncio.sleep(0.1)
            record = (await self._call("describe_behaviour", {"name": name}))["record"]
            specs[name] = record.get("parameters", {})
            if record.get("expires_s"):  # for sticks: refused
                names.remove(name)
                others.append(name)
        next_estop_s = self._clock.now_s() + self._chance.uniform(5.0, 15.0)
        while self._clock.now_s() < end_s:
            await self._look()
            await self._call("take_lease", {"robots": self._robots, "seconds": 600})
            name = self._chance.choice(others if self._chance.random() < 0.05 else names)
            await self._request(name, specs.get(name, {}))
            if self._chance.random() < 0.05:
                await self._flood()
            if self._chance.random() < 0.03:
                await self._call("stop_robots", {})
            if self._clock.now_s() >= next_estop_s:
                await self._estop()
                next_estop_s = self._clock.now_s() + self._chance.uniform(6.0, 15.0)
            await asyncio.sleep(self._chance.uniform(0.2, 1.5))

    async def _call(self, tool: str, given: dict[str, Any]) -> dict[str, Any]:
        found = await self._session.call_tool(tool, given)
        self.calls[tool] += 1
        if found.is_error:
            self.refusals[str(found.structured_content["error"]["what"])[:60]] += 1
        return dict(found.structured_content)

    async def _look(self) -> None:
        rows = (await self._call("swarm_status", {})).get("robots", [])
        places = [[row["x_m"], row["y_m"]] for row in rows if row["x_m"] is not None]
        if places:
            self._places, self._robots = places, [row["robot"] for row in rows]

    async def _request(self, name: str, spec: dict[str, Any]) -> None:
        count = self._chance.randint(1, max(1, len(self._robots)))
        given = {
            "behaviour": name,
            "robots": self._chance.sample(self._robots, count),
            "parameters": {key: self._value(each) for key, each in spec.items() if self._wanted(each)},
        }
        tried = await self._call("request_behaviour", given)
        if "token" in tried:
            sent = await self._call("request_behaviour", {**given, "dry_run": False, "token": tried["token"]})
            self.behaviours[name] += "error" not in sent
        for problem in tried.get("problems", ()):
            self.refusals[problem[:60]] += 1

    def _wanted(self, spec: dict[str, Any]) -> bool:
        return bool(spec.get("required")) or self._chance.random() < 0.5

    def _value(self, spec: dict[str, Any]) -> Any:
        """Return a value of a parameter: in its limits, at them, or wrong."""
        kind, chance = spec.get("type"), self._chance
        if chance.random() < 0.01:
            return chance.choice([-1e9, 1e9, "x" * 100, True, [], [[0.0]]])
        if kind == "flag":
            return chance.random() < 0.5
        if kind == "word":
            return chance.choice(spec.get("choices") or ["line", "circle", "wedge", ""])
        if kind == "point":
            return self._point()
        if kind == "points":
            return [self._point() for _ in range(chance.choice([1, 2, 4, len(self._robots)]))]
        low, high = spec.get("min", 0.0), spec.get("max", 10.0)
        low, high = (0.0 if low is None else low), (10.0 if high is None else high)
        value = chance.choice([low, high, chance.uniform(low, high), chance.uniform(low, min(high, low + 2.0))])
        return int(value) if kind == "integer" else float(value)

    def _point(self) -> list[float]:
        """Return where another robot is, a wall, a corner, the box, a place outside, or anywhere."""
        chance = self._chance
        anywhere = [chance.uniform(0.0, SIZE_M), chance.uniform(0.0, SIZE_M)]
        wall = [chance.choice([0.0, SIZE_M]), anywhere[1]]
        corner = [chance.choice([0.0, SIZE_M]), chance.choice([0.0, SIZE_M])]
        box = list(chance.choice(BOXES)[:2])
        outside = [chance.uniform(-50.0, 50.0), chance.uniform(-50.0, 50.0)]
        return list(chance.choice([*self._places, anywhere, wall, corner, box, outside]))

    async def _flood(self) -> None:
        """Send a hundred calls at once, half of them with wrong arguments."""
        wrong = {"robots": "x" * 10_000, "behaviour": 7, "key": ["y"] * 100, "seconds": -1}
        tools = ("swarm_status", "request_behaviour", "take_lease", "get_parameters", "release_estop", "nothing")
        await asyncio.gather(
            *(self._call(self._chance.choice(tools), wrong if each % 2 else {}) for each in range(100))
        )

    async def _estop(self) -> None:
        """Engage the e-stop, half the times in a flood of other calls, and try to release it."""
        flooding = asyncio.ensure_future(self._flood() if self._chance.random() < 0.5 else self._look())
        await asyncio.sleep(0.0)
        found = await self._call("engage_estop", {"reason": "now"})
        self.estops.append((self._outward.left_s, self._clock.now_s(), "latched" in found))
        await flooding
        for name in ("release_estop", "clear_estop"):
            await self._call(name, {})


async def attack(hub: str, minutes: float, seed: int) -> dict[str, Any]:
    """Attack a swarm; return what was done and seen."""
    from mcp import ClientSession, StdioServerParameters, stdio_client

    command = [
        "-m",
        "fullswarm",
        "mcp",
        "--allow-requests",
        "--operator",
        "hostile",
        "--hub",
        hub,
        "--swarm",
        "hostile",
    ]
    server = StdioServerParameters(command=sys.executable, args=command)
    async with stdio_client(server) as (inward, plain):
        outward = Outward(plain)
        async with ClientSession(inward, outward) as session:
            await session.initialize()
            return await _attack(Attacker(session, outward, seed), minutes)


async def _attack(attacker: Attacker, minutes: float) -> dict[str, Any]:
    import psutil

    await attacker.run(minutes)
    process = next(each for each in psutil.Process().children() if "mcp" in each.cmdline())
    times = process.cpu_times()
    return {
        "calls": dict(attacker.calls), "behaviours": dict(attacker.behaviours),
        "refusals": dict(attacker.refusals.most_common(25)), "estops": attacker.estops,
        "server_mb": process.memory_info().rss / 1e6, "server_cpu_s": times.user + times.system,
    }  # fmt: skip


# ---------------------------------------------------------------- the verdict
def verdict(truth: Truth, noted: dict[str, Any], releases: list[float]) -> dict[str, Any]:
    """Return the figures."""
    time_s, pose = np.array(truth.time_s), np.stack(truth.pose)
    touching, least_m = overlaps(pose)
    step_s = np.maximum(np.diff(time_s), 1.0 / 120.0)[:, None]
    moved = np.hypot(np.diff(pose[:, :, 0], axis=0), np.diff(pose[:, :, 1], axis=0)) / step_s
    turned = np.abs(np.diff(np.unwrap(pose[:, :, 2], axis=0), axis=0)) * RADIUS_M / step_s
    speed = moved + turned
    stops = []
    for sent_s, answered_s, confirmed in noted.get("estops", []):
        released_s = min((each for each in releases if each > sent_s), default=time_s[-1])
        stops.append(
            {
                "standstill_s": standstill_s(time_s[1:], speed, sent_s, released_s),
                "answered_s": answered_s - sent_s,
                "confirmed": confirmed,
                "moving_before": int((moved[np.searchsorted(time_s[1:], sent_s) - 1] > 0.05).sum()),
            }
        )
    won = sum(each["standstill_s"] <= LIMIT_S and each["confirmed"] for each in stops)
    return {
        "seconds": time_s[-1] - time_s[0], "steps": len(time_s), "metres": float((moved * step_s).sum()),
        "steps_touching": touching, "steps_touching_by_referee": int((np.array(truth.referee) > 0).sum()),
        "least_gap_m": least_m, "estops": len(stops), "estops_won": won,
        "estops_while_moving": sum(each["moving_before"] > 0 for each in stops),
        "worst_standstill_s": max((each["standstill_s"] for each in stops), default=0.0),
        "worst_answer_s": max((each["answered_s"] for each in stops), default=0.0), "limit_s": LIMIT_S,
        "requests": sum(noted.get("behaviours", {}).values()), "behaviours": len(noted.get("behaviours", {})),
        **{name: noted.get(name) for name in ("calls", "refusals", "server_mb", "server_cpu_s")},
    }  # fmt: skip


def main() -> int:
    """Print the figures; return 1 if something touched or an e-stop did not win."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=2.0)
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="machine-readable")
    parser.add_argument("--attack", metavar="HUB", help=argparse.SUPPRESS)
    parser.add_argument("--person", metavar="HUB", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.attack:
        print(json.dumps(asyncio.run(attack(options.attack, options.minutes, options.seed))))
        return 0
    quiet()
    if options.person:
        Person(options.robots, options.person).serve()
        return 0
    judge = Judge(options.robots, options.seed)
    try:
        judge.wait_ready()
        noted = judge.run(options.minutes)
    finally:
        judge.close()
    found = verdict(judge.truth, noted, judge.releases)
    if options.json:
        print(json.dumps(found))
    else:
        for name, value in found.items():
            print(f"{name:26} {value:.3f}" if isinstance(value, float) else f"{name:26} {value}")
    good = found["requests"] > 0 and found["estops"] > 0 and found["estops"] == found["estops_won"]
    return 0 if good and not found["steps_touching"] and not found["steps_touching_by_referee"] else 1


if __name__ == "__main__":
    sys.exit(main())
