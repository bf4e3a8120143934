"""Serves one process: hub, core, centralised behaviours, agent or world; until Ctrl-C, SIGTERM or its parent's end."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import platformdirs
import structlog

from fullswarm import registry
from fullswarm.bus.base import CENTRALISED, CORE, WORLD, Bus, SenderBus
from fullswarm.bus.endpoint import credentials_at, host_of, is_loopback, is_secured
from fullswarm.clock import MonotonicClock, clock_id
from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.drivers.fleet_file import check_frames, in_frame
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.heap import settle
from fullswarm.identity import Role
from fullswarm.keys import Keys
from fullswarm.launch.liveness import report_alive
from fullswarm.launch.nodes import Node, process_id
from fullswarm.output import INTERRUPTED
from fullswarm.runtime import Mailbox, Runtime

if TYPE_CHECKING:
    from fullswarm.bus.hub import Hub
    from fullswarm.drivers.ranges import RangeSensor

RUN = "FULLSWARM_RUN"
"""Folder of the `up` or `demo` that started this process; it ends with the run, as its simulated bodies do."""
STATE = "FULLSWARM_STATE"
"""Folder for what must survive every process and a power cut; default: the user's state folder."""
log = structlog.get_logger()

PARENT_CHECK_S = 0.25
GRANTS_CHECK_S = 0.5
"""How often a hub looks whether its list of valid certificates has changed."""
ROLE_OF: dict[str, Role] = {CORE: "core", CENTRALISED: "centralised", WORLD: "world"}
PARENT = "FULLSWARM_PARENT"
"""Process id of the parent. Asking the system would come too late: the parent may die while this process imports."""


def latch_folder(config: SwarmConfig, robot: RobotConfig) -> Path:
    """Return the folder for the latch of `robot`: a latch lasts as long as the body that it stops."""
    run = os.environ.get(RUN, "")
    if robot.simulated and run:
        return Path(run) / "estop"
    folder = state_folder() / "estop" / config.swarm
    if not robot.simulated:
        return folder
    return folder / re.sub(r"[^A-Za-z0-9.-]", "_", config.world_or_default.address)


def state_folder() -> Path:
    """Return the folder for what must survive every process and a power cut."""
    state = os.environ.get(STATE, "")
    return Path(state) if state else platformdirs.user_state_path("fullswarm")


def audit_folder(config: SwarmConfig) -> Path:
    """Return the folder for the audit log of a core."""
    from fullswarm.audit.log import unlocked

    core, run = config.core, os.environ.get(RUN, "")
    if core.audit is not None:
        return core.audit
    if core.store is not None and not (run and core.store.is_relative_to(run)):
        return core.store.with_name(f"{core.store.stem}-audit")
    return Path(run) / "audit" if run else unlocked(usual_audit_folder(config.swarm))


def usual_audit_folder(swarm: str) -> Path:
    """Return where the audit log of a swarm is unless its fleet file says otherwise."""
    return state_folder() / "audit" / swarm


def newest_audit_folder(swarm: str) -> Path:
    """Return the audit log of a swarm's core on this machine: of several the one that was written last."""
    usual = usual_audit_folder(swarm)
    found = [usual, *usual.parent.glob(f"{usual.name}-[0-9]*")]
    return max(found, key=_written_s)


def _written_s(folder: Path) -> float:
    return max((path.stat().st_mtime for path in folder.glob("*.jsonl")), default=0.0)


def hub(endpoint: str, swarm: str, insecure_network: bool, with_parent: bool) -> int:
    """Serve as the hub at a zenoh endpoint such as ``tcp/127.0.0.1:7447`` or ``tls/10.0.0.2:7447``."""
    from fullswarm.output import progress

    runtime = Runtime(MonotonicClock())
    if is_secured(endpoint):
        return _secured_hub(runtime, endpoint, swarm, with_parent)
    with hub_at(endpoint, swarm, insecure_network):
        progress(f"hub: listening at {endpoint}")
        if insecure_network and is_loopback(host_of(endpoint)):
            progress("only this machine reaches it; for others: --listen tcp/ADDRESS:7447, an address of this machine")
        return serve(runtime, [], with_parent)


def hub_at(endpoint: str, swarm: str, insecure_network: bool) -> Hub:
    """Return the hub of a swarm, not open yet; a secured one with its certificate and the list of valid ones.

    Raises
    ------
    ConfigError
        The address is open to the network without certificates, or a secured one and the hub's files are not there.
    """
    from fullswarm.bus.hub import Hub
    from fullswarm.identity import read_grants
    from fullswarm.identity.folder import grants_file

    credentials = credentials_at(endpoint, swarm, "hub", "hub")
    grants = () if credentials is None else read_grants(grants_file(swarm))
    return Hub(endpoint, insecure_network=insecure_network, credentials=credentials, swarm=swarm, grants=grants)


def _secured_hub(runtime: Runtime, endpoint: str, swarm: str, with_parent: bool) -> int:
    """Serve as a secured hub: follow the list of valid certificates and the own certificate, log what is refused."""
    from fullswarm.bus.refusals import REPORT_S, RefusalLog
    from fullswarm.identity import read_grants
    from fullswarm.identity.folder import credentials_for, grants_file
    from fullswarm.output import progress

    listed = grants_file(swarm)
    followed = (listed, credentials_for(swarm, "hub", "hub").certificate)
    seen = contents(followed)
    hub = hub_at(endpoint, swarm, insecure_network=False)

    def follow() -> None:
        nonlocal seen
        now = contents(followed)
        if now == seen:
            return
        seen = now
        try:
            grants = read_grants(listed)
        except ConfigError as error:
            log.error("the list of valid certificates is not used; the one before stays valid", reason=str(error))
            return
        hub.reopen(grants)
        log.info("the list of valid certificates has changed", certificates=len(grants))

    refusals = RefusalLog(runtime.now_s)
    refusals.start()
    try:
        with hub:
            progress(f"hub: listening at {endpoint}, for the valid certificates of swarm '{swarm}'")
            runtime.every(GRANTS_CHECK_S, follow)
            runtime.every(REPORT_S, refusals.report)
            return serve(runtime, [], with_parent)
    finally:
        refusals.close()


def contents(paths: Iterable[Path]) -> tuple[bytes | None, ...]:
    """Return the contents of files; None: it cannot be read."""
    return tuple(_content(path) for path in paths)


def _content(path: Path) -> bytes | None:
    try:
        return path.read_bytes()
    except OSError:
        return None


def core(config: SwarmConfig, with_parent: bool) -> int:
    """Serve as the core."""
    from fullswarm.core.settings import record_seeds
    from fullswarm.launch import journals, nodes, reload
    from fullswarm.store import Store

    def build(bus: SenderBus, runtime: Runtime) -> list[Node]:
        process, audit = process_id(CORE), audit_folder(config)
        store = Store(config.core.store)
        live = journals.begin_live(
            runtime, process, lambda: journals.core_head(config, process, store, audit, watch=True)
        )
        journal = live.journal if live else None
        given = journals.given(bus, runtime, journal)
        store.wall_s = given.wall_s

        def make() -> list[Node]:
            return nodes.core_process(
                given.bus, given.scheduler, config, process, given.wall_s, audit=audit, store=store, watch=True
            )

        built = [*([live] if live else []), *journals.built(make, journal)]
        if reload.wanted():
            report = reload.reporter(bus, Keys(config.swarm), CORE)
            built.append(reload.RecordReloader(runtime, lambda: store.seed(record_seeds()), report))
        return built

    return serve_on_bus(config, with_parent, build, CORE)


def centralised(config: SwarmConfig, with_parent: bool) -> int:
    """Serve the centralised behaviours."""
    from fullswarm.core.centralised.node import CentralisedNode
    from fullswarm.launch import journals, nodes, reload

    def build(bus: SenderBus, runtime: Runtime) -> list[Node]:
        process = process_id(CENTRALISED)
        live = journals.begin_live(runtime, process, lambda: journals.head_of(CENTRALISED, process, config, watch=True))
        journal = live.journal if live else None
        given = journals.given(bus, runtime, journal)
        found: list[Node] = []

        def make() -> list[Node]:
            found.extend(nodes.centralised_process(given.bus, given.scheduler, config, process, watch=True))
            return found

        built = [*([live] if live else []), *journals.built(make, journal)]
        if reload.wanted():
            report = reload.reporter(bus, Keys(config.swarm), CENTRALISED)
            node = next(each for each in found if isinstance(each, CentralisedNode))
            built.append(reload.LawReloader(runtime, node, lambda: registry.loaded(registry.CENTRALISED_GROUP), report))
        return built

    return serve_on_bus(config, with_parent, build, CENTRALISED)


def agent(
    config: SwarmConfig,
    robot: str,
    with_parent: bool,
    sensors: Callable[[Bus, Runtime], Iterable[Node]] = lambda _bus, _runtime: (),
) -> int:
    """Serve as the agent of one robot.

    Parameters
    ----------
    sensors
        Makes the nodes that read sensors on board which the driver does not have, such as a GNSS receiver.
    """
    from fullswarm.agent.node import AgentNode
    from fullswarm.agent.orders.tasks import read_records_again
    from fullswarm.agent.state import Identity
    from fullswarm.drivers.fleet import OneRobot
    from fullswarm.drivers.guardian import guarded
    from fullswarm.launch import journals, nodes, reload
    from fullswarm.launch.on_board import OnBoard

    entry = _entry(config, robot)
    check_frames(config, (entry,))
    url = driver_url(config, entry)
    fleet = OneRobot(robot, guarded(registry.driver_class(url)(url)), sensor=_range_sensor(entry))

    def build(bus: SenderBus, runtime: Runtime) -> list[Node]:
        process, latches, clock = process_id(robot), latch_folder(config, entry), clock_id()
        board = OnBoard.from_environment(runtime, config.agent)
        given = nodes.AgentPorts(bus, board or runtime, fleet, runtime.stats)
        live = journals.begin_live(
            runtime, process, lambda: journals.agent_head(config, fleet, robot, process, latches, clock)
        )
        journal = live.journal if live else None
        if journal:
            given = journals.noted(given, journal)
        found: list[Node] = []

        def make() -> list[Node]:
            found.extend(nodes.agent_process(given, config, Identity(robot, process), latches, clock))
            return found

        built = [*([live] if live else []), *journals.built(make, journal)]
        node = next(each for each in found if isinstance(each, AgentNode))
        more = list(sensors(bus, runtime))
        if board:
            return [*built, board.watch(node), *more]
        if reload.wanted():
            report = reload.reporter(bus, Keys(config.swarm), robot)
            built.append(
                reload.LawReloader(
                    runtime, reload.RobotsOf(node), lambda: registry.loaded(registry.BEHAVIOUR_GROUP), report
                )
            )
            built.append(reload.RecordReloader(runtime, read_records_again, report))
        return [*built, *more]

    return serve_on_bus(config, with_parent, build, robot)


def _range_sensor(entry: RobotConfig) -> RangeSensor | None:
    """Return the range sensor that the fleet file gives the robot beside its driver."""
    if not entry.ranges:
        return None
    from fullswarm.drivers.ranges import sensor_of

    return sensor_of(entry.ranges)


def world(config: SwarmConfig, insecure_network: bool, with_parent: bool) -> int:
    """Serve the simulated world on its UDP port, in real time."""
    from fullswarm.launch.world import WorldNode, compile_kernels

    compile_kernels(config)

    def build(bus: Bus, runtime: Runtime) -> list[Node]:
        node = WorldNode(bus, runtime, config, process_id("world"), insecure_network)
        return [node, node.supervise(config.bounds_m, config.performance.coverage_cell_m)]

    return serve_on_bus(config, with_parent, build, WORLD)


def driver_url(config: SwarmConfig, robot: RobotConfig) -> str:
    """Return the URL of a robot's driver; a simulated one gets the world's address unless it names its own."""
    if robot.emulate:
        from fullswarm.launch.network import emulated_url

        return emulated_url(config, robot)
    url = urlsplit(robot.url)
    if url.scheme != "sim" or url.path.strip("/"):
        return in_frame(robot.url, config.origin_deg)
    from fullswarm.drivers.sim.settings import url_for

    return url_for(config.world_or_default, url.netloc or robot.id, config.agent.sensing_radius_m)


def _entry(config: SwarmConfig, robot: str) -> RobotConfig:
    for each in config.robot:
        if each.id == robot:
            return each
    raise ConfigError(f"the fleet file has no robot '{robot}'", hint=did_you_mean(robot, config.robots))


def serve_on_bus(
    config: SwarmConfig,
    with_parent: bool,
    build: Callable[[SenderBus, Runtime], Iterable[Node]],
    name: str,
    identity: tuple[str, Role] | None = None,
) -> int:
    """Serve the nodes that `build` makes, on the fleet's bus and the machine's clock; return the exit code.

    Parameters
    ----------
    name
        What a partition of the fleet's network calls this process.
    identity
        Name and role of its certificate; None: `name`, and the role of that name, else ``robot``.
    """
    from fullswarm.bus.zenoh_bus import ZenohBus
    from fullswarm.launch.network import on_network

    mailbox = Mailbox()
    runtime = Runtime(MonotonicClock(), mailbox)
    own, role = identity or (name, ROLE_OF.get(name, "robot"))
    endpoint = config.hub.endpoint
    credentials = credentials_at(endpoint, config.swarm, own, role)
    bus = ZenohBus(mailbox, hub=endpoint, credentials=credentials)
    try:
        shown = on_network(bus, runtime, config, name)
        nodes = list(build(shown, runtime))
        if credentials is not None:
            from fullswarm.bus.renewal import renewal_node

            renewal = renewal_node(shown, runtime, Keys(config.swarm), credentials)
            nodes += [] if renewal is None else [renewal]
        return serve(runtime, nodes, with_parent)
    finally:
        bus.close()


def serve(runtime: Runtime, nodes: Iterable[Node], with_parent: bool) -> int:
    """Run until a signal or the parent's end; then close the nodes, the last one first."""
    runtime.stop_on_signals()
    if with_parent:
        parent = int(os.environ.get(PARENT) or os.getppid())

        def leave_with_parent() -> None:
            if os.getppid() != parent:
                runtime.stop()

        runtime.every(PARENT_CHECK_S, leave_with_parent)
        report_alive(runtime)
    settle(runtime)
    try:
        runtime.run()
    finally:
        for node in reversed(list(nodes)):
            node.close()
    return INTERRUPTED if runtime.exit_signal == signal.SIGINT else 0
