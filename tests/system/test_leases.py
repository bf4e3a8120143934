"""Authority between real processes: it outlives a core that is killed, and ends with an operator who is."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from fullswarm.keys import Keys
from fullswarm.messages import Leases
from fullswarm.operator.leases import LeaseHolder
from tests.system.live import START_S, LiveSwarm

CONFIG = {
    "world": {"engine": "kinematic", "bounds_m": [0, 0, 10, 10]},
    "robot": [{"id": f"r{number}", "pose": [2.0 * number, 2.0, 0.0]} for number in (1, 2)],
}
EXPIRE_S = 3.0


@pytest.fixture(scope="module")
def swarm() -> Iterator[LiveSwarm]:
    live = LiveSwarm(CONFIG, watch=True)
    yield live
    live.close()


def test_a_lease_is_back_soon_after_the_core_was_killed(swarm: LiveSwarm) -> None:
    lost: list[str] = []
    holder = LeaseHolder(
        swarm.bus, Keys(swarm.config.swarm), swarm.runtime, "anna", on_lost=lambda robots, _: lost.extend(robots)
    )
    cores: list[str] = []
    granted: list[str] = []

    def note(message: Leases) -> None:
        if cores[-1:] != [message.core]:
            cores.append(message.core)
            granted.clear()
        granted.extend(lease.operator for lease in message.leases)

    listening = swarm.bus.subscribe(Keys(swarm.config.swarm).leases, Leases, note)
    try:
        holder.hold(["r1"])
        swarm.until(lambda: holder.held() == ("r1",), 10.0, "anna holds r1")
        before = cores[-1]
        swarm.supervisor.kill("core")
        swarm.supervisor.revive("core")
        swarm.until(lambda: cores[-1] != before, START_S, "another core speaks")
        swarm.until(lambda: granted[-1:] == ["anna"], 2.0, "which grants anna her robot again")
        refused = swarm.cli("request", "flocking_bc", "--robots", "r1", "--operator", "bob")
        assert refused.returncode == 2, refused.stderr
        assert "r1 is held by anna" in refused.stderr
        assert "--take" in refused.stderr
        taken = swarm.cli("request", "flocking_bc", "--robots", "r1", "--operator", "bob", "--take", "--wait")
        assert taken.returncode == 0, taken.stderr
        swarm.until(lambda: lost == ["r1"], 5.0, "anna is told")
    finally:
        listening.close()
        holder.close()


def test_an_operator_who_is_killed_holds_nothing_for_long(swarm: LiveSwarm) -> None:
    holder = LeaseHolder(swarm.bus, Keys(swarm.config.swarm), swarm.runtime, "carl")
    process = swarm.spawn("leases", "hold", "r2", "--operator", "dora")
    try:
        swarm.until(lambda: holder.held_by_others(["r2"]) == {"r2": "dora"}, 20.0, "dora holds r2")
        process.send_signal(signal.SIGKILL)
        took_s = swarm.until(lambda: "r2" not in holder.leases, 10.0, "nobody holds r2")
        assert took_s < EXPIRE_S + 1.0 + 0.5  # the expiry, the period of publishing, and polling
    finally:
        process.kill()
        process.communicate()
        holder.close()


def test_stopping_needs_no_lease(swarm: LiveSwarm) -> None:
    holder = LeaseHolder(swarm.bus, Keys(swarm.config.swarm), swarm.runtime, "emma")
    try:
        holder.hold(["r1", "r2"], take=True)
        swarm.until(lambda: holder.held() == ("r1", "r2"), 10.0, "emma holds both")
        driving = swarm.operator.request("move_to_goal_bc", (), {"goal": [5.0, 8.0]}, take=True)
        swarm.until(swarm.driven, 10.0, "both drive")
        assert driving.status is not None
        holder.hold(["r1", "r2"], take=True)
        swarm.until(lambda: holder.held() == ("r1", "r2"), 10.0, "emma holds both again")
        assert swarm.cli("stop").returncode == 0
        swarm.until(swarm.stands, 2.0, "both stand although emma holds them")
    finally:
        holder.close()
