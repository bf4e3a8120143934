"""Asks an address whether a Scout is there: it greets, and sends nothing that moves a motor."""

import socket
from collections.abc import Callable
from functools import partial
from urllib.parse import urlsplit

from fullswarm.clock import Clock
from fullswarm.drivers.make import Scope
from fullswarm.drivers.probe.found import Asked, Found

from fullswarm_acme.protocol import LineParser, line, parse_robot, parse_state

HERE, ANSWER_S = "acme://127.0.0.1:7700", 0.5


def questions(scope: Scope, clock: Clock) -> list[tuple[str, Callable[[], Asked]]]:
    """Return the one address that is asked when none is named."""
    return [("tcp 127.0.0.1:7700", partial(ask_url, HERE, clock))] if scope.everything else []


def ask_url(url: str, clock: Clock) -> Asked:
    """Ask the robot at a driver's URL."""
    parts = urlsplit(url)
    name, battery, parser = f"tcp {parts.netloc}", None, LineParser()
    end_s, robot = clock.now_s() + ANSWER_S, None
    try:
        with socket.create_connection((parts.hostname, parts.port or 7700), timeout=ANSWER_S) as link:
            link.sendall(line("HELLO"))
            while clock.now_s() < end_s and (robot is None or battery is None) and (data := link.recv(4096)):
                for text in parser.feed(data):
                    robot, state = parse_robot(text) or robot, parse_state(text)
                    battery = state.battery if state is not None else battery
    except OSError as error:
        return Asked(name, problem=f"nothing answers: {error.strerror or error}")
    if robot is None:
        return Asked(name, problem="no Scout answers there")
    return Asked(name, robots=(Found(name, "Acme", robot.model, robot.firmware, battery, f"acme://{parts.netloc}"),))
