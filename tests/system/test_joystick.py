"""A gamepad drives a live swarm: from SDL through hub, core and agents to the robots' set-points."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from fullswarm.messages import Leases
from tests.system.live import LiveSwarm

pytestmark = pytest.mark.alone

COUNT = 3
EXPIRES_S = 0.3
PERIOD_S = 0.05
LOOK_S = 0.2
"""The world is looked at each 5 ms, on a machine that may be busy."""


class Gamepad:
    """A process of the joystick command with a pad in its hands."""

    def __init__(self, live: LiveSwarm, *options: str) -> None:
        self._live = live
        environment = {**os.environ, "FULLSWARM_HUB": live.config.hub.endpoint, "FULLSWARM_SWARM": live.config.swarm}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.system.pad_process", "joystick", "--operator", "anna@lab", *options],
            env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def do(self, *what: object) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(what) + "\n")
        self.process.stdin.flush()

    def drive(self) -> None:
        """Hold the dead-man and push the left stick forward until all robots have a set-point."""
        self.do("axis", "lefty", -1.0)
        held = False

        def driven() -> bool:
            # The pilot may still be looking for robots: whoever is refused lets go and presses again.
            nonlocal held
            if not self._live.driven():
                now = self._live.clock.now_s() % 2.0 < 1.7
                if now != held:
                    held = now
                    self.do("button", "leftshoulder", held)
            return held and self._live.driven()

        try:
            self._live.until(driven, 60.0, "the gamepad drives all robots")
        except AssertionError as error:
            raise AssertionError(f"{error}\n--- gamepad\n{self.end(signal.SIGKILL)[1]}") from None

    def end(self, number: int = signal.SIGINT) -> tuple[int, str]:
        """Send a signal; return exit code and stderr."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        self._live.until(lambda: self.process.poll() is not None, 10.0, "the joystick command ends")
        _, err = self.process.communicate()
        return self.process.returncode, err


@pytest.fixture(scope="module")
def live() -> Iterator[LiveSwarm]:
    made = LiveSwarm({"world": {"engine": "kinematic"},
                      "robot": [{"id": f"r{row}", "driver": f"sim://r{row}", "pose": [4.0 * row, 2.0, 1.57]}
                                for row in range(1, COUNT + 1)]}, watch=True)  # fmt: skip
    yield made
    made.close()


@pytest.fixture
def gamepad(live: LiveSwarm) -> Iterator[Gamepad]:
    made = Gamepad(live)
    yield made
    made.end(signal.SIGKILL)
    live.until(live.stands, 5.0, "all stand")


def zero_after(live: LiveSwarm) -> float:
    """Return how long it takes from now until no set-point is other than zero."""
    return live.until(live.stands, 5.0, "all set-points are zero")


def test_letting_the_dead_man_go_is_zero_at_once(live: LiveSwarm, gamepad: Gamepad) -> None:
    gamepad.drive()
    speeds = [abs(row.speed_m_s) for row in live.view.snapshot().robots]
    live.until(lambda: all(abs(live.row(f"r{row}").speed_m_s) > 0.05 for row in range(1, COUNT + 1)), 5.0,
               f"robots report that they move, after {speeds}")  # fmt: skip
    gamepad.do("button", "leftshoulder", False)
    assert zero_after(live) <= LOOK_S + PERIOD_S
    live.rest(0.5)
    assert live.stands()


def test_a_killed_joystick_process_is_zero_when_its_intent_lapses(live: LiveSwarm, gamepad: Gamepad) -> None:
    gamepad.drive()
    gamepad.process.kill()
    assert zero_after(live) <= EXPIRES_S + PERIOD_S + LOOK_S
    live.rest(0.5)
    assert live.stands()


def test_an_unplugged_pad_is_zero_and_plugged_in_again_does_not_drive_on(live: LiveSwarm, gamepad: Gamepad) -> None:
    gamepad.drive()
    gamepad.do("unplug")
    assert zero_after(live) <= LOOK_S + PERIOD_S
    gamepad.do("plug")
    gamepad.do("button", "leftshoulder", True)  # down before the first look, or soon after: both are tried over time
    gamepad.do("button", "leftshoulder", False)
    gamepad.do("axis", "lefty", -1.0)
    live.rest(0.5)
    assert live.stands()
    gamepad.drive()


def test_a_stopped_process_that_comes_back_after_its_pad_was_let_go_stays_at_zero(
    live: LiveSwarm, gamepad: Gamepad
) -> None:
    gamepad.drive()
    gamepad.process.send_signal(signal.SIGSTOP)
    assert zero_after(live) <= EXPIRES_S + PERIOD_S + LOOK_S
    gamepad.do("button", "leftshoulder", False)
    gamepad.process.send_signal(signal.SIGCONT)
    live.rest(0.5)
    assert live.stands()


def test_ctrl_c_is_zero_gives_the_leases_back_and_ends_with_0(live: LiveSwarm, gamepad: Gamepad) -> None:
    held: list[set[str]] = []
    subscription = live.bus.subscribe(
        live.operator._keys.leases, Leases, lambda told: held.append({each.operator for each in told.leases})
    )
    gamepad.drive()
    live.until(lambda: bool(held) and held[-1] == {"anna@lab"}, 5.0, "the gamepad holds its robots")
    code, err = gamepad.end()
    assert code == 0, err
    assert "robots released" in err
    live.until(lambda: held[-1] == set(), 2.5, "the leases are given back, not lapsed")
    subscription.close()
    live.until(live.stands, LOOK_S, "all stand")


def test_only_the_robots_that_were_named_move(live: LiveSwarm) -> None:
    assert live.world is not None
    gamepad, world = Gamepad(live, "--robots", "r2"), live.world
    try:
        gamepad.do("axis", "lefty", -1.0)
        for _ in range(10):
            gamepad.do("button", "leftshoulder", True)
            live.rest(0.5)
            if world.setpoint.any():
                break
            gamepad.do("button", "leftshoulder", False)
            live.rest(0.1)
        assert world.setpoint[1].any()
        assert not world.setpoint[[0, 2]].any()
    finally:
        gamepad.end(signal.SIGKILL)
    live.until(live.stands, 5.0, "all stand")


def test_without_a_hub_it_ends_with_3_and_says_so(live: LiveSwarm) -> None:
    gamepad = Gamepad(live, "--hub", "tcp/127.0.0.1:9")
    live.until(lambda: gamepad.process.poll() is not None, 20.0, "the command gives up")
    code, err = gamepad.end()
    assert code == 3
    assert "error:" in err
    assert "Traceback" not in err
