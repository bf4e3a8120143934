"""A bad network between real processes: as the flag makes it, and as the kernel makes it where it can."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
from collections.abc import Iterator
from itertools import count
from typing import Any

import pytest

from tests.system.live import LiveSwarm

PERIOD_S = 1 / 50
CORE_SILENCE_S = 1.0
LOOK_S = 0.2
"""This machine may be busy; the bound itself is exact in tests/unit/test_bus_faulty_swarm.py."""
CUT_S = 4.0
LEADS_S = (10.0, 25.0, 60.0)
"""The cut is set for a time before the processes start; a machine that is too slow for one gets a later one."""

BASE: dict[str, Any] = {
    "world": {"engine": "kinematic", "bounds_m": [0, 0, 40, 40], "watchdog_s": 5.0},
    "robot": [{"id": f"r{row}", "pose": [2.0, 2.0 + 2 * row, 0.0]} for row in range(3)],
}
FAR = {"goal": [38.0, 20.0]}


@pytest.fixture
def cut() -> Iterator[tuple[LiveSwarm, float]]:
    """Yield three robots that drive, and the time when r1 is to be cut off, a second or more from now."""
    for lead_s in LEADS_S:
        network = {"conditions": f"partition=r1|*@{lead_s}s-{lead_s + CUT_S}s"}
        swarm = LiveSwarm({**BASE, "network": network}, watch=True)
        try:
            zero_s = swarm.supervisor.config.network.since_s
            assert zero_s is not None
            at_s = zero_s + lead_s
            if swarm.clock.now_s() > at_s - 3.0:
                continue
            swarm.request("move_to_goal", FAR)  # type: ignore[arg-type]  # values of a test
            swarm.until(swarm.driven, 10.0, "all robots are driven")
            if swarm.clock.now_s() > at_s - 1.0:
                continue
            yield swarm, at_s
            return
        finally:
            swarm.close()
    pytest.fail(f"three robots did not drive within {LEADS_S[-1]:.0f} s")


def test_a_robot_that_is_cut_off_stops_and_comes_back(cut: tuple[LiveSwarm, float]) -> None:
    swarm, at_s = cut
    world = swarm.world
    assert world

    def stands() -> bool:
        return not world.setpoint[1].any()

    swarm.rest(at_s - swarm.clock.now_s())
    assert swarm.driven()
    swarm.until(stands, CORE_SILENCE_S + PERIOD_S + 2.0, "r1 stands")
    took_s = world.driven_s[1] - at_s
    assert CORE_SILENCE_S / 2 < took_s <= CORE_SILENCE_S + PERIOD_S + LOOK_S
    swarm.rest(at_s + CUT_S - 0.5 - swarm.clock.now_s())
    assert stands(), "and it goes on standing"
    assert world.setpoint[0].any()
    assert world.setpoint[2].any()
    # Nobody asks again: the core tells the robot what it has missed.
    swarm.until(swarm.driven, 5.0, "r1 drives again")
    assert swarm.clock.now_s() >= at_s + CUT_S


def test_loss_and_delay() -> None:
    """Requests are answered, robots reach what they are sent to; a stop gets through."""
    swarm = LiveSwarm({**BASE, "network": {"conditions": "loss=20%,delay=100ms±50"}}, watch=True)
    try:
        for number in count(1):
            swarm.request("move_to_goal_bc", {"goal": [6.0 + number, 4.0], "arrive_radius_m": 1.5}, timeout_s=15.0)
            swarm.until(swarm.driven, 10.0, "all robots are driven")
            if number == 2:
                break
        assert (swarm.cli("stop")).returncode == 0
        swarm.until(swarm.stands, 5.0, "all stand")
    finally:
        swarm.close()


def test_robots_that_do_not_receive_each_other_pass() -> None:
    """A cut link between two robots, real processes: the core relays their states, and they swap places untouched."""
    places, touched = [[6.0, 10.0], [10.0, 10.0]], 0
    fleet = {
        "world": {"engine": "kinematic", "bounds_m": [0, 0, 16, 20], "sight": {"bodies": False}},
        "robot": [{"id": "r0", "pose": [*places[0], 0.0]}, {"id": "r1", "pose": [*places[1], math.pi]}],
        "network": {"conditions": "partition=r0|r1"},
    }
    swarm = LiveSwarm(fleet, watch=True)
    world = swarm.world
    assert world

    def watch() -> None:
        nonlocal touched
        touched += len(world.pairs)

    def swapped() -> bool:
        return all(math.dist(world.pose[row, :2], places[1 - row]) < 0.4 for row in range(2))

    try:
        world.watchers.append(watch)
        for row in range(2):
            goal = {"goal": places[1 - row], "arrive_radius_m": 0.2}
            swarm.operator.request("move_to_goal_bc", (f"r{row}",), goal)  # type: ignore[arg-type]
        swarm.until(swapped, 60.0, "both have swapped places")
        assert touched == 0
    finally:
        swarm.close()


def in_namespace(script: str, timeout_s: float) -> subprocess.CompletedProcess[str]:
    """Run a shell script in a network namespace of its own, which needs no administrator's rights."""
    command = ["unshare", "-rn", "sh", "-ec", script]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s)


def need(script: str, *programs: str) -> None:
    """Skip the test, with the reason, unless the programs are there and the kernel lets the script pass."""
    lacking = [each for each in ("unshare", *programs) if shutil.which(each) is None]
    if lacking:
        pytest.skip(f"needs {' and '.join(lacking)}")
    tried = in_namespace(script, 10.0)
    if tried.returncode:
        pytest.skip(f"no `{script}` in a network namespace: {tried.stderr.strip()}")


@pytest.mark.parametrize("secured", [False, True])
def test_a_cable_that_is_pulled(secured: bool) -> None:
    """The robot's computer in a namespace of its own, hub and core in another, and the cable between them down."""
    need("ip link add v0 type veth peer name v1; unshare -n true; nsenter -t $$ -n true", "ip", "nsenter")
    ran = in_namespace(f"exec {sys.executable} -m tests.system.cut_cable{' secured' * secured}", 200.0)
    assert ran.returncode == 0, ran.stderr
    found = json.loads(ran.stdout)
    assert "refused" not in found["phases"]
    if secured:  # its certificate has expired and was renewed over the cable, and the robot drives on
        assert (found["renewed"], found["drives"]) == (True, True)
    assert found["stood_after_s"] <= CORE_SILENCE_S + PERIOD_S + LOOK_S
    assert found["stayed"]
    assert found["drove_after_s"] < 5.0


def test_packets_that_the_kernel_loses() -> None:
    """The show over a loopback that loses and delays packets: TCP turns losses into delays."""
    bad = "ip link set lo up; tc qdisc add dev lo root netem loss 2% delay 20ms 5ms"
    need(bad, "ip", "tc")
    ran = in_namespace(f"{bad}; exec {sys.executable} -m fullswarm demo --headless --json --seconds 15", 120.0)
    assert ran.returncode == 0, ran.stderr
    document = json.loads(ran.stdout)
    assert document["collisions"] == 0
    assert all(len(each["confirmed_by"]) == 8 for each in document["requests"])
