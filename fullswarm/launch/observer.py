"""Serves what an observer of a swarm receives to programs that connect by HTTP or WebSocket: viewers, Prometheus.

The observer's certificate has the role ``observer``, which may send nothing but the request for its own renewal. All
runs on asyncio's thread, which also serves the nodes, as in the web console: a slow client waits by itself.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import signal
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fullswarm import output
from fullswarm.bus.endpoint import DEFAULT_HUB, credentials_at, is_loopback
from fullswarm.bus.renewal import renew_later
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.errors import MissingExtra
from fullswarm.heap import settle
from fullswarm.keys import Keys
from fullswarm.launch.nodes import Node
from fullswarm.operator.console.serve import OUTSIDE, RuntimeLoop, bind, end_on_signals, own_address, parse_listen
from fullswarm.operator.session import CONNECT_S, Target
from fullswarm.runtime import Runtime

if TYPE_CHECKING:
    from starlette.applications import Starlette


@dataclass(frozen=True, slots=True)
class Address:
    """Where a server listens.

    Parameters
    ----------
    host, port : as bound; never port 0
    """

    host: str
    port: int

    @property
    def local(self) -> bool:
        """Whether only this machine reaches it."""
        return is_loopback(self.host)

    @property
    def shown(self) -> str:
        """``host:port`` as other programs name it; a wildcard becomes an address of this machine."""
        host = own_address(self.host) if self.host in OUTSIDE else self.host
        return f"[{host}]:{self.port}" if ":" in host else f"{host}:{self.port}"


@dataclass(frozen=True, slots=True)
class Connection:
    """What the nodes of an observer get."""

    bus: ZenohBus
    keys: Keys
    runtime: Runtime
    address: Address


Build = Callable[[Connection], tuple["Starlette", Sequence[Node]]]


def need(modules: Sequence[str], what: str, extra: str) -> None:
    """Raise `MissingExtra` where one of the modules is not installed."""
    for name in modules:
        if importlib.util.find_spec(name) is None:
            raise MissingExtra(f"{what} needs {name}", hint=f"pip install 'fullswarm[{extra}]'")


def serve(
    target: Target, name: str, listen: str, build: Build, on_start: Callable[[Address], None], *, wait: bool
) -> int:
    """Serve until Ctrl-C or SIGTERM; return the exit code.

    Parameters
    ----------
    name
        Of its certificate, where the hub is secured.
    listen
        ``HOST:PORT``; port 0: any free one.
    build
        Makes the application and the nodes, which are closed at the end, the last one first.
    on_start
        Called once it listens.
    wait
        Whether the hub must answer at the start; later it may come and go.

    Raises
    ------
    ConfigError
        The address is malformed, or the hub is secured and there is no certificate.
    Unreachable
        The address is in use; no hub answers.
    """
    host, port = parse_listen(listen, insecure_network=True)
    hint = "is it running already? port 0 takes any free port"
    with contextlib.closing(bind(host, port, f"--listen {listen}", hint)) as listener:
        runtime = Runtime(MonotonicClock())
        hub = target.hub or DEFAULT_HUB
        credentials = credentials_at(hub, target.swarm, name, "observer")
        keys = Keys(target.swarm)
        bus = ZenohBus(runtime.mailbox, hub=hub, credentials=credentials)
        try:
            if wait:
                bus.wait_connected(CONNECT_S)
            renew_later(bus, runtime, keys, credentials)
            address = Address(host, listener.getsockname()[1])
            app, nodes = build(Connection(bus, keys, runtime, address))
            return asyncio.run(_serve(runtime, app, nodes, lambda: on_start(address), listener))
        finally:
            bus.close()


async def _serve(
    runtime: Runtime, app: Starlette, nodes: Sequence[Node], on_start: Callable[[], None], listener: socket.socket
) -> int:
    from fullswarm.operator.console.access import uvicorn_server

    loop = asyncio.get_running_loop()
    failed: list[BaseException] = []

    def fail(error: BaseException) -> None:
        failed.append(error)
        server.should_exit = True

    runtime_loop = RuntimeLoop(runtime, loop, fail)
    server = uvicorn_server(app)
    ended_by = end_on_signals(loop, server)
    loop.call_soon(on_start)
    loop.call_soon(runtime_loop.wake)
    settle(runtime)
    try:
        await server.serve([listener])
    finally:
        for node in reversed(nodes):
            node.close()
        runtime_loop.close()
    if failed:
        raise failed[0]
    return output.INTERRUPTED if signal.SIGINT in ended_by else 0
