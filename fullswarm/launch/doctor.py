"""`fullswarm doctor`: is this machine, and a fleet's hub and robots, fit to drive? What mends it if not.

Nothing moves and nothing is changed. The machine's own checks are in :mod:`.machine`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from urllib.parse import unquote, urlsplit

from fullswarm.clock import MonotonicClock, wall_time_s
from fullswarm.config import RobotConfig, SwarmConfig, load_swarm
from fullswarm.errors import FullswarmError, Unreachable
from fullswarm.launch import machine
from fullswarm.launch.machine import Check
from fullswarm.operator import output

HUB_S = 1.5
LOW_BATTERY = 0.2
_EXTRA_OF = {"sim": "sim", "mavlink": "mavlink", "can": "can"}


def run(fleet: Path | None, *, as_json: bool) -> int:
    """Print the checks; return 0 without a failure, else 1.

    Raises
    ------
    ConfigError
        The fleet file is wrong.
    """
    config = None if fleet is None else load_swarm(fleet, ())
    checks = []
    for check in _checks(config):
        checks.append(check)
        if not as_json:
            output.data(_line(check))
    failed = sum(each.status == "failure" for each in checks)
    if as_json:
        output.data_json({"ok": not failed, "checks": [asdict(each) for each in checks]})
    else:
        warned = sum(each.status == "warning" for each in checks)
        output.progress(f"{len(checks)} checks: {failed} failures, {warned} warnings")
    return 1 if failed else 0


def _line(check: Check) -> str:
    text = f"{check.status:8} {check.name}: {check.what}"
    return f"{text}\n{'':8} mend it: {check.mend}" if check.mend else text


def _checks(config: SwarmConfig | None) -> Iterator[Check]:
    clock = MonotonicClock()
    began_s, began_wall_s = clock.now_s(), wall_time_s()
    yield machine.python()
    yield from machine.extras(_needed_extras(config))
    yield from machine.serial_ports()
    yield machine.interferer()
    yield from machine.resources()
    yield machine.network_time()
    if config is not None:
        yield _hub(config)
        for robot in config.robot:
            yield from _robot(config, robot)
    # Compared over all the checks before: no need to wait just for this.
    yield machine.clocks(clock.now_s() - began_s, wall_time_s() - began_wall_s, wall_time_s())


def _needed_extras(config: SwarmConfig | None) -> frozenset[str]:
    if config is None:
        return frozenset()
    needed = {_EXTRA_OF[family] for each in config.robot if (family := _family(each.url)) in _EXTRA_OF}
    emulated = {"rover": "mavlink", "odrive": "can", "vesc": "can"}
    needed |= {emulated[each.emulate] for each in config.robot if each.emulate in emulated}
    if any(each.emulate for each in config.robot):
        needed.add("sim")
    if config.agent.estimator == "ekf":
        needed.add("estimation")
    return frozenset(needed)


def _family(url: str) -> str:
    return urlsplit(url).scheme.partition("+")[0]


def _hub(config: SwarmConfig) -> Check:
    from fullswarm.bus.endpoint import host_of, is_loopback
    from fullswarm.bus.zenoh_bus import ZenohBus
    from fullswarm.runtime import Mailbox

    endpoint = config.hub.endpoint
    bus = ZenohBus(Mailbox(), hub=endpoint)
    try:
        bus.wait_connected(HUB_S)
    except Unreachable as error:
        if is_loopback(host_of(endpoint)):
            what = f"nobody listens on {endpoint}: fine until the swarm is started"
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
        yield Check(name, "ok", f"emulated by the world: {robot.emulate}")
        return
    try:
        driver = registry.driver_class(url)(url)  # touches nothing, but refuses a wrong URL
        warning = getattr(driver, "warning", "")
        if warning:
            yield Check(name, "warning", warning)
        if _family(url) in ("sim", "null"):
            yield Check(name, "ok", f"simulated: {url}")
            return
        device = list(_device(config, robot))
        yield from device
        if all(each.status != "failure" for each in device):
            yield from _answer(name, url)
    except FullswarmError as error:
        yield Check(name, "failure", error.what, error.hint)


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
    yield machine.access(path)


def _answer(name: str, url: str) -> Iterator[Check]:
    from fullswarm.drivers.probe import ask

    asked = ask.ask_url(url)
    if not asked.robots:
        held = "held by" in asked.problem
        mend = "" if held else "fullswarm robots find"
        yield Check(name, "warning" if held else "failure", f"not asked: {asked.problem}", mend)
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
