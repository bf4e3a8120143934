"""Runs the console: binds, serves until it is ended. One thread: asyncio's, which serves the nodes.

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
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fullswarm import __version__, output
from fullswarm.bus.base import OPERATOR, NamedBus
from fullswarm.bus.endpoint import DEFAULT_HUB, credentials_at, is_loopback
from fullswarm.bus.renewal import renew_later
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock, wall_time_s
from fullswarm.errors import ConfigError, MissingExtra, Unreachable
from fullswarm.heap import settle
from fullswarm.keys import Keys
from fullswarm.operator.console.tokens import Doorkeeper, TokenFile, check_private
from fullswarm.operator.session import Target
from fullswarm.runtime import Runtime, Scheduler

if TYPE_CHECKING:
    import uvicorn

    from fullswarm.operator.console.experiments import ExperimentOptions
    from fullswarm.operator.console.gateway import Gateway
    from fullswarm.operator.console.server import PageSource
    from fullswarm.operator.console.underlay import Underlay
import html
import tempfile
import webbrowser

DEFAULT_LISTEN = "127.0.0.1:8807"
TOKEN = "FULLSWARM_CONSOLE_TOKEN"  # noqa: S105  (the name of a variable)
ANOTHER = "is another console running? --listen 127.0.0.1:0 takes any free port"
LEAST_TOKEN = 16
DEAD_LINK_MS = 10_000
OUTSIDE = {"0.0.0.0": (socket.AF_INET, "192.0.2.1"), "::": (socket.AF_INET6, "2001:db8::1")}  # noqa: S104  (compared)
"""For each wildcard address a remote address that is assigned to no host."""

OnStart = Callable[[str, Scheduler, Callable[[], None]], None]
"""Called when the server starts, with its address, its scheduler and a function that ends it."""


@dataclass(frozen=True, slots=True)
class Options:
    """The options of the server."""

    listen: str = DEFAULT_LISTEN
    read_only: bool = False
    allow_hosts: tuple[str, ...] = ()
    token_file: Path | None = None
    tokens: Path | None = None  # file with the tokens of named operators; None: one token for all
    operator: str = ""  # whose the one token is; empty: each page may state a name
    insecure_network: bool = False
    icons: Mapping[str, tuple[str, str]] = field(default_factory=dict)  # URL scheme → outline and letter of its make
    study: Path | None = None  # folder of a trial of a study
    api: Path | None = None  # file with the tokens of programs; None: no interface for them
    underlay: Path | None = None  # drawn under the map: a plan, a map of ROS, tiles; None: nothing
    recording: Callable[[], Path | None] = lambda: None  # the recording that is made of the swarm now, on this machine
    experiments: ExperimentOptions | None = None  # where experiments are; None: pages are offered none


def serve(
    target: Target, options: Options, on_start: OnStart, recording: Callable[[Scheduler], PageSource[Any]] | None = None
) -> int:
    """Serve the console until Ctrl-C or SIGTERM; return the exit code.

    Parameters
    ----------
    recording : makes what pages are connected to in place of a live swarm; None: the swarm of `target`

    Raises
    ------
    MissingExtra
        The extra ``[console]`` is not installed.
    ConfigError
        The address is malformed, or open to the network without permission; a token too short.
    Unreachable
        The address is in use.
    """
    try:
        for name in ("starlette", "uvicorn", "websockets"):
            importlib.import_module(name)
    except ImportError as error:
        raise MissingExtra(f"the console needs {error.name}", hint="pip install 'fullswarm[console]'") from error
    host, port = parse_listen(options.listen, options.insecure_network)
    token, file = ("", TokenFile(options.tokens)) if options.tokens else (read_token(options.token_file), None)
    if file is not None and not file.tokens():
        hint = "make one: fullswarm console tokens add NAME"
        raise ConfigError("no operator has a token", where=str(options.tokens), hint=hint)
    if options.api is not None:
        TokenFile(options.api).tokens()  # raises what is wrong with the file
    doorkeeper = Doorkeeper(token, wall_time_s, name=options.operator, file=file)
    if options.underlay is not None:
        from fullswarm.operator.console.underlay import read_underlay

        underlay = read_underlay(options.underlay)
    else:
        underlay = None
    keys = Keys(target.swarm)
    with contextlib.closing(bind(host, port, options.listen, ANOTHER)) as listener:
        return asyncio.run(
            _serve(listener, host, (token, doorkeeper), keys, target, options, on_start, recording, underlay)
        )


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
        hint = f"expected HOST:PORT, for example {DEFAULT_LISTEN}"
        raise ConfigError(f"invalid address '{text}'", where="--listen", hint=hint)
    if not is_loopback(bare) and not insecure_network:
        raise ConfigError(
            "this address is open to the network, and the console speaks plain HTTP: everyone there can read the "
            "token and drive the robots",
            where=f"--listen {text}",
            hint=f"use {DEFAULT_LISTEN} and an SSH tunnel, or allow it with --insecure-network on a trusted network",
        )
    return bare, int(port)


def read_token(path: Path | None) -> str:
    """Return the token of the file, else of the environment, else a new one of 192 bits.

    Raises
    ------
    ConfigError
        The file cannot be read, others can read it, or the token is too short.
    """
    where, token = TOKEN, os.environ.get(TOKEN, "")
    if path is not None:
        where = str(path)
        check_private(path)
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


def bind(host: str, port: int, listen: str, hint: str) -> socket.socket:
    """Return a socket that is bound, but does not listen yet.

    Raises
    ------
    Unreachable
        The address is in use, or none of this machine's; with the hint.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # The system closes the connection of a page that takes nothing more without closing it itself.
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux only; elsewhere its own limits are longer
            listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, DEAD_LINK_MS)
        listener.bind((host, port))
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise Unreachable(f"cannot listen: {error.strerror or error}", where=listen, hint=hint) from error
    return listener


async def _serve(
    listener: socket.socket,
    host: str,
    access: tuple[str, Doorkeeper],
    keys: Keys,
    target: Target,
    options: Options,
    on_start: OnStart,
    recording: Callable[[Scheduler], PageSource[Any]] | None,
    underlay: Underlay | None,
) -> int:
    from fullswarm.operator.console.access import Names, lower, uvicorn_server
    from fullswarm.operator.console.api.server import Api
    from fullswarm.operator.console.reports import Reports
    from fullswarm.operator.console.server import Pages, Web

    token, doorkeeper = access
    loop = asyncio.get_running_loop()
    runtime = Runtime(MonotonicClock())
    port = listener.getsockname()[1]
    failed: list[BaseException] = []
    with contextlib.ExitStack() as stack:

        def fail(error: BaseException) -> None:
            failed.append(error)
            server.should_exit = True

        process = f"console@{socket.gethostname()}:{os.getpid()}"
        runtime_loop = RuntimeLoop(runtime, loop, fail)
        shown: PageSource[Any]
        api = reports = None
        if recording is not None:
            shown = recording(runtime)
        else:
            shown = gateway = _gateway(stack, runtime, keys, target, options, process)
            reports = None if gateway.experiments is None else Reports(gateway.experiments)
            if options.api is not None:
                tokens = Doorkeeper("", wall_time_s, file=TokenFile(options.api))
                api = Api(gateway, tokens, runtime.now_s, runtime_loop.wake, process)
        names = Names(host, port, lower(options.allow_hosts))
        web = Web(shown, doorkeeper, runtime.now_s, runtime_loop.wake, underlay)
        more = [each.route() for each in (api, reports) if each is not None]
        server = uvicorn_server(web.app(names, Pages(), *more))
        ended_by = end_on_signals(loop, server)
        address = url(host, port, token, options.allow_hosts)
        loop.call_soon(on_start, address, runtime, lambda: setattr(server, "should_exit", True))
        loop.call_soon(runtime_loop.wake)
        settle(runtime)
        await server.serve([listener])
        if api is not None:
            api.close()
        if reports is not None:
            reports.close()
        shown.close()
        runtime_loop.close()
    if failed:
        raise failed[0]
    return output.INTERRUPTED if signal.SIGINT in ended_by else 0


def _gateway(
    stack: contextlib.ExitStack, runtime: Runtime, keys: Keys, target: Target, options: Options, process: str
) -> Gateway:
    """Return the gateway of a live swarm, whose bus the stack closes."""
    from fullswarm.operator.console.gateway import Gateway, Identity

    hub = target.hub or DEFAULT_HUB
    credentials = credentials_at(hub, target.swarm, "console", "console")
    bus = ZenohBus(runtime.mailbox, hub=hub, credentials=credentials, only_shows=True)
    stack.callback(bus.close)
    renew_later(bus, runtime, keys, credentials)
    identity = Identity(
        socket.gethostname(), process, __version__, options.read_only, options.icons, options.study,
        options.recording, options.experiments,
    )  # fmt: skip
    return Gateway(NamedBus(bus, OPERATOR), keys, runtime, identity, wall_time_s)


def end_on_signals(loop: asyncio.AbstractEventLoop, server: uvicorn.Server) -> list[int]:
    """Shut the server down on the first signal, abort on the second; return the list of signals received."""
    received: list[int] = []

    def on_signal(number: int) -> None:
        if received:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
        received.append(number)
        server.should_exit = True

    for number in (signal.SIGINT, signal.SIGTERM):
        try:
            loop.add_signal_handler(number, on_signal, number)
        except NotImplementedError:  # on Windows, where Python itself carries the signal to its main thread
            signal.signal(number, lambda number, _frame: loop.call_soon_threadsafe(on_signal, number))
    return received


def url(host: str, port: int, token: str, allow_hosts: Iterable[str] = ()) -> str:
    """Return the page's address, by a name that is accepted; the fragment behind # never leaves the browser.

    Without a token each operator puts their own behind it.
    """
    called = _called(host, [name.strip() for name in allow_hosts if name.strip()])
    if _is_ipv6(called):
        called = f"[{called}]:{port}"
    elif ":" not in called:  # else it was allowed with a port of its own
        called = f"{called}:{port}"
    return f"http://{called}/" + (f"#token={token}" if token else "")


def _called(host: str, allowed: list[str]) -> str:
    """Return the name by which other computers reach a server on `host`."""
    if host not in OUTSIDE:
        return host
    if allowed:
        return min(allowed, key=lambda name: ":" in name)  # one with a port of its own is likely a proxy's
    return own_address(host)


def own_address(everywhere: str) -> str:
    """Return an address of this machine for other computers, or the loopback address when it has none.

    Parameters
    ----------
    everywhere
        ``0.0.0.0`` or ``::``.
    """
    family, far = OUTSIDE[everywhere]
    with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as asking:
        asking.connect((far, 9))  # sends nothing: the system only selects the source address
        address = ipaddress.ip_address(asking.getsockname()[0])
        if address.version == 4 or not address.is_link_local:  # browsers accept no fe80::1%eth0
            return str(address)
    return "127.0.0.1" if family == socket.AF_INET else "::1"


def _is_ipv6(name: str) -> bool:
    try:
        return ipaddress.ip_address(name).version == 6
    except ValueError:
        return False


# ---------------------------------------------------------------- the loop
GATHER_S = 0.02
"""How long states may wait for others: to wake the loop costs more than to deliver one, and pages get 20 a second."""


class RuntimeLoop:
    """Calls :meth:`Runtime.serve_due` whenever a timer is due, an urgent message has come, or states have gathered.

    Parameters
    ----------
    on_error
        Called with what a node raised; nothing is served after that.
    """

    def __init__(
        self, runtime: Runtime, loop: asyncio.AbstractEventLoop, on_error: Callable[[BaseException], None]
    ) -> None:
        self._runtime, self._loop, self._on_error = runtime, loop, on_error
        self._called = self._gathers = self._closed = False
        self._timer: asyncio.TimerHandle | None = None
        runtime.mailbox.on_put = self._wake_from_any_thread

    def wake(self) -> None:
        """Serve soon: a timer was set on the loop."""
        if not self._called and not self._closed:
            self._called = True
            self._loop.call_soon(self._serve)

    def close(self) -> None:
        """Serve no more."""
        self._closed = True
        self._runtime.mailbox.on_put = None
        if self._timer is not None:
            self._timer.cancel()

    def _wake_from_any_thread(self, urgent: bool) -> None:
        """Have the loop serve what was put; called on any thread, once for many messages."""
        if self._called or self._closed or (self._gathers and not urgent):
            return
        if urgent:
            self._called = True
            self._loop.call_soon_threadsafe(self._serve)
        else:
            self._gathers = True
            self._loop.call_soon_threadsafe(self._gather)

    def _gather(self) -> None:
        """Serve in a moment, unless something is due before."""
        due_s = self._loop.time() + GATHER_S
        if self._closed or (self._timer is not None and self._timer.when() <= due_s):
            return
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop.call_at(due_s, self._serve)

    def _serve(self) -> None:
        self._called = self._gathers = False  # first: what is put from here on must schedule again
        if self._timer is not None:
            self._timer.cancel()
        if self._closed:
            return
        try:
            wait_s = self._runtime.serve_due()
        except BaseException as error:  # any kind: it must end the process as on the runtime's own loop
            self.close()
            self._on_error(error)
            return
        self._timer = self._loop.call_later(wait_s, self._serve)


# ---------------------------------------------------------------- the browser
OPEN_S = 60.0
"""The file is removed then: a browser reads it at once."""
PAGE = """<!doctype html>
<meta charset="utf-8"><meta name="referrer" content="no-referrer"><title>fullswarm</title>
<script>location.replace({script})</script>
<noscript><a href="{link}">the console</a></noscript>
"""


class RedirectPage:
    """A file that only this user can read, and that redirects a browser to an address. It must be closed."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._file: Path | None = None

    def open(self) -> bool:
        """Open the page in the user's browser; return False when there is none."""
        try:
            self._file = _written(PAGE.format(script=_quoted(self._address), link=html.escape(self._address)))
        except OSError:
            return False
        return webbrowser.open(self._file.as_uri())

    def close(self) -> None:
        """Remove the file; closing twice is fine."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.unlink(missing_ok=True)
            self._file = None


def _quoted(text: str) -> str:
    """Return a JavaScript string that cannot end its script element."""
    return json.dumps(text).replace("<", "\\u003c")


def _written(page: str) -> Path:
    # Not in /tmp and not in a hidden folder: a browser from a snap or a flatpak cannot read those.
    for folder in (Path.home(), Path(tempfile.gettempdir())):
        with contextlib.suppress(OSError):
            descriptor, name = tempfile.mkstemp(".html", "fullswarm-console-", folder)  # mode 0600
            with os.fdopen(descriptor, "w", encoding="utf-8") as file:
                file.write(page)
            return Path(name)
    raise OSError("neither the home folder nor the one for temporary files can be written")
