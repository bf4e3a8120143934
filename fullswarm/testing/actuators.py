"""The check of a driver's actuators: what is declared can be set, what is not is refused, and no stop waits for any."""

from __future__ import annotations

import math
from collections.abc import Callable

from fullswarm.drivers.actuators import Actuates, Actuator
from fullswarm.drivers.base import STAND, Lifecycle
from fullswarm.errors import DriverError
from fullswarm.testing.trial import Trial

NAME = "actuators"
BEST_S = 0.005
"""A call must be faster; the contract is 1 ms, machines are noisy."""
FLOOD = 20
"""Rounds of all values that are asked for right before a stop."""

Stops = Callable[[Trial, Callable[[], None], str, str], float]
"""See ``driver.check_stops``: drives off, calls what must stop the robot, returns how soon it did."""


def check_actuators(trial: Trial, stops: Stops) -> None:
    """Set every actuator that the description declares; begins and ends with an open driver at standstill."""
    driver, declared = trial.driver, trial.driver.description.actuators
    if not isinstance(driver, Actuates):
        trial.demand(not declared, "its description declares actuators, but it has no method actuate(name, value)")
        trial.report.add(NAME, "none declared")
        return
    names = [each.name for each in declared]
    trial.demand(len(set(names)) == len(names), f"two actuators have one name: {', '.join(sorted(names))}")
    trial.go()
    trial.halt("a zero command", each=lambda: trial.command(STAND))
    _check_refused(trial, driver, "no-such-actuator", True)
    for each in declared:
        for bad in bad_values(each):
            _check_refused(trial, driver, each.name, bad)
        for good in good_values(each):
            _check_taken(trial, driver, each.name, good)
    if not declared:
        trial.report.add(NAME, "none declared, and unknown names are refused")
        return
    still = trial.fresh().odometry
    trial.stays(still, "after its actuators were set", lambda: trial.command(STAND))
    trial.demand(trial.state is Lifecycle.ACTIVE, f"setting its actuators makes it {trial.state}; it stays ACTIVE")

    def flood_and_stop() -> None:
        for _ in range(FLOOD):
            for each in declared:
                for value in good_values(each):
                    driver.actuate(each.name, value)
        driver.deactivate()

    took_s = stops(
        trial, flood_and_stop, "deactivate() right after many actuator commands", "send stops before what may wait"
    )
    trial.report.add(NAME, f"{', '.join(names)}; a stop behind {FLOOD} rounds of them slows it after {took_s:.2f} s")


def good_values(actuator: Actuator) -> tuple[object, ...]:
    """Return values that it must take, the last one differs from the first."""
    if actuator.kind == "flag":
        return True, False
    if actuator.kind == "number":
        return tuple(actuator.span[0])
    if actuator.kind == "word":
        return (actuator.choices[-1], actuator.choices[0]) if actuator.choices else ("8" * actuator.longest, "")
    most = tuple(high for _, high in actuator.span)
    return [most] * actuator.longest, []


def bad_values(actuator: Actuator) -> tuple[object, ...]:
    """Return values that it must refuse."""
    if actuator.kind == "flag":
        return "on", 2.0, None
    if actuator.kind == "number":
        low, high = actuator.span[0]
        return low - 1.0, high + 1.0, math.nan, math.inf, "1", True
    if actuator.kind == "word":
        return "no such word, and too long for every display there is" * 8, 1.0, None
    low, high = actuator.span[0]
    most = tuple(high for _, high in actuator.span)
    return [most] * (actuator.longest + 1), [(high + 1.0, most[1])], [(math.nan, most[1])], [most[:1]], "ab", 1.0


def _check_refused(trial: Trial, driver: Actuates, name: str, value: object) -> None:
    try:
        driver.actuate(name, value)
    except ValueError:
        trial.command(STAND)
        return
    except Exception as error:
        raise AssertionError(
            f"{trial.driver.url}: actuate({name!r}, {value!r}) raises {type(error).__name__}; ValueError, with what it "
            "takes: fullswarm.drivers.actuators.checked() does that"
        ) from error
    trial.demand(False, f"actuate({name!r}, {value!r}) is taken; raise ValueError for what is not declared")


def _check_taken(trial: Trial, driver: Actuates, name: str, value: object) -> None:
    trial.command(STAND)
    took_s = math.inf
    for _ in range(5):
        began_s = trial.clock.now_s()
        try:
            driver.actuate(name, value)
        except (ValueError, DriverError) as error:
            trial.demand(False, f"actuate({name!r}, {value!r}) is declared but refused while ACTIVE: {error}")
        took_s = min(took_s, trial.clock.now_s() - began_s)
    trial.demand(
        took_s < BEST_S, f"actuate({name!r}) takes {took_s * 1e3:.1f} ms at best; leave it to the link's thread"
    )
