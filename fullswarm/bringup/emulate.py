"""`fullswarm emulate MAKE`: one emulated robot on a real port, on an endless floor, for anybody's client.

What a client opens is printed on stdout; on stderr follows what the robot is told; stdin takes mishaps.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

from fullswarm import output
from fullswarm.bringup import mishaps
from fullswarm.clock import MonotonicClock
from fullswarm.drivers.body import Body, FreeBody
from fullswarm.drivers.faults import LinkFaults
from fullswarm.errors import ConfigError, FullswarmError, did_you_mean
from fullswarm.launch.typed import Typed
from fullswarm.runtime import Runtime

LOOK_S, TELL_S, LISTEN_S = 0.1, 1.0, 0.05
DEFAULT_LISTEN = "udp://127.0.0.1:14550"
CAN_BODY = "left=1&right=2&wheel_radius=0.05&base=0.3"
CAN_OPTIONS = {"odrive": CAN_BODY, "vesc": f"{CAN_BODY}&pole_pairs=7&gear=10"}
NOT_FOR = {  # which option means nothing to which make
    "create": ("listen",),
    "mavlink": (),
    "odrive": ("listen", "model"),
    "vesc": ("listen", "model"),
}


class Emulator(Protocol):
    """What all makes have in common."""

    faults: LinkFaults

    @property
    def url(self) -> str:
        """What our driver opens."""
        ...

    def close(self) -> None:
        """Switch the robot off and give up its port."""
        ...


@dataclass(frozen=True, slots=True)
class Wish:
    """What the command line asks for; None: not said."""

    make: str
    port: Path | None = None
    listen: str | None = None
    url: str | None = None
    model: str | None = None


def run(wish: Wish, faults: LinkFaults, orders: Sequence[str], seconds: float | None, *, as_json: bool) -> int:
    """Serve until Ctrl-C, ``quit`` or for so many seconds; return the exit code.

    Raises
    ------
    ConfigError
        An option does not fit the make, or an order is wrong.
    DriverError
        The port cannot be had.
    MissingExtra
        The make's library is not installed.
    """
    _refuse_misfits(wish)
    runtime = Runtime(MonotonicClock())
    runtime.stop_on_signals()
    body = FreeBody()
    with _port_path(wish) as path, _started(wish, path, body) as emulator:
        emulator.faults.drop, emulator.faults.corrupt = faults.drop, faults.corrupt
        emulator.faults.delay_s = faults.delay_s
        for each in orders:
            mishaps.obey(emulator, each)
        _announce(wish, emulator.url, as_json=as_json)
        teller, typed = _Teller(emulator, body), Typed()
        runtime.every(LOOK_S, lambda: teller.look(runtime.now_s()), first_s=0.0)
        runtime.every(LISTEN_S, lambda: _listen(typed, emulator, runtime))
        runtime.run(seconds)
    return 130 if runtime.exit_signal == 2 else 0


def _refuse_misfits(wish: Wish) -> None:
    for name in NOT_FOR[wish.make]:
        if getattr(wish, name) is not None:
            raise ConfigError(f"means nothing to an emulated {wish.make}", where=f"--{name}")
    if sum(each is not None for each in (wish.port, wish.listen, wish.url)) > 1:
        raise ConfigError("--port, --listen and --url exclude each other", hint="name one place")


# ---------------------------------------------------------------- starting
@contextmanager
def _port_path(wish: Wish) -> Iterator[str]:
    """Hand out the path for a serial port; without a wish one in a new folder."""
    if wish.port is not None:
        yield os.path.abspath(wish.port)  # noqa: PTH100  (resolve() would follow the link that an emulator left)
        return
    with tempfile.TemporaryDirectory(prefix="fullswarm-") as folder:
        yield str(Path(folder) / wish.make)


@contextmanager
def _started(wish: Wish, path: str, body: Body) -> Iterator[Emulator]:
    builders: dict[str, Callable[[Wish, str, Body], Emulator]] = {
        "create": _create, "mavlink": _rover, "odrive": _base, "vesc": _base,
    }  # fmt: skip
    emulator = builders[wish.make](wish, path, body)
    try:
        yield emulator
    finally:
        emulator.close()


def _create(wish: Wish, path: str, body: Body) -> Emulator:
    from fullswarm.drivers.create_oi.emulator import CreateEmulator
    from fullswarm.drivers.create_oi.protocol import GENERATIONS
    from fullswarm.drivers.create_oi.settings import parse_url

    if wish.url is not None:
        settings = parse_url(wish.url)
        return CreateEmulator(settings.generation, body, port=settings.path).start()
    model = wish.model or "create2"
    if model not in GENERATIONS:
        raise ConfigError(f"no model '{model}'", where="--model", hint=did_you_mean(model, GENERATIONS))
    return CreateEmulator(GENERATIONS[model], body, port=path).start()


def _rover(wish: Wish, path: str, body: Body) -> Emulator:
    address = f"pty:{path}" if wish.port is not None else wish.listen or DEFAULT_LISTEN
    if wish.url is not None:
        address = _other_end(wish.url)
    model = wish.model or "rover"
    if model == "px4":
        from fullswarm.drivers.mavlink.px4_emulator import Px4Emulator

        return Px4Emulator(address, body).start()
    if model != "rover":
        raise ConfigError(f"no model '{model}'", where="--model", hint=did_you_mean(model, ("rover", "px4")))
    from fullswarm.drivers.mavlink.emulator import RoverEmulator

    return RoverEmulator(address, body).start()


def _other_end(url: str) -> str:
    """Return the vehicle's end of the link that a driver's URL names."""
    from fullswarm.drivers.mavlink.link import parse_url

    address, _ = parse_url(url)
    if address.device:
        return f"pty:{address.device}"
    kind = {"mavlink+udp": "udp", "mavlink+udpout": "udpin", "mavlink+tcp": "tcp"}[address.scheme]
    host = f"[{address.host}]" if ":" in address.host else address.host
    return f"{kind}://{host}:{address.port}"


def _base(wish: Wish, path: str, body: Body) -> Emulator:
    from fullswarm.drivers.can.emulator import EmulatedBase

    url = wish.url or f"can+{wish.make}://{path}?interface=slcan&{CAN_OPTIONS[wish.make]}"
    if urlsplit(url).scheme != f"can+{wish.make}":
        raise ConfigError(f"this is not a base with {wish.make}", where=url, hint=f"write can+{wish.make}://...")
    return EmulatedBase(url, body).start()


# ---------------------------------------------------------------- what a client opens
def _announce(wish: Wish, url: str, *, as_json: bool) -> None:
    clients = openings(url)
    if as_json:
        # One line, and at once: programs wait for it.
        output.data(_json_line({"make": wish.make, "url": url, "clients": clients, "pid": os.getpid()}))
    else:
        output.data(f"our driver:  {url}")
        for client, opening in clients.items():
            output.data(f"{client + ':':12} {opening}")
    output.progress("type `help` for mishaps; Ctrl-C ends")


def openings(url: str) -> dict[str, str]:
    """Return what other people's clients open for the robot that our driver opens as `url`."""
    parts = urlsplit(url)
    scheme, path = parts.scheme, parts.netloc + parts.path
    if scheme == "create":
        if "model=create1" in parts.query:
            return {"port": f"{path} at 57600 baud"}
        return {"pycreate2": f"Create2(port='{path}', baud=115200)", "port": f"{path} at 115200 baud"}
    if scheme == "mavlink+serial":
        return {"pymavlink": f"mavutil.mavlink_connection('{path}', baud=115200)", "port": path}
    if scheme.startswith("mavlink+"):
        kinds = {"mavlink+udp": ("udpin", "udpin"), "mavlink+udpout": ("udpout", "udpout")}
        ours, mavsdk = kinds.get(scheme, ("tcp", "tcpout"))
        return {
            "pymavlink": f"mavutil.mavlink_connection('{ours}:{path}')",
            "MAVProxy": f"mavproxy.py --master={ours}:{path}",
            "MAVSDK": f"{mavsdk}://{path}",
        }
    options = dict(each.partition("=")[::2] for each in parts.query.split("&"))
    more = f", port={options['port']}" if "port" in options else ""
    interface = options.get("interface", "socketcan")
    return {"python-can": f"can.Bus(interface='{interface}', channel='{path}'{more})"}


def _json_line(value: object) -> str:
    import json

    return json.dumps(value, ensure_ascii=False)


# ---------------------------------------------------------------- while it runs
class _Teller:
    """Says on stderr what the robot is told and does: on a change, and each second while it moves."""

    def __init__(self, emulator: Any, body: FreeBody) -> None:
        self._emulator, self._body = emulator, body
        self._told, self._told_s = "", -math.inf

    def look(self, now_s: float) -> None:
        """Look once."""
        state = self._body.state()
        doing = f"{self._mode()}{_plain(state.speed_m_s):+.2f} m/s {_plain(state.turn_rad_s):+.2f} rad/s"
        moves = bool(_plain(state.speed_m_s) or _plain(state.turn_rad_s))
        if doing == self._told and not (moves and now_s - self._told_s >= TELL_S):
            return
        self._told, self._told_s = doing, now_s
        heading = math.degrees(state.heading_rad)
        x, y = _plain(state.x_m), _plain(state.y_m)
        output.progress(f"{doing}  at x {x:.2f} y {y:.2f} m, heading {heading:.0f} degrees")

    def _mode(self) -> str:
        """Return the mode that the firmware is in, where it has one."""
        firmware = getattr(self._emulator, "firmware", None)
        mode = getattr(self._emulator, "mode", getattr(firmware, "mode", None))
        if mode is None:
            return ""
        if firmware is None or not hasattr(firmware, "armed"):
            return f"{getattr(mode, 'name', mode)} "
        return f"{_autopilot_mode(self._emulator, mode)} {'armed' if firmware.armed else 'disarmed'} "


def _autopilot_mode(emulator: Any, mode: int) -> str:
    from fullswarm.drivers.mavlink.emulator import RoverEmulator
    from fullswarm.drivers.mavlink.protocol import mode_name
    from fullswarm.drivers.mavlink.px4 import Px4

    return mode_name(mode) if isinstance(emulator, RoverEmulator) else Px4().mode_name(mode)


def _plain(value: float) -> float:
    return round(value, 2) + 0.0  # -0.00 looks like a motion


def _listen(typed: Typed, emulator: Emulator, runtime: Runtime) -> None:
    while (line := typed.line()) is not None:
        if line in ("quit", "exit"):
            runtime.stop()
        elif line == "help":
            output.progress(mishaps.explain(emulator))
        elif line:
            try:
                mishaps.obey(emulator, line)
                output.progress(f"done: {line}")
            except FullswarmError as error:
                output.progress(f"error: {error}")
