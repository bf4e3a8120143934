"""Keys of hosts and of the fleet: what is pinned, what changed, and whose fault it is if none can be read."""

from __future__ import annotations

import asyncio
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import asyncssh
import pytest

from fullswarm.config import SwarmConfig
from fullswarm.deploy.fleet.login import Address, Login, Pins, key_fingerprint, known_hosts_name, login_for
from fullswarm.deploy.release.keys import Keys
from fullswarm.errors import ConfigError, FullswarmError

KEY = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIJ4mWTLtnLS1f9gqhPp7uNfbZ2Y6vYkqYw9yUkFJ0nVd"
OTHER = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIB4mWTLtnLS1f9gqhPp7uNfbZ2Y6vYkqYw9yUkFJ0nVd"
HERE = Address("r1", "10.0.0.1", 22, "me")


@pytest.fixture
def pins(tmp_path: Path) -> Pins:
    return Pins(tmp_path / "known_hosts", tmp_path / "hosts")


def test_a_pinned_key_holds_for_its_name_and_port_alone(pins: Pins) -> None:
    pins.pin("10.0.0.1", 22, KEY + " comment")
    pins.pin("10.0.0.1", 2222, OTHER)
    assert pins.known_hosts.read_text() == f"10.0.0.1 {KEY}\n[10.0.0.1]:2222 {OTHER}\n"
    assert pins.keys("r1", "10.0.0.1", 22) == [KEY]
    assert pins.keys("r1", "10.0.0.1", 2222) == [OTHER]
    assert pins.keys("r1", "10.0.0.1", 23) == []
    assert known_hosts_name("r1.local", 22) == "r1.local"


def test_a_line_may_have_several_names(pins: Pins) -> None:
    pins.known_hosts.write_text(f"# ours\nr1.local,10.0.0.1 {KEY}\n|1|hash= {OTHER}\n@revoked * {OTHER}\n\n")
    assert pins.keys("r1", "10.0.0.1", 22) == pins.keys("r1", "r1.local", 22) == [KEY]


def test_a_flashed_robot_is_known_and_a_pinned_key_goes_before(pins: Pins) -> None:
    pins.flashed.mkdir()
    (pins.flashed / "r1_ed25519.pub").write_text(f"{KEY} fullswarm lab r1\n")
    assert pins.keys("r1", "anywhere", 22) == [KEY]
    assert pins.keys("r2", "anywhere", 22) == []
    assert "rm '" in str(pins.changed("r1", "anywhere", 22))
    pins.pin_flashed("r1", "anywhere", 22)
    pins.pin_flashed("r1", "anywhere", 22)
    assert pins.known_hosts.read_text() == f"anywhere {KEY}\n"
    assert "ssh-keygen -R 'anywhere'" in str(pins.changed("r1", "anywhere", 22))


@pytest.mark.skipif(shutil.which("ssh-keygen") is None, reason="needs ssh-keygen: sudo apt install openssh-client")
def test_fingerprints_are_those_of_ssh_keygen(tmp_path: Path) -> None:
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", tmp_path / "key"], check=True)
    public = tmp_path / "key.pub"
    said = subprocess.run(["ssh-keygen", "-lf", public], check=True, capture_output=True, text=True).stdout
    assert key_fingerprint(public.read_text()) in said.split()


def forbid(monkeypatch: pytest.MonkeyPatch, file: Path) -> None:
    """Let a file be another user's, for root too."""
    real_open, real_read = os.open, Path.read_text

    def refuse(path: object) -> None:
        if Path(str(path)) == file:
            raise PermissionError(13, "Permission denied", str(file))

    def opened(path: Any, *rest: Any, **more: Any) -> int:
        refuse(path)
        return real_open(path, *rest, **more)

    def read(path: Path, *rest: Any, **more: Any) -> str:
        refuse(path)
        return real_read(path, *rest, **more)

    monkeypatch.setattr(os, "open", opened)
    monkeypatch.setattr(Path, "read_text", read)


def test_files_that_root_has_left_are_named_with_what_gives_them_back(
    pins: Pins, monkeypatch: pytest.MonkeyPatch
) -> None:
    uses: dict[Path, tuple[Callable[[], object], ...]] = {
        pins.known_hosts: (
            lambda: pins.keys("r1", "10.0.0.1", 22),
            lambda: pins.pin("10.0.0.1", 22, KEY),
            lambda: pins.pin_flashed("r1", "10.0.0.1", 22),
            lambda: pins.changed("r1", "10.0.0.1", 22),
        ),
        pins.flashed / "r1_ed25519.pub": (lambda: pins.keys("r1", "10.0.0.1", 22),),
    }
    for file, calls in uses.items():
        with monkeypatch.context() as patched:
            forbid(patched, file)
            for call in calls:
                with pytest.raises(ConfigError, match="cannot be read or written: permission denied") as caught:
                    call()
                assert caught.value.where == str(file)
                assert caught.value.hint == f"sudo chown -R \"$USER\" '{file.parent}'"


@pytest.mark.skipif(shutil.which("ssh-keygen") is None, reason="needs ssh-keygen: sudo apt install openssh-client")
def test_a_fleet_key_that_root_has_left_is_no_robots_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keys = Keys(tmp_path / "keys")
    key = keys.fleet_key()
    assert login_for(SwarmConfig(), keys).fleet_key == key
    real_open = Path.open

    def opened(path: Path, *rest: Any, **more: Any) -> Any:
        if path == key:
            raise PermissionError(13, "Permission denied", str(key))
        return real_open(path, *rest, **more)

    monkeypatch.setattr(Path, "open", opened)
    with pytest.raises(ConfigError, match=r"fleet_ed25519: cannot be read.*sudo chown"):
        login_for(SwarmConfig(), keys)


@pytest.mark.parametrize(
    ("error", "arrives", "says"),
    [
        (asyncssh.HostKeyNotVerifiable("Host key is not trusted for host hop"), False, "jump host hop, .*`ssh hop`"),
        (asyncssh.KeyExchangeFailed("No matching host key algorithm found"), False, "jump host, .*`ssh JUMPHOST`"),
        (asyncssh.HostKeyNotVerifiable("Host key is not trusted for host 10.0.0.1"), True, "another host key"),
        (asyncssh.KeyExchangeFailed("No matching host key algorithm found"), True, "another host key"),
    ],
)  # fmt: skip
def test_a_jump_host_nobody_knows_is_not_taken_for_the_robot(
    pins: Pins, monkeypatch: pytest.MonkeyPatch, error: Exception, arrives: bool, says: str
) -> None:
    async def connect(*_: object, client_factory: Callable[[], object], **__: object) -> None:
        if arrives:  # asyncssh makes the client when the connection stands, before host keys are shown
            client_factory()
        raise error

    async def enter() -> None:
        async with Login(pins, Path("no key")).connect(HERE):
            pass

    pins.pin(HERE.host, HERE.port, KEY)
    monkeypatch.setattr(asyncssh, "connect", connect)
    with pytest.raises(FullswarmError, match=says) as caught:
        asyncio.run(enter())
    assert ("ssh-keygen -R" in caught.value.hint) == arrives


def test_who_only_asks_for_a_host_key_hears_of_the_jump_host_too(pins: Pins, monkeypatch: pytest.MonkeyPatch) -> None:
    async def ask(*_: object) -> None:
        raise asyncssh.HostKeyNotVerifiable("Host key is not trusted for host hop with alias bastion")

    monkeypatch.setattr(asyncssh, "get_server_host_key", ask)
    with pytest.raises(FullswarmError, match=r"jump host hop, .*`ssh hop` once"):
        asyncio.run(Login(pins, Path("no key")).host_key(HERE))
