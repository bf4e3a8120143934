"""Runs trials on the robots of a fleet file (``--fleet``), one by one, with pauses to set up.

Before each trial a person puts robots and boxes where the scenario wants them; nothing moves before a person has
confirmed that it may. The first Ctrl-C stops all robots, the second one engages their e-stop. What comes of a trial is
kept as of any other, with ``fleet`` as its runner.
"""

from __future__ import annotations

import math
import signal
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, TracebackType
from typing import Protocol

import numpy as np

from fullswarm import kernels, output
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.config import AgentConfig, SwarmConfig
from fullswarm.drivers.fleet_file import load_fleet
from fullswarm.errors import ConfigError, SafetyStop
from fullswarm.evaluate.experiment.model import EvidenceMode
from fullswarm.evaluate.experiment.outcomes import TrialResult
from fullswarm.evaluate.experiment.plan import Cell, Trial, scenario_of, world_of
from fullswarm.evaluate.live_swarm import LiveSwarm
from fullswarm.evaluate.scenarios import Scenario, goals_for, spawn, world_config
from fullswarm.evaluate.scenarios.maps import text_map
from fullswarm.evaluate.swarm import TrialFailed, TrialHeld, TrialStopped
from fullswarm.evaluate.trial import Keeper, KeepingEvidence, TrialRequest, drive, request_of, terms, world_witness
from fullswarm.evaluate.trial_folder import Measurement, recording_of
from fullswarm.evaluate.witness import ReportedWitness, Witness, in_safe_set
from fullswarm.geometry import wrap
from fullswarm.kernels import Array
from fullswarm.keys import Keys
from fullswarm.launch.processes import hub_at
from fullswarm.messages import PoseFix
from fullswarm.operator.estop import EStopOrder
from fullswarm.operator.session import own_credentials
from fullswarm.output import TypedLines
from fullswarm.runtime import Runtime
from fullswarm.simulation.world import World

RUNNER = "fleet"
CHECK_PERIOD_S = 0.2
FRESH_S = 1.0
"""A pose fix that is older does not show where a robot stands now."""
POSES_S = 1.0
"""How long to wait for poses before it is checked where the robots stand."""
UNCONFIRMED = "no one confirmed"
RELEASE = "release it with `fullswarm up` and `fullswarm estop --clear`, then run the same command again"


def run_fleet(
    trials: Sequence[Trial], fleet: Path | SwarmConfig, experiment: str, out: Path | None, *, yes: bool = False,
    insecure_network: bool = False, typed: Lines | None = None, evidence: EvidenceMode = "contacts",
    recordings: Path | None = None,
) -> Iterator[tuple[Trial, TrialResult]]:  # fmt: skip
    """Yield the trials that the fleet can run, each with its result as it ends; what is left out is printed on stderr.

    Parameters
    ----------
    out : folder of the results; None: nothing is kept
    yes : skip both confirmations: robots stand in their places, and it is safe to drive
    typed : where confirmations are read; by default standard input
    evidence : of which trials the motion is kept
    recordings : folder for a recording of each trial; None: they are not recorded

    Raises
    ------
    ConfigError
        The fleet file is wrong, no trial fits it, or there is no input to confirm from.
    KeyboardInterrupt
        Ctrl-C, or the answer was that it is not safe to drive; that trial is not kept and runs another time.
    SafetyStop
        A robot is held by an e-stop: nothing goes on by itself. The trial is kept as a failed one.
    """
    config = fleet if isinstance(fleet, SwarmConfig) else load_fleet(fleet, here=True)
    fits, left_out = choose(trials, config)
    print_left_out(left_out)
    if not fits:
        raise ConfigError("it can run no trial of this experiment", where=str(fleet) if isinstance(fleet, Path) else "")
    runner = FleetRunner(config, yes=yes, insecure_network=insecure_network, typed=typed, recordings=recordings)
    for number, trial in enumerate(fits, 1):
        output.progress(f"trial {number} of {len(fits)}: {trial.label}")
        try:
            result = Keeper(out, experiment, KeepingEvidence(runner, evidence), RUNNER)(trial)
        except Over as over:
            raise over.error from None
        yield trial, result
        if runner.held:
            raise SafetyStop(runner.held, hint=RELEASE)


def print_left_out(left_out: dict[Cell, str]) -> None:
    """Print on stderr which cells are left out and why."""
    for cell, reason in left_out.items():
        output.progress(f"left out: {cell.label} {cell.scenario} N={cell.robots} {cell.engine} {cell.limits}: {reason}")


class Over(BaseException):
    """An error that every further trial would meet; it is not kept as the failure of one trial."""

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
    """Lines of a person's input."""

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
        self,
        fleet: SwarmConfig,
        *,
        yes: bool = False,
        insecure_network: bool = False,
        typed: Lines | None = None,
        recordings: Path | None = None,
    ) -> None:
        self._fleet, self._yes, self._insecure_network = fleet, yes, insecure_network
        self._recordings = recordings
        self._typed: Lines = typed or TypedLines()
        self.held = ""

    def __call__(self, trial: Trial) -> Measurement:
        """Set up a trial, ask, run it.

        Raises
        ------
        ConfigError
            So many robots do not fit into the scenario.
        Over
            The fleet's settings are wrong, its port is in use, or there is no input to confirm from.
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
        config, limit = terms(trial, scenario, config)
        spare = [each.id for each in self._fleet.robot[len(config.robot) :] if not each.simulated]
        output.progress(instructions(config, scenario, goals, spare))
        simulated = all(each.simulated for each in config.robot)
        if not (simulated or self._yes):
            with ends_all():
                self._set_up(config)
        kernels.compile_all()
        record = recording_of(trial, self._recordings)
        with LiveSwarm(config, insecure_network=self._insecure_network, record=record) as swarm:
            with ends_all():
                swarm.start()
            config = swarm.config
            request = request_of(trial, scenario, goals, config, limit, _safe(config))
            reported = ReportedWitness(
                swarm.bus, config, swarm.runtime.now_s, request.goals, scenario.goal.radius_m
            )  # fmt: skip
            try:
                swarm.until(lambda: not np.isnan(reported.pose).any(), POSES_S)
                self._check_places(config, reported)
                with ends_all():
                    self._confirm(swarm, limit[0])
                return self._drive(swarm, request, self._witness(swarm, request, reported, simulated))
            finally:
                reported.close()

    def _drive(self, swarm: LiveSwarm, request: TrialRequest, witness: Witness) -> Measurement:
        with Interrupts(swarm) as interrupts:
            try:
                return drive(swarm, request, witness, interrupts.stopped)
            except TrialStopped as error:
                raise KeyboardInterrupt from error
            except TrialHeld as error:
                if interrupts.stopped():  # engaged by Ctrl-C here
                    raise KeyboardInterrupt from error
                raise

    def _witness(self, swarm: LiveSwarm, request: TrialRequest, reported: ReportedWitness, simulated: bool) -> Witness:
        if swarm.world is None or not simulated:
            return reported
        emulated = any(each.emulate for each in swarm.config.robot)
        return world_witness(swarm.world.world, request, swarm.config, emulated)

    def _check_places(self, config: SwarmConfig, reported: ReportedWitness) -> None:
        wrong = off(config.robots, reported.pose, starts_of(config))
        if wrong:
            raise TrialFailed("; ".join(wrong), hint="put them there and run it again")

    # ------------------------------------------------------------------------------------------ asking
    def _set_up(self, config: SwarmConfig) -> None:
        """Wait for Enter, or until pose fixes show that all robots stand in their places."""
        runtime = Runtime(MonotonicClock())
        fixes: dict[str, tuple[float, PoseFix]] = {}

        def on_fix(fix: PoseFix) -> None:
            fixes[fix.robot] = runtime.now_s(), fix

        hub = config.hub.endpoint
        with hub_at(hub, config.swarm, self._insecure_network):
            bus = ZenohBus(runtime.mailbox, hub=hub, credentials=own_credentials(hub, config.swarm))
            try:
                bus.subscribe(Keys(config.swarm).pose_fix(), PoseFix, on_fix)
                self._discard_typed()
                output.progress("Put all in place, then press Enter; with motion capture it goes on by itself.")
                printed = ""
                while self._typed.line() is None:
                    if self._typed.ended:
                        raise ConfigError(f"{UNCONFIRMED} that all is in place", hint="press Enter, or use --yes")
                    runtime.run(CHECK_PERIOD_S)
                    wrong = _wrong(config, fixes, runtime.now_s())
                    text = printed if wrong is None else "; ".join(wrong) or "all robots stand in their places"
                    if text != printed:
                        output.progress(text)
                    if wrong == []:
                        return
                    printed = text
            finally:
                bus.close()

    def _confirm(self, swarm: LiveSwarm, limit_s: float) -> None:
        """Ask whether it is safe to drive; serve the swarm meanwhile."""
        if self._yes:
            return
        self._discard_typed()
        count = len(swarm.config.robots)
        output.progress(f"{count} robots are ready and will drive for {limit_s:.0f} s at most. Is it safe? [y/n]")
        answers: list[str] = []

        def answered() -> bool:
            answers.extend(filter(None, [self._typed.line()]))  # Enter alone is no answer
            return bool(answers) or self._typed.ended

        swarm.until(answered, math.inf)
        if not answers:
            raise ConfigError(f"{UNCONFIRMED} that it is safe to drive", hint="answer y, or use --yes")
        if answers[0].lower() not in ("y", "yes"):
            output.progress("nothing moved")
            raise KeyboardInterrupt

    def _discard_typed(self) -> None:
        """Discard lines typed before the question: they do not answer it."""
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
    """Return whether the start, as it is meant to be, is in the filter's safe set."""
    settings = config.world_or_default.model_copy(update={"engine": "kinematic"})
    world = World(settings, config.robots, starts_of(config))
    try:
        return in_safe_set(world, config.agent.safety_margin_m)
    finally:
        world.close()


NEAR_M, NEAR_RAD = 0.2, 0.3
"""So far from its place a robot may stand at the start."""
NAMES = "123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ"


# ---------------------------------------------------------------------------------------------------- which trials
def choose(trials: Sequence[Trial], fleet: SwarmConfig) -> tuple[list[Trial], dict[Cell, str]]:
    """Return the trials that this fleet can run, and for each cell that is left out the reason."""
    fits, left_out = list[Trial](), dict[Cell, str]()
    engines: dict[Cell, str] = {}
    for trial in trials:
        cell = trial.cell
        reason = left_out.get(cell) or _obstacle(trial, fleet)
        if not reason and not any(each.simulated for each in fleet.robot):
            first = engines.setdefault(_without_engine(cell), cell.engine)
            reason = "" if first == cell.engine else f"real robots have no engine: it is the same as '{first}'"
        if reason:
            left_out[cell] = reason
        else:
            fits.append(trial)
    return fits, left_out


def _obstacle(trial: Trial, fleet: SwarmConfig) -> str:
    """Return why a trial is not for this fleet; empty: it is."""
    cell, have = trial.cell, len(fleet.robot)
    if cell.robots > have:
        return f"it needs {cell.robots} robots, the fleet file has {have}"
    if (cell.noise_m or cell.noise_rad) and not all(each.simulated for each in fleet.robot):
        return "its noise is that of simulated sensors, and the fleet has real ones"
    if trial.bodies:
        return "its robots differ from each other, and the fleet has its own"
    fence = fleet.agent.bounds_m
    if fence is not None:
        left, low, right, high = scenario_of(trial).bounds_m
        if left < fence[0] or low < fence[1] or right > fence[2] or high > fence[3]:
            return "its arena reaches out of the fleet file's agent.bounds_m"
    return ""


def _without_engine(cell: Cell) -> Cell:
    fields = {name: getattr(cell, name) for name in cell.__slots__}
    return Cell(**{**fields, "engine": ""})


# ---------------------------------------------------------------------------------------------------- settings
def fit(trial: Trial, scenario: Scenario, fleet: SwarmConfig) -> tuple[SwarmConfig, Array]:
    """Return the fleet as a trial uses it, and the goals (n, 2): its first robots, each on its start pose.

    The scenario's boxes are in the settings as in a simulated trial: agents have them as the map. Of two limits of
    the speed the lower one holds, of two margins the wider one.

    Raises
    ------
    ConfigError
        So many robots do not fit into the scenario.
    """
    base = world_of(trial).model_copy(update={"address": fleet.world_or_default.address})
    world = world_config(scenario, trial.seed, base)
    poses = spawn(scenario, trial.cell.robots, trial.seed, world.radius_m)
    robots = tuple(
        robot.model_copy(update={"pose": (x_m, y_m, heading_rad)})
        for robot, (x_m, y_m, heading_rad) in zip(fleet.robot, poses.tolist(), strict=False)
    )
    network = fleet.network
    if trial.cell.network:
        network = network.model_copy(update={"conditions": trial.cell.network, "seed": trial.seed})
    values = {
        **fleet.model_dump(),
        "world": world.model_dump(),
        "robot": [each.model_dump() for each in robots],
        "agent": _agent(trial, fleet.agent).model_dump(),
        "performance": dict(trial.stop),
        "network": network.model_dump(),
    }
    return SwarmConfig.model_validate(values), goals_for(scenario, poses)


def _agent(trial: Trial, ours: AgentConfig) -> AgentConfig:
    body, theirs = dict(trial.body), AgentConfig.model_validate(dict(trial.agent))
    limits = {
        name: min(float(each) for each in (body[name], getattr(ours, name), getattr(theirs, name)) if each is not None)
        for name in ("speed_limit_m_s", "turn_limit_rad_s")
    }
    margin_m = max(ours.safety_margin_m, theirs.safety_margin_m)
    wanted = {**dict(trial.agent), **limits, "safety_margin_m": margin_m, "bounds_m": None}  # the scenario's bounds
    return AgentConfig.model_validate({**ours.model_dump(), **wanted})


# ---------------------------------------------------------------------------------------------------- instructions
def off(ids: Iterable[str], poses: Array, starts: Array) -> list[str]:
    """Return in words which robots stand elsewhere than they should, poses and starts (n, 3); NaN: not known."""
    found = []
    for robot, (x_m, y_m, heading_rad), (at_x, at_y, at_rad) in zip(ids, poses.tolist(), starts.tolist(), strict=True):
        apart_m, turned_rad = math.hypot(x_m - at_x, y_m - at_y), abs(wrap(heading_rad - at_rad))
        if apart_m > NEAR_M or turned_rad > NEAR_RAD:
            found.append(f"{robot} stands {apart_m:.2f} m and {math.degrees(turned_rad):.0f}° from its place")
    return found


def starts_of(config: SwarmConfig) -> Array:
    """Return where the robots of a trial begin, (n, 3)."""
    return np.array([each.pose or (math.nan,) * 3 for each in config.robot], float).reshape(-1, 3)


def instructions(config: SwarmConfig, scenario: Scenario, goals: Array, spare: Sequence[str] = ()) -> str:
    """Return what a person in the room must do before the trial: robots, boxes, a map."""
    lines = ["robot             x m      y m  heading"]
    for name, robot in zip(names(len(config.robot)), config.robot, strict=True):
        x_m, y_m, heading_rad = robot.pose or (math.nan,) * 3
        place = f"{x_m:8.2f} {y_m:8.2f} {math.degrees(heading_rad):7.0f}°"
        lines.append(f"{name} {robot.id:10} {place}{'  (simulated)' if robot.simulated else ''}".rstrip())
    boxes = config.world_or_default.boxes
    if boxes:
        lines.append("boxes, centre x, y, size x, y in m and turned by:")
        lines += [f"  {x:6.2f} {y:6.2f}  {wide:5.2f} x {deep:5.2f}  {math.degrees(yaw):4.0f}°"
                  for x, y, wide, deep, yaw in boxes]  # fmt: skip
    if spare:
        lines.append(f"out of the arena: {', '.join(spare)}")
    return "\n".join([*lines, *drawing(config, scenario, goals)])


def names(count: int) -> list[str]:
    """Return what the robots are called on the map."""
    return [NAMES[row] if row < len(NAMES) else "*" for row in range(count)]


def drawing(config: SwarmConfig, scenario: Scenario, goals: Array) -> list[str]:
    """Return the arena from above, north up, robots by their names on the map."""
    x_min, y_min, x_max, y_max = scenario.bounds_m
    starts = [(x_m, y_m) for x_m, y_m, _ in starts_of(config).tolist()]
    picture = text_map(scenario, config.world_or_default.boxes, starts, names(len(starts)), goals.tolist())
    return [picture, f"{x_min:g}, {y_min:g} m at the lower left, {x_max:g}, {y_max:g} m at the upper right"]


# ---------------------------------------------------------------------------------------------------- Ctrl-C
DEADLINE_S = 5.0
SIGNALS = (signal.SIGINT, signal.SIGTERM)
ESTOP, AT_ONCE = 2, 3
"""Which Ctrl-C does what; the third leaves at once, and the robots' agents stop their wheels as they end."""


class Interrupts:
    """Acts on Ctrl-C and SIGTERM while it is entered."""

    def __init__(self, swarm: LiveSwarm) -> None:
        self._swarm = swarm
        self._count = 0
        self._order: EStopOrder | None = None
        self._before: dict[signal.Signals, signal._HANDLER] = {}

    def __enter__(self) -> Interrupts:
        """Take the signals."""
        self._before = {number: signal.signal(number, self._on_signal) for number in SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Wait for an e-stop that is under way, then give the signals back."""
        try:
            if self._order is not None:
                self._swarm.serve(lambda: self._order is None or self._order.done, DEADLINE_S)
        finally:
            for number, handler in self._before.items():
                signal.signal(number, handler)

    def stopped(self) -> bool:
        """Return whether the trial shall end."""
        return self._count > 0

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self._count += 1
        if self._count >= AT_ONCE:
            raise KeyboardInterrupt
        self._swarm.runtime.mailbox.put(self._act, self._count)

    def _act(self, count: int) -> None:
        if count < ESTOP:
            output.progress("stopping all robots; Ctrl-C again engages their e-stop")
            self._swarm.operator.stop()
            return
        output.progress("e-stop for all robots")
        robots = self._swarm.config.robots
        self._order = self._swarm.operator.estop(
            True, robots, "Ctrl-C", deadline_s=DEADLINE_S, on_done=_print_confirmed
        )  # fmt: skip


def _print_confirmed(order: EStopOrder) -> None:
    missing = order.unconfirmed()
    if missing:
        output.progress(f"NOT confirmed by {', '.join(missing)}: use their switches")
    else:
        output.progress(f"all {len(order.concerned())} robots stand, latched")
