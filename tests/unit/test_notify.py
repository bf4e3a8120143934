"""sd_notify's protocol, as systemd's side of the socket hears it."""

from __future__ import annotations

import os
import socket
import uuid
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from fullswarm.launch.on_board import Notifier


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    """A service manager's socket, and how it is called in NOTIFY_SOCKET."""
    name = str(tmp_path / "notify") if request.param == "path" else f"@fullswarm-{uuid.uuid4()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as here:
        here.bind(name.replace("@", "\0"))
        here.settimeout(5.0)
        yield here, name


def test_what_is_said_arrives(manager: tuple[socket.socket, str]) -> None:
    here, name = manager
    notifier = Notifier.from_environment({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "10000000"})
    assert notifier is not None
    assert notifier.watchdog_s == 10.0
    with closing(notifier):
        notifier.ready("READY")
        notifier.alive("FAULT the port\nis gone")
        notifier.stopping()
    assert [here.recv(4096) for _ in range(3)] == [
        b"READY=1\nSTATUS=READY",
        b"WATCHDOG=1\nSTATUS=FAULT the port is gone",
        b"STOPPING=1",
    ]


@pytest.mark.parametrize("name", ["", "relative/path", "@", "/"])
def test_nobody_listens(name: str) -> None:
    assert Notifier.from_environment({"NOTIFY_SOCKET": name}) is None
    assert Notifier.from_environment({}) is None


@pytest.mark.parametrize(
    ("environment", "watched"),
    [
        ({"WATCHDOG_USEC": "2000000"}, True),
        ({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": str(os.getpid())}, True),
        ({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"}, False),
        ({"WATCHDOG_USEC": "0"}, False),
        ({"WATCHDOG_USEC": "soon"}, False),
    ],
)
def test_a_watchdog_that_is_meant_for_another_process_is_not_ours(environment: dict[str, str], watched: bool) -> None:
    notifier = Notifier.from_environment({"NOTIFY_SOCKET": "/run/somewhere", **environment})
    assert notifier is not None
    with closing(notifier):
        assert (notifier.watchdog_s is not None) == watched


def test_a_manager_that_is_gone_or_swamped_ends_nobody(tmp_path: Path) -> None:
    gone = Notifier(str(tmp_path / "gone"))
    with closing(gone):
        gone.alive("READY")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as here:
        here.bind(str(tmp_path / "full"))
        with closing(Notifier(str(tmp_path / "full"))) as swamped:
            for _ in range(10_000):
                swamped.alive("READY")  # nobody reads: its buffer is full long before
