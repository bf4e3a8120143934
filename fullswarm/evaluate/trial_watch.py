"""The onlookers of a trial: at the bodies after every step of the world, and at what the swarm says of itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fullswarm.drivers.base import Array
from fullswarm.drivers.sim.world import World
from fullswarm.evaluate.experiment.record import Contacts, Trajectory
from fullswarm.evaluate.experiment.results import Outcome
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import Summary
from fullswarm.perf.coverage import GridFrame
from fullswarm.perf.metrics import METRICS
from fullswarm.perf.truth import Truth

SAMPLE_S = 0.2
"""Simulated time from one sample of the trajectory to the next."""
ROBOT_QUANTITY = {
    "work": "distance_m",
    "collisions": "events",
    "coverage": "area_m2",
    **{name: metric.per_robot for name, metric in METRICS.items() if metric.per_robot},
}
"""What a summary's numbers per robot are, by its metric."""

Numbers = Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Measurement:
    """All that one trial measured: what a results folder keeps of it."""

    outcome: Outcome
    end_reason: str = ""
    onboard: Numbers = field(default_factory=dict)
    truth: Numbers = field(default_factory=dict)
    per_robot: Mapping[str, Numbers] = field(default_factory=dict)
    trajectory: Trajectory | None = None
    coverage: tuple[GridFrame, NDArray[np.uint8]] | None = None  # the swarm's own; (rows, columns) of 0 and 1
    contacts: Contacts | None = None


class BodyWatch:
    """Sees the bodies from the request on: true metrics, and their trajectory. It costs a kernel call per step.

    Parameters
    ----------
    goals : (n, 2), each reached within `goal_radius_m`
    cell_m : of the true coverage grid
    """

    def __init__(self, world: World, goals: Array, goal_radius_m: float, cell_m: float) -> None:
        settings, count = world.config, len(world.ids)
        self._world, self._goals, self._goal_radius_m = world, goals, goal_radius_m
        self._radius_m = np.full(count, settings.radius_m)
        self.truth = Truth(world.ids, self._radius_m, goals, goal_radius_m, settings.bounds_m, cell_m)
        self._every = max(1, round(SAMPLE_S / world.dt_s))
        self._steps = 0
        self._sampled_at = -1
        self._touching = np.zeros(count, np.bool_)
        self._samples: list[tuple[float, NDArray[np.float32], NDArray[np.bool_]]] = []

    @property
    def time_s(self) -> float:
        """Since the request."""
        return self._steps * self._world.dt_s

    def begin(self) -> None:
        """Take the first sample, at the request."""
        self._sample()

    def look(self) -> None:
        """Take in the last step."""
        world = self._world
        self._steps += 1
        self.truth.look(self.time_s, world.pose, world.twist, world.dt_s, world.contacts)
        if len(world.pairs):
            self._touching |= world.contacts > 0
        if self._steps % self._every == 0:
            self._sample()

    def trajectory(self) -> Trajectory:
        """Return where the bodies were; the last sample is of now."""
        self._sample()
        settings = self._world.config
        times_s, poses, touching = zip(*self._samples, strict=True)
        return Trajectory(
            ids=self._world.ids,
            time_s=np.array(times_s),
            pose=np.array(poses),
            touching=np.array(touching),
            goals=np.array(self._goals, float),
            goal_radius_m=self._goal_radius_m,
            radius_m=self._radius_m,
            boxes=np.array(settings.boxes, float).reshape(-1, 5),
            bounds_m=np.array(settings.bounds_m, float),
        )

    def _sample(self) -> None:
        if self._sampled_at == self._steps:
            return
        self._sampled_at = self._steps
        self._samples.append((self.time_s, self._world.pose.astype(np.float32), self._touching.copy()))
        self._touching[:] = False


class SummaryWatch:
    """Hears the swarm's own summaries.

    Parameters
    ----------
    on_finished : called when a summarizer has met one of the termination conditions
    """

    def __init__(self, swarm: Lockstep, on_finished: Callable[[], None]) -> None:
        self._swarm, self._on_finished = swarm, on_finished
        self._newest: dict[str, Summary] = {}
        self.reason = ""
        """The first condition that was met."""
        self._subscription = swarm.bus.subscribe(swarm.keys.summary(), Summary, self._on_summary)

    def close(self) -> None:
        """Hear no more."""
        self._subscription.close()

    def onboard(self) -> dict[str, float]:
        """Return what the summarizers say: ``work.total_m``, ``coverage.fraction`` and so on."""
        return {
            f"{metric}.{name}": value
            for metric, each in sorted(self._newest.items())
            for name, value in each.values.items()
            if math.isfinite(value)
        }

    def per_robot(self) -> dict[str, dict[str, float]]:
        """Return the same by robot: ``work.distance_m`` → robot → value."""
        return {
            f"{metric}.{ROBOT_QUANTITY[metric]}" if metric in ROBOT_QUANTITY else metric: finite(each.per_robot)
            for metric, each in sorted(self._newest.items())
            if each.per_robot
        }

    def coverage(self) -> tuple[GridFrame, NDArray[np.uint8]]:
        """Return the grid that the robots have covered together, as they know it themselves."""
        grids = [agent.calculators.coverage for agent in self._swarm.agents]
        return grids[0].frame, np.maximum.reduce([each.grid for each in grids])

    def _on_summary(self, summary: Summary) -> None:
        self._newest[summary.metric] = summary
        if summary.finished and not self.reason:
            self.reason = summary.reason
            self._on_finished()


def finite(values: Numbers) -> dict[str, float]:
    """Return the values without those that JSON cannot hold."""
    return {name: value for name, value in values.items() if math.isfinite(value)}


def joined(onboard: Mapping[str, Numbers], truth: Mapping[str, Numbers]) -> dict[str, dict[str, float]]:
    """Return both tables in one, by ``onboard <name>`` and ``truth <name>``."""
    tables = (("onboard", onboard), ("truth", truth))
    return {f"{who} {name}": finite(values) for who, table in tables for name, values in table.items()}
