"""An emergency stop outlives agents and cores, reaches who was away, and needs no disk."""

from __future__ import annotations

from pathlib import Path

import pytest

from fullswarm.errors import ConfigError
from fullswarm.messages import EStop
from fullswarm.store import Store
from tests.unit.core_restart import restart_core
from tests.unit.core_swarm import KEYS, Swarm


def latches(swarm: Swarm) -> list[EStop]:
    return [m for m in swarm.sent(EStop) if isinstance(m, EStop)]


@pytest.mark.parametrize("with_core", [False, True])
def test_an_e_stop_outlives_the_agents_process(tmp_path: Path, with_core: bool) -> None:
    swarm = Swarm(store=Store(tmp_path / "core.db"))
    swarm.bus.publish(KEYS.estop, EStop(id="e", engaged=True, reason="smoke"))
    swarm.run(0.2)
    robot = swarm.robots["r1"]
    robot.kill()
    if with_core:
        restart_core(swarm, tmp_path / "core.db")
    swarm.messages.clear()
    robot.start()
    swarm.run(0.6)
    again = [each for each in latches(swarm) if "r1" in each.robots]
    assert len(again) == 1
    assert again[0].engaged
    assert again[0].id not in ("", "e")
    assert "smoke" in again[0].reason
    swarm.bus.publish(KEYS.estop, EStop(id="f", engaged=False))
    swarm.run(0.2)
    swarm.messages.clear()
    robot.kill()
    robot.start()
    swarm.run(0.6)
    assert latches(swarm) == []
    swarm.close()


def test_a_robot_that_was_away_is_latched_when_it_comes() -> None:
    swarm = Swarm(late=1)
    swarm.bus.publish(KEYS.estop, EStop(id="e", engaged=True))
    swarm.run(3.0)
    swarm.messages.clear()
    swarm.robots["r2"].start()
    swarm.run(2.0)
    assert [each.robots for each in latches(swarm)] == [("r2",)]
    swarm.close()


def test_a_failing_disk_cannot_keep_an_e_stop_from_being_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    swarm = Swarm()

    def fail(*_: object) -> None:
        raise ConfigError("the local database fails: disk full")

    monkeypatch.setattr(swarm.store, "set_many", fail)
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    swarm.bus.publish(KEYS.estop, EStop(id="e", engaged=True))
    swarm.run(0.2)
    assert swarm.behaviours() == ["", "", ""]
    swarm.close()
