"""`fullswarm fixes`: poses of capture systems, receivers or radio anchors in, fixes or a recording out."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import structlog

from fullswarm.bus.base import Bus
from fullswarm.clock import MonotonicClock
from fullswarm.config import DEFAULT_HUB, FixesConfig, HubConfig, SwarmConfig
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.identity import Role
from fullswarm.keys import Keys
from fullswarm.localization.publisher import FixPublisher, Names
from fullswarm.localization.schemes import convention_of, open_source
from fullswarm.localization.source import Anchors, Recorder, Settings, SourceNode
from fullswarm.output import INTERRUPTED, progress
from fullswarm.runtime import Mailbox, Runtime

if TYPE_CHECKING:
    from fullswarm.launch.nodes import Node

log = structlog.get_logger()

IDENTITY = "fixes"
"""Name of the certificate with which it connects to a secured hub; its role is ``source``."""
DEFAULT_SOURCE = "json://127.0.0.1:9870"


# ---------------------------------------------------------------- what a fleet file says
def settings_of(config: SwarmConfig, fixes: FixesConfig, insecure_network: bool = False) -> Settings:
    """Return the settings of one source of a fleet file.

    Raises
    ------
    ConfigError
        The map names a robot that the file does not have.
    """
    for robot in (*fixes.map.values(), *((fixes.robot,) if fixes.robot else ())):
        if robot not in config.robots:
            hint = did_you_mean(robot, config.robots)
            raise ConfigError(f"the fleet file has no robot '{robot}'", where="[fixes]", hint=hint)
    return Settings(
        fixes.source,
        Names(dict(fixes.map), dict(fixes.objects)),
        fixes.axes,
        fixes.unit,
        fixes.sigma_m,
        fixes.sigma_rad,
        insecure_network or fixes.insecure_network,
        fixes.robot,
        config.origin_deg,
        anchors_of(config),
    )


def anchors_of(config: SwarmConfig) -> Anchors:
    """Return where a fleet file says that radio anchors are."""
    return Anchors(dict(config.anchors), config.radio_height_m)


def on_board_settings(config: SwarmConfig, robot: str) -> Settings | None:
    """Return the settings of the sensor on board of a robot; None: the fleet file names none."""
    entry = next(each for each in config.robot if each.id == robot)
    if not entry.fixes:
        return None
    return Settings(entry.fixes, robot=robot, origin_deg=config.origin_deg, anchors=anchors_of(config))


# ---------------------------------------------------------------- nodes
def source_node(bus: Bus, runtime: Runtime, keys: Keys, settings: Settings) -> SourceNode:
    """Return the node of a source, started; raises `ConfigError` and `MissingExtra`."""
    convention = convention_of(settings)
    source = open_source(settings, runtime.clock)
    publisher = FixPublisher(bus, runtime, keys, settings.names, sensor=source.sensor)
    for marker, robot in settings.names.robots.items():
        publisher.expect(robot, marker)
    if settings.robot:
        publisher.expect(settings.robot, source.sensor)
    node = SourceNode(source, convention, publisher, runtime, runtime.mailbox, anchors=settings.anchors)
    node.start()
    log.info("listening" if "://" not in source.address else "connecting", source=source.address, sensor=source.sensor)
    return node


def run(config: SwarmConfig, sources: Iterable[Settings], with_parent: bool) -> int:
    """Serve until Ctrl-C, SIGTERM or the death of the process that started this one; return the exit code."""
    from fullswarm.bus.base import WORLD
    from fullswarm.launch.processes import serve_on_bus

    wanted, keys = list(sources), Keys(config.swarm)
    for each in wanted:  # what is wrong is said before anything is opened
        convention_of(each)

    def build(bus: Bus, runtime: Runtime) -> list[Node]:
        return [source_node(bus, runtime, keys, each) for each in wanted]

    identity: tuple[str, Role] = (IDENTITY, "source")
    return serve_on_bus(config, with_parent, build, WORLD, identity)  # where the simulated world stands in simulation


def swarm_at(hub: str | None, swarm: str) -> SwarmConfig:
    """Return the settings of a process that knows no fleet file."""
    return SwarmConfig(swarm=swarm, hub=HubConfig(endpoint=hub or DEFAULT_HUB))


def record(settings: Settings, path: Path, seconds: float) -> int:
    """Write what a source delivers to a file until Ctrl-C or for a time; return 1 if nothing arrived."""
    convention = convention_of(settings)
    runtime = Runtime(MonotonicClock(), Mailbox())
    source = open_source(settings, runtime.clock)
    recorder = Recorder(path, settings.url, convention)
    node = SourceNode(source, convention, None, runtime, runtime.mailbox, recorder=recorder)
    runtime.stop_on_signals()
    node.start()
    progress(f"recording {source.address} to {path}; Ctrl-C ends")
    try:
        runtime.run(seconds if seconds > 0.0 else math.inf)
    finally:
        node.close()
    progress(f"{recorder.frames} frames" + (f"; {node.problem}" if node.problem else ""))
    return 0 if recorder.frames else (INTERRUPTED if runtime.exit_signal else 1)
