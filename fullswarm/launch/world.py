"""The world's process: steps the simulated world in real time and serves all robots in it.

Simulated robots have a UDP port (`WorldServer`), emulated ones (``emulate = "create2"``) a port of their make: their
agents open it with the make's own driver. Real robots of the fleet file are bodies, too, where they report to be
(``simulation/ghosts.py``). Like any supervisory process with cameras, the world also sends emulated
robots their poses: `PoseFix` on the bus, unless the fleet file has a camera that renders this world.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable
from urllib.parse import urlsplit

import numpy as np

from fullswarm import kernels, registry
from fullswarm.bus.base import Bus
from fullswarm.bus.report_query import ReportsOnQuery
from fullswarm.config import SwarmConfig
from fullswarm.config.docks import slots_of
from fullswarm.drivers.base import Pose
from fullswarm.drivers.fleet_file import in_frame
from fullswarm.drivers.make import Emulator, emulated_as, emulation_part
from fullswarm.errors import ConfigError, FullswarmError
from fullswarm.keys import Keys
from fullswarm.launch import nodes
from fullswarm.launch.network import emulated_url, port_folder
from fullswarm.messages import Heartbeat, PoseFix, RobotStates, TruePoses, WorldHold
from fullswarm.perf.coverage import Bounds
from fullswarm.perf.truth import SupervisorCalculator, Truth
from fullswarm.runtime import Scheduler
from fullswarm.simulation.bodies import EMULATED_RATE_HZ, Body, SteppedBodies
from fullswarm.simulation.fleet import SimFleet
from fullswarm.simulation.ghosts import Ghosts, with_ghosts
from fullswarm.simulation.server import WorldServer
from fullswarm.simulation.world import World

HEARTBEAT_S = 0.25
FIX_HZ = 20.0
MOST_AT_ONCE = 20
FILMED = "world:"
"""Source of a camera that renders this world."""
HELD_S = 2.0
"""A hold that is not repeated for this long is over: a study whose console has failed does not hold the world."""
LEAST_SIGMA_M, LEAST_SIGMA_RAD = 0.002, 0.002
"""Standard deviations of a fix when the world has no noise: a filter needs a variance above zero."""


def compile_kernels(config: SwarmConfig) -> None:
    """Compile what a step calls, by steps of a separate world; then it is in the kernels' cache.

    After an install this takes many seconds, for which the loop of the world would stand and its robots report faults.
    """
    kernels.compile_all()
    simulated = [each for each in config.robot if each.simulated]
    if not simulated:
        return
    world = World(config.world_or_default, [each.id for each in simulated], nodes.start_poses(config, simulated))
    try:
        fleet = SimFleet(world, lambda: world.time_s)
        nowhere = np.full((len(world.ids), 2), np.nan)
        truth = Truth(world.ids, world.radius_m, nowhere, 0.0, config.bounds_m, config.performance.coverage_cell_m)
        fleet.open()
        for _ in range(2):
            fleet.read()
            fleet.command(np.zeros((len(world.ids), 2)), np.ones(len(world.ids), bool))
            world.step()
            truth.sample(world.time_s, world.pose, world.twist, world.dt_s, world.contacts)
    finally:
        world.close()


class WorldNode:
    """Steps the world and everything in it.

    Attributes
    ----------
    bodies, emulators : what emulated robots are made of, by robot
    world : its robots are the simulated ones of the fleet; the real ones are its last movers

    Raises
    ------
    ConfigError
        See :class:`~fullswarm.simulation.world.World` and :class:`~fullswarm.simulation.server.WorldServer`.
    DriverError
        The port of an emulated robot cannot be had.
    """

    def __init__(
        self, bus: Bus, scheduler: Scheduler, config: SwarmConfig, process: str, insecure_network: bool = False
    ) -> None:
        self._bus, self._scheduler, self._process = bus, scheduler, process
        self._keys = Keys(config.swarm)
        skins = [each for each in config.robot if each.emulate]
        settings = config.world_or_default
        if skins and settings.rate_hz < EMULATED_RATE_HZ:
            settings = settings.model_copy(update={"rate_hz": EMULATED_RATE_HZ, "substeps": 1})
        self._ratio = settings.rate_hz / config.world_or_default.rate_hz
        self._noise = settings.noise
        real = tuple(each.id for each in config.robot if not each.simulated)
        simulated = [each for each in config.robot if each.simulated]
        settings = with_ghosts(settings, {robot: _radius_m(config, robot) for robot in real})
        self.world = World(
            settings, [each.id for each in simulated], nodes.start_poses(config, simulated), slots_of(config)
        )
        self._ghosts = Ghosts(self.world.movers, real) if real else None
        self._server = WorldServer(self.world, settings.address, insecure_network=insecure_network)
        self.bodies = SteppedBodies(self.world, [each.id for each in skins])
        self.emulators: dict[str, Emulator] = {}
        try:
            for robot in skins:
                if robot.emulate is not None:
                    url = emulated_url(config, robot)
                    emulator = start_emulator(robot.emulate, url, self.bodies.of[robot.id])
                    self.emulators[robot.id] = emulator
                    _equip(emulator, config, self.world, robot.id)
        except BaseException:
            self._end()
            raise
        self._truth: Truth | None = None
        self._folder = port_folder(config) if skins else None
        self._steps = self._made = 0
        self._touched = self.world.contacts.copy()  # the most at once since the last fix, by row
        self._began_s = scheduler.now_s()
        self._timers = [
            scheduler.every(1.0 / settings.rate_hz, self._run),
            scheduler.every(HEARTBEAT_S, self._beat, first_s=0.0),
        ]
        self._held_until_s = -math.inf
        self._on_query = ReportsOnQuery(bus, self._keys, scheduler, self._beat)
        self._subscriptions = [bus.subscribe(self._keys.world_hold, WorldHold, self._on_hold)]
        if real:
            self._subscriptions.append(bus.subscribe(self._keys.state(), RobotStates, self._on_states))
        filmed = [each for each in config.camera if each.source.startswith(FILMED)]
        if filmed:  # a simulated camera measures the poses: emulated robots have no other, as real ones
            rate_hz = max(each.rate_hz for each in filmed)
            self._timers.append(scheduler.every(1.0 / rate_hz, self._send_true_poses))
        elif skins:
            self._timers.append(scheduler.every(1.0 / FIX_HZ, self._send_fixes))

    def _run(self) -> None:
        """Make the steps that are due: physics must keep up with the clocks of the firmware that drives in it."""
        now_s = self._scheduler.now_s()
        if now_s < self._held_until_s:
            self._began_s, self._made = now_s, 0
            self._server.tick(held=True)
            return
        due = int((now_s - self._began_s) / self.world.dt_s + 1e-6) - self._made
        for _ in range(min(due, MOST_AT_ONCE)):
            self._step()
        if due > MOST_AT_ONCE:  # the machine was suspended or is too slow: the world continues from now
            self._began_s, self._made = now_s, 0
        else:
            self._made += due

    def supervise(self, bounds_m: Bounds, cell_m: float) -> SupervisorCalculator:
        """Measure the true bodies, too, beside what the robots measure of themselves (paper II.F.1).

        Parameters
        ----------
        bounds_m, cell_m : of the coverage grid
        """
        world = self.world
        nowhere = np.full((len(world.ids), 2), np.nan)
        radius_m = world.radius_m
        self._truth = Truth(world.ids, radius_m, nowhere, 0.0, bounds_m, cell_m)
        return SupervisorCalculator(self._bus, self._keys, self._scheduler, self._truth, self._process)

    def _on_hold(self, message: WorldHold) -> None:
        # Firmware on the machine's clock and real robots do not stand still with the world.
        if self._ghosts is None and not self.emulators:
            self._held_until_s = self._scheduler.now_s() + HELD_S if message.held else -math.inf

    def _on_states(self, states: RobotStates) -> None:
        if self._ghosts is not None:
            self._ghosts.report(states, self._scheduler.now_s())

    def _step(self) -> None:
        if self._ghosts is not None:
            self._ghosts.move(self._scheduler.now_s())
        self.bodies.before_step()
        self._server.tick()
        self.bodies.after_step()
        self._steps += 1
        np.maximum(self._touched, self.world.contacts, out=self._touched)
        if self._truth is not None:
            world = self.world
            self._truth.sample(world.time_s, world.pose, world.twist, world.dt_s, world.contacts)

    def _beat(self) -> None:
        # In steps of the rate that the fleet file names, so that a reader of that file can derive the time.
        steps = int(self._steps / self._ratio)
        beat = Heartbeat(node="world", process=self._process, sequence=steps, stamp_s=self._scheduler.now_s())
        self._bus.publish(self._keys.heartbeat("world"), beat)

    def _send_fixes(self) -> None:
        if not self.world.config.sight.pose:
            return
        now_s = self._scheduler.now_s()
        for robot in self.bodies.of:
            row = self.world.row(robot)
            x_m, y_m, heading_rad = self.world.sensed_pose[row].tolist()
            fix = PoseFix(
                robot=robot,
                x_m=x_m,
                y_m=y_m,
                heading_rad=heading_rad,
                position_sigma_m=max(self._noise.position_m, LEAST_SIGMA_M),
                heading_sigma_rad=max(self._noise.heading_rad, LEAST_SIGMA_RAD),
                source=self._process,
                stamp_s=now_s,
                contacts=int(self._touched[row]),
            )
            self._bus.publish(self._keys.pose_fix(robot), fix)
        self._touched[:] = 0

    def _send_true_poses(self) -> None:
        world = self.world
        x_m, y_m, heading_rad = world.pose[: len(world.ids)].T.tolist()
        speed_m_s, turn_rad_s = world.twist[: len(world.ids)].T.tolist()
        message = TruePoses(
            robots=tuple(world.ids), x_m=tuple(x_m), y_m=tuple(y_m), heading_rad=tuple(heading_rad),
            speed_m_s=tuple(speed_m_s), turn_rad_s=tuple(turn_rad_s), stamp_s=self._scheduler.now_s(),
        )  # fmt: skip
        self._bus.publish(self._keys.true_poses, message)

    def close(self) -> None:
        """Switch off the emulated robots, give up all ports, let go of the physics."""
        for timer in self._timers:
            timer.cancel()
        self._on_query.close()
        for subscription in self._subscriptions:
            subscription.close()
        self._end()
        if self._folder is not None:
            _tidy(self._folder)

    def _end(self) -> None:
        for emulator in self.emulators.values():
            emulator.close()
        self._server.close()
        self.world.close()


@runtime_checkable
class _HasBases(Protocol):
    def set_bases(self, bases: Sequence[Pose]) -> None: ...


@runtime_checkable
class _HasBattery(Protocol):
    def set_battery(self, fraction: float) -> None: ...


def _equip(emulator: Emulator, config: SwarmConfig, world: World, robot: str) -> None:
    """Give an emulated robot the docks of the fleet file as its Home Bases, and a charge at first."""
    if isinstance(emulator, _HasBases) and config.dock:
        emulator.set_bases([Pose(slot.x_m, slot.y_m, slot.heading_rad) for slot in slots_of(config)])
    if isinstance(emulator, _HasBattery) and world.batteries is not None:
        emulator.set_battery(float(world.batteries.charge[world.row(robot)]))


def _radius_m(config: SwarmConfig, robot: str) -> float:
    """Return the radius of a real robot's body, as its make states it."""
    entry = next(each for each in config.robot if each.id == robot)
    try:
        described = registry.driver_class(entry.url)(in_frame(entry.url, config.origin_deg)).description
    except FullswarmError:  # its driver is installed where its agent runs only
        return config.world_or_default.of_body(robot).radius_m
    return float(described.radius_m)


def _tidy(folder: Path) -> None:
    """Remove the folder of the ports when no port is in it any more."""
    try:
        folder.rmdir()
    except OSError:
        return


def start_emulator(word: str, url: str, body: Body) -> Emulator:
    """Start the emulator that a word names on a body, at the other end of a driver's URL.

    Raises
    ------
    ConfigError
        The URL is not one of this make.
    DriverError
        Its port cannot be had.
    MissingExtra
        The make's library is not installed.
    """
    make, model = emulated_as(word)
    fits, scheme = urlsplit(model.url).scheme, urlsplit(url).scheme
    if make.emulation is None or scheme != fits:
        raise ConfigError(f"an emulated {word} has no port of the kind '{scheme}'", where=url, hint=f"write {fits}://…")
    emulator: Emulator = emulation_part(make, make.emulation.start)(url, body)
    return emulator
