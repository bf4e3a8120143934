"""Runs `fullswarm doctor`: checks this machine, and a fleet's hub and robots, and says what fixes what is wrong.

Nothing moves and nothing is changed. The machine's own checks are in :mod:`.machine`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote, urlsplit

from fullswarm.bringup import checks
from fullswarm.bringup.certificates import check_certificates
from fullswarm.bringup.checks import Check
from fullswarm.bringup.machine import (
    access,
    clocks,
    extras,
    gamepads,
    interferer,
    network_time,
    python,
    resources,
    serial_ports,
)
from fullswarm.clock import MonotonicClock, wall_time_s
from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.drivers.base import Description
from fullswarm.drivers.fleet_file import check_frames, load_fleet
from fullswarm.drivers.guardian import needs_guardian, takes_guardian
from fullswarm.drivers.make import Make, broken, emulated_as, make_of
from fullswarm.errors import ConfigError, FullswarmError, Unreachable

HUB_S = 1.5
LOW_BATTERY = 0.2


def run(fleet: Path | None, *, as_json: bool) -> int:
    """Print the checks; return 0 without a failure, else 1.

    Raises
    ------
    ConfigError
        The fleet file is wrong.
    """
    config = None if fleet is None else load_fleet(fleet)
    return 1 if checks.show(_checks(config), as_json=as_json) else 0


def _checks(config: SwarmConfig | None) -> Iterator[Check]:
    clock = MonotonicClock()
    began_s, began_wall_s = clock.now_s(), wall_time_s()
    yield python()
    yield from extras(_needed_extras(config))
    for why in broken().values():
        yield Check("outside make", "failure", why, "install its package again, or remove it")
    yield from serial_ports()
    yield interferer()
    yield from gamepads()
    yield from resources()
    yield network_time()
    if config is not None:
        yield from _frame(config)
        yield from checks.stopping(config)
        yield from _evidence(config)
        yield from check_certificates(config)
        yield _hub(config)
        for robot in config.robot:
            yield from _robot(config, robot)
    # Compared over all the checks before: no need to wait just for this.
    yield clocks(clock.now_s() - began_s, wall_time_s() - began_wall_s, wall_time_s())


def _needed_extras(config: SwarmConfig | None) -> frozenset[str]:
    if config is None:
        return frozenset()
    makes = {make.extra for each in config.robot for make in _makes_of(each)} - {""}
    return frozenset(makes | {"camera"} if config.camera else makes)


def _makes_of(robot: RobotConfig) -> Iterator[Make]:
    """Yield the makes whose code a robot runs: its driver's, and for one of a world the simulator's."""
    try:
        yield make_of(robot.url)  # of an emulated robot without a driver: the simulated one
        if robot.emulate:
            yield emulated_as(robot.emulate)[0]
            yield make_of("sim:")
    except ConfigError:
        return  # the robot's own check reports what is wrong


def _family(url: str) -> str:
    return urlsplit(url).scheme.partition("+")[0]


def _hub(config: SwarmConfig) -> Check:
    from fullswarm.bus.endpoint import host_of, is_loopback
    from fullswarm.bus.zenoh_bus import ZenohBus
    from fullswarm.operator.session import own_credentials
    from fullswarm.runtime import Mailbox

    endpoint = config.hub.endpoint
    try:
        bus = ZenohBus(Mailbox(), hub=endpoint, credentials=own_credentials(endpoint, config.swarm))
    except ConfigError as error:
        return Check("hub", "failure", error.what, error.hint)
    try:
        bus.wait_connected(HUB_S)
    except Unreachable as error:
        if is_loopback(host_of(endpoint)):
            what = f"no process listens on {endpoint}: normal before the swarm is started"
            return Check("hub", "warning", what, "fullswarm up FLEET.toml")
        return Check("hub", "failure", str(error), "start `fullswarm hub` there; check network and firewall")
    finally:
        bus.close()
    return Check("hub", "ok", f"{endpoint} answers")


# ---------------------------------------------------------------- robots of the fleet
def _robot(config: SwarmConfig, robot: RobotConfig) -> Iterator[Check]:
    from fullswarm import registry

    name, url = f"robot {robot.id}", robot.url
    if robot.emulate is not None:
        try:
            emulated_as(robot.emulate)
            yield Check(name, "ok", f"emulated by the world: {robot.emulate}")
        except FullswarmError as error:
            yield Check(name, "failure", error.what, error.hint)
        return
    try:
        make = make_of(url)
        driver = registry.driver_class(url)(url)  # touches nothing, but refuses a wrong URL
        warning = getattr(driver, "warning", "")
        if warning:
            yield Check(name, "warning", warning)
        if make.simulated:
            yield Check(name, "ok", f"simulated: {url}")
            return
        yield from _guardian(name, driver)
        device = list(_device(config, robot))
        yield from device
        if all(each.status != "failure" for each in device):
            yield from _answer(name, url)
    except FullswarmError as error:
        yield Check(name, "failure", error.what, error.hint)


def _evidence(config: SwarmConfig) -> Iterator[Check]:
    """Report what was proven for each make of the fleet, according to its record."""
    for make in dict.fromkeys(make for each in config.robot for make in _makes_of(each) if not make.simulated):
        yield Check(f"evidence for {make.name}", "ok", make.proven())


def _guardian(name: str, driver: object) -> Iterator[Check]:
    """Warn of a robot that drives on when its agent is killed, and whose driver takes no guardian."""
    description = getattr(driver, "description", None)
    if isinstance(description, Description) and needs_guardian(description) and not takes_guardian(driver):
        what = "it drives on when its agent is killed: no quick watchdog of its own, and its driver takes no guardian"
        yield Check(name, "warning", what, "keep a hand on its switch; its driver needs guard(), see decision 14")


def _frame(config: SwarmConfig) -> Iterator[Check]:
    """Check that robots which know their own position know it in the swarm's frame."""
    try:
        check_frames(config)
    except ConfigError as error:
        yield Check("frame", "failure", error.what, error.hint)


def _device(config: SwarmConfig, robot: RobotConfig) -> Iterator[Check]:
    """Check the serial device that a URL names, if it names one."""
    path = unquote(urlsplit(robot.url).path)
    if not path.startswith("/dev/"):
        return
    others = [each.id for each in config.robot if each.id != robot.id and unquote(urlsplit(each.url).path) == path]
    if others:
        yield Check(f"robot {robot.id}", "failure", f"{path} is also the port of {', '.join(others)}", "one port each")
    if not Path(path).exists():
        yield Check(f"robot {robot.id}", "failure", f"{path} does not exist", "plug it in; see `fullswarm robots find`")
        return
    yield access(path)


def _answer(name: str, url: str) -> Iterator[Check]:
    from fullswarm.drivers.probe import ask

    asked = ask.ask_url(url)
    if not asked.robots:
        mend = "" if asked.held else "fullswarm robots find"
        yield Check(name, "warning" if asked.held else "failure", f"not probed: {asked.problem}", mend)
        return
    for each in asked.robots:
        if _family(each.url) != _family(url):
            yield Check(name, "failure", f"{each.make} {each.model} answers: another robot", each.url)
            continue
        parts = [f"{each.make} {each.model}", f"firmware {each.firmware}" if each.firmware else "", each.note]
        if each.battery is not None:
            parts.insert(2, f"battery {each.battery:.0%}")
        low = each.battery is not None and each.battery < LOW_BATTERY
        what = ", ".join(filter(None, parts))
        yield Check(name, "warning" if low else "ok", what, "charge it" if low else "")
