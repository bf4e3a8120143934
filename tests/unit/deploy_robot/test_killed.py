"""``fullswarm-robot`` killed at any step: what is there afterwards is the old release or the new one, whole."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from fullswarm.deploy.release.store import gzipped_archive, head_archive
from tests.unit.deploy_robot.script import Robot

AFTER = ("power", "guard")
"""What comes after a kill: the power goes, too; or the robot stays on, and the guard if it is armed."""


@dataclass(frozen=True)
class Step:
    """One command in a state of its own: the template is copied for each kill."""

    template: Robot
    old: str | None
    new: str
    arguments: tuple[str, ...]
    feed: bytes = b""

    def killed(self, at: int, after: str, folder: Path) -> bool:
        """Kill it in place of its `at`-th call, let come what comes, look, try again; False: it ended before."""
        robot = self.template.copy(folder)
        done = robot.call_killed(at, *self.arguments, feed=self.feed)
        if done.returncode != -9:
            assert done.returncode == 0, done.stderr.decode()
            assert robot.calls < at
            return False
        self._look(robot)
        if after == "power":
            robot.reboot()
        else:
            robot.fire_guard()
        self._look(robot)
        if after == "power" or robot.agent is None:
            assert robot.agent == robot.current, "an agent runs, and it is what current says"
        if self.arguments[0] != "commit" or robot.current == self.new:
            again = robot.call(*self.arguments, feed=self.feed)
            assert again.returncode == 0, again.stderr.decode()
            self._look(robot)
        robot.fire_guard()
        robot.reboot()
        self._look(robot)
        assert (robot.pending, robot.agent) == (False, robot.current)
        assert robot.current is not None or self.old is None
        return True

    def _look(self, robot: Robot) -> None:
        robot.check()
        assert robot.current in (self.old, self.new)


Make = Callable[[Robot, Path, Path], Step]


def _want(robot: Robot, old: Path, new: Path) -> Step:
    return Step(robot, old.name, new.name, ("want", new.name), head_archive(new))


def _receive(robot: Robot, old: Path, new: Path) -> Step:
    missing = robot.want(new)
    return Step(robot, old.name, new.name, ("receive", new.name), b"".join(gzipped_archive(new, missing)))


def _switch(robot: Robot, old: Path, new: Path) -> Step:
    robot.ship(new)
    return Step(robot, old.name, new.name, ("switch", new.name))


def _commit(robot: Robot, old: Path, new: Path) -> Step:
    robot.ship(new)
    robot.ok("switch", new.name)
    return Step(robot, old.name, new.name, ("commit", new.name))


def _rollback(robot: Robot, old: Path, new: Path) -> Step:
    robot.ship(new)
    robot.ok("switch", new.name)
    return Step(robot, old.name, new.name, ("rollback",))


def _rollback_later(robot: Robot, old: Path, new: Path) -> Step:
    robot.run_release(new)
    return Step(robot, old.name, new.name, ("rollback",))


def _boot(robot: Robot, old: Path, new: Path) -> Step:
    robot.ship(new)
    robot.ok("switch", new.name)
    robot.new_boot_id()
    return Step(robot, old.name, new.name, ("boot",))


MAKE: dict[str, Make] = {
    "want": _want, "receive": _receive, "switch": _switch, "commit": _commit, "rollback": _rollback,
    "rollback-later": _rollback_later, "boot": _boot,
}  # fmt: skip


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> tuple[Robot, Path, Path]:
    robot = Robot(tmp_path_factory.mktemp("robot"))
    robot.wrap()
    old, new = robot.make("1.0.0"), robot.make("1.0.1")
    robot.run_release(old)
    return robot, old, new


@pytest.fixture(params=sorted(MAKE))
def step(request: pytest.FixtureRequest, running: tuple[Robot, Path, Path], tmp_path: Path) -> Step:
    robot, old, new = running
    return MAKE[request.param](robot.copy(tmp_path / "before"), old, new)


@pytest.mark.parametrize("share", [0.2, 0.6, 0.95])
def test_some_kills(running: tuple[Robot, Path, Path], share: float, tmp_path: Path) -> None:
    """The switch alone, at three of its steps: all steps of all commands are the slow test's."""
    robot, old, new = running
    step = _switch(robot.copy(tmp_path / "before"), old, new)
    step.template.tell(moving=False)  # each time: the script makes fewer calls where the last report is old
    whole = step.template.copy(tmp_path / "whole")
    whole.call_killed(0, *step.arguments)
    step.template.tell(moving=False)
    assert step.killed(max(1, int(share * whole.calls)), "power", tmp_path / "one")


@pytest.mark.slow
@pytest.mark.parametrize("after", AFTER)
def test_every_kill(step: Step, after: str, tmp_path: Path) -> None:
    at = 1
    while step.killed(at, after, tmp_path / f"at-{at}"):
        at += 1
    assert at > 5, "the counter counts"
