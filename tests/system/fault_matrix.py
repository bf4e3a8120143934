"""The fault matrix: each fault on each backend, measured on the true bodies. Real agents, drivers, ports and signals.

One swarm of five makes lives in one world; robots drive straight on, the faults of a round happen, and the world tells
when each device's set-point came to zero, when its body stood and how far it went.
"""

from __future__ import annotations

import math
import os
import signal
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fullswarm.drivers.mavlink.protocol import Mode
from tests.system.live import LiveSwarm

BACKENDS = {"s1": "sim", "c1": "create2", "m1": "rover", "o1": "odrive", "v1": "vesc"}
LANE_M = {robot: 5.0 + 10.0 * number for number, robot in enumerate(BACKENDS)}
START_M, FENCE_M, BOX_M = 5.0, 59.0, 30.0
CRUISE_M_S, STOPPED_M_S = 0.35, 0.02
LONGEST_S = 6.0
CALM_S = 0.3
PAUSE_S = 0.6
TTL_S, CORE_S, PERIOD_S = 0.3, 1.0, 0.02

VESC = "interface=slcan&left=1&right=2&wheel_radius=0.05&base=0.3&radius=0.17&pole_pairs=7&gear=10"
"""As usual, but with the volts that tell how full the battery is."""


def config(folder: str) -> dict[str, Any]:
    """Return the fleet; a port of its own lies in `folder`."""
    robots: list[dict[str, Any]] = [
        {"id": robot, "pose": [START_M, LANE_M[robot], 0.0], **({} if make == "sim" else {"emulate": make})}
        for robot, make in BACKENDS.items()
    ]
    robots[-1]["driver"] = f"can+vesc://{folder}/v1?{VESC}&volts_empty=21&volts_full=29.4"
    return {**SETTINGS, "robot": robots}


SETTINGS: dict[str, Any] = {
    "swarm": "faults",
    "world": {
        "engine": "kinematic", "bounds_m": [0, 0, 60, 60],
        "boxes": [[BOX_M, LANE_M[robot], 0.4, 0.4, 0.0] for robot in ("s1", "c1")],
    },
    # Every silence has the same bound here, also that of a robot that tells nothing.
    "agent": {"speed_limit_m_s": 0.4, "reading_timeout_s": TTL_S, "bounds_m": [0, 0, FENCE_M, 60]},
}  # fmt: skip

DEVICE_S = {"s1": 0.3, "c1": math.inf, "m1": 3.0, "o1": 0.5, "v1": 1.0}
"""What each device's own watchdog takes; a Create has none. Those above 0.5 s have a guardian besides."""
GUARDIAN_S = 0.3


@dataclass(frozen=True, slots=True)
class Result:
    """One cell."""

    fault: str
    backend: str
    zero_s: float = math.nan  # from the fault until the device's set-point was zero; inf: it never was
    rest_s: float = math.nan  # until the body stood
    distance_m: float = math.nan  # that it went meanwhile
    bound_s: float = math.nan
    note: str = ""

    def __str__(self) -> str:
        """Return a line for people."""
        return (
            f"{self.fault:20} {self.backend:8} zero {self.zero_s:6.3f} s (bound {self.bound_s:5.3f}), "
            f"rest {self.rest_s:6.3f} s, {self.distance_m:6.3f} m"
        )


@dataclass(slots=True)
class Rig:
    """The swarm, and what can be seen of it and done to it."""

    swarm: LiveSwarm
    deaf: set[str] = field(default_factory=set)  # simulated robots whose datagrams do not arrive
    mute: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        server = self.server
        take, send = server._take, server._send

        def maybe_take(datagram: Any, sender: Any) -> Any:
            return None if datagram.robot in self.deaf else take(datagram, sender)

        def maybe_send(datagram: Any, to: Any) -> None:
            if datagram.robot not in self.mute:
                send(datagram, to)

        server._take, server._send = maybe_take, maybe_send

    @property
    def node(self) -> Any:
        return self.swarm.node

    @property
    def server(self) -> Any:
        return self.node._server

    def emulator(self, robot: str) -> Any:
        return self.node.emulators[robot]

    def driven(self, robot: str) -> bool:
        """Whether the device's own set-point is not zero."""
        if robot == "s1":
            world = self.node.world
            row = world.row(robot)
            fresh = world.time_s - world.commanded_s[row] <= world.config.watchdog_s
            return bool(fresh and np.any(world.target[row]))
        robot_end = self.emulator(robot)
        if robot == "c1":
            return bool(robot_end.firmware.wheels_mm_s != (0, 0))
        if robot == "m1":
            target = robot_end.firmware.target
            on = robot_end.firmware.armed and robot_end.firmware.mode == Mode.GUIDED
            return bool(on and target is not None and (target.speed_m_s or target.turn_rad_s))
        if robot == "v1":
            return bool(robot_end.left.driving or robot_end.right.driving)
        return any(each.energised and each._set.velocity_turn_s for each in (robot_end.left, robot_end.right))

    def speed_m_s(self, robot: str) -> float:
        return abs(float(self.node.world.twist[self.node.world.row(robot)][0]))

    def x_m(self, robot: str) -> float:
        return float(self.node.world.pose[self.node.world.row(robot)][0])

    def kill_guardian(self, robot: str) -> None:
        """Kill the process that watches over a robot's port, a child of its agent's."""
        process, found = self.swarm.supervisor.children[robot].process, 0
        assert process is not None
        for entry in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):  # ended meanwhile, or somebody else's
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                if parent == process.pid and b"guardian_process" in (entry / "cmdline").read_bytes():
                    os.kill(int(entry.name), signal.SIGKILL)
                    found += 1
        assert found == 1, f"{found} guardians of {robot}"

    def place(self, robot: str, x_m: float) -> None:
        """Carry a robot along its lane."""
        self.node.world.pose[self.node.world.row(robot)][0] = x_m

    def cut(self, robot: str, on: bool) -> None:
        """Pull the cable, or put it back."""
        if robot != "s1":
            (self.emulator(robot).unplug if on else self.emulator(robot).replug)()
            return
        for each in (self.deaf, self.mute):
            (each.add if on else each.discard)(robot)

    def freeze(self) -> None:
        """Stop the simulation's clock for `PAUSE_S`: messages go to and fro, but time and bodies stand still."""
        world, until_s = self.node.world, self.swarm.clock.now_s() + PAUSE_S

        def step() -> None:
            if self.swarm.clock.now_s() >= until_s:
                del world.step
                world.step()

        world.step = step

    def hush(self, robot: str, on: bool) -> None:
        """Let a robot hear, but say nothing."""
        if robot != "s1":
            self.emulator(robot).mute(on)
        else:
            (self.mute.add if on else self.mute.discard)(robot)


Act = Callable[[Rig, Sequence[str]], object]


def each(act: Callable[[Rig, str], object]) -> Act:
    return lambda rig, robots: [act(rig, robot) for robot in robots]


def kill(name: str, number: signal.Signals = signal.SIGKILL) -> Act:
    return lambda rig, _: rig.swarm.supervisor.kill(name, number)


def revive(name: str) -> Act:
    return lambda rig, _: rig.swarm.supervisor.revive(name)


def to_agent(number: signal.Signals) -> Act:
    return each(lambda rig, robot: rig.swarm.supervisor.kill(robot, number))


def nothing(rig: Rig, robots: Sequence[str]) -> None:
    """Nothing is to be done."""
    del rig, robots


@dataclass(frozen=True, slots=True)
class Fault:
    """How one fault is made and mended, on which robots, and how soon the set-point must be zero."""

    name: str
    inject: Act
    mend: Act = nothing
    bound_s: dict[str, float] | float = TTL_S + PERIOD_S
    robots: tuple[str, ...] = tuple(BACKENDS)
    lacking: str = ""  # why the others have no such fault
    start_m: float = START_M
    notes: dict[str, str] = field(default_factory=dict)
    whole: bool = False  # it happens to all robots at once
    centralised: bool = False
    from_mark: bool = False  # time counts from when a robot would cross, not from the injection

    def bound(self, robot: str) -> float:
        return self.bound_s if isinstance(self.bound_s, float) else self.bound_s[robot]


SENSOR_S = {"s1": 0.02, "c1": 0.015, "m1": 0.05, "o1": 0.05, "v1": 0.05}
"""How often a robot tells of its bumper, or is told where it is."""
BATTERY_S = {"c1": 0.015, "m1": 0.25, "o1": 1.0, "v1": 0.02}
"""How often it tells, or its driver asks, how full the battery is."""
REPLACED_S = 0.45
"""A guardian that is killed: a quarter of a second until the next try and the first words."""
BATTERY = {robot: sensor_s + PERIOD_S for robot, sensor_s in BATTERY_S.items()}
REFLEX = {robot: sensor_s + PERIOD_S for robot, sensor_s in SENSOR_S.items()}
ALONE = {"m1": "the firmware's own time-out", "o1": "the axis' own watchdog", "v1": "the controller's own time-out"}
WATCHED = ("c1", "m1", "v1")
GUARDED = {"s1": "the world's watchdog", **ALONE, **dict.fromkeys(WATCHED, "its guardian")}
OWN = {robot: wait_s + 3.0 * PERIOD_S for robot, wait_s in DEVICE_S.items()}
"""The last set-point is on its way, is heard, and is seen to be old: a loop of the emulated firmware each."""
DIES = {
    **OWN, "s1": DEVICE_S["s1"] + PERIOD_S, "c1": GUARDIAN_S + PERIOD_S,
    **dict.fromkeys(("m1", "v1"), GUARDIAN_S + 3.0 * PERIOD_S),
}  # fmt: skip
NO_SENSOR = "no such sensor"

FAULTS = {
    fault.name: fault
    for fault in (
        Fault("command time-to-live", kill("centralised"), revive("centralised"), whole=True, centralised=True),
        Fault("core heartbeat", kill("core"), revive("core"), CORE_S + PERIOD_S, whole=True),
        Fault("hub lost", kill("hub"), revive("hub"), whole=True),
        Fault(
            "driver link lost", each(lambda rig, robot: rig.cut(robot, True)),
            each(lambda rig, robot: rig.cut(robot, False)),
            OWN,
            notes={"c1": "moves on until the cable is back: no command reaches it", "s1": GUARDED["s1"], **ALONE},
        ),
        Fault(
            "estimator silent", each(lambda rig, robot: rig.hush(robot, True)),
            each(lambda rig, robot: rig.hush(robot, False)),
        ),
        Fault(
            "clock jump", to_agent(signal.SIGCONT), bound_s=2 * PERIOD_S,
            notes=dict.fromkeys(BACKENDS, f"paused for {PAUSE_S} s; time from when it goes on"),
        ),
        Fault(
            "frozen simulation clock", lambda rig, _: rig.freeze(), robots=("s1",),
            lacking="its firmware has a clock of its own",
            notes={"s1": f"for {PAUSE_S} s; the body goes no way meanwhile, and comes to stand when time goes on"},
        ),
        Fault("agent SIGKILL", to_agent(signal.SIGKILL), each(lambda rig, robot: rig.swarm.supervisor.revive(robot)),
              DIES, notes=GUARDED),
        Fault("agent SIGSTOP", to_agent(signal.SIGSTOP), to_agent(signal.SIGCONT), DIES, notes=GUARDED),
        Fault(
            "guardian SIGKILL", each(lambda rig, robot: rig.kill_guardian(robot)), nothing, REPLACED_S, WATCHED,
            "it needs no guardian", notes={
                "c1": "its driver opens the port again, and its first words are zero",
                **dict.fromkeys(("m1", "v1"), "its driver stops it, until another one watches"),
            },
        ),
        Fault("bump", nothing, bound_s=REFLEX, robots=("s1", "c1"), lacking=NO_SENSOR, start_m=BOX_M - 1.4,
              from_mark=True),
        Fault(
            "cliff", each(lambda rig, robot: rig.emulator(robot).set_cliff(front_left=True)),
            each(lambda rig, robot: rig.emulator(robot).set_cliff()), REFLEX, ("c1",), NO_SENSOR,
        ),
        Fault(
            "wheel drop", each(lambda rig, robot: rig.emulator(robot).set_wheel_drop(left=True)),
            each(lambda rig, robot: rig.emulator(robot).set_wheel_drop()), REFLEX, ("c1",), NO_SENSOR,
        ),
        Fault(
            "low battery", each(lambda rig, robot: rig.emulator(robot).set_battery(0.05)),
            each(lambda rig, robot: rig.emulator(robot).set_battery(1.0)), BATTERY, ("c1", "m1", "o1", "v1"),
            "a simulated robot has no battery",
        ),
        Fault(
            "e-stop", lambda rig, _: rig.swarm.operator.estop(True, ()),
            lambda rig, _: rig.swarm.operator.estop(False, ()), 0.2, whole=True,
        ),
        Fault("geofence", nothing, bound_s=REFLEX, start_m=FENCE_M - 1.5, from_mark=True,
              notes={
                  **dict.fromkeys(BACKENDS, "distance and times count from the fence"),
                  "m1": "the last of its speed dies away slowly: give the fence a margin",
              }),
    )
}  # fmt: skip

Round = dict[str, str]
"""Robot → fault; all happen at once."""


def full_rounds() -> list[Round]:
    """Each fault on each backend that can have it."""
    return [dict.fromkeys(fault.robots, fault.name) for fault in FAULTS.values()]


def quick_rounds() -> list[Round]:
    """Each fault at least once, each backend at least twice."""
    # A Create that leaves Safe mode three times in 10 s is in FAULT for as long: its agent's new start counts anew.
    apart: list[Round] = [
        {
            "c1": "agent SIGSTOP",
            "s1": "geofence",
            "m1": "clock jump",
            "o1": "estimator silent",
            "v1": "driver link lost",
        },
        {"c1": "agent SIGKILL", "s1": "bump", "m1": "low battery", "o1": "agent SIGKILL", "v1": "low battery"},
        {"c1": "cliff", "s1": "agent SIGSTOP"},
        {"c1": "wheel drop", "o1": "clock jump"},
        {"c1": "guardian SIGKILL", "m1": "agent SIGKILL", "v1": "agent SIGSTOP"},
        {"m1": "guardian SIGKILL", "v1": "guardian SIGKILL"},
        {"s1": "frozen simulation clock"},
    ]
    together = ("command time-to-live", "hub lost", "e-stop", "core heartbeat")  # the slowest to mend comes last
    return apart + [dict.fromkeys(BACKENDS, name) for name in together]
