"""Connects one command to a swarm: bus, keys and runtime, with an orderly Ctrl-C."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from fullswarm.bus.base import Bus
from fullswarm.bus.endpoint import DEFAULT_HUB, credentials_at
from fullswarm.clock import MonotonicClock, clock_id
from fullswarm.errors import Unreachable
from fullswarm.identity import Credentials
from fullswarm.identity.folder import certificate_name
from fullswarm.keys import Keys
from fullswarm.logs import log_to_stderr
from fullswarm.operator.client import Operator
from fullswarm.operator.target import OPERATOR as OPERATOR
from fullswarm.operator.target import Target as Target
from fullswarm.operator.target import operator_name as operator_name
from fullswarm.operator.target import usual_name as usual_name
from fullswarm.runtime import Runtime

CONNECT_S = 3.0


class Session:
    """A connected command. It runs once: :meth:`run` until :meth:`finish`, a time limit or Ctrl-C."""

    def __init__(self, bus: Bus, keys: Keys, runtime: Runtime, hub: str, name: str = "") -> None:
        self.bus, self.keys, self.runtime, self.hub = bus, keys, runtime, hub
        self.source = f"cli@{socket.gethostname()}:{os.getpid()}"
        self.operator = Operator(bus, keys, runtime, self.source, name=name or usual_name(), clock=clock_id())
        self.on_interrupt: Callable[[], None] | None = None
        """What Ctrl-C does; None: end the command with code 130. It must lead to :meth:`finish`."""

    def finish(self) -> None:
        """End :meth:`run`."""
        self.runtime.stop()

    def run(self, duration_s: float | None = None) -> None:
        """Serve the bus; the first Ctrl-C or SIGTERM ends in order, the second at once.

        Raises
        ------
        KeyboardInterrupt
            Ctrl-C, unless `on_interrupt` is set.
        """
        interrupted = False

        def on_signal(_number: int, _frame: FrameType | None) -> None:
            nonlocal interrupted
            if interrupted:
                raise KeyboardInterrupt
            interrupted = True
            act = self.on_interrupt or self.finish
            self.runtime.mailbox.put(lambda _: act(), None)

        before = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            self.runtime.run(duration_s)
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
        if interrupted and self.on_interrupt is None:
            raise KeyboardInterrupt

    def no_core(self, timeout_s: float) -> Unreachable:
        """Return the error for a core that does not answer."""
        return Unreachable(
            f"the core of swarm '{self.keys.swarm}' did not answer within {timeout_s:g} s",
            where=self.hub,
            hint="is it running? start it with `fullswarm core`, or name the swarm with --swarm",
        )


def own_credentials(hub: str, swarm: str, operator: str = "") -> Credentials | None:
    """Return the files by which an operator proves its name at a hub; None: the hub asks for none.

    Parameters
    ----------
    operator
        Its name; empty: :func:`usual_name`.

    Raises
    ------
    ConfigError
        The hub is secured, and this operator has no certificate on this computer.
    """
    return credentials_at(hub, swarm, certificate_name(operator or usual_name()), "operator")


@contextmanager
def connect(target: Target, within_s: float | None = None) -> Iterator[Session]:
    """Open the bus for one command; the hub has `within_s` to answer, 3 s by default.

    Raises
    ------
    Unreachable
        No hub answers.
    ConfigError
        The hub's address or the swarm's name is malformed, or the hub is secured and this operator has no certificate.
    """
    from fullswarm.bus.base import OPERATOR, NamedBus
    from fullswarm.bus.renewal import renew_later
    from fullswarm.bus.zenoh_bus import ZenohBus

    log_to_stderr(at_once=False)
    keys = Keys(target.swarm)
    runtime = Runtime(MonotonicClock())
    hub = target.hub or DEFAULT_HUB
    credentials = own_credentials(hub, target.swarm, target.operator)
    bus = ZenohBus(runtime.mailbox, hub=hub, credentials=credentials)
    try:
        bus.wait_connected(CONNECT_S if within_s is None else within_s)
        renew_later(bus, runtime, keys, credentials)
        yield Session(NamedBus(bus, OPERATOR), keys, runtime, hub, target.operator)
    finally:
        bus.close()
