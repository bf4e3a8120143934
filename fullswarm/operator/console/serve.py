"""Runs the console: binds, prints its address, serves until told to end. One thread: asyncio's, which serves the nodes.

Imports nothing of the extra ``[console]`` before :func:`serve`, which names it when it is missing.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import ipaddress
import json
import os
import secrets
import signal
import socket
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from fullswarm import __version__, output
from fullswarm.bus.base import OPERATOR, NamedBus
from fullswarm.bus.endpoint import is_loopback
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock, wall_time_s
from fullswarm.config import DEFAULT_HUB
from fullswarm.errors import ConfigError, MissingExtra, Unreachable
from fullswarm.keys import Keys
from fullswarm.operator.session import Target
from fullswarm.runtime import Runtime, Scheduler

if TYPE_CHECKING:
    import uvicorn

DEFAULT_LISTEN = "127.0.0.1:8807"
TOKEN = "FULLSWARM_CONSOLE_TOKEN"  # noqa: S105  (the name of a variable)
LEAST_TOKEN = 16
DEAD_LINK_MS = 10_000
OUTSIDE = {"0.0.0.0": (socket.AF_INET, "192.0.2.1"), "::": (socket.AF_INET6, "2001:db8::1")}  # noqa: S104  (compared)
"""For each way to listen everywhere: a remote address that is assigned to no host."""

Guest = Callable[[Scheduler, Callable[[], None]], None]
"""Gets the scheduler and how to end; launch brings the check whether its parent still lives."""


@dataclass(frozen=True, slots=True)
class Options:
    """How to serve."""

    listen: str = DEFAULT_LISTEN
    read_only: bool = False
    allow_hosts: tuple[str, ...] = ()
    token_file: Path | None = None
    open_browser: bool = False
    insecure_network: bool = False
    as_json: bool = False
    icons: Mapping[str, tuple[str, str]] = field(default_factory=dict)  # URL scheme → outline and letter of its make


def serve(target: Target, options: Options, guest: Guest | None = None) -> int:
    """Serve the console until Ctrl-C or SIGTERM; print its address with the token.

    Raises
    ------
    MissingExtra
        The extra ``[console]`` is not installed.
    ConfigError
        The address is malformed, or open to the network without permission; a token too short.
    Unreachable
        The address is taken.
    """
    try:
        for name in ("starlette", "uvicorn", "websockets"):
            importlib.import_module(name)
    except ImportError as error:
        raise MissingExtra(f"the console needs {error.name}", hint="pip install 'fullswarm[console]'") from error
    output.log_to_stderr(warnings_only=True)
    host, port = parse_listen(options.listen, options.insecure_network)
    token = read_token(options.token_file)
    keys = Keys(target.swarm)
    with contextlib.closing(_bind(host, port, options.listen)) as listener:
        return asyncio.run(_serve(listener, host, token, keys, target, options, guest))


def parse_listen(text: str, insecure_network: bool) -> tuple[str, int]:
    """Return host and port of ``127.0.0.1:8807``, ``[::1]:8807`` or ``:0``.

    Raises
    ------
    ConfigError
        Not of that form, or open to the network although `insecure_network` is False.
    """
    host, colon, port = text.rpartition(":")
    bare = host.removeprefix("[").removesuffix("]") or "127.0.0.1"
    if not colon or not port.isdecimal() or int(port) > 65535 or (":" in bare and not host.startswith("[")):
        raise ConfigError(f"'{text}' is no address", where="--listen", hint=f"write HOST:PORT, like {DEFAULT_LISTEN}")
    if not is_loopback(bare) and not insecure_network:
        raise ConfigError(
            "this address is open to the network, and the console speaks plain HTTP: a listener there can read the "
            "token and drive the robots",
            where=f"--listen {text}",
            hint=f"use {DEFAULT_LISTEN} and an SSH tunnel, or allow it with --insecure-network on a network that you "
            "trust",
        )
    return bare, int(port)


def read_token(path: Path | None) -> str:
    """Return the token of the file, else of the environment, else a fresh one of 192 bits.

    Raises
    ------
    ConfigError
        The file cannot be read, or the token is too short to be one.
    """
    where, token = TOKEN, os.environ.get(TOKEN, "")
    if path is not None:
        where = str(path)
        try:
            token = path.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"the token cannot be read: {error}", where=where) from error
    elif not token:
        return secrets.token_urlsafe(24)
    if len(token) < LEAST_TOKEN or not token.isascii() or not token.isprintable() or set(token) & set(' #"&%'):
        raise ConfigError(
            f"a token has at least {LEAST_TOKEN} letters and digits",
            where=where,
            hint="python3 -c 'import secrets; print(secrets.token_urlsafe(24))' makes one",
        )
    return token


def _bind(host: str, port: int, listen: str) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # A page that takes nothing more and does not say so: the system ends its connection, ours is then over too.
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, DEAD_LINK_MS)
        listener.bind((host, port))
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        hint = "is another console running? --listen 127.0.0.1:0 takes any free port"
        raise Unreachable(f"cannot listen: {error.strerror or error}", where=listen, hint=hint) from error
    return listener


async def _serve(
    listener: socket.socket, host: str, token: str, keys: Keys, target: Target, options: Options, guest: Guest | None
) -> int:
    from fullswarm.operator.console.connections import uvicorn_server
    from fullswarm.operator.console.gateway import Gateway, Identity
    from fullswarm.operator.console.guard import Names, lower
    from fullswarm.operator.console.pages import Pages
    from fullswarm.operator.console.pump import Pump
    from fullswarm.operator.console.server import Web

    loop = asyncio.get_running_loop()
    runtime = Runtime(MonotonicClock())
    port = listener.getsockname()[1]
    failed: list[BaseException] = []
    stack = contextlib.ExitStack()
    bus = ZenohBus(runtime.mailbox, hub=target.hub or DEFAULT_HUB)
    try:
        process = f"console@{socket.gethostname()}:{os.getpid()}"
        identity = Identity(socket.gethostname(), process, __version__, options.read_only, options.icons)
        gateway = Gateway(NamedBus(bus, OPERATOR), keys, runtime, identity, wall_time_s)
        names = Names(host, port, lower(options.allow_hosts))

        def fail(error: BaseException) -> None:
            failed.append(error)
            server.should_exit = True

        pump = Pump(runtime, loop, fail)
        web = Web(gateway, token, runtime.now_s, pump.poke)
        server = uvicorn_server(web.app(names, Pages()))
        ended_by = _end_on_signals(loop, server)
        if guest is not None:
            guest(runtime, lambda: setattr(server, "should_exit", True))
        pump.poke()
        loop.call_soon(_announce, address := url(host, port, token, options.allow_hosts), options)
        if options.open_browser:
            loop.call_soon(_open, address, loop, stack)
        await server.serve([listener])
        gateway.close()
        pump.close()
    finally:
        stack.close()
        bus.close()
    if failed:
        raise failed[0]
    return output.INTERRUPTED if signal.SIGINT in ended_by else 0


def _end_on_signals(loop: asyncio.AbstractEventLoop, server: uvicorn.Server) -> list[int]:
    """End the server in order on the first signal, at once on the second; return the list of those that came."""
    came: list[int] = []

    def on_signal(number: int) -> None:
        if came:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
        came.append(number)
        server.should_exit = True

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, on_signal, number)
    return came


def url(host: str, port: int, token: str, allow_hosts: Iterable[str] = ()) -> str:
    """Return the page's address, by a name that the guard lets in; what stands behind # never leaves the browser."""
    called = _called(host, [name.strip() for name in allow_hosts if name.strip()])
    if _is_ipv6(called):
        called = f"[{called}]:{port}"
    elif ":" not in called:  # else it was allowed with a port of its own
        called = f"{called}:{port}"
    return f"http://{called}/#token={token}"


def _called(host: str, allowed: list[str]) -> str:
    """Return the name by which others reach what listens on `host`."""
    if host not in OUTSIDE:
        return host
    if allowed:
        return min(allowed, key=lambda name: ":" in name)  # one with a port of its own is likely a proxy's
    return own_address(host)


def own_address(everywhere: str) -> str:
    """Return an address of this machine for others, or its own for itself when it has none.

    Parameters
    ----------
    everywhere
        ``0.0.0.0`` or ``::``.
    """
    family, far = OUTSIDE[everywhere]
    with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as asking:
        asking.connect((far, 9))  # sends nothing: the system only chooses from which address it would
        address = ipaddress.ip_address(asking.getsockname()[0])
        if address.version == 4 or not address.is_link_local:  # a browser takes no fe80::1%eth0
            return str(address)
    return "127.0.0.1" if family == socket.AF_INET else "::1"


def _is_ipv6(name: str) -> bool:
    try:
        return ipaddress.ip_address(name).version == 6
    except ValueError:
        return False


def _announce(address: str, options: Options) -> None:
    if options.as_json:
        output.data(json.dumps({"url": address}))
    else:
        output.data(address)
        output.progress("open this address in a browser; Ctrl-C ends")
    sys.stdout.flush()


def _open(address: str, loop: asyncio.AbstractEventLoop, stack: contextlib.ExitStack) -> None:
    from fullswarm.operator.console.door import OPEN_S, Door

    door = Door(address)
    stack.callback(door.close)
    loop.call_later(OPEN_S, door.close)
    if not door.open():
        output.progress("no browser could be started here")
