"""An experiment on a fleet file's robots: what is asked before they move, what Ctrl-C does, what is kept."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
import pytest

from fullswarm.agent.orders.estops import LatchFolder
from fullswarm.bus.hub import Hub
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.config import SwarmConfig
from fullswarm.drivers.create_oi.settings import parse_url
from fullswarm.emulators.create_oi.emulator import CreateEmulator
from fullswarm.errors import ConfigError, SafetyStop
from fullswarm.evaluate.experiment import Trial, TrialResult, scenario_of
from fullswarm.evaluate.fleet_swarm import FleetRunner, fit, run_fleet, starts_of
from fullswarm.evaluate.provenance import Provenance
from fullswarm.evaluate.swarm import TrialFailed
from fullswarm.evaluate.trial_folder import PROVENANCE_FILE, RESULT_FILE, Record, trial_id
from fullswarm.kernels import Array
from fullswarm.keys import Keys
from fullswarm.launch.network import on_free_ports
from fullswarm.launch.processes import STATE, latch_folder
from fullswarm.messages import EStop, PoseFix
from fullswarm.runtime import Mailbox
from fullswarm.simulation.bodies import FreeBody
from tests.system.live_room import FAR, ROOM, nobody_new, processes_of, trial


@pytest.fixture(autouse=True)
def nobody_is_left() -> Iterator[None]:
    before = processes_of(os.getpid())  # other tests' may be there, a resource tracker for one
    yield
    nobody_new(before)


class Script:
    """Somebody who types: one line after the other; None: nothing yet. Ctrl-C comes so long after the last line."""

    def __init__(self, *lines: str | None, interrupts_s: Sequence[float] = ()) -> None:
        self._lines, self._interrupts_s = list(lines), list(interrupts_s)

    @property
    def ended(self) -> bool:
        return not self._lines and not self._interrupts_s

    def line(self) -> str | None:
        if not self._lines:
            return None
        line = self._lines.pop(0)
        if not self._lines:
            self._next_interrupt()
        return line

    def _next_interrupt(self) -> None:
        if self._interrupts_s:
            signal.signal(signal.SIGALRM, self._interrupt)
            signal.setitimer(signal.ITIMER_REAL, self._interrupts_s.pop(0))

    def _interrupt(self, *_: object) -> None:
        self._next_interrupt()
        signal.raise_signal(signal.SIGINT)


@pytest.fixture
def simulated() -> SwarmConfig:
    return on_free_ports(
        SwarmConfig.model_validate({"swarm": "lab", "robot": [{"id": "a"}, {"id": "b"}]}), prefer_configured=False
    )


@pytest.fixture
def creates(tmp_path: Path) -> Iterator[SwarmConfig]:
    """Robots that fullswarm takes for real ones: it knows their ports and nothing else."""
    robots = [{"id": robot, "driver": f"create://{tmp_path}/{robot}?model=create2"} for robot in ("a", "b", "spare")]
    config = on_free_ports(SwarmConfig.model_validate({"swarm": "lab", "robot": robots}), prefer_configured=False)
    with contextlib.ExitStack() as stack:
        for each in config.robot:
            settings = parse_url(each.driver)
            emulator = CreateEmulator(settings.generation, FreeBody(), port=settings.path).start()
            stack.callback(emulator.close)
        yield config


def test_a_trial_of_real_robots_is_set_up_confirmed_driven_and_kept(
    creates: SwarmConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # None: what was typed before a question was asked is no answer to it.
    runner = FleetRunner(creates, typed=Script("y", None, None, "", "y", None, None, "", "y"))
    # On odometry alone robots become less and less certain of their positions, and keep a metre from each other.
    found = runner(trial(2, ROOM.replace("radius_m = 1.0", "radius_m = 1.5")))
    assert (found.end_reason, found.outcome.arrived, found.outcome.events) == ("all arrived", 2, 0)
    assert found.outcome.safe_start
    # Nobody saw the bodies: what is known follows from the poses that they report.
    assert set(found.truth) == {"separation.min_m", "clearance.min_m", "time_to_contact.min_s"}
    assert found.onboard["work.total_m"] > 0.5
    assert found.trajectory is not None
    assert found.trajectory.ids == ("a", "b")
    told = capsys.readouterr().err
    assert told.index("out of the arena: spare") < told.index("press Enter") < told.index("Is it safe?")


class Camera:
    """Motion capture that sees robots being carried to their places; then somebody types y, and never Enter."""

    ended = False

    def __init__(self, config: SwarmConfig, starts: Array) -> None:
        self._clock = MonotonicClock()
        self._bus = ZenohBus(Mailbox(), hub=config.hub.endpoint)
        self._keys, self._robots, self._starts = Keys(config.swarm), config.robots, starts
        self._asked_s, self._looks, self._quick = 0.0, 0, 0

    def line(self) -> str | None:
        before_s, self._asked_s = self._asked_s, self._clock.now_s()
        self._quick = self._quick + 1 if self._asked_s - before_s < 0.1 else 0
        if self._quick > 3:  # asked for safety, many times a second
            return "y"
        self._looks += self._bus.connected()
        away_m = 0.5 if self._looks < 12 else 0.0
        for robot, (x_m, y_m, heading_rad) in zip(self._robots, self._starts.tolist(), strict=False):
            fix = PoseFix(
                robot=robot, x_m=x_m + away_m, y_m=y_m, heading_rad=heading_rad, position_sigma_m=0.01,
                heading_sigma_rad=0.01, source="camera", stamp_s=self._asked_s,
            )  # fmt: skip
            self._bus.publish(self._keys.pose_fix(robot), fix)
        return None

    def close(self) -> None:
        self._bus.close()


@pytest.mark.slow
def test_with_motion_capture_nobody_has_to_press_enter(
    creates: SwarmConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    one = trial(2)
    camera = Camera(creates, starts_of(fit(one, scenario_of(one), creates)[0]))
    try:
        found = FleetRunner(creates, typed=camera)(one)
    finally:
        camera.close()
    assert found.end_reason == "all arrived"
    told = capsys.readouterr().err
    away = "a stands 0.50 m and 0° from its place; b stands 0.50 m and 0° from its place"
    assert told.index(away) < told.index("all robots stand in their places") < told.index("Is it safe?")


def test_a_fleet_keeps_its_trials_and_tells_which_it_cannot_run(
    simulated: SwarmConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trials = [trial(2), trial(3)]
    ((ran, result),) = run_fleet(trials, simulated, "lab", tmp_path, yes=True)
    assert ran == trials[0]
    assert result.end_reason == "all arrived", result.failure
    folder = tmp_path / "trials" / trial_id(ran)
    record = msgspec.json.decode((folder / RESULT_FILE).read_bytes(), type=Record)
    assert record.outcome == result.outcome
    assert record.truth["arrival.fraction"] == 1.0  # a fleet of simulated robots has a world that can be watched
    assert msgspec.json.decode((folder / PROVENANCE_FILE).read_bytes(), type=Provenance).runner == "fleet"
    assert "N=3 kinematic create: it needs 3 robots, the fleet file has 2" in capsys.readouterr().err


def test_a_fleet_that_fits_nothing_is_an_error(simulated: SwarmConfig) -> None:
    with pytest.raises(ConfigError, match="no trial"):
        list(run_fleet([trial(3)], simulated, "lab", None, yes=True))


@pytest.mark.parametrize(("typed", "error"), [("n", KeyboardInterrupt), (None, ConfigError)])
def test_nothing_moves_unless_somebody_says_that_it_may(
    simulated: SwarmConfig,
    typed: str | None,
    error: type[BaseException],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(error):
        list(run_fleet([trial(2)], simulated, "lab", tmp_path, typed=Script(None, typed)))
    assert not list(tmp_path.glob("trials/*"))  # no trial, not even a failed one
    assert ("nothing moved" in capsys.readouterr().err) is (typed == "n")


@pytest.mark.parametrize("times", [1, 2])
def test_ctrl_c_stops_all_and_a_second_one_engages_the_estop(
    simulated: SwarmConfig, times: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runner = FleetRunner(simulated, typed=Script(None, "y", interrupts_s=[1.5, 0.2][:times]))
    with pytest.raises(KeyboardInterrupt):
        runner(trial(2, FAR))
    told = capsys.readouterr().err
    assert told.count("stopping all robots") == 1
    assert ("all 2 robots stand, latched" in told) is (times == 2)


@pytest.mark.parametrize("yes", [False, True])
def test_a_hub_that_is_there_already_is_told_at_once(creates: SwarmConfig, tmp_path: Path, yes: bool) -> None:
    with Hub(creates.hub.endpoint), pytest.raises(ConfigError, match="another program listens on this port"):
        list(run_fleet([trial(2), trial(1)], creates, "lab", tmp_path, yes=yes, typed=Script(None, "")))
    assert not list(tmp_path.glob("trials/*"))


def test_a_latched_estop_ends_the_experiment(
    creates: SwarmConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(STATE, str(tmp_path / "state"))
    LatchFolder(latch_folder(creates, creates.robot[1])).engage("b", EStop(id="e", engaged=True))
    ran: list[tuple[Trial, TrialResult]] = []
    with pytest.raises(SafetyStop, match="b: an e-stop holds the robot"):
        ran.extend(run_fleet([trial(2), trial(1)], creates, "lab", tmp_path, yes=True))
    assert [result.failure for _, result in ran] == ["b: an e-stop holds the robot"]  # and the second one never began


def test_robots_in_the_wrong_place_do_not_start(simulated: SwarmConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fullswarm.evaluate.fleet_swarm.NEAR_M", -1.0)
    with pytest.raises(TrialFailed, match=r"a stands .* from its place; b stands"):
        FleetRunner(simulated, yes=True)(trial(2))
