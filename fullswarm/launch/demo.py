"""`fullswarm demo`: a whole swarm on this machine, live or in lockstep, with a table and a summary."""

from __future__ import annotations

import itertools
import json
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit

from rich.console import Console
from rich.live import Live

from fullswarm.bus.endpoint import host_of
from fullswarm.bus.senders import OPERATOR
from fullswarm.clock import MonotonicClock
from fullswarm.config import RobotConfig, SwarmConfig, load_swarm
from fullswarm.errors import Unreachable
from fullswarm.keys import Keys
from fullswarm.launch.network import on_network, with_network
from fullswarm.launch.show import Show, acts_for
from fullswarm.launch.summary import print_summary
from fullswarm.operator.client import Operator
from fullswarm.operator.render import fleet_table
from fullswarm.runtime import Mailbox, Runtime

DEMO_FILE = Path(__file__).with_name("demo.toml")
NAMED = {"mixed": Path(__file__).with_name("mixed.toml")}
"""Fleets that come with the package, besides the usual one."""
START_TIMEOUT_S = 60.0
REFRESH_S = 0.2
POLL_S = 0.1


def demo_config(fleet: Path | None, overrides: tuple[str, ...], network: str | None = None) -> SwarmConfig:
    """Return the demo's settings, or those of the user's own fleet file, on a bad network if one is wanted."""
    named = NAMED.get(str(fleet)) if fleet is not None and not fleet.exists() else None
    return with_network(load_swarm(named or fleet or DEMO_FILE, overrides), network)


def run_lockstep(config: SwarmConfig, seconds: float, seed: int, as_json: bool) -> int:
    """Run the show on a simulated clock; the JSON of two runs with one seed is the same to the byte."""
    from fullswarm.launch.lockstep import Lockstep

    if any(robot.emulate for robot in config.robot):
        _say("in lockstep emulated robots run as simulated ones: ports and firmware live on the wall clock")
    world = config.world_or_default.model_copy(update={"seed": seed})
    section = config.network.model_copy(update={"seed": seed})
    lockstep = Lockstep(config.model_copy(update={"world": world, "network": section}))
    bus = lockstep.bus_of(OPERATOR)
    numbers = itertools.count(1)
    keys = Keys(config.swarm)
    operator = Operator(bus, keys, lockstep.runtime, "demo", new_id=lambda: f"demo-{seed}-{next(numbers)}")
    show = Show(bus, lockstep.runtime, config, operator, seconds, acts_for(config))
    try:
        lockstep.run(1.0)
        show.start()
        lockstep.run(seconds)
        # A wall-clock figure would make two runs differ, so it goes to stderr.
        print(f"{lockstep.real_time_factor:.0f} times faster than real time", file=sys.stderr)  # noqa: T201
        return _report(show, as_json, None)
    finally:
        lockstep.close()


def run_live(config: SwarmConfig, seconds: float, as_json: bool, headless: bool) -> int:
    """Run the show with one process per robot, in real time."""
    from fullswarm.bus.zenoh_bus import ZenohBus
    from fullswarm.launch.supervisor import Supervisor

    config = on_free_ports(config)
    mailbox = Mailbox()
    runtime = Runtime(MonotonicClock(), mailbox)
    runtime.stop_on_signals()
    supervisor = Supervisor(config, runtime)
    bus = on_network(ZenohBus(mailbox, hub=config.hub.endpoint), runtime, supervisor.config, OPERATOR)
    keys = Keys(config.swarm)
    operator = Operator(bus, keys, runtime, "demo")
    show = Show(bus, runtime, config, operator, seconds, acts_for(config))
    try:
        _say(
            f"starting {len(config.robots)} robots, the core and the world; logs in {supervisor.folder}\n"
            f"from another terminal: FULLSWARM_HUB={config.hub.endpoint} fullswarm watch"
        )
        if config.network.conditions is not None:
            _say(f"on a bad network: {config.network.conditions}; times of a partition count from now")
        supervisor.start()
        _run_until(runtime, show.ready, START_TIMEOUT_S)
        if runtime.exit_signal is None and not show.ready():
            raise Unreachable(
                f"the swarm was not ready within {START_TIMEOUT_S:.0f} s", where=str(supervisor.folder),
                hint="the logs there say why",
            )  # fmt: skip
        if runtime.exit_signal is None:
            show.start()
            _watch(runtime, show, seconds, headless)
        if runtime.exit_signal is not None:
            return 130
        return _report(show, as_json, show.real_time_factor())
    finally:
        operator.close()
        supervisor.close()
        bus.close()


def on_free_ports(config: SwarmConfig) -> SwarmConfig:
    """Give hub and world other loopback ports where theirs are taken, so that a demo never disturbs a swarm."""
    from fullswarm.drivers.sim.protocol import parse_address

    world = config.world_or_default
    host_of(config.hub.endpoint)
    port = _free_port(socket.SOCK_STREAM, int(config.hub.endpoint.rpartition(":")[2]))
    world_port = _free_port(socket.SOCK_DGRAM, parse_address(world.address, where="world.address")[1])
    free = config.model_copy(
        update={
            "hub": config.hub.model_copy(update={"endpoint": f"tcp/127.0.0.1:{port}"}),
            "world": world.model_copy(update={"address": f"127.0.0.1:{world_port}"}),
        }
    )
    return free.model_copy(update={"robot": tuple(_on_free_port(free, each) for each in free.robot)})


def _on_free_port(config: SwarmConfig, robot: RobotConfig) -> RobotConfig:
    """Write the driver of an emulated robot down, a rover's with a UDP port that is free."""
    from fullswarm.drivers import emulated

    if not robot.emulate or robot.driver:
        return robot
    url = emulated.driver_url(config, robot)
    port = urlsplit(url).port
    if port is not None:
        url = url.replace(f":{port}", f":{_free_port(socket.SOCK_DGRAM, port)}", 1)
    return robot.model_copy(update={"driver": url})


def _free_port(kind: socket.SocketKind, wished: int) -> int:
    for port in (wished, 0):
        with socket.socket(socket.AF_INET, kind) as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise Unreachable("this machine has no free port", where="127.0.0.1")


def _run_until(runtime: Runtime, condition: Callable[[], bool], timeout_s: float) -> None:
    deadline_s = runtime.now_s() + timeout_s

    def check() -> None:
        if condition() or runtime.now_s() >= deadline_s:
            timer.cancel()
            runtime.pause()

    timer = runtime.every(POLL_S, check)
    runtime.run()


def _watch(runtime: Runtime, show: Show, seconds: float, headless: bool) -> None:
    if headless:
        _run_until(runtime, lambda: show.done, seconds + 10.0)
        return
    console = Console(stderr=True)
    with Live(fleet_table(show.view.snapshot()), console=console, auto_refresh=False, transient=True) as live:
        timer = runtime.every(REFRESH_S, lambda: live.update(fleet_table(show.view.snapshot()), refresh=True))
        _run_until(runtime, lambda: show.done, seconds + 10.0)
        timer.cancel()


def _report(show: Show, as_json: bool, real_time_factor: float | None) -> int:
    document = show.document(real_time_factor)
    if as_json:
        print(json.dumps(document, indent=2))  # noqa: T201
    else:
        print_summary(document, show.view.snapshot())
    answered = all(each.acknowledged_s is not None for each in show.sent)
    return 0 if answered and len(show.sent) == len(show.acts) else 1


def _say(text: str) -> None:
    print(text, file=sys.stderr)  # noqa: T201
