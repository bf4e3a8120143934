"""``--live``: a trial through real processes in real time, behind emulated ports if wanted."""

from __future__ import annotations

from fullswarm import kernels
from fullswarm.config import SwarmConfig
from fullswarm.drivers.make import emulated
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.evaluate.experiment.plan import Trial, scenario_of
from fullswarm.evaluate.live_swarm import LiveSwarm
from fullswarm.evaluate.trial import Measurement, configure, drive, request_of, terms
from fullswarm.evaluate.witness import WorldWitness, in_safe_set
from fullswarm.launch.ports import on_free_ports

EMULATED_MARGIN_M = 0.08
"""Odometry and fixes are a few centimetres off, and a rover needs time to brake."""


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
    config = on_free_ports(with_make(config, trial, emulate), wished=False)
    config, limit_s, limit_reason = terms(trial, scenario, config)
    kernels.compile_all()
    with LiveSwarm(config) as swarm:
        swarm.start()
        world = swarm.bodies
        safe = in_safe_set(world, config.agent.safety_margin_m)
        request = request_of(trial, scenario, goals, config, (limit_s, limit_reason), safe)
        cell_m = config.performance.coverage_cell_m
        return drive(swarm, request, WorldWitness(world, goals, scenario.goal.radius_m, cell_m, emulate is not None))


def with_make(config: SwarmConfig, trial: Trial, emulate: str | None) -> SwarmConfig:
    """Put every robot behind an emulated port; agents keep the cell's limits where the make could do more."""
    if emulate is None:
        return config
    if emulate not in (known := emulated()):
        raise ConfigError(f"no emulated robot '{emulate}'", where="--emulate", hint=did_you_mean(emulate, known))
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
