"""``--fleet lab.toml``: an experiment's trials on the robots of a fleet file, one by one, with pauses to set up.

Before each trial somebody puts robots and boxes where the scenario wants them; nothing moves before somebody has said
that it may. What comes of it is kept as of any other trial, with ``fleet`` as its runner.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np

from fullswarm import kernels, output
from fullswarm.bus.hub import Hub
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.config import SwarmConfig
from fullswarm.drivers.fleet_file import load_fleet
from fullswarm.errors import ConfigError, SafetyStop
from fullswarm.evaluate.experiment.plan import Cell, Trial, scenario_of
from fullswarm.evaluate.experiment.results import TrialResult
from fullswarm.evaluate.fleet_interrupts import Interrupts
from fullswarm.evaluate.fleet_setup import choose, fit, instructions, off, starts_of
from fullswarm.evaluate.live_swarm import LiveSwarm
from fullswarm.evaluate.swarm import TrialFailed, TrialHeld, TrialStopped
from fullswarm.evaluate.trial import Measurement, TrialRequest, drive, request_of, terms
from fullswarm.evaluate.trial_folder import Keeper, perform
from fullswarm.evaluate.witness import HeardWitness, Witness, WorldWitness, in_safe_set
from fullswarm.keys import Keys
from fullswarm.launch.typed import Typed
from fullswarm.messages import PoseFix
from fullswarm.runtime import Runtime
from fullswarm.simulation.starts import start_problems
from fullswarm.simulation.world import World

RUNNER = "fleet"
LOOK_S = 0.2
FRESH_S = 1.0
"""A pose fix that is older does not tell where a robot stands now."""
HEARD_S = 1.0
"""How long to listen for poses before it is checked where the robots stand."""
NOBODY = "nobody confirmed"
RELEASE = "release it with `fullswarm up` and `fullswarm estop --clear`, then run the same command again"


def run_fleet(
    trials: Sequence[Trial], fleet: Path | SwarmConfig, experiment: str, out: Path | None, *, yes: bool = False,
    insecure_network: bool = False, typed: Lines | None = None,
) -> Iterator[tuple[Trial, TrialResult]]:  # fmt: skip
    """Yield the trials that the fleet can run, each with its result as it ends; what is left out is told on stderr.

    Parameters
    ----------
    out : folder of the results; None: nothing is kept
    yes : do not wait for anybody: robots stand in their places, and it is safe to drive
    typed : who is asked; by default standard input

    Raises
    ------
    ConfigError
        The fleet file is wrong, no trial fits it, or nobody is there to be asked.
    KeyboardInterrupt
        Ctrl-C, or somebody said that it is not safe to drive; that trial is not kept and runs another time.
    SafetyStop
        A robot is held by an e-stop: nothing goes on by itself. The trial is kept as a failed one.
    """
    config = fleet if isinstance(fleet, SwarmConfig) else load_fleet(fleet, here=True, check=start_problems)
    fits, left_out = choose(trials, config)
    tell_left_out(left_out)
    if not fits:
        raise ConfigError("it can run no trial of this experiment", where=str(fleet) if isinstance(fleet, Path) else "")
    runner = FleetRunner(config, yes=yes, insecure_network=insecure_network, typed=typed)
    for number, trial in enumerate(fits, 1):
        output.progress(f"trial {number} of {len(fits)}: {trial.label}")
        try:
            if out is None:
                result, _, _ = perform(trial, experiment, 1, runner, RUNNER)
            else:
                result = Keeper(out, experiment, runner, RUNNER)(trial)
        except Over as over:
            raise over.error from None
        yield trial, result
        if runner.held:
            raise SafetyStop(runner.held, hint=RELEASE)


def tell_left_out(left_out: dict[Cell, str]) -> None:
    """Tell on stderr which cells are left out and why."""
    for cell, reason in left_out.items():
        output.progress(f"left out: {cell.label} {cell.scenario} N={cell.robots} {cell.engine} {cell.limits}: {reason}")


class Over(BaseException):
    """Not this trial alone: no other one can do better. It passes by those who keep failures."""

    def __init__(self, error: ConfigError) -> None:
        super().__init__(str(error))
        self.error = error


@contextmanager
def ends_all() -> Iterator[None]:
    """Turn a `ConfigError` into `Over`."""
    try:
        yield
    except ConfigError as error:
        raise Over(error) from error


class Lines(Protocol):
    """What somebody types."""

    @property
    def ended(self) -> bool:
        """Whether nothing more will come."""
        ...

    def line(self) -> str | None:
        """Return the next line; None when there is none now."""
        ...


class FleetRunner:
    """Measures trials on one fleet.

    Attributes
    ----------
    held : why an e-stop held a robot in the last trial; empty: it did not
    """

    def __init__(
        self, fleet: SwarmConfig, *, yes: bool = False, insecure_network: bool = False, typed: Lines | None = None
    ) -> None:
        self._fleet, self._yes, self._insecure_network = fleet, yes, insecure_network
        self._typed: Lines = typed or Typed()
        self.held = ""

    def __call__(self, trial: Trial) -> Measurement:
        """Set up a trial, ask, run it.

        Raises
        ------
        ConfigError
            So many robots do not fit into the scenario.
        Over
            The fleet's settings are wrong, its port is in use, or nobody is there to be asked.
        TrialFailed
            As `drive`, or a robot does not stand where it should.
        KeyboardInterrupt
            It shall not go on.
        """
        self.held = ""
        try:
            return self._run(trial)
        except TrialHeld as error:
            self.held = str(error)
            raise

    def _run(self, trial: Trial) -> Measurement:
        scenario = scenario_of(trial)
        config, goals = fit(trial, scenario, self._fleet)
        config, limit_s, limit_reason = terms(trial, scenario, config)
        spare = [each.id for each in self._fleet.robot[len(config.robot) :] if not each.simulated]
        output.progress(instructions(config, scenario, goals, spare))
        simulated = all(each.simulated for each in config.robot)
        if not (simulated or self._yes):
            with ends_all():
                self._set_up(config)
        kernels.compile_all()
        with LiveSwarm(config, insecure_network=self._insecure_network) as swarm:
            with ends_all():
                swarm.start()
            config = swarm.config
            request = request_of(trial, scenario, goals, config, (limit_s, limit_reason), _safe(config))
            heard = HeardWitness(swarm.bus, config)
            try:
                swarm.until(lambda: not np.isnan(heard.pose).any(), HEARD_S)
                self._check_places(config, heard)
                with ends_all():
                    self._confirm(swarm, limit_s)
                return self._drive(swarm, request, self._witness(swarm, request, heard, simulated))
            finally:
                heard.close()

    def _drive(self, swarm: LiveSwarm, request: TrialRequest, witness: Witness) -> Measurement:
        with Interrupts(swarm) as interrupts:
            try:
                return drive(swarm, request, witness, interrupts.stopped)
            except TrialStopped as error:
                raise KeyboardInterrupt from error
            except TrialHeld as error:
                if interrupts.stopped():  # it was our own
                    raise KeyboardInterrupt from error
                raise

    def _witness(self, swarm: LiveSwarm, request: TrialRequest, heard: HeardWitness, simulated: bool) -> Witness:
        if swarm.world is None or not simulated:
            return heard
        emulated = any(each.emulate for each in swarm.config.robot)
        cell_m = swarm.config.performance.coverage_cell_m
        return WorldWitness(swarm.world.world, request.goals, request.scenario.goal.radius_m, cell_m, emulated)

    def _check_places(self, config: SwarmConfig, heard: HeardWitness) -> None:
        wrong = off(config.robots, heard.pose, starts_of(config))
        if wrong:
            raise TrialFailed("; ".join(wrong), hint="put them there and run it again")

    # ------------------------------------------------------------------------------------------ asking
    def _set_up(self, config: SwarmConfig) -> None:
        """Wait for Enter, or until pose fixes say that all robots stand in their places."""
        runtime = Runtime(MonotonicClock())
        fixes: dict[str, tuple[float, PoseFix]] = {}

        def on_fix(fix: PoseFix) -> None:
            fixes[fix.robot] = runtime.now_s(), fix

        with Hub(config.hub.endpoint, insecure_network=self._insecure_network):
            bus = ZenohBus(runtime.mailbox, hub=config.hub.endpoint)
            try:
                bus.subscribe(Keys(config.swarm).pose_fix(), PoseFix, on_fix)
                self._forget_typed()
                output.progress("Put all in place, then press Enter; with motion capture it goes on by itself.")
                told = ""
                while self._typed.line() is None:
                    if self._typed.ended:
                        raise ConfigError(f"{NOBODY} that all is in place", hint="press Enter, or say so with --yes")
                    runtime.run(LOOK_S)
                    wrong = _wrong(config, fixes, runtime.now_s())
                    text = told if wrong is None else "; ".join(wrong) or "all robots stand in their places"
                    if text != told:
                        output.progress(text)
                    if wrong == []:
                        return
                    told = text
            finally:
                bus.close()

    def _confirm(self, swarm: LiveSwarm, limit_s: float) -> None:
        """Ask whether it is safe to drive; serve the swarm meanwhile."""
        if self._yes:
            return
        self._forget_typed()
        count = len(swarm.config.robots)
        output.progress(f"{count} robots are ready and will drive for {limit_s:.0f} s at most. Is it safe? [y/n]")
        answers: list[str] = []

        def answered() -> bool:
            answers.extend(filter(None, [self._typed.line()]))  # Enter alone is no answer
            return bool(answers) or self._typed.ended

        swarm.until(answered, math.inf)
        if not answers:
            raise ConfigError(f"{NOBODY} that it is safe to drive", hint="answer y, or say so with --yes")
        if answers[0].lower() not in ("y", "yes"):
            output.progress("nothing moved")
            raise KeyboardInterrupt

    def _forget_typed(self) -> None:
        """A yes to a question that was not asked yet is none."""
        while self._typed.line() is not None:
            continue


def _wrong(config: SwarmConfig, fixes: dict[str, tuple[float, PoseFix]], now_s: float) -> list[str] | None:
    """Return which real robots stand elsewhere by their newest fixes; None: not all of them are seen."""
    real = [each for each in config.robot if not each.simulated]
    seen = [fixes[each.id][1] for each in real if each.id in fixes and now_s - fixes[each.id][0] <= FRESH_S]
    if len(seen) < len(real):
        return None
    poses = np.array([(fix.x_m, fix.y_m, fix.heading_rad) for fix in seen])
    return off([each.id for each in real], poses, np.array([each.pose for each in real], float))


def _safe(config: SwarmConfig) -> bool:
    """Tell whether the start, as it is meant to be, is in the filter's safe set."""
    settings = config.world_or_default.model_copy(update={"engine": "kinematic"})
    world = World(settings, config.robots, starts_of(config))
    try:
        return in_safe_set(world, config.agent.safety_margin_m)
    finally:
        world.close()
