"""Trials through real processes: simulated robots, emulated ports; whatever happens, nobody is left."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from fullswarm.clock import MonotonicClock
from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment import scenario_of
from fullswarm.evaluate.live_swarm import LiveSwarm, measure_live, with_make
from fullswarm.evaluate.swarm import TrialFailed, TrialHeld
from fullswarm.evaluate.trial import TrialRequest, configure, drive, drive_in_world, parameters, terms
from fullswarm.evaluate.trial_folder import Measurement
from fullswarm.evaluate.witness import WorldWitness
from fullswarm.launch.network import on_free_ports
from tests.system.live_room import FAR, nobody_new, processes_of, trial

LIMIT_S = 60.0  # 12 s of them are the trial's own time limit; the processes start on a machine that has other work


@pytest.fixture(autouse=True)
def nobody_is_left() -> Iterator[None]:
    before = processes_of(os.getpid())  # other tests' may be there, a resource tracker for one
    yield
    nobody_new(before)


def check(found: Measurement, robots: int) -> None:
    """Look at a trial in which all arrived without touching anything."""
    ids = tuple(f"r{row}s3" for row in range(robots))
    assert found.end_reason == "all arrived"
    outcome = found.outcome
    assert (outcome.robots, outcome.arrived, outcome.events, outcome.above_limits) == (robots, robots, 0, 0)
    assert outcome.safe_start
    assert 1.0 < outcome.simulated_s < 12.0
    # What the robots say and what their bodies did; odometry and coverage grids are a little off.
    assert found.onboard["work.total_m"] == pytest.approx(found.truth["work.total_m"], rel=0.05)
    assert found.onboard["coverage.area_m2"] == pytest.approx(found.truth["coverage.area_m2"], rel=0.15)
    assert found.onboard["collisions.events"] == found.truth["collisions.events"] == 0.0
    assert found.truth["arrival.fraction"] == 1.0
    assert found.per_robot["onboard work.distance_m"].keys() == set(ids)
    assert found.per_robot["truth work.distance_m"].keys() == set(ids)
    trajectory = found.trajectory
    assert trajectory is not None
    assert trajectory.ids == ids
    assert trajectory.pose.shape == (len(trajectory.time_s), robots, 3)
    assert trajectory.time_s[0] == pytest.approx(0.0, abs=0.1)
    assert trajectory.time_s[-1] == pytest.approx(outcome.simulated_s, abs=0.01)
    assert np.median(np.diff(trajectory.time_s[:-1])) == pytest.approx(0.2, abs=0.02)
    assert (np.hypot(*(trajectory.pose[-1, :, :2] - [2.6, 2.0]).T) <= 1.0).all()
    assert trajectory.boxes.tolist() == [[3.4, 0.5, 0.4, 0.4, 0.0]]
    assert not trajectory.touching.any()
    assert found.coverage is not None
    frame, covered = found.coverage
    assert covered.sum() * frame.cell_area_m2 == pytest.approx(found.onboard["coverage.area_m2"], rel=0.05)


@pytest.mark.alone  # a trial ends when a robot is silent for a second
@pytest.mark.parametrize(("robots", "emulate"), [(4, None), (2, "create2")])
def test_a_live_trial_measures_what_happened(robots: int, emulate: str | None) -> None:
    clock = MonotonicClock()
    began_s = clock.now_s()
    found = measure_live(trial(robots), emulate)
    assert clock.now_s() - began_s < LIMIT_S
    check(found, robots)


def test_a_live_trial_carries_team_needs_and_roles() -> None:
    usual = trial(3)
    slow = tuple({**dict(usual.body), "speed_limit_m_s": 0.1}.items())
    cell = replace(usual.cell, team="swarm", needs=(("speed_m_s", 0.3),), roles=(("leader", ("r1",)),))
    asked = replace(usual, cell=cell, bodies=(usual.body, usual.body, slow))
    scenario = scenario_of(asked)
    config, goals = configure(asked, scenario)
    config, limit = terms(asked, scenario, on_free_ports(config, prefer_configured=False))
    with LiveSwarm(config) as swarm:
        swarm.start()
        found = drive_in_world(swarm, swarm.bodies, asked, scenario, goals, limit)
        newest = swarm._statuses[-1]
    assert found.end_reason == "all arrived"
    assert (found.outcome.robots, found.outcome.left_out, found.outcome.arrived) == (2, 1, 2)
    assert found.per_robot["truth work.distance_m"]["r2s3"] == pytest.approx(0.0, abs=0.01)
    assert (newest.robots, newest.roles) == (("r0s3", "r1s3"), {"r1s3": "leader"})


@pytest.mark.slow
def test_a_condition_of_the_trial_ends_it() -> None:
    found = measure_live(trial(2, FAR, stop=(("max_execution_s", 1.5),)))
    assert found.end_reason == "max_execution_s"
    assert found.outcome.simulated_s == pytest.approx(1.5, abs=0.3)
    found = measure_live(trial(2, FAR, stop=(("coverage_at_least", 0.03),)))
    assert found.end_reason == "coverage_at_least"
    assert found.outcome.simulated_s < 12.0


@pytest.mark.parametrize(("behaviour", "words"), [("fly_away", "fly_away"), ("formation_bc", "targets")])
def test_a_request_that_is_refused_fails_the_trial(behaviour: str, words: str) -> None:
    with pytest.raises(TrialFailed, match=words):
        measure_live(trial(1, behaviour=behaviour))


def test_an_unknown_make_is_told_before_anything_starts() -> None:
    with pytest.raises(ConfigError, match="create2"):
        measure_live(trial(1), "crate2")


class Trouble:
    """A trial on two robots, to which something happens while they drive."""

    def __init__(self, act: str, emulate: str | None = None) -> None:
        self._act, self._emulate, self._at_s = act, emulate, float("inf")
        self.there: dict[int, str] = {}
        self.standing = False

    def run(self) -> None:
        """Run the trial; it fails."""
        one = trial(2, FAR)
        scenario = scenario_of(one)
        config, goals = configure(one, scenario)
        with LiveSwarm(on_free_ports(with_make(config, one, self._emulate), prefer_configured=False)) as self.swarm:
            self.swarm.start()
            assert self.swarm.world is not None
            self._at_s = self.swarm.runtime.now_s() + 1.0
            witness = WorldWitness(self.swarm.world.world, goals, 0.1, 0.1)
            request = TrialRequest(one.cell.behaviour, parameters(one, scenario, goals), scenario, goals, 12.0, True)
            try:
                drive(self.swarm, request, witness, self._look)
            finally:
                self.standing = bool((abs(self.swarm.world.world.twist) < 1e-6).all())

    def _look(self) -> bool:
        if self.swarm.runtime.now_s() >= self._at_s:
            self._at_s = float("inf")
            assert self.swarm.world is not None
            assert self.swarm.world.world.twist[:, 0].all()  # they drive
            self.there = processes_of(os.getpid())
            if self._act == "kill":
                self.swarm.supervisor.kill("r1s3")
            elif self._act == "switch off":
                self.swarm.world.emulators["r1s3"].close()
            else:
                self.swarm.operator.estop(True, ("r0s3",), "test")
        return False


@pytest.mark.parametrize(
    ("act", "emulate", "error", "words"),
    [
        ("kill", None, TrialFailed, "the process of 'r1s3' ended with code -9"),
        ("estop", None, TrialHeld, "r0s3: an e-stop holds the robot"),
        ("switch off", "create2", TrialFailed, "r1s3: it is in FAULT"),
    ],
)
def test_what_happens_in_mid_trial_ends_it_and_is_named(
    act: str, emulate: str | None, error: type[Exception], words: str
) -> None:
    trouble = Trouble(act, emulate)
    with pytest.raises(error, match=words):
        trouble.run()
    assert len(trouble.there) >= 5  # hub, core, centralised, two agents: the fixture counts them to zero
    assert trouble.standing or act == "switch off"  # nobody can stop a robot whose firmware is gone


ALONE = """
from fullswarm.evaluate.live_swarm import measure_live
from tests.system.live_room import FAR, trial
measure_live(trial(2, FAR))
"""


def test_nobody_outlives_a_trial_that_is_killed() -> None:
    with subprocess.Popen([sys.executable, "-c", ALONE], stderr=subprocess.DEVNULL) as process:
        try:
            clock = MonotonicClock()
            began_s = clock.now_s()
            while len(processes_of(process.pid)) < 5 and clock.now_s() - began_s < LIMIT_S:
                assert process.poll() is None
            there = processes_of(process.pid)
        finally:
            process.send_signal(signal.SIGKILL)
        assert len(there) >= 5, there  # hub, core, centralised, two agents
    began_s = clock.now_s()  # each looks for its parent four times a second, once it has imported what it needs
    while (left := processes_of(process.pid)) and clock.now_s() - began_s < LIMIT_S:
        time.sleep(0.02)
    assert not left
