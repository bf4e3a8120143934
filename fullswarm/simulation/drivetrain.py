"""Kinematic bodies behind imperfect drivetrains: dead time, motor lag, soft brakes, unequal wheels and wheel slip.

What the safety filter does not assume of a unicycle. The bodies are those of :mod:`fullswarm.simulation.kinematic`:
the same solid discs, judged by the same referee. Their set-points go through, one after the other:

- a dead time: the motors follow the set-points of `dead_time_s` ago;
- the motor controller's ramp, with `brakes` times the acceleration where the speed falls;
- the motors, first order with the time constant `lag_s`;
- two wheels of different radii, each of which loses up to `slip` of its speed to the floor. How much varies with time.

All that is random is drawn once, from the world's seed. The measured twist is that of the wheels' encoders, which
notice neither slip nor a wheel's radius, but what pushes a body.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fullswarm.config import WorldConfig
from fullswarm.drivers.sim.settings import WHEEL_BASE_RADII
from fullswarm.kernels import Array, Index, kernel
from fullswarm.simulation.kinematic import KinematicEngine

SLIP_HZ = (0.2, 2.0)
"""How often the slip of a wheel rises and falls: drawn for each."""
_DRIVETRAIN = 7  # stream of random numbers


class Motors(NamedTuple):
    """The drivetrains of n bodies."""

    delay: Index  # (n,) world steps from a set-point to its effect
    ramp: Array  # (n, 2) greatest change of speed and turn rate in a step
    brake: Array  # (n,) greatest fall of the speed in a step
    follow: Array  # (n,) share of the difference to the ramp that the motors make up in a step
    base_m: Array  # (n,) distance of the wheels
    wheel: Array  # (n, 2) radius of the left and the right wheel over the one that its firmware assumes
    slip: Array  # (n,) greatest share of a wheel's speed that is lost
    slip_rate: Array  # (n, 2) rad/s, of its rise and fall, of the left and the right wheel
    slip_phase: Array  # (n, 2) rad


class Turning(NamedTuple):
    """What changes from step to step."""

    queue: Array  # (k, n, 2) the last set-points; step s is in row s % k
    ramped: Array  # (n, 2) where the ramps are, m/s and rad/s
    encoders: Array  # (n, 2) what the motors do, as the encoders see it
    moved: Array  # (n, 2) what the bodies do


def motors_of(config: WorldConfig, bodies: Sequence[WorldConfig]) -> Motors:
    """Return the drivetrains of bodies in a world; equal settings and seeds make equal ones."""
    n, dt_s = len(bodies), 1.0 / config.rate_hz
    rng = np.random.default_rng([config.seed & (2**63 - 1), _DRIVETRAIN])
    each = [body.drivetrain for body in bodies]
    lag_s = np.array([one.lag_s for one in each])
    accel = np.array([body.accel_limit_m_s2 for body in bodies])
    unequal = np.array([one.unequal_wheels for one in each])
    return Motors(
        delay=np.array([math.ceil(one.dead_time_s / dt_s - 1e-9) for one in each], np.int64),
        ramp=np.array([(body.accel_limit_m_s2, body.turn_accel_limit_rad_s2) for body in bodies]).reshape(n, 2) * dt_s,
        brake=accel * np.array([one.brakes for one in each]) * dt_s,
        follow=-np.expm1(-dt_s / np.maximum(lag_s, 1e-9)),
        base_m=np.array([WHEEL_BASE_RADII * body.radius_m for body in bodies]),
        wheel=1.0 + 0.5 * unequal[:, None] * rng.uniform(-1.0, 1.0, (n, 2)),
        slip=np.array([one.slip for one in each]),
        slip_rate=2.0 * math.pi * rng.uniform(*SLIP_HZ, (n, 2)),
        slip_phase=rng.uniform(0.0, 2.0 * math.pi, (n, 2)),
    )


class DrivetrainEngine:
    """An :class:`~fullswarm.simulation.engine.Engine` of kinematic bodies behind drivetrains."""

    def __init__(self, config: WorldConfig, starts: Array, bodies: Sequence[WorldConfig]) -> None:
        n = len(starts)
        self._plane = KinematicEngine(config, starts, bodies)
        self.firmware = self._plane.firmware.replace("kinematic", "drivetrain")
        self.pose, self.referee = self._plane.pose, self._plane.referee
        self.twist = np.zeros((n, 2))
        self._motors, self._dt_s, self._steps = motors_of(config, bodies), 1.0 / config.rate_hz, 0
        depth = int(self._motors.delay.max(initial=0)) + 1
        self._turning = Turning(
            queue=np.zeros((depth, n, 2)), ramped=np.zeros((n, 2)), encoders=np.zeros((n, 2)), moved=np.zeros((n, 2))
        )

    def step(self, twists: Array) -> None:
        """Advance one world step."""
        turning = self._turning
        turn_wheels.run(self._motors, twists, self._steps, self._dt_s, turning)
        self._steps += 1
        self._plane.step(turning.moved)
        np.subtract(self._plane.twist, turning.moved, out=self.twist)
        self.twist += turning.encoders

    def place_movers(self, places: Array) -> None:
        """Put the movers there before the next step."""
        self._plane.place_movers(places)

    def close(self) -> None:
        """Do nothing: there is nothing to release."""


@kernel
def grip(motors: Motors, i: int, side: int, time_s: float) -> float:
    """Return which share of a wheel's speed the floor takes up at a time."""
    phase = motors.slip_rate[i, side] * time_s + motors.slip_phase[i, side]
    return 1.0 - 0.5 * float(motors.slip[i]) * (1.0 + math.sin(phase))


@kernel
def turn_wheels(motors: Motors, twists: Array, step: int, dt: float, turning: Turning) -> None:
    """Take the set-points `twists` (n, 2) of step number `step`, and fill `encoders` and `moved` of `turning`."""
    queue, ramped, encoders = turning.queue, turning.ramped, turning.encoders
    depth = queue.shape[0]
    now = step % depth
    for i in range(twists.shape[0]):
        queue[now, i, 0], queue[now, i, 1] = twists[i, 0], twists[i, 1]
        due = (step - motors.delay[i]) % depth
        for axis in range(2):
            goal = queue[due, i, axis]
            rise = motors.ramp[i, axis]
            fall = motors.brake[i] if axis == 0 else rise
            was = ramped[i, axis]
            least = was - fall if was > 0.0 else was - rise
            most = was + fall if was < 0.0 else was + rise
            ramped[i, axis] = max(least, min(most, goal))
            encoders[i, axis] += motors.follow[i] * (ramped[i, axis] - encoders[i, axis])
        half_m = 0.5 * motors.base_m[i]
        left = encoders[i, 0] - encoders[i, 1] * half_m
        right = encoders[i, 0] + encoders[i, 1] * half_m
        left *= motors.wheel[i, 0] * grip(motors, i, 0, step * dt)
        right *= motors.wheel[i, 1] * grip(motors, i, 1, step * dt)
        turning.moved[i, 0] = 0.5 * (left + right)
        turning.moved[i, 1] = (right - left) / motors.base_m[i]
