"""A secured hub as a process of its own: it follows the list of valid certificates, with the keys that users make."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
import zenoh

from fullswarm.bus.zenoh_bus import ZenohBus, client_config, untyped
from fullswarm.identity import Credentials, Role
from fullswarm.identity.access import ACCESS_KEY
from fullswarm.identity.authority import Authority, revoke
from fullswarm.identity.folder import KeysFolder
from fullswarm.keys import Keys
from fullswarm.messages import Reception
from fullswarm.runtime import Mailbox
from tests.unit.secured_hub import free_port

DEADLINE_S = 10.0
NAMES: tuple[tuple[str, Role], ...] = (("hub", "hub"), ("core", "core"), ("r1", "robot"), ("r2", "robot"))
KEYS = Keys("lab")


@pytest.fixture
def folder(tmp_path: Path) -> KeysFolder:
    made = KeysFolder.of("lab", tmp_path / "identity")
    authority = Authority.make(made)
    for name, role in NAMES:
        authority.issue(name, role)
    return made


@pytest.fixture
def hub(folder: KeysFolder) -> Iterator[tuple[str, int, Callable[[], str]]]:
    """Endpoint and id of a hub's process, and what it has logged."""
    endpoint, log = f"tls/127.0.0.1:{free_port()}", folder.path.parent.parent / "hub.log"
    environment = {**os.environ, "FULLSWARM_IDENTITY": str(folder.path.parent)}
    command = [sys.executable, "-m", "fullswarm", "hub", "--listen", endpoint, "--swarm", "lab"]
    with log.open("wb") as sink:
        process = subprocess.Popen(command, env=environment, stderr=sink, stdout=sink)
    yield endpoint, process.pid, log.read_text
    process.terminate()
    process.wait(DEADLINE_S)


def wait(condition: Callable[[], bool], what: str, within_s: float = DEADLINE_S) -> None:
    end_s = time.monotonic() + within_s
    while not condition():
        time.sleep(0.01)
        assert time.monotonic() < end_s, what


def test_a_revoked_robot_is_out_and_the_others_stay(
    folder: KeysFolder, hub: tuple[str, int, Callable[[], str]]
) -> None:
    endpoint, _, logged = hub
    mailbox = Mailbox()
    buses = {
        name: ZenohBus(
            mailbox if name == "core" else Mailbox(), hub=endpoint, credentials=folder.credentials(name, role)
        )
        for name, role in NAMES
        if role != "hub"
    }
    got: list[Reception] = []
    buses["core"].subscribe(KEYS.reception(), Reception, got.append)
    for bus in buses.values():
        bus.wait_connected(DEADLINE_S)

    def arrive() -> set[str]:
        for name in ("r1", "r2"):
            buses[name].publish(KEYS.reception(name), Reception(host=name, robots=(name,), x_m=(0.0,), y_m=(0.0,)))
        while mailbox.deliver_one(0.01):
            pass
        return {each.host for each in got}

    wait(lambda: arrive() == {"r1", "r2"}, "both robots are received")
    revoke(folder, "r2")
    wait(lambda: not buses["r2"].connected(), "r2 is out", within_s=5.0)
    wait(lambda: buses["r1"].connected() and buses["core"].connected(), "the others are back", within_s=5.0)
    while mailbox.deliver_one(0.2):  # what r2 sent while it was in
        pass
    got.clear()
    wait(lambda: "r1" in arrive(), "r1 is received")
    for _ in range(20):
        arrive()
    assert {each.host for each in got} == {"r1"}
    folder.grants_path.write_bytes(b"[{")
    wait(lambda: "is not used; the one before stays valid" in logged(), "the torn list is logged")
    assert buses["r1"].connected()
    for bus in buses.values():
        bus.close()


def test_a_message_of_100_megabytes_costs_the_hub_nothing(
    folder: KeysFolder, hub: tuple[str, int, Callable[[], str]]
) -> None:
    endpoint, process, _ = hub
    credentials = folder.credentials("r1", "robot")
    with bare_session(endpoint, credentials) as session:
        before = psutil.Process(process).memory_info().rss
        most = before
        session.put("lab/r1/reception/r1", bytes(100_000_000), congestion_control=zenoh.CongestionControl.BLOCK)
        end_s = time.monotonic() + 2.0
        while time.monotonic() < end_s:
            most = max(most, psutil.Process(process).memory_info().rss)
            time.sleep(0.01)
        assert any(reply.ok for reply in session.get(ACCESS_KEY, timeout=5.0))
    assert most - before < 40e6


@contextmanager
def bare_session(endpoint: str, credentials: Credentials) -> Iterator[zenoh.Session]:
    """Open a bare session of an attacker who has a robot's certificate."""
    session = None
    while session is None:
        try:
            session = zenoh.open(client_config(endpoint, multicast=False, credentials=credentials))
        except zenoh.ZError:  # the hub's process is still starting
            time.sleep(0.1)
    try:
        yield session
    finally:
        untyped(session.close)


def test_a_hub_without_keys_names_the_command(tmp_path: Path) -> None:
    environment = {**os.environ, "FULLSWARM_IDENTITY": str(tmp_path)}
    command = [sys.executable, "-m", "fullswarm", "hub", "--listen", f"tls/127.0.0.1:{free_port()}", "--swarm", "lab"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 2
    assert "fullswarm keys init" in done.stderr


def test_an_open_address_without_tls_names_both_commands() -> None:
    command = [sys.executable, "-m", "fullswarm", "hub", "--listen", "tcp/0.0.0.0:7447"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 2
    assert "fullswarm keys init" in done.stderr
    assert "--listen tls/0.0.0.0:7447" in done.stderr
