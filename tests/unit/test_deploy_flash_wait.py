"""Waiting for the hello of flashed robots, on a bus and a clock of its own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from fullswarm.bus import LocalBus
from fullswarm.clock import SimClock
from fullswarm.deploy.flash.result import LOOK_S, wait_for_robots
from fullswarm.keys import Keys
from fullswarm.messages import HealthReport, RobotHealth
from fullswarm.operator import session
from fullswarm.operator.session import Session, Target
from fullswarm.runtime import Runtime


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """Return when which robot says hello for the first time, in seconds; fill it before you wait."""
    hellos: dict[str, float] = {}

    @contextmanager
    def connect(target: Target, within_s: float | None = None) -> Iterator[Session]:
        del within_s
        runtime, keys = Runtime(SimClock()), Keys(target.swarm)
        bus = LocalBus(runtime.mailbox)
        for robot, after_s in hellos.items():
            health = RobotHealth(
                robot=robot, driver="create:///dev/x", make="iRobot", model="Create 2", firmware="", lifecycle="READY"
            )
            report = HealthReport(host=robot, process="1", version="0.1.0", robots=(health,))
            runtime.after(after_s, lambda report=report: bus.publish(keys.health(report.host), report))  # type: ignore[misc]
        yield Session(bus, keys, runtime, "tcp/hub")

    monkeypatch.setattr(session, "connect", connect)
    return hellos


def test_each_robot_is_told_as_it_comes(hub: dict[str, float], capsys: pytest.CaptureFixture[str]) -> None:
    hub.update(r2=40.0, r1=90.0, stranger=5.0)
    heard, silent = wait_for_robots(Target("tcp/hub", "lab"), ["r1", "r2"], 15.0)
    assert (list(heard), silent) == (["r2", "r1"], [])
    assert (heard["r1"].state, heard["r1"].driver) == ("READY", "create:///dev/x")
    assert heard["r1"].after_s == pytest.approx(90.0, abs=LOOK_S)
    assert "r2: first report from r2" in capsys.readouterr().err


def test_who_never_comes_is_named(hub: dict[str, float]) -> None:
    hub.update(r1=30.0)
    heard, silent = wait_for_robots(Target("tcp/hub", "lab"), ["r1", "r2"], 2.0)
    assert (list(heard), silent) == (["r1"], ["r2"])
