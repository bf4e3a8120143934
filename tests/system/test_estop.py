"""E-stop of twenty live robots: receipts, a deaf one, a dead core, a dead hub, processes that start anew."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import suppress

import numpy as np
import pytest

from fullswarm.messages import Value
from fullswarm.operator.estop import EStopOrder
from tests.system.live import START_S, LiveSwarm

pytestmark = pytest.mark.alone

COUNT = 20
RATE_HZ = 25.0
"""Half of what agents do unless told otherwise: twenty of those fill two processors."""
RECEIPT_S = 3.0
"""Generous, the machine may be busy; ``python -m benchmarks.estop`` measures against 0.2 s."""
HUB_LOST_S = 0.3 + 1.0 / RATE_HZ + 0.2
CONFIG = {
    "swarm": "estop",
    "world": {"engine": "kinematic", "walls": False, "bounds_m": [0, 0, 200, 60]},
    "agent": {"speed_limit_m_s": 0.3, "control_rate_hz": RATE_HZ},
    "performance": {"coverage_cell_m": 1.0},
    "robot": [{"id": f"r{row}", "pose": [2.0, 2.0 + 2.5 * row, 0.0]} for row in range(COUNT)],
}
FAR: dict[str, Value] = {"goal": [190.0, 26.0]}


@pytest.fixture(scope="module")
def swarm() -> Iterator[LiveSwarm]:
    live = LiveSwarm(CONFIG, watch=True)
    yield live
    live.close()


@pytest.fixture(autouse=True)
def released(swarm: LiveSwarm) -> Iterator[None]:
    """Release what a test that failed has left latched: the next one has the same robots."""
    yield
    if not free(swarm):
        with suppress(AssertionError):
            clear(swarm)


def drive(swarm: LiveSwarm) -> None:
    """Have all robots drive; repeat the request if a busy machine has kept the world's readings from one of them."""
    for _ in range(4):
        swarm.request("move_to_goal", FAR)
        with suppress(AssertionError):
            swarm.until(swarm.driven, 8.0, "all robots are driven")
            break
    assert swarm.driven()
    swarm.rest(0.7)


def press(swarm: LiveSwarm, *, engaged: bool = True) -> EStopOrder:
    order = swarm.operator.estop(engaged, known=swarm.view.present, deadline_s=20.0)
    swarm.until(lambda: order.done, 21.0, "the order has come to an end")
    assert order.unconfirmed() == ()
    return order


def clear(swarm: LiveSwarm) -> None:
    """Release; then all are READY and stand, with no behaviour, and stay so."""
    press(swarm, engaged=False)
    swarm.until(lambda: free(swarm), 10.0, "all are READY, standing, without a behaviour")
    swarm.rest(1.5)
    assert free(swarm)
    assert swarm.stands()


def free(swarm: LiveSwarm) -> bool:
    found = [row.health for row in swarm.view.snapshot().robots if row.health and row.age_s < 1.5]
    good = [each for each in found if each.lifecycle == "READY" and not (each.estop or each.behaviour or each.moving)]
    return len(good) == COUNT


def latched(swarm: LiveSwarm, *robots: str) -> bool:
    rows = {row.robot: row for row in swarm.view.snapshot().robots}
    return all(rows[each].health.estop and rows[each].age_s < 1.0 for each in robots or swarm.config.robots)  # type: ignore[union-attr]  # all have been heard


def test_twenty_receipts_and_how_far_each_rolled(swarm: LiveSwarm) -> None:
    assert swarm.world
    drive(swarm)
    swarm.until(swarm.driven, 8.0, "all robots are driven at one moment")
    before = swarm.world.pose[:, :2].copy()
    order = press(swarm)
    assert len(order.receipts) == COUNT
    assert max(order.answered_s.values()) < RECEIPT_S
    true_m = np.hypot(*(swarm.world.pose[:, :2] - before).T)
    told_m = np.array([order.receipts[robot].rolled_m for robot in swarm.config.robots])
    # The way to a standstill from 0.3 m/s is 2 cm. A busy machine makes commands late: some may just have set off.
    drove = true_m > 0.01
    assert drove.sum() >= COUNT / 2, f"they were driving: {true_m.round(3)}"
    assert told_m[drove].mean() > 0.005
    # Until the order has arrived a robot drives on, as far as it gets in the time that a busy machine takes for the
    # order, and the reading before it is old: 3 cm at 0.3 m/s.
    way_m = 0.3 * np.array([order.answered_s[robot] for robot in swarm.config.robots])
    assert (np.abs(true_m - told_m) < 0.03 + way_m).all(), f"{true_m.round(3)} {told_m.round(3)} {way_m.round(3)}"
    swarm.rest(1.0)
    assert swarm.stands()
    clear(swarm)


def test_a_deaf_robot_is_named_and_confirms_when_it_hears_again(swarm: LiveSwarm) -> None:
    drive(swarm)
    swarm.supervisor.kill("r7", signal.SIGSTOP)
    try:
        pressing = swarm.spawn("estop", "--reason", "smoke")
        others = [robot for robot in swarm.config.robots if robot != "r7"]
        swarm.until(lambda: latched(swarm, *others), 20.0, "the others are latched")
        swarm.rest(1.5)
        assert pressing.poll() is None, "it is pressed on"
    finally:
        swarm.supervisor.kill("r7", signal.SIGCONT)
    swarm.until(lambda: pressing.poll() is not None, 15.0, "it ends by itself")
    out, err = pressing.communicate()
    assert pressing.returncode == 0, err
    named = next(line for line in err.splitlines() if line.startswith("after 0.5 s"))
    assert "received from r7;" in named  # the others may still decelerate, which it names after that
    assert named.endswith("still trying")
    assert "r7: at standstill after" in out
    assert out.count("at standstill after") == COUNT
    assert latched(swarm, "r7")
    clear(swarm)


def test_without_a_core(swarm: LiveSwarm) -> None:
    drive(swarm)
    swarm.supervisor.kill("core")
    assert len(press(swarm).receipts) == COUNT
    pressed = swarm.cli("estop")  # by another operator, while it is latched already
    assert pressed.returncode == 0, pressed.stderr
    assert pressed.stdout.count("at standstill after 0.000 m") == COUNT
    swarm.supervisor.revive("core")
    swarm.until(swarm.ready, START_S, "the core is back")
    swarm.rest(2.0)
    assert latched(swarm)
    assert swarm.stands()
    clear(swarm)


def test_a_robot_that_is_not_there_is_named_and_latched_when_it_comes(swarm: LiveSwarm) -> None:
    swarm.supervisor.kill("r3")
    swarm.rest(2.0)
    pressed = swarm.cli("estop", "--timeout", "1.5")
    assert pressed.returncode == 4
    assert "r3 (go there: they may still move)" in pressed.stderr
    swarm.supervisor.revive("r3")
    swarm.until(lambda: latched(swarm), START_S, "the core has told it")
    clear(swarm)


def test_core_and_agents_that_start_anew_at_once(swarm: LiveSwarm) -> None:
    drive(swarm)
    press(swarm)
    for name in ("core", "r5", "r6"):
        swarm.supervisor.kill(name)
    swarm.rest(1.5)
    for name in ("r5", "r6"):
        swarm.supervisor.revive(name)
    swarm.until(lambda: latched(swarm, "r5", "r6"), START_S, "they know by themselves")
    swarm.supervisor.revive("core")
    swarm.until(swarm.ready, START_S, "the core is back")
    swarm.rest(2.0)  # by then the core, too, has heard them all
    refused = swarm.cli("request", "move_to_goal", "--set", "goal=190,26", "--wait", "--timeout", "15")
    assert refused.returncode == 4, refused.stderr
    assert swarm.stands()
    clear(swarm)


def test_a_dead_hub_stops_all_and_the_operator_is_told(swarm: LiveSwarm) -> None:
    drive(swarm)
    swarm.supervisor.kill("hub")
    took_s = swarm.until(swarm.stands, 5.0, "all stand by themselves")
    assert took_s <= HUB_LOST_S
    pressing = swarm.spawn("estop")
    swarm.rest(4.5)
    assert pressing.poll() is None
    assert swarm.stands()
    swarm.supervisor.revive("hub")
    swarm.until(lambda: pressing.poll() is not None, START_S, "it gets through when the hub is back")
    out, err = pressing.communicate()
    assert pressing.returncode == 0, err
    assert "robots without a hub stop by themselves, but they are not latched; still trying" in err
    assert out.count("at standstill after") == COUNT
    swarm.until(lambda: latched(swarm), 5.0, "all are latched")
    clear(swarm)
    drive(swarm)
