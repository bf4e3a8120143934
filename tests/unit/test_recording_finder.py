"""Which recording a console cuts clips from: that of its own swarm at its own hub."""

from __future__ import annotations

from pathlib import Path

import pytest

from fullswarm.config import DEFAULT_HUB
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
