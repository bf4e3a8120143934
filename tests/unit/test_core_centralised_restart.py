"""Centralised behaviours over restarts of the core, and what their node does not know."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import pytest
from structlog.testing import capture_logs

from fullswarm.core.centralised.behaviours import formation_assigned
from fullswarm.core.centralised.node import CentralisedNode
from fullswarm.messages import CentralisedCommands, CentralisedRequest, ControlRequest, Heartbeat, RobotStates, Value
from fullswarm.store import Store
from tests.unit.core_restart import restart_core
from tests.unit.core_swarm import KEYS, Swarm

LINE: dict[str, Value] = {"shape": "line", "centre": [5.0, 5.0], "spacing_m": 1.0}


@pytest.mark.parametrize("both", [False, True])
def test_a_centralised_request_goes_on_after_a_restart_of_the_core(tmp_path: Path, both: bool) -> None:
    swarm = Swarm(store=Store(tmp_path / "core.db"))
    node = CentralisedNode(swarm.bus, swarm.runtime, swarm.config, "n1")
    commands: list[CentralisedCommands] = []
    swarm.bus.subscribe(KEYS.centralised_commands(), CentralisedCommands, commands.append)
    tell = swarm.runtime.every(0.05, lambda: swarm.bus.publish(KEYS.state("all", "h"), states("r0", "r1", "r2")))
    swarm.ask("c", "formation_assigned", **LINE)
    swarm.run(0.5)
    swarm.ask("d", "flocking", "r2")
    swarm.run(0.5)
    assert commands[-1].robots == ("r0", "r1")
    if both:
        node.close()
    restart_core(swarm, tmp_path / "core.db")
    if both:
        node = CentralisedNode(swarm.bus, swarm.runtime, swarm.config, "n2")
    swarm.run(4.0)
    commands.clear()
    before = len(swarm.robots["r0"].commands)
    swarm.run(1.0)
    assert commands[-1].robots == ("r0", "r1")
    assert len(swarm.robots["r0"].commands) - before >= 15
    swarm.ask("e", "flocking")
    swarm.run(1.0)
    commands.clear()
    swarm.run(1.0)
    assert commands == []
    tell.cancel()
    restart_core(swarm, tmp_path / "core.db")
    swarm.run(3.0)
    assert swarm.core.remapper.requests() == (), "what is over does not come back"
    node.close()
    swarm.close()


def test_a_centralised_intent_is_not_restored(tmp_path: Path) -> None:
    swarm = Swarm(store=Store(tmp_path / "core.db"))
    node = CentralisedNode(swarm.bus, swarm.runtime, swarm.config, "n1")
    swarm.ask("i", "teleop_centroid", vx=1.0)
    swarm.run(0.1)
    restart_core(swarm, tmp_path / "core.db")
    swarm.messages.clear()
    swarm.run(3.0)
    assert [m for m in swarm.sent(CentralisedRequest) if isinstance(m, CentralisedRequest) and m.enable] == []
    assert [m for m in swarm.sent(ControlRequest) if isinstance(m, ControlRequest) and m.enable] == []
    node.close()
    swarm.close()


def states(*robots: str, x_m: float = 1.0) -> RobotStates:
    count = len(robots)
    return RobotStates(
        host="h", sequence=1, stamp_s=0.0, robots=robots, x_m=tuple(x_m + k for k in range(count)),
        y_m=(1.0,) * count, heading_rad=(0.0,) * count, speed_m_s=(0.0,) * count, turn_rad_s=(0.0,) * count,
        radius_m=(0.17,) * count,
    )  # fmt: skip


def centralised_request(request_id: str, law: str, *robots: str, sequence: int = 1) -> CentralisedRequest:
    return CentralisedRequest(
        request_id=request_id, behaviour="x", law=law, enable=True, robots=robots, core="c", sequence=sequence,
        parameters={"targets": [[float(k), 0.0] for k in range(len(robots))], "gain": 1.0},
    )  # fmt: skip


def test_the_centralised_node_survives_what_it_does_not_know() -> None:
    swarm = Swarm(count=2)
    swarm.core.close()  # it would end what it did not ask for
    node = CentralisedNode(swarm.bus, swarm.runtime, swarm.config, "n1")
    with capture_logs() as logs:
        for sequence in range(1, 30):
            unknown = centralised_request("u", "nobody_knows", sequence=sequence)
            swarm.bus.publish(KEYS.centralised_request("x"), unknown)
            swarm.run(0.1)
    assert len(logs) == 1
    swarm.bus.publish(KEYS.centralised_request("x"), centralised_request("k", "formation_assigned", "r0", "r1"))
    swarm.run(0.1)
    uneven = msgspec.structs.replace(states("r0", "r1"), x_m=(1.0,))
    for odd in (uneven, states("r0", x_m=math.nan), states("r1", x_m=math.inf)):
        swarm.bus.publish(KEYS.state("all", "h"), odd)
        swarm.run(0.1)
    commands: list[CentralisedCommands] = []
    swarm.bus.subscribe(KEYS.centralised_commands(), CentralisedCommands, commands.append)
    swarm.bus.publish(KEYS.state("all", "h"), states("r0", "r1"))
    swarm.run(0.1)
    assert list(commands[-1].robots) == ["r0", "r1"]
    left = centralised_request("k", "formation_assigned", "r1", sequence=2)  # r0 left the group
    swarm.bus.publish(KEYS.centralised_request("x"), left)
    swarm.run(0.1)
    assert list(commands[-1].robots) == ["r1"]
    node.close()
    swarm.close()


def test_a_law_that_raises_anything_ends_nobody_else(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise TypeError("outside code")

    swarm = Swarm(count=1)
    monkeypatch.setattr(formation_assigned, "velocity", broken)
    swarm.core.close()
    node = CentralisedNode(swarm.bus, swarm.runtime, swarm.config, "n1")
    swarm.bus.publish(KEYS.centralised_request("x"), centralised_request("k", "formation_assigned", "r0"))
    swarm.run(0.05)
    swarm.bus.publish(KEYS.state("all", "h"), states("r0"))
    swarm.messages.clear()
    swarm.run(0.5)
    assert [m for m in swarm.sent(Heartbeat) if isinstance(m, Heartbeat) and m.node == "centralised"]
    node.close()
    swarm.close()
