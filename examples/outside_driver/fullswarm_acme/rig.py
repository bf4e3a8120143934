"""Yields the emulated Scout with all its faults: ``fullswarm robots check --rig fullswarm_acme.rig:rig``."""

from collections.abc import Iterator
from contextlib import contextmanager

from fullswarm.drivers.base import Pose
from fullswarm.simulation.bodies import FreeBody
from fullswarm.testing import Rig, emulator_rig

from fullswarm_acme.driver import AcmeDriver
from fullswarm_acme.emulator import AcmeEmulator


@contextmanager
def rig() -> Iterator[Rig]:
    """Yield the rig of one robot; it is switched off at the end."""
    with AcmeEmulator(body=FreeBody(Pose(2.0, 1.0, 2.5))) as robot:
        yield emulator_rig(robot, AcmeDriver, lambda: robot.motors_on)
