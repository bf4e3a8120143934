"""Replay: nodes do again what they did, to the bit, and the first thing that they do differently is named."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from typer.testing import CliRunner

from fullswarm.agent.behaviours import move_to_goal
from fullswarm.bus.base import OPERATOR
from fullswarm.cli.main import app
from fullswarm.config import SwarmConfig
from fullswarm.errors import ConfigError
from fullswarm.journal.journal import _encoder as encoder
from fullswarm.journal.journal import compressed, read_block
from fullswarm.launch.lockstep import Lockstep
from fullswarm.operator.client import Operator
from fullswarm.record.lockstep import LockstepRecorder
from fullswarm.record.replay import Outcome, Recorded, Window, check_code, recorded_in, run_journal

PLAIN: dict[str, Any] = {
    "world": {"engine": "kinematic", "bounds_m": (0.0, 0.0, 6.0, 6.0), "seed": 3},
    "robot": [{"id": f"r{row}", "pose": (1.5 + row, 1.5, 0.5 * row)} for row in range(3)],
}
BOXES = [{"center_m": (3.0, 3.0), "half_m": (0.4, 0.2)}]


def world(**changes: Any) -> dict[str, Any]:
    return {**PLAIN, "world": {**PLAIN["world"], **changes}}


SWARMS: Mapping[str, dict[str, Any]] = {
    "plain": PLAIN,
    "bad network": {**PLAIN, "network": {"conditions": "loss=20%,delay=50ms±30"}},
    "ranges": world(ranges={"count": 60, "max_m": 5.0, "sigma_m": 0.01, "dropout": 0.02, "rate_hz": 10.0}),
    "noise": world(noise={"position_m": 0.02, "odometry": 0.02}),
    "odometry alone": world(sight={"pose": False}, noise={"odometry": 0.02}),
    "batteries": {
        **world(battery={"start": 0.32, "drive_per_m": 0.02, "rest_per_h": 0.1, "turn_per_rad": 0.0}),
        "dock": [{"id": "d1", "pose": (0.3, 3.0, np.pi)}],
    },
}  # fmt: skip


def record(path: Path, config: SwarmConfig, seconds: float = 6.0) -> Lockstep:
    """Record a run in which robots drive, gather, keep a formation of the base station, are stopped and latched."""
    recorder = LockstepRecorder(path, config.swarm)
    lockstep = Lockstep(config, recorder.begin)
    recorder.record(lockstep)
    numbers = itertools.count()
    operator = Operator(
        lockstep.bus_of(OPERATOR), lockstep.keys, lockstep.runtime, "test", new_id=lambda: f"q{next(numbers)}"
    )
    part_s = seconds / 6.0
    lockstep.run(part_s)
    operator.request("move_to_goal_bc", (), {"goal": [4.0, 4.5]})
    lockstep.run(2 * part_s)
    operator.request("formation_assigned_bc", (), {"targets": [[2.0, 2.0], [3.0, 4.0], [4.0, 2.0]]})
    lockstep.run(part_s)
    operator.stop(("r0",))
    lockstep.run(0.5 * part_s)
    operator.estop(True, ("r1",))
    lockstep.run(0.5 * part_s)
    operator.request("flocking_bc", ("r0", "r2"))
    lockstep.run(part_s)
    lockstep.report()
    operator.close()
    lockstep.close()
    recorder.close()
    return lockstep


def again(found: Recorded, window: Window | None = None) -> dict[str, Outcome]:
    window = window or Window()
    return {each: run_journal(each, each, blocks, 0.0, window) for each, blocks in found.journals.items()}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "run.mcap"
    record(path, SwarmConfig.model_validate(PLAIN))
    return path


@pytest.mark.parametrize("kind", SWARMS)
def test_the_same_nodes_do_the_same(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    lockstep = record(path, SwarmConfig.model_validate(SWARMS[kind]))
    found = recorded_in([path])
    check_code(found)
    outcomes = again(found)
    assert len(outcomes) == 2 + len(lockstep.agents)
    for outcome in outcomes.values():
        assert not outcome.trouble
        assert outcome.first is None
        assert outcome.outputs > 50
    assert sum(each.commands for each in outcomes.values()) > 250 * len(lockstep.agents)


def test_a_recorded_run_is_the_run_that_is_not_recorded(tmp_path: Path) -> None:
    config = SwarmConfig.model_validate(SWARMS["noise"])
    recorded = record(tmp_path / "run.mcap", config)
    begin, LockstepRecorder.begin = LockstepRecorder.begin, None  # type: ignore[method-assign, assignment]
    try:
        plain = record(tmp_path / "plain.mcap", config)
    finally:
        LockstepRecorder.begin = begin  # type: ignore[method-assign]
    assert recorded.world.pose.tobytes() == plain.world.pose.tobytes()
    with pytest.raises(ConfigError, match="no journal"):
        recorded_in([tmp_path / "plain.mcap"])


def test_a_changed_gain_is_named_at_its_first_effect(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    law = move_to_goal.velocity

    def changed(view: Any, params: Any) -> Any:
        return law(view, params._replace(gain=1.001 * params.gain))

    monkeypatch.setattr(move_to_goal, "velocity", changed)
    outcomes = again(recorded_in([recording]))
    assert outcomes["core-0"].first is None
    first = outcomes["lockstep-0"].first
    assert first is not None
    assert first.what.startswith(("command of r", "behaviour"))
    assert first.during == "timer AgentNode.tick"
    # The goal was requested at 1 s; an agent evaluates the law at its next tick.
    assert 1.0 <= outcomes["lockstep-0"].at_s <= 1.06
    assert first.then != first.now


def test_a_changed_setting_is_named(recording: Path) -> None:
    found = recorded_in([recording])
    blocks = found.journals["lockstep-0"]
    number, items = read_block(blocks[0])
    config = json.loads(items[0]["config"])
    config["agent"]["speed_limit_m_s"] = 0.1
    items[0]["config"] = json.dumps(config)
    blocks[0] = compressed(encoder.encode((number, items)))
    outcome = again(found)["lockstep-0"]
    assert outcome.first is not None
    assert outcome.different > 10


def test_only_what_is_within_the_window_is_compared(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = recorded_in([recording])
    whole = again(found)["lockstep-0"]
    part = again(found, Window(1.0, 2.0))["lockstep-0"]
    assert part.commands == pytest.approx(whole.commands / 6, abs=2)
    law = move_to_goal.velocity
    monkeypatch.setattr(move_to_goal, "velocity", lambda view, params: -law(view, params))
    assert again(found, Window(0.0, 0.9))["lockstep-0"].first is None
    assert again(found, Window(0.0, 1.5))["lockstep-0"].first is not None


def test_blocks_that_are_missing_are_named(recording: Path) -> None:
    found = recorded_in([recording])
    blocks = found.journals["lockstep-0"]
    del blocks[10:12]
    outcome = again(found)["lockstep-0"]
    assert "2 blocks of its journal are missing" in outcome.trouble
    assert outcome.first is None
    assert outcome.events > 50
    del blocks[0]
    assert "beginning" in again(found)["lockstep-0"].trouble


def test_blocks_in_any_order_and_twice_are_the_same(recording: Path) -> None:
    found = recorded_in([recording])
    blocks = found.journals["core-0"]
    found.journals["core-0"] = [*reversed(blocks), *blocks[3:7]]
    outcome = again(found)["core-0"]
    assert not outcome.trouble
    assert outcome.first is None


def test_a_damaged_journal_is_no_crash(recording: Path) -> None:
    found = recorded_in([recording])
    random = np.random.default_rng(5)
    found.journals = {"centralised-0": found.journals["centralised-0"][:2]}
    number, items = read_block(found.journals["centralised-0"][0])
    for _ in range(60):
        changed = [items[0], *(wild(each, random) for each in items[1:])]
        found.journals["centralised-0"][0] = compressed(encoder.encode((number, changed)))
        outcome = again(found)["centralised-0"]
        assert isinstance(outcome, Outcome)  # it ends, and says something
    for key in items[0]:
        head = {name: each for name, each in items[0].items() if name != key}
        found.journals["centralised-0"][0] = compressed(encoder.encode((number, [head, *items[1:]])))
        again(found)


def wild(item: Any, random: np.random.Generator) -> Any:
    """Return an item, sometimes with another element in a place."""
    if random.random() > 0.1 or not isinstance(item, list):
        return item
    item = list(item)
    item[int(random.integers(len(item)))] = (None, "x", 99, b"", [], {"a": 1}, -1.5)[int(random.integers(7))]
    return item


def test_other_code_is_refused(recording: Path) -> None:
    found = recorded_in([recording])
    found.code = "0" * 64
    with pytest.raises(ConfigError, match="other code") as error:
        check_code(found)
    assert "--with-code" in (error.value.hint or "")


def test_a_file_that_is_none_and_one_without_journals(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"nothing")
    for path in (tmp_path / "a.mcap", tmp_path / "missing.mcap"):
        with pytest.raises(ConfigError):
            recorded_in([path])


def replayed(*arguments: str) -> Iterator[Any]:
    result = CliRunner().invoke(app, ["replay", *arguments])
    yield result.exit_code
    yield result.stdout or result.stderr


def test_the_command(recording: Path) -> None:
    code, text = replayed(str(recording), "--json")
    assert code == 0
    assert {each["name"]: each["first"] for each in json.loads(text)} == {
        "core": None, "centralised": None, "lockstep": None,
    }  # fmt: skip
    code, text = replayed(str(recording), "--robot", "core", "--from", "2", "--to", "3")
    assert code == 0
    assert "are equal" in text
    assert "lockstep" not in text


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(("--robot", "r9"), "there are: centralised, core, lockstep"), (("--from", "3", "--to", "2"), "--to 2")],
)
def test_the_command_refuses(recording: Path, arguments: tuple[str, ...], said: str) -> None:
    code, text = replayed(str(recording), *arguments)
    assert code == 2
    assert said in text.replace("\n", " ")


def test_a_continued_recording_is_read_to_its_end(recording: Path, tmp_path: Path) -> None:
    data = msgspec.msgpack.encode([("x", b"y")])
    from fullswarm.record.recorder import JOURNAL, JOURNAL_TYPE
    from fullswarm.record.recording import Recording

    made = Recording(tmp_path / "a.mcap", {}, limit_bytes=1)
    for _ in range(3):
        made.attach(JOURNAL, JOURNAL_TYPE, 1, data)
        made.flush()
    made.close()
    assert len(made.files) > 2
    assert recorded_in([tmp_path / "a.mcap"]).journals == {"x": [b"y"] * 3}
