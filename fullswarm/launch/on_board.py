"""Reports from a robot's own computer: the agent's state to systemd (sd_notify) and to the health file.

Only on demand: systemd by ``NOTIFY_SOCKET``, the unit by ``FULLSWARM_HEALTH``. The reports come from the loop that
drives the wheels: when it hangs, none is sent, and systemd restarts the agent.
"""

from __future__ import annotations

import math
import os
import socket
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import structlog

import fullswarm
from fullswarm.agent.telemetry import health_file
from fullswarm.agent.telemetry.health_file import Process, Rate
from fullswarm.config import AgentConfig
from fullswarm.files import replace_file
from fullswarm.launch import HEALTH
from fullswarm.runtime import Runtime, Timer

if TYPE_CHECKING:
    from fullswarm.agent.node import AgentNode

SOCKET = "NOTIFY_SOCKET"
WATCHDOG_US, WATCHDOG_PID = "WATCHDOG_USEC", "WATCHDOG_PID"
log = structlog.get_logger()

LOOK_S = 0.05
"""How soon after the first tick the agent reports READY."""
SHARE_OF_WATCHDOG = 0.25


class Notifier:
    """The connection to the service manager that started this process.

    Parameters
    ----------
    address
        A path, or ``@name`` for an abstract socket.
    watchdog_s
        A process without a report for so long is killed and restarted; None: there is no watchdog.
    """

    def __init__(self, address: str, watchdog_s: float | None = None) -> None:
        self.watchdog_s = watchdog_s
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> Notifier | None:
        """Return the connection to the service manager, None when it wants no notices."""
        address = environment.get(SOCKET, "")
        if address[:1] not in ("/", "@") or len(address) < 2:
            return None
        meant = environment.get(WATCHDOG_PID, "") in ("", str(os.getpid()))
        microseconds = environment.get(WATCHDOG_US, "")
        watched = meant and microseconds.isdecimal() and int(microseconds) > 0
        return cls(address, int(microseconds) / 1e6 if watched else None)

    def ready(self, status: str) -> None:
        """Report that the service is ready."""
        self._send("READY=1", f"STATUS={status}")

    def alive(self, status: str) -> None:
        """Report that it is alive, which resets the watchdog."""
        self._send("WATCHDOG=1", f"STATUS={status}")

    def stopping(self) -> None:
        """Report that it is about to end, in order."""
        self._send("STOPPING=1")

    def _send(self, *lines: str) -> None:
        text = "\n".join(line.replace("\n", " ") for line in lines)
        # A manager that is restarting or overloaded must not end a robot; the next report follows soon.
        with suppress(OSError):
            self._socket.sendto(text.encode(), self._address)

    def close(self) -> None:
        """Close the socket. Closing twice is allowed."""
        self._socket.close()


# ---------------------------------------------------------------- the agent's reports
def release() -> str:
    """Return the id of the release that this code is in, ``<id>/app/fullswarm``; empty when it is in none."""
    folder = Path(fullswarm.__file__).resolve().parents[2]
    return folder.name if (folder / "SHA256SUMS").is_file() else ""


class OnBoard:
    """The agent's scheduler, watched: it keeps the control loop's timer, the first one that an agent sets.

    Parameters
    ----------
    path
        The health file; None: not wanted.
    notifier
        The connection to systemd; None: it did not start this process.
    """

    def __init__(self, runtime: Runtime, settings: AgentConfig, path: Path | None, notifier: Notifier | None) -> None:
        self._runtime, self._settings, self._path, self._notifier = runtime, settings, path, notifier
        self._control: Timer | None = None
        self._ticks = 0
        self._rate = Rate()
        self._began_s = runtime.now_s()
        self._release, self._boot_id = release(), health_file.boot_id()
        self._agent: AgentNode | None = None
        self._trouble = ""
        self._timers: list[Timer] = []

    @classmethod
    def from_environment(
        cls, runtime: Runtime, settings: AgentConfig, environment: Mapping[str, str] = os.environ
    ) -> OnBoard | None:
        """Return what the environment requests, None when it requests nothing."""
        path, notifier = environment.get(HEALTH, ""), Notifier.from_environment(environment)
        return cls(runtime, settings, Path(path) if path else None, notifier) if path or notifier else None

    # ------------------------------------------------------------------ a scheduler
    def now_s(self) -> float:
        """Return the runtime's time."""
        return self._runtime.now_s()

    def every(self, period_s: float, callback: Callable[[], None], *, first_s: float | None = None) -> Timer:
        """Pass on; keep the control loop's timer."""
        timer = self._runtime.every(period_s, callback, first_s=first_s)
        if self._control is None and period_s == 1.0 / self._settings.control_rate_hz:
            self._control = timer
        return timer

    def after(self, delay_s: float, callback: Callable[[], None]) -> Timer:
        """Pass on."""
        return self._runtime.after(delay_s, callback)

    # ------------------------------------------------------------------ the watch
    def watch(self, agent: AgentNode) -> OnBoard:
        """Report the state of this agent from now on; return self, to be closed before it."""
        self._agent = agent
        self._timers = [self._runtime.every(LOOK_S, self._until_ready, first_s=0.0)]
        return self

    def _until_ready(self) -> None:
        if not self._ticked():
            return
        self._timers.pop().cancel()
        self._write_health()
        if self._notifier is not None:
            self._notifier.ready(self._status())
            if self._notifier.watchdog_s is not None:
                period_s = SHARE_OF_WATCHDOG * self._notifier.watchdog_s
                self._timers.append(self._runtime.every(period_s, self._ping, first_s=0.0))
        self._timers.append(self._runtime.every(health_file.PERIOD_S, self._write_health))

    def _ticked(self) -> bool:
        """Return whether the control loop has ticked since the last call."""
        ticks = self._control.ticks if self._control is not None and self._control.active else 0
        before, self._ticks = self._ticks, ticks
        return ticks > before

    def _ping(self) -> None:
        if self._notifier is not None and self._ticked():
            self._notifier.alive(self._status())

    def _status(self) -> str:
        agent = self._agent
        return f"{agent.fleet.lifecycle(0)} {agent.fleet.fault(0)}".strip() if agent else ""

    def _write_health(self) -> None:
        """Write the health file; an error of the disk must not end the agent."""
        if self._path is None or self._agent is None or self._control is None:
            return
        now_s, settings = self.now_s(), self._settings
        agent = self._agent
        (report,) = agent.health(now_s).robots
        reading_age_s = math.inf if agent.reading is None else now_s - float(agent.reading.stamp_s[0])
        vitals = health_file.vitals_of(
            report, reading_age_s, agent.inbox.core_age_s(now_s), agent.neighbours.ages_s(now_s),
            self._rate.see(now_s, self._control.ticks), settings.control_rate_hz,
            (settings.reading_timeout_s, settings.neighbour_timeout_s),
        )  # fmt: skip
        process = Process(
            self._release,
            os.getpid(),
            self._boot_id,
            round(health_file.machine_s(), 2),
            round(now_s - self._began_s, 2),
        )
        why = health_file.why_not(vitals, settings.core_silence_s)
        try:
            replace_file(self._path, health_file.text_of(vitals, process, why))
            self._trouble = ""
        except OSError as error:
            if str(error) != self._trouble:
                self._trouble = str(error)
                log.warning("the health file cannot be written", reason=self._trouble)

    def close(self) -> None:
        """Report the end, and remove the health file."""
        for timer in self._timers:
            timer.cancel()
        if self._notifier is not None:
            self._notifier.stopping()
            self._notifier.close()
        if self._path is not None:
            self._path.unlink(missing_ok=True)
