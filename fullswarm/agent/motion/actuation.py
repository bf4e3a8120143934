"""Passes what control laws ask of actuators on to the drivers: after the motion, and of robots that may drive only."""

from __future__ import annotations

from typing import NamedTuple

import structlog

from fullswarm.drivers.base import Fleet
from fullswarm.errors import DriverError
from fullswarm.kernels import Flags
from fullswarm.reasons import NONE, Code, Reason, reason
from fullswarm.recent import Recent

MOST = 256

log = structlog.get_logger()


class Actuation(NamedTuple):
    """One request to an actuator: robot, name, state."""

    row: int
    name: str
    value: object


class ActuatorCommands:
    """Carries out actuations.

    A robot that is stopped for good (no task, e-stop) gets none. What a driver refuses is logged once, with the reason,
    until it takes something else under that name.

    Attributes
    ----------
    refused : by robot and name, why the newest value was not taken
    """

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self.refused: Recent[tuple[int, str], Reason] = Recent(MOST)

    def carry_out(self, asked: list[Actuation], drive_on: Flags) -> None:
        """Pass on what was asked, in its order, to the robots in `drive_on` (n,)."""
        for row, name, value in asked:
            if not drive_on[row]:
                continue
            why = self._why_not(row, name, value)
            if why:
                if self.refused.get((row, name), NONE).text != why.text:
                    log.error("an actuator is not set", robot=self._fleet.ids[row], code=why.code, reason=why.text)
                self.refused[row, name] = why
            elif self.refused:
                self.refused.pop((row, name), None)

    def _why_not(self, row: int, name: str, value: object) -> Reason:
        try:
            self._fleet.actuate(row, name, value)
        except (ValueError, DriverError) as error:
            return reason(Code.ACTUATOR, name=name, error=str(error))
        return NONE
