"""Restarts of the core that the swarm must survive: half-done switches, failing databases, a successor's numbers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from fullswarm.errors import ConfigError
from fullswarm.messages import ControlRequest, Message, ParamEntry, RequestStatus, StopRequest
from fullswarm.store import Store, Stored
from tests.unit.core_restart import restart_core
from tests.unit.core_swarm import KEYS, Swarm


def test_a_request_is_kept_before_it_is_sent(tmp_path: Path) -> None:
    """A core that dies between the two must not leave robots with a request that its successor ends."""
    swarm = Swarm(store=Store(tmp_path / "core.db"))
    order: list[str] = []
    swarm.store.watch(lambda entry: order.append("kept") if entry.key.startswith("wanted/") else None)
    publish = swarm.bus.publish

    def note(key: str, message: Message, *, sender: str = "") -> None:
        order.append(type(message).__name__) if isinstance(message, ControlRequest | RequestStatus) else None
        publish(key, message, sender=sender)

    swarm.bus.publish = note  # type: ignore[method-assign]  # listens at the very call, not after the mailbox
    swarm.ask("a", "flocking")
    swarm.run(0.02)
    assert order[0] == "kept"
    assert "ControlRequest" in order
    swarm.close()


def test_a_scheduled_request_survives_the_core(tmp_path: Path) -> None:
    swarm = Swarm(store=Store(tmp_path / "core.db"), interval_s=3.0)
    swarm.ask("a", "flocking")
    swarm.run(0.1)
    swarm.ask("b", "rendezvous")
    swarm.run(0.1)
    assert swarm.status("b").phase == "scheduled"
    restart_core(swarm, tmp_path / "core.db")
    swarm.run(4.0)
    assert swarm.behaviours() == ["rendezvous"] * 3
    assert swarm.status("b").phase == "running"
    assert all(robot.log.count(("on", "rendezvous", "b")) == 1 for robot in swarm.robots.values())
    swarm.close()


def test_what_was_accepted_is_executed_by_robots_that_start_after_a_restart_of_the_core(tmp_path: Path) -> None:
    """One was away when it was asked for, another one dies after the core did: neither may stay idle."""
    swarm = Swarm(store=Store(tmp_path / "core.db"), late=1)
    swarm.ask("a", "move_to_goal", goal=[3.0, 4.0])
    swarm.run(0.2)
    assert swarm.status("a").missing == ("r2",)
    restart_core(swarm, tmp_path / "core.db")
    swarm.run(0.2)
    swarm.robots["r2"].start()
    swarm.robots["r0"].kill()
    swarm.run(0.2)
    swarm.robots["r0"].start()
    swarm.run(1.0)
    tasks = [robot.task for robot in swarm.robots.values()]
    assert [task.request_id if task else "" for task in tasks] == ["a"] * 3
    assert all(task is not None and task.parameters["goal"] == [3.0, 4.0] for task in tasks)
    swarm.close()


def test_core_restart_with_a_switch_half_done(tmp_path: Path) -> None:
    swarm = Swarm(store=Store(tmp_path / "core.db"))
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    swarm.bus.drop = lambda _key, message: isinstance(message, ControlRequest) and message.enable
    swarm.ask("b", "rendezvous")
    swarm.run(0.1)
    assert swarm.behaviours() == ["", "", ""]
    swarm.bus.drop = lambda _key, _message: False
    restart_core(swarm, tmp_path / "core.db")
    swarm.run(1.0)
    assert swarm.behaviours() == ["rendezvous"] * 3
    assert swarm.status("b").phase == "running"
    swarm.ask("b", "rendezvous")  # the operator, who never heard
    swarm.run(0.5)
    assert all(robot.log.count(("on", "rendezvous", "b")) == 1 for robot in swarm.robots.values())
    swarm.close()


def test_a_closed_core_does_nothing_more() -> None:
    swarm = Swarm(interval_s=1.0)
    swarm.ask("a", "flocking")
    swarm.run(0.1)
    swarm.ask("b", "rendezvous")
    swarm.run(0.1)
    swarm.core.close()
    swarm.store.close()
    swarm.messages.clear()
    swarm.run(2.0)
    assert swarm.sent(ControlRequest) == []
    swarm.bus.close()


def test_a_database_that_fails_does_not_end_the_core(monkeypatch: pytest.MonkeyPatch) -> None:
    swarm = Swarm()

    def fail(*_: object) -> None:
        raise ConfigError("the local database fails: disk full")

    monkeypatch.setattr(swarm.store, "set_many", fail)
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    assert swarm.behaviours() == ["flocking"] * 3
    swarm.bus.publish(KEYS.stop, StopRequest(id="s"))
    swarm.run(0.2)
    assert swarm.status("s").running == ("r0", "r1", "r2")
    swarm.close()


class FullDisk:
    """The disk of a swarm's core: while `full`, its database takes nothing whose key `begins` so."""

    def __init__(self, swarm: Swarm, monkeypatch: pytest.MonkeyPatch, begins: str = "") -> None:
        self.full = False
        write = swarm.store.set_many

        def set_many(values: Mapping[str, Stored], author: str) -> tuple[ParamEntry, ...]:
            if self.full and all(key.startswith(begins) for key in values):
                raise ConfigError("the local database fails: disk full")
            return write(values, author)

        monkeypatch.setattr(swarm.store, "set_many", set_many)


def die(swarm: Swarm, path: Path) -> None:
    """Let the core die without a word to its database, and another one start."""
    swarm.core.close()
    swarm.store._db.close()
    swarm.run(0.4)
    swarm.start_core(Store(path))


def test_what_a_full_disk_did_not_take_is_saved_when_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without that a core that dies later takes the robots back to what they had been asked for before."""
    swarm = Swarm(store=Store(tmp_path / "core.db"))
    disk = FullDisk(swarm, monkeypatch)
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    disk.full = True
    swarm.ask("b", "rendezvous")
    swarm.run(3.0)
    disk.full = False
    swarm.run(0.6)
    assert not swarm.store.unsaved
    die(swarm, tmp_path / "core.db")
    for robot in swarm.robots.values():  # they know nothing either
        robot.kill()
        robot.start()
    swarm.run(1.0)
    assert swarm.behaviours() == ["rendezvous"] * 3
    assert all(robot.log.count(("on", "flocking", "a")) == 1 for robot in swarm.robots.values())
    swarm.close()


def test_a_core_that_died_with_a_full_disk_leaves_robots_what_they_were_asked_for_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    swarm = Swarm(store=Store(tmp_path / "core.db"))
    disk = FullDisk(swarm, monkeypatch)
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    disk.full = True
    swarm.ask("b", "rendezvous")
    swarm.run(0.3)
    die(swarm, tmp_path / "core.db")
    swarm.run(2.0)
    assert swarm.behaviours() == ["rendezvous"] * 3
    assert all(("on", "flocking", "a") not in robot.log[1:] for robot in swarm.robots.values())
    assert swarm.status("b").phase == "running"
    assert swarm.status("a").phase in ("superseded", "ended")
    swarm.ask("c", "voronoi_coverage")
    swarm.run(0.3)
    assert swarm.behaviours() == ["voronoi_coverage"] * 3
    swarm.close()


def test_a_core_that_has_lost_who_runs_a_centralised_request_has_it_started_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot reports twice before it has the request of the new core: ``rehearse --seed 71 --episode 29``."""
    swarm = Swarm(store=Store(tmp_path / "core.db"))
    disk = FullDisk(swarm, monkeypatch, "wanted/")
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    disk.full = True
    swarm.ask("b", "voronoi_centralised", bounds=[[0.0, 0.0], [6.0, 6.0]])
    swarm.run(0.3)
    assert swarm.behaviours() == ["voronoi_centralised"] * 3
    begun = {name: len(robot.log) for name, robot in swarm.robots.items()}
    die(swarm, tmp_path / "core.db")
    for robot in swarm.robots.values():
        robot.report()
        robot.report()
    swarm.run(2.0)
    assert [robot.log[begun[name] :] for name, robot in swarm.robots.items()] == [
        [("on", "voronoi_centralised", "b")]
    ] * 3
    swarm.close()


def test_a_robot_that_was_to_stand_is_stopped_by_a_core_that_has_forgotten_its_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    swarm = Swarm(store=Store(tmp_path / "core.db"))
    disk = FullDisk(swarm, monkeypatch)
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    swarm.ask("s", "stop")
    swarm.run(0.2)
    disk.full = True
    swarm.ask("b", "rendezvous")
    swarm.run(0.3)
    assert swarm.behaviours() == ["rendezvous"] * 3
    die(swarm, tmp_path / "core.db")
    swarm.run(2.0)
    assert swarm.behaviours() == [""] * 3
    swarm.close()


def test_numbers_of_a_later_core_are_higher() -> None:
    swarm = Swarm(count=1)
    for k in range(5):
        swarm.ask(f"q{k}", "flocking" if k % 2 else "rendezvous")
        swarm.run(0.2)
    last = max(m.sequence for m in swarm.sent(ControlRequest) if isinstance(m, ControlRequest))
    swarm.core.close()
    swarm.store.close()
    swarm.messages.clear()
    swarm.start_core(Store())
    swarm.run(0.6)
    swarm.ask("n", "voronoi_coverage")
    swarm.run(0.2)
    assert min(m.sequence for m in swarm.sent(ControlRequest) if isinstance(m, ControlRequest)) > last
    swarm.close()
