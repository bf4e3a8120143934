"""Listens whether a ROS base is at a driver's URL: its odometry arrives. Nothing is published, so nothing moves."""

from __future__ import annotations

import select
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial

from fullswarm.clock import Clock
from fullswarm.drivers.base import Lifecycle
from fullswarm.drivers.make import Scope
from fullswarm.drivers.probe.found import Asked, Found, unasked
from fullswarm.drivers.ros import MAKE
from fullswarm.drivers.ros.driver import begin, open_port
from fullswarm.drivers.ros.settings import parse_url, without_guardian
from fullswarm.errors import DriverError, LinkLost

ANSWER_S, BATTERY_S, POLL_S = 2.0, 0.5, 0.05
"""Longest wait for odometry; then for a battery that is reported less often."""


def questions(scope: Scope, clock: Clock) -> Sequence[tuple[str, Callable[[], Asked]]]:
    """Return the questions to where emulated bases are: a real one could be at any address, and is asked by its URL."""
    emulation = MAKE.emulation
    urls = [each.driver_url("") for each in emulation.models] if scope.everything and emulation is not None else []
    return [(parse_url(url).where, partial(ask_url, url, clock)) for url in urls]


def ask_url(url: str, clock: Clock) -> Asked:
    """Listen to the robot at a driver's URL.

    Raises
    ------
    ConfigError
        The URL is wrong.
    MissingExtra
        The transport's library is not installed.
    """
    settings = without_guardian(parse_url(url))
    session = None
    try:
        with closing(open_port(settings, clock)()) as port:
            session = begin(settings)  # after the port: its library may be missing where nothing is to be asked
            began_s = clock.now_s()
            session.linked(began_s)
            heard_s = None
            while clock.now_s() - began_s < ANSWER_S:
                if heard_s is not None and (
                    clock.now_s() - heard_s > BATTERY_S or (session.reading and session.reading.battery is not None)
                ):
                    break
                descriptor = port.fileno()
                if descriptor is not None and select.select([descriptor], [], [], POLL_S)[0]:
                    for chunk in port.read():
                        session.received(chunk, clock.now_s())
                port.beat()
                for chunk in session.greeting():
                    port.write(chunk)
                if heard_s is None and session.reading is not None:
                    heard_s = clock.now_s()
    except DriverError as error:  # LinkLost is one
        return unasked(settings.where, error)
    except OSError as error:
        return unasked(settings.where, LinkLost(str(error.strerror or error)))
    if session.reading is None:
        return Asked(settings.where, problem=session.why(clock.now_s()) or "no odometry arrives")
    ready = session.state is Lifecycle.READY
    found = Found(
        settings.where, settings.description.make, settings.description.model, battery=session.reading.battery, url=url,
        note="" if ready else session.fault,
    )  # fmt: skip
    return Asked(settings.where, robots=(found,))
