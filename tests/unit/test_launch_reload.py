"""Behaviours under development: robots stop, the law is exchanged, they go on; what does not load changes nothing."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from structlog.testing import capture_logs

from fullswarm import registry
from fullswarm.bringup.init import lab_files, write
from fullswarm.config import SwarmConfig
from fullswarm.core.centralised.node import CentralisedNode
from fullswarm.core.settings import record_seeds
from fullswarm.launch import reload
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import RequestStatus
from fullswarm.operator.client import Operator
from fullswarm.store import Store

LAW = """
import numpy as np

def velocity(view, params):
    return np.tile([{vx}, 0.0], (len(view.position), 1)) * params.speed
"""
REMEMBERING = """
from dataclasses import dataclass
import numpy as np
from fullswarm.memory import rows

@dataclass
class Memory:
    calls: object = rows()

def velocity(view, params, memory):
    memory.calls += 1
    return np.tile([1.0, 0.0], (len(view.position), 1)) * params.speed * (memory.calls[:, None] > 75)
"""
RECORD = """
[glide]
summary = "Glide"
law = "glide"
{where}
[glide.parameters]
speed = {{ type = "number", unit = "m/s", default = 0.3, min = 0.0, max = {most}, doc = "how fast" }}
"""


class Lab:
    """A package under development with one law, `glide`, and a swarm of two robots in lockstep."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.law, self.record = folder / "my_lab" / "glide.py", folder / "my_lab" / "glide.toml"
        self.statuses: list[RequestStatus] = []
        self.reports: list[tuple[str, str]] = []  # name of a file, why it does not load

    def note(self, file: Path, problem: str) -> None:
        self.reports.append((file.name, problem))

    def write(self, file: Path, text: str) -> None:
        before = file.stat().st_mtime_ns if file.exists() else 0
        file.write_text(text)
        os.utime(file, ns=(before + 10**9, before + 10**9))  # a file system may count in seconds

    def start(self) -> None:
        robots = [{"id": f"r{k}", "pose": [-8.0, 4.0 * k, 0.0]} for k in (0, 1)]
        world = {"engine": "kinematic", "bounds_m": [-20, -10, 20, 10]}
        config = SwarmConfig.model_validate({"world": world, "robot": robots})
        self.lockstep = Lockstep(config)
        self.lockstep.run(1.0)
        self.operator = Operator(self.lockstep.bus, self.lockstep.keys, self.lockstep.runtime, "test")

    def ask(self, **parameters: float) -> None:
        self.operator.request("glide", (), {**parameters}, self.statuses.append)
        self.lockstep.run(2.0)

    @property
    def speed(self) -> list[float]:
        return [round(float(each), 3) for each in self.lockstep.world.twist[:, 0]]

    @property
    def phase(self) -> str:
        return self.statuses[-1].phase


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    folder = tmp_path / "my-lab"
    write({folder / path: text for path, text in lab_files("my-lab").items()})
    monkeypatch.setenv(registry.DEVELOP, str(folder))
    monkeypatch.setattr(sys, "path", sys.path[:])
    made = Lab(folder)
    yield made
    if hasattr(made, "lockstep"):
        made.lockstep.close()
    for name in [name for name in sys.modules if name.startswith("my_lab")]:
        del sys.modules[name]
    registry.law_module.cache_clear()
    registry.centralised_module.cache_clear()


def entry(lab: Lab, group: str) -> None:
    project = lab.folder / "pyproject.toml"
    project.write_text(project.read_text() + f'\n[project.entry-points."{group}"]\nglide = "my_lab.glide"\n')


@pytest.fixture
def on_board(lab: Lab) -> Lab:
    project = lab.folder / "pyproject.toml"
    project.write_text(
        project.read_text().replace('ring = "my_lab.ring"', 'ring = "my_lab.ring"\nglide = "my_lab.glide"')
    )
    lab.law.write_text(LAW.format(vx=1.0))
    lab.record.write_text(RECORD.format(most=0.4, where=""))
    lab.start()
    return lab


def watch(lab: Lab) -> list[reload.LawReloader]:
    return [
        reload.LawReloader(
            lab.lockstep.runtime, reload.RobotsOf(agent), lambda: registry.loaded(registry.BEHAVIOUR_GROUP), lab.note
        )
        for agent in lab.lockstep.agents
    ]


def test_robots_stand_for_the_exchange_and_then_run_the_new_law(on_board: Lab) -> None:
    lab = on_board
    lab.ask()
    watch(lab)
    lab.lockstep.run(1.0)
    assert lab.speed == [0.3, 0.3]
    lab.write(lab.law, LAW.format(vx=-1.0))
    speeds: list[Any] = []
    for _ in range(200):
        lab.lockstep.run(0.02)
        speeds.append(lab.speed)
    stood = speeds.index([0.0, 0.0])
    assert 0.02 * stood < 1.0
    assert all(0.0 <= speed <= 0.3 for pair in speeds[:stood] for speed in pair)
    assert lab.speed[0] == pytest.approx(0.3, abs=0.01)  # turned round, and on
    assert lab.lockstep.world.twist[0, 0] * np.cos(lab.lockstep.world.pose[0, 2]) < -0.25
    assert lab.phase == "running"


def test_a_file_that_does_not_load_keeps_the_law_and_is_named_with_its_line(on_board: Lab) -> None:
    lab = on_board
    lab.ask()
    watch(lab)
    with capture_logs() as logs:
        for text, says in (
            ("def velocity(view, params):\n    return (\n", "SyntaxError"),
            ("import numpy\n\nraise RuntimeError('half done')\n", "half done"),
            ("", "has no law"),
        ):
            lab.write(lab.law, text)
            lab.lockstep.run(1.0)
            assert lab.speed == [0.3, 0.3]
            told = [each for each in logs if "does not load" in each["event"]]
            assert says in told[-1]["error"]
            assert str(lab.law) in told[-1]["error"]
    assert f"{lab.law}:2" in told[0]["error"]
    assert f"{lab.law}:3" in told[1]["error"]
    assert len(told) == 3
    assert lab.reports == [("glide.py", each["error"]) for each in told]
    lab.write(lab.law, LAW.format(vx=0.5))
    lab.lockstep.run(2.0)
    assert lab.speed == [0.15, 0.15]
    assert lab.reports[3:] == [("glide.py", "")]


def test_memory_starts_afresh(on_board: Lab) -> None:
    lab = on_board
    lab.ask()
    watch(lab)
    lab.lockstep.run(1.0)
    lab.write(lab.law, REMEMBERING)
    lab.lockstep.run(0.9)
    assert lab.speed == [0.0, 0.0]
    lab.lockstep.run(2.0)
    assert lab.speed == [0.3, 0.3]
    lab.write(lab.law, REMEMBERING.replace("> 75", "> 60"))
    lab.lockstep.run(1.2)
    assert lab.speed == [0.0, 0.0]  # its count begins at zero again
    lab.lockstep.run(2.0)
    assert lab.speed == [0.3, 0.3]


def test_a_centralised_law_is_exchanged_as_well(lab: Lab) -> None:
    entry(lab, "fullswarm.centralised")
    lab.law.write_text(LAW.format(vx=1.0))
    lab.record.write_text(RECORD.format(most=0.4, where="centralised = true"))
    lab.start()
    lab.ask()
    node = next(each for each in lab.lockstep._nodes if isinstance(each, CentralisedNode))
    reload.LawReloader(lab.lockstep.runtime, node, lambda: registry.loaded(registry.CENTRALISED_GROUP), lab.note)
    lab.lockstep.run(0.5)
    assert lab.speed == [0.3, 0.3]
    lab.write(lab.law, LAW.format(vx=0.5))
    speeds = []
    for _ in range(100):
        lab.lockstep.run(0.02)
        speeds.append(lab.speed)
    assert [0.0, 0.0] in speeds
    assert lab.speed == [0.15, 0.15]


def test_the_core_and_the_robots_take_a_new_record(on_board: Lab) -> None:
    lab = on_board
    store = next(each for each in lab.lockstep._nodes if isinstance(each, Store))
    with capture_logs() as logs:
        reload.RecordReloader(lab.lockstep.runtime, lambda: store.seed(record_seeds()), lab.note)
        from fullswarm.agent.orders.tasks import read_records_again

        reload.RecordReloader(lab.lockstep.runtime, read_records_again, print)
        lab.ask(speed=0.45)
        assert lab.phase == "refused"
        lab.write(lab.record, RECORD.format(most=0.5, where="") + "colour = 1\n")
        lab.lockstep.run(1.0)
        assert any("do not load" in each["event"] and "glide.toml" in each["error"] for each in logs)
        lab.write(lab.record, RECORD.format(most=0.5, where=""))
        lab.lockstep.run(1.0)
    assert [(file, bool(problem)) for file, problem in lab.reports] == [("glide.toml", True), ("glide.toml", False)]
    assert "glide.toml" in lab.reports[0][1]
    lab.ask(speed=0.45)
    assert lab.phase == "running"
    assert lab.speed == [0.45, 0.45]


def test_a_behaviour_that_is_written_while_the_swarm_runs_can_be_requested(on_board: Lab) -> None:
    lab, project = on_board, on_board.folder / "pyproject.toml"
    store = next(each for each in lab.lockstep._nodes if isinstance(each, Store))
    said: list[str] = []
    reload.Reporter(lab.lockstep.runtime, said.append)
    reload.RecordReloader(lab.lockstep.runtime, lambda: store.seed(record_seeds()), lab.note)
    lab.lockstep.run(1.0)
    assert (said, lab.reports) == ([], [])
    lab.law.with_name("slide.py").write_text(LAW.format(vx=0.5))
    lab.record.with_name("slide.toml").write_text(RECORD.replace("glide", "slide").format(most=0.4, where=""))
    lab.write(project, project.read_text().replace("glide =", 'slide = "my_lab.slide"\nglide ='))
    lab.lockstep.run(1.0)
    assert said == ["slide.py is loaded", "slide.toml is loaded"]
    assert lab.reports == [("slide.toml", "")]
    lab.operator.request("slide", (), {}, lab.statuses.append)
    lab.lockstep.run(2.0)
    assert lab.phase == "running"
    assert lab.speed == [0.15, 0.15]
    assert len(said) == 2


def test_a_law_that_was_never_good_is_refused_with_its_line_and_runs_once_it_is(on_board: Lab) -> None:
    lab = on_board
    for text, why in (
        ("x = 1\ny = = 2\n", "SyntaxError: invalid syntax"),
        ("x = 1\ny = int('z')\n", "ValueError: invalid literal"),
        ("from fullswarm.envs import policy\n_law = policy('none.onnx')\n", "none.onnx: no such file"),
    ):
        lab.write(lab.law, text)
        lab.ask()
        assert lab.phase != "running"
        assert f"{lab.law}:2: 'my_lab.glide' does not import: {why}" in lab.statuses[-1].reason
    lab.write(lab.law, LAW.format(vx=1.0))
    lab.ask()
    assert lab.phase == "running"


def test_a_project_file_that_is_being_edited_ends_nothing(on_board: Lab) -> None:
    lab, project = on_board, on_board.folder / "pyproject.toml"
    lab.ask()
    watch(lab)
    good = project.read_text()
    with capture_logs() as logs:
        lab.write(project, good + "[half")
        lab.lockstep.run(1.0)
    assert [each["event"] for each in logs] == ["the behaviours under development are unknown"]
    assert "pyproject.toml" in logs[0]["error"]
    lab.write(project, good)
    lab.write(lab.law, LAW.format(vx=0.5))
    lab.lockstep.run(2.0)
    assert lab.speed == [0.15, 0.15]


def test_looking_at_the_files_reads_no_installed_package(on_board: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    on_board.ask()
    watch(on_board)
    read: list[str] = []

    def entry_points(**named: str) -> tuple[str, ...]:
        read.append(str(named))
        return ()

    monkeypatch.setattr("importlib.metadata.entry_points", entry_points)
    on_board.lockstep.run(2.0)
    assert read == []


def test_built_in_laws_are_not_watched(on_board: Lab) -> None:
    assert set(registry.law_files()) == {"ring", "glide"}
    on_board.ask()
    assert set(registry.loaded(registry.BEHAVIOUR_GROUP)) == {"glide"}
