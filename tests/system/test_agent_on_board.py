"""An agent as its unit starts it: what systemd hears, what the health file says, what happens when it hangs."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.system.live import START_S

WATCHDOG_S = 2.0


@dataclass
class Service:
    """An agent process, its manager's socket and its health file."""

    process: subprocess.Popen[str]
    manager: socket.socket
    health: Path

    def heard(self, word: bytes, timeout_s: float) -> bool:
        """Tell whether a datagram with `word` comes in time."""
        end_s = time.monotonic() + timeout_s
        while (left_s := end_s - time.monotonic()) > 0:
            self.manager.settimeout(left_s)
            try:
                if word in self.manager.recv(4096):
                    return True
            except TimeoutError:
                return False
        return False

    def forget(self) -> None:
        """Drop what has been said so far."""
        self.manager.setblocking(False)
        try:
            while self.manager.recv(4096):
                pass
        except BlockingIOError:
            return

    def says(self, timeout_s: float, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Return the health file once it fulfils the condition."""
        end_s = time.monotonic() + timeout_s
        said: dict[str, Any] = {}
        while time.monotonic() < end_s:
            if self.health.exists():
                said = json.loads(self.health.read_text())
                if condition(said):
                    return said
            time.sleep(0.02)
        raise AssertionError(f"the health file says {said}")


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    fleet = tmp_path / "fleet.toml"
    fleet.write_text('[[robot]]\nid = "r1"\ndriver = "null://r1"\n[hub]\nendpoint = "tcp/127.0.0.1:9"\n')
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        environment = {
            **os.environ,
            "NOTIFY_SOCKET": str(tmp_path / "notify"),
            "WATCHDOG_USEC": str(int(WATCHDOG_S * 1e6)),
            "FULLSWARM_HEALTH": str(tmp_path / "health.json"),
            "FULLSWARM_STATE": str(tmp_path),
        }
        environment.pop("WATCHDOG_PID", None)
        command = [sys.executable, "-m", "fullswarm", "agent", "r1", "--fleet", str(fleet)]
        with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
            yield Service(process, manager, tmp_path / "health.json")
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.kill()
            process.communicate()


def test_it_says_ready_and_goes_on_and_leaves_in_order(service: Service) -> None:
    assert service.heard(b"READY=1", START_S)
    assert service.heard(b"WATCHDOG=1\nSTATUS=READY", WATCHDOG_S)
    said = service.says(20.0, lambda said: said["control_rate_hz"] > 45.0)
    assert (said["robot"], said["lifecycle"], said["driver_answers"]) == ("r1", "READY", True)
    assert said["why"] == ["it receives neither the core nor another robot"]  # no hub is there
    assert (said["pid"], said["release"]) == (service.process.pid, "")
    later = service.says(5.0, lambda now: now["machine_s"] > said["machine_s"])
    assert later["machine_s"] - said["machine_s"] < 3.0
    service.process.terminate()
    assert service.process.wait(10.0) == 0
    assert service.heard(b"STOPPING=1", 1.0)
    assert not service.health.exists()


def test_a_process_that_stands_still_says_nothing(service: Service) -> None:
    assert service.heard(b"WATCHDOG=1", START_S)
    service.process.send_signal(signal.SIGSTOP)
    service.forget()
    assert not service.heard(b"WATCHDOG=1", 1.5 * WATCHDOG_S)
    service.process.send_signal(signal.SIGCONT)
    assert service.heard(b"WATCHDOG=1", WATCHDOG_S)


def test_it_does_without_what_only_people_need(service: Service) -> None:
    assert service.heard(b"READY=1", START_S)
    mapped = Path(f"/proc/{service.process.pid}/maps").read_text()
    assert "numpy" in mapped
    # A health file that cannot be written is a warning, no end.
    service.health.unlink(missing_ok=True)
    service.health.mkdir()
    assert service.heard(b"WATCHDOG=1", WATCHDOG_S)
    service.health.rmdir()
    assert service.says(10.0, lambda said: said["robot"] == "r1")
