"""The published check of actuators: it lets a driver with a lamp pass, and names each defect of a broken one."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import pytest

from fullswarm.drivers.actuators import checked, flag, pairs, word
from fullswarm.drivers.base import Lifecycle, Twist
from fullswarm.drivers.null.driver import NullDriver
from fullswarm.errors import DriverError
from fullswarm.testing import Report, Rig, check_driver, driver
from fullswarm.testing.actuators import check_actuators
from fullswarm.testing.trial import Trial

PARTS = (flag("lamp"), word("gripper", ("open", "closed")), pairs("song", ((0, 127), (0, 4)), ("MIDI note", "s"), 4))


class WithLamp(NullDriver):
    """The template driver with three actuators."""

    def __init__(self, url: str = "null://r1") -> None:
        super().__init__(url)
        self.description = replace(self.description, actuators=PARTS)
        self.set: dict[str, Any] = {}

    def actuate(self, name: str, value: object) -> None:
        self.set[name] = checked(self.description.actuators, name, value)


class Silent(WithLamp):
    actuate = None  # type: ignore[assignment]  # declares actuators, but cannot set them


class TakesAll(WithLamp):
    def actuate(self, name: str, value: object) -> None:
        self.set[name] = value


class AnyWord(WithLamp):
    def actuate(self, name: str, value: object) -> None:
        if name != "gripper":
            super().actuate(name, value)


class OtherError(WithLamp):
    def actuate(self, name: str, value: object) -> None:
        self.set[name] = {each.name: each for each in PARTS}[name].check(value)


class Refuses(WithLamp):
    def actuate(self, name: str, value: object) -> None:
        super().actuate(name, value)
        raise DriverError("not now")


class Waits(WithLamp):
    def actuate(self, name: str, value: object) -> None:
        super().actuate(name, value)
        time.sleep(0.01)


class Drives(WithLamp):
    def actuate(self, name: str, value: object) -> None:
        super().actuate(name, value)
        self._twist = Twist(0.2, 0.0)

    def command(self, twist: Twist) -> Twist:
        applied = super().command(twist)
        if self.set and twist == Twist() and self.state is Lifecycle.ACTIVE:
            self._twist = Twist(0.2, 0.0)
        return applied


class StopsLast(WithLamp):
    """One queue for all: a stop waits for everything before it."""

    waiting = 0

    def actuate(self, name: str, value: object) -> None:
        super().actuate(name, value)
        self.waiting += 1 if self._twist.linear_m_s else 0

    def deactivate(self) -> None:
        time.sleep(0.003 * self.waiting)
        super().deactivate()


class Twins(WithLamp):
    def __init__(self, url: str = "null://r1") -> None:
        super().__init__(url)
        self.description = replace(self.description, actuators=(*PARTS, flag("lamp")))


def check(broken: type[WithLamp]) -> None:
    made = broken("null://r1")
    report = Report(made.url)
    bench = Trial(made, Rig(make=lambda: made), 0.3, 0.3, report)
    try:
        bench.open()
        bench.reach(Lifecycle.READY, "open()")
        check_actuators(bench, driver._check_stops_soon)
    finally:
        made.close()


def test_a_driver_with_actuators_passes_and_the_report_names_them() -> None:
    report = check_driver(lambda: WithLamp("null://r1"), settle_s=0.3, deadline_s=0.3)
    assert "lamp, gripper, song; a stop behind 20 rounds" in str(report)


@pytest.mark.parametrize(
    ("broken", "sentence"),
    [
        (Silent, "declares actuators, but it has no method actuate"),
        (TakesAll, "'no-such-actuator', True.* is taken; raise ValueError"),
        (AnyWord, "'gripper', .* is taken; raise ValueError"),
        (OtherError, "raises KeyError; ValueError, with what it takes"),
        (Refuses, "'lamp', True.* is declared but refused while ACTIVE"),
        (Waits, "takes 1.* ms at best; leave it to the link's thread"),
        (Drives, "it moves after its actuators were set"),
        (StopsLast, "deactivate.. right after many actuator commands slows it after .* only"),
        (Twins, "two actuators have one name: gripper, lamp, lamp, song"),
    ],
)
def test_a_driver_that_breaks_a_rule_is_told_which(broken: type[WithLamp], sentence: str) -> None:
    with pytest.raises(AssertionError, match=sentence):
        check(broken)
