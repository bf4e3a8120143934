"""Tells systemd how a service of ours is: sd_notify's protocol, a datagram of ``NAME=value`` lines.

Nothing happens, and nothing is imported, where ``NOTIFY_SOCKET`` is not set.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from contextlib import suppress

SOCKET = "NOTIFY_SOCKET"
WATCHDOG_US, WATCHDOG_PID = "WATCHDOG_USEC", "WATCHDOG_PID"


class Notifier:
    """A way to the service manager that started this process.

    Parameters
    ----------
    address
        A path, or ``@name`` for an abstract socket.
    watchdog_s
        A process that is silent for so long is killed and started again; None: there is no watchdog.
    """

    def __init__(self, address: str, watchdog_s: float | None = None) -> None:
        self.watchdog_s = watchdog_s
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> Notifier | None:
        """Return the way to the service manager, None when it asks for no notices."""
        address = environment.get(SOCKET, "")
        if address[:1] not in ("/", "@") or len(address) < 2:
            return None
        meant = environment.get(WATCHDOG_PID, "") in ("", str(os.getpid()))
        microseconds = environment.get(WATCHDOG_US, "")
        watched = meant and microseconds.isdecimal() and int(microseconds) > 0
        return cls(address, int(microseconds) / 1e6 if watched else None)

    def ready(self, status: str) -> None:
        """Say that the service serves."""
        self._send("READY=1", f"STATUS={status}")

    def alive(self, status: str) -> None:
        """Say that it goes on; the watchdog counts anew."""
        self._send("WATCHDOG=1", f"STATUS={status}")

    def stopping(self) -> None:
        """Say that it is about to end, in order."""
        self._send("STOPPING=1")

    def _send(self, *lines: str) -> None:
        text = "\n".join(line.replace("\n", " ") for line in lines)
        # A manager that is being replaced or swamped must not end a robot; the next word comes soon.
        with suppress(OSError):
            self._socket.sendto(text.encode(), self._address)

    def close(self) -> None:
        """Let go of the socket. Closing twice is fine."""
        self._socket.close()
