"""Yields the emulated Scout with all hands that break it: ``fullswarm robots check --rig fullswarm_acme.rig:rig``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from fullswarm.drivers.base import Pose, Twist
from fullswarm.simulation.bodies import FreeBody
from fullswarm.testing import Rig

from fullswarm_acme.driver import AcmeDriver
from fullswarm_acme.emulator import AcmeEmulator


@contextmanager
def rig() -> Iterator[Rig]:
    """Yield the rig of one robot; it is switched off at the end."""
    body = FreeBody(Pose(2.0, 1.0, 2.5))

    def body_speed() -> Twist:
        now = body.state()
        return Twist(now.speed_m_s, now.turn_rad_s)

    with AcmeEmulator(body=body) as robot:
        yield Rig(
            make=lambda: AcmeDriver(robot.url),
            make_on=lambda clock: AcmeDriver(robot.url, clock),
            body_speed=body_speed,
            unplug=robot.unplug,
            replug=robot.replug,
            mute=robot.mute,
            garbage=robot.garbage,
            cut=robot.cut,
            bump=lambda pressed: body.press(pressed, pressed),
            motors_on=lambda: robot.motors_on,
            other_process=True,
            fault_s=0.8,
        )
