"""``--live``: a trial through real processes in real time, behind emulated ports if wanted."""

from __future__ import annotations

import socket
from typing import get_args
from urllib.parse import urlsplit

from fullswarm import kernels
from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.config.models import Emulated
from fullswarm.drivers import emulated
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.launch.evaluate.live_run import Asked, drive, terms
from fullswarm.launch.evaluate.live_swarm import LiveSwarm
from fullswarm.launch.evaluate.trial import configure, in_safe_set, parameters
from fullswarm.launch.evaluate.trial_watch import Measurement
from fullswarm.launch.evaluate.witness import WorldWitness
from fullswarm.perf.experiment.plan import Trial, scenario_of

EMULATED: tuple[str, ...] = get_args(Emulated)
EMULATED_MARGIN_M = 0.08
"""Odometry and fixes are a few centimetres off, and a rover needs time to brake."""
LOOPBACK = "127.0.0.1"


def measure_live(trial: Trial, emulate: str | None = None) -> Measurement:
    """Run a trial with a process for each robot; none is left afterwards.

    Parameters
    ----------
    emulate : the robots are of this make, behind emulated ports with their real drivers; None: simulated ones

    Raises
    ------
    ConfigError
        The trial's settings are wrong, the make is unknown, or so many robots do not fit.
    MissingExtra
        The make's library, or that of the estimator, is not installed.
    TrialFailed
        A process ended, a robot is in FAULT, or the swarm did not do what it was asked.
    """
    scenario = scenario_of(trial)
    config, goals = configure(trial, scenario)
    config = on_unused_ports(with_make(config, trial, emulate))
    config, limit_s, limit_reason = terms(trial, scenario, config)
    kernels.compile_all()
    with LiveSwarm(config) as swarm:
        swarm.start()
        assert swarm.world is not None  # noqa: S101  (narrows the type: all robots of a trial are simulated)
        world = swarm.world.world
        asked = Asked(
            behaviour=trial.cell.behaviour,
            parameters=parameters(trial, scenario, goals),
            scenario=scenario,
            goals=goals,
            limit_s=limit_s,
            limit_reason=limit_reason,
            safe_start=in_safe_set(world, config.agent.safety_margin_m),
            boxes=config.world_or_default.boxes,
        )
        cell_m = config.performance.coverage_cell_m
        return drive(swarm, asked, WorldWitness(world, goals, scenario.goal.radius_m, cell_m, emulate is not None))


def with_make(config: SwarmConfig, trial: Trial, emulate: str | None) -> SwarmConfig:
    """Put every robot behind an emulated port; agents keep the cell's limits where the make could do more."""
    if emulate is None:
        return config
    if emulate not in EMULATED:
        raise ConfigError(f"nobody emulates a '{emulate}'", where="--emulate", hint=did_you_mean(emulate, EMULATED))
    body, asked = dict(trial.body), dict(trial.agent)
    usual = {
        "estimator": "ekf",
        "safety_margin_m": EMULATED_MARGIN_M,
        "speed_limit_m_s": body["speed_limit_m_s"],
        "turn_limit_rad_s": body["turn_limit_rad_s"],
    }
    agent = config.agent.model_copy(update={name: value for name, value in usual.items() if name not in asked})
    robots = tuple(each.model_copy(update={"emulate": emulate}) for each in config.robot)
    return config.model_copy(update={"agent": agent, "robot": robots})


def on_unused_ports(config: SwarmConfig) -> SwarmConfig:
    """Give hub, world and emulated robots ports of this machine that nobody uses, whatever the file wishes.

    Trials run side by side: they must not all find the usual port free and then take it.
    """
    hub = config.hub.model_copy(update={"endpoint": f"tcp/{LOOPBACK}:{_unused(socket.SOCK_STREAM)}"})
    world = config.world_or_default.model_copy(update={"address": f"{LOOPBACK}:{_unused(socket.SOCK_DGRAM)}"})
    config = config.model_copy(update={"hub": hub, "world": world})
    return config.model_copy(update={"robot": tuple(_on_unused_port(config, each) for each in config.robot)})


def _on_unused_port(config: SwarmConfig, robot: RobotConfig) -> RobotConfig:
    """Write the driver of an emulated robot down; its port, if it is one of the network, is free."""
    if not robot.emulate or robot.driver:
        return robot
    url = emulated.driver_url(config, robot)
    port = urlsplit(url).port
    if port is not None:
        url = url.replace(f":{port}", f":{_unused(socket.SOCK_DGRAM)}", 1)
    return robot.model_copy(update={"driver": url})


def _unused(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])
