"""`fullswarm robots check`: runs the published check of drivers on a robot, an emulator or an outside package's rig."""

from __future__ import annotations

import importlib
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit, urlunsplit

from fullswarm import output, registry
from fullswarm.bringup.robot_test import Bench
from fullswarm.clock import MonotonicClock
from fullswarm.drivers.guardian import guarded
from fullswarm.errors import ConfigError
from fullswarm.output import TypedLines
from fullswarm.runtime import Runtime
from fullswarm.testing import Report, Rig, Wire, check_driver, emulated_rig, serial_wire, udp_wire

MOVES = """The check drives the robot at up to its full speed for a moment and at half of it for seconds.
Jack it up so that no wheel touches the ground, keep hands and cables away, and one hand on its switch."""


def run(
    url: str | None,
    model: str | None,
    rig: str | None,
    *,
    wire_baud: int | None,
    still: bool,
    confirmed: bool,
    settle_s: float,
    deadline_s: float,
    as_json: bool,
) -> int:
    """Check the driver of `url`, of an emulated `model`, or of the rig that `rig` (``module:function``) makes.

    Return 0 if it passes, else 1.

    Parameters
    ----------
    wire_baud
        Put a relay into the link, which unplugs, mutes and disturbs it; the rate of a serial line. None: no relay.
    still
        The robot may not move: only lifecycle and promptness are checked.
    confirmed
        Skip the confirmation prompt.
    settle_s, deadline_s
        As in :func:`fullswarm.testing.check_driver`.

    Raises
    ------
    ConfigError
        None or several of `url`, `model` and `rig`, a wrong URL, an unknown model, a rig that does not import, or no
        confirmation.
    DriverError
        The port cannot be had.
    """
    with _rig(url, model, rig, wire_baud) as hands:
        if url is not None and not still and not confirmed:
            _confirm(url, hands)
        for each in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(each, signal.default_int_handler)  # the check closes its driver on the way out
        try:
            report = check_driver(hands, settle_s=settle_s, deadline_s=deadline_s, exercise=not still)
        except AssertionError as error:
            return _failed(str(error), as_json)
    return _passed(report, as_json)


@contextmanager
def _rig(url: str | None, model: str | None, rig: str | None, wire_baud: int | None) -> Iterator[Rig]:
    if [url, model, rig].count(None) != 2:
        raise ConfigError(
            "name one of a URL, --emulated and --rig", where="robots check", hint="e.g. create:///dev/ttyUSB0"
        )
    if model is not None:
        with emulated_rig(model) as emulated:
            yield emulated
        return
    if url is not None:
        kind = registry.driver_class(url)
        kind(url)  # a wrong URL is refused before anything is opened
        if wire_baud is None:
            yield Rig(make=lambda: guarded(kind(url)))
            return
        with _wire(url, wire_baud) as (wire, wired):
            yield Rig(
                make=lambda: guarded(kind(wired)), unplug=wire.unplug, replug=wire.replug, mute=wire.mute,
                garbage=wire.garbage, cut=wire.cut,
            )  # fmt: skip
        return
    with _factory(str(rig))() as hands:
        if not isinstance(hands, Rig):
            raise ConfigError(
                f"it yields {type(hands).__name__}, not a fullswarm.testing.Rig", where=f"--rig {rig}",
                hint="see docs/how-to-add-a-driver.md",
            )  # fmt: skip
        yield hands


@contextmanager
def _wire(url: str, baud: int) -> Iterator[tuple[Wire, str]]:
    """Put a relay between a driver and its serial or UDP port; hand out the relay and the URL that leads to it."""
    parts = urlsplit(url)
    if parts.path and Path(parts.path).exists():
        with serial_wire(parts.path, baud) as wire:
            yield wire, url.replace(parts.path, str(wire.port), 1)
    elif parts.hostname and parts.port:
        with udp_wire(f"{parts.hostname}:{parts.port}") as wire:
            yield wire, urlunsplit(parts._replace(netloc=f"127.0.0.1:{wire.port}"))
    else:
        raise ConfigError(
            "no relay fits this URL",
            where=f"--wire {url}",
            hint="a serial port that exists, or HOST:PORT of a UDP link",
        )


def _factory(target: str) -> Callable[[], AbstractContextManager[Any]]:
    module, _, name = target.partition(":")
    where = f"--rig {target}"
    if not module or not name:
        raise ConfigError("not a rig", where=where, hint="write module:function, a context manager that yields a Rig")
    try:
        found: Any = importlib.import_module(module)
    except ImportError as error:
        raise ConfigError(f"'{module}' does not import: {error}", where=where, hint="install its package") from error
    try:
        for each in name.split("."):
            found = getattr(found, each)
    except AttributeError as error:
        raise ConfigError(f"{error}", where=where, hint="name a function of that module") from error
    factory: Callable[[], AbstractContextManager[Any]] = found
    return factory


def _confirm(url: str, hands: Rig) -> None:
    """Ask the person beside the robot; raise ``ConfigError`` unless the answer is yes."""
    runtime = Runtime(MonotonicClock())
    runtime.stop_on_signals()
    output.progress(f"{url}\n{MOVES}")
    if not Bench(hands.make(), runtime, TypedLines()).answers("Is it safe to drive?"):
        raise ConfigError("not confirmed: nothing was opened, nothing moved", where=url, hint="--yes skips the prompt")


def _failed(what: str, as_json: bool) -> int:
    if as_json:
        output.data_json({"passed": False, "failed": what})
    else:
        output.data(f"failed   {what}")
    return 1


def _passed(report: Report, as_json: bool) -> int:
    if as_json:
        output.data_json({"passed": True, "url": report.url, "checked": report.checked, "skipped": report.skipped})
    else:
        output.data(str(report))
        output.data(f"passed: {len(report.checked)} checked, {len(report.skipped)} not checked")
    return 0
