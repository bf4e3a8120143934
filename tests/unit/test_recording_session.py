"""Which recording a console cuts clips from, and what a recorder may ask for at a secured hub."""

from __future__ import annotations

from pathlib import Path

import pytest

from fullswarm.config import DEFAULT_HUB
from fullswarm.errors import ConfigError
from fullswarm.operator.session import Target
from fullswarm.record import session
from fullswarm.record.session import RecordingFinder, Running


def test_it_is_that_of_the_same_swarm_at_the_same_hub(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [
        Running(1, "swarm", "/other-hub.mcap", "tcp/127.0.0.1:7000"),
        Running(2, "other", "/other-swarm.mcap", DEFAULT_HUB),
        Running(3, "swarm", "/of-an-older-version.mcap"),
        Running(4, "swarm", "/mine.mcap", DEFAULT_HUB),
    ]
    monkeypatch.setattr(session, "running", lambda: iter(found))
    assert RecordingFinder(Target(swarm="swarm", hub=None), None)() == Path("/mine.mcap")
    assert RecordingFinder(Target(swarm="swarm", hub="tcp/127.0.0.1:7001"), None)() is None


def test_that_of_up_is_given(tmp_path: Path) -> None:
    finder = RecordingFinder(Target(swarm="swarm", hub=None), tmp_path / "run.mcap")
    assert finder() is None
    (tmp_path / "run.mcap").touch()
    assert finder() == tmp_path / "run.mcap"


def test_a_recorder_at_a_secured_hub_asks_no_robot_for_scans(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(session, "credentials_at", lambda *_: object())
    target = Target(swarm="swarm", hub="tls/hub.lab:7447")
    with pytest.raises(ConfigError, match="an observer, which can ask robots for nothing") as refused:
        session.start(target, tmp_path / "run.mcap", None, 0.0, 0, False, ranges_hz=2.0)
    assert refused.value.hint.startswith("leave it out")
    assert not (tmp_path / "run.mcap").exists()
