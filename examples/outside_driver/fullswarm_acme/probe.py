"""Asks an address whether a Scout is there: it greets, and sends nothing that moves a motor."""

from fullswarm.clock import Clock
from fullswarm.drivers.ports import parse_address
from fullswarm.drivers.probe.found import Asked, Found, unasked
from fullswarm.drivers.probe.line import exchange
from fullswarm.errors import DriverError

from fullswarm_acme.protocol import Hello, LineParser, Robot, State, line

ANSWER_S = 0.2


def ask_url(url: str, clock: Clock) -> Asked:
    """Ask the robot at a driver's URL."""
    name = url.removeprefix("acme://")
    try:
        messages = LineParser().feed(exchange(*parse_address(name, where=url), line(Hello()), ANSWER_S, clock))
    except DriverError as error:
        return unasked(f"tcp {name}", error)
    states = [each for each in messages if isinstance(each, State)]
    robots = [each for each in messages if isinstance(each, Robot)]
    if not states or not robots:
        return Asked(f"tcp {name}", problem="no Scout answers there")
    found = Found(f"tcp {name}", "Acme", robots[0].model, robots[0].firmware, states[0].percent / 100.0, url)
    return Asked(f"tcp {name}", robots=(found,))
