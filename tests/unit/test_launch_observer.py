"""Where an observer's server listens, what it says of it, and which logs a live view shows."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest

from fullswarm.errors import ConfigError, MissingExtra, Unreachable
from fullswarm.keys import Keys
from fullswarm.launch import observer
from fullswarm.launch.observer import Address, need
from fullswarm.launch.run_folder import RunFolder, running
from fullswarm.launch.spare import FLEET
from fullswarm.operator.session import Target
from fullswarm.record import live
from fullswarm.record.recorder import Recorder
from tests.unit.test_recording import START_NS
from tests.unit.test_viewer import Rig


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


def test_a_missing_package_is_named_with_the_command_that_brings_it() -> None:
    need(("json",), "the view", "record,console")
    with pytest.raises(MissingExtra) as raised:
        need(("json", "no_such_package"), "the view", "record,console")
    assert str(raised.value) == "the view needs no_such_package (pip install 'fullswarm[record,console]')"
    assert raised.value.exit_code == 2


@pytest.mark.parametrize(
    ("host", "shown", "local"),
    [("127.0.0.1", "127.0.0.1:80", True), ("::1", "[::1]:80", True), ("192.0.2.7", "192.0.2.7:80", False)],
)
def test_an_address_is_shown_as_others_name_it(host: str, shown: str, local: bool) -> None:
    assert (Address(host, 80).shown, Address(host, 80).local) == (shown, local)


def test_an_address_for_all_is_shown_as_one_of_this_machine() -> None:
    assert not Address("0.0.0.0", 80).local
    assert Address("0.0.0.0", 80).shown != "0.0.0.0:80"


@pytest.mark.parametrize("listen", ["9464", "127.0.0.1:", "127.0.0.1:99999", "::1:80"])
def test_a_malformed_address_is_refused_before_anything_starts(listen: str) -> None:
    with pytest.raises(ConfigError, match="HOST:PORT"):
        observer.serve(Target(), "x", listen, _never, _never, wait=False)
    with pytest.raises(Unreachable, match="cannot listen"):
        observer.serve(Target(), "x", "192.0.2.7:0", _never, _never, wait=False)


def _never(*_: Any) -> Any:
    raise AssertionError("nothing may start")


def started(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], address: Address, as_json: bool
) -> tuple[str, str]:
    """Return what `viewer foxglove` prints on stdout and stderr once it listens on an address."""

    def serve(*given: Any, wait: bool) -> int:
        assert wait
        given[-1](address)
        return 0

    monkeypatch.setattr(live, "serve", serve)
    assert live.show(Target(swarm="hall"), "", frozenset(), as_json) == 0
    return capsys.readouterr()


def test_a_view_that_others_can_reach_says_who_can_read_what(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, err = started(monkeypatch, capsys, Address("127.0.0.1", 8765), False)
    assert out == "ws://127.0.0.1:8765\n"
    assert "can read" not in err
    out, err = started(monkeypatch, capsys, Address("192.0.2.7", 8765), False)
    assert out == "ws://192.0.2.7:8765\n"
    assert "every program that reaches 192.0.2.7:8765 can read all that swarm 'hall' publishes" in err
    out, _ = started(monkeypatch, capsys, Address("127.0.0.1", 8765), True)
    assert json.load(io.StringIO(out))["url"] == "ws://127.0.0.1:8765"


def test_a_view_finds_the_logs_of_the_run_with_its_hub_and_swarm(temporary: Path) -> None:
    def run(hub: str, swarm: str) -> RunFolder:
        folder = RunFolder()
        (folder.path / FLEET).write_text(f'swarm = "{swarm}"\n[hub]\nendpoint = "{hub}"\n[fleet]\ncount = 1\n')
        return folder

    broken, other, mine = RunFolder(), run("tcp/127.0.0.1:7000", "hall"), run("tcp/127.0.0.1:7001", "hall")
    (broken.path / FLEET).write_text("swarm = 5 =")
    assert set(running()) == {broken.path, other.path, mine.path}
    assert live.logs_of(Target("tcp/127.0.0.1:7001", "hall")) == mine.path
    assert live.logs_of(Target("tcp/127.0.0.1:7001", "yard")) is None
    mine.close()
    assert live.logs_of(Target("tcp/127.0.0.1:7001", "hall")) is None
    assert set(running()) == {broken.path, other.path}
    other.close()
    broken.close()


def test_a_view_has_the_lines_that_the_logs_get(tmp_path: Path) -> None:
    rig = Rig()
    Recorder(rig.air, Keys("s"), rig.runtime, rig.channels, START_NS, tmp_path, flush_s=0.05)
    (tmp_path / "core.log").write_text("2026-11-27 09:00:00 [warning  ] a robot is gone   robot=r1\n")
    rig.runtime.run(0.1)
    channel = next(each for each in rig.channels._by_id.values() if each.announcement["topic"] == "/log")
    assert channel.last is not None
    assert b"a robot is gone" in channel.last[1]
