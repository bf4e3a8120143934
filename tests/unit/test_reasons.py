"""Programs decide by the codes of reasons: with every text changed they do the same.

The swarm of the test is a real one in lockstep: core, agents, operators. It is run with the texts as they are, and with
texts without a meaning; what the two runs lead to must be the same.
"""

from __future__ import annotations

import ast
import string
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

import fullswarm
from fullswarm import reasons
from fullswarm.agent.motion import robot_controller
from fullswarm.bus.base import OPERATOR, NamedBus
from fullswarm.config import SwarmConfig
from fullswarm.drivers.base import STOPPING_HAZARDS, Hazard
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import EStop, HealthReport, LeaseRequest, RequestStatus, RobotHealth, StopRequest
from fullswarm.operator.client import Operator
from fullswarm.operator.console.log import for_page
from fullswarm.operator.outcome import refusal
from fullswarm.operator.robot_state import advise, row_state
from fullswarm.operator.view import RobotRow
from fullswarm.reasons import TEXTS, Code, Reason, given, joined, reason

FAR = {"goal": [9.0, 3.0]}
PACKAGE = Path(fullswarm.__file__).parent
TOLD = {"reason", "stop_reason", "fault", "pose_note", "filter_note"}
"""Fields of messages that hold texts for people."""


def meaningless(text: str) -> str:
    """Return another text with the same parameters."""
    names = [name for _, name, _, _ in string.Formatter().parse(text) if name]
    return "".join(["wibble ", *(f"{{{name}}} " for name in names), "wobble"]) if text else ""


@dataclass
class Seen:
    """What a run has led to, without any text."""

    statuses: list[tuple[Any, ...]] = field(default_factory=list)
    exits: list[int] = field(default_factory=list)
    rows: list[tuple[str, bool, str, str]] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)


class Base:
    """Two robots, a core, and operators who disagree."""

    def __init__(self) -> None:
        robots = [{"id": f"r{k}", "pose": (2.0 * k, 1.0, 0.0)} for k in (1, 2)]
        config = SwarmConfig.model_validate(
            {"world": {"engine": "kinematic", "bounds_m": (0.0, 0.0, 12.0, 7.0)}, "robot": robots}
        )
        self.lockstep = Lockstep(config)
        self.bus, self.keys, self.seen = NamedBus(self.lockstep.bus, OPERATOR), Keys(), Seen()
        self.operator = Operator(self.bus, self.keys, self.lockstep.runtime, "anna")
        self.health: dict[str, RobotHealth] = {}
        self.bus.subscribe(self.keys.health("*"), HealthReport, self._report)
        self.lockstep.run(1.0)

    def _report(self, report: HealthReport) -> None:
        self.health.update({each.robot: each for each in report.robots})

    def ask(self, behaviour: str, parameters: Mapping[str, Any]) -> RequestStatus:
        heard: list[RequestStatus] = []
        self.operator.request(behaviour, (), dict(parameters), heard.append)
        self.lockstep.run(0.6)
        newest = heard[-1]
        self.seen.statuses.append((newest.phase, newest.code, dict(newest.parameters).keys(), newest.refused_by))
        self.seen.texts.append(newest.reason)
        if newest.phase == "refused":
            self.seen.exits.append(refusal(newest).exit_code)
            self.seen.texts.append(for_page(newest))
        return newest

    def look(self) -> None:
        self.lockstep.run(0.6)
        for robot, health in sorted(self.health.items()):
            row = RobotRow(robot, 0.1, 0.0, 0.0, 0.0, 0.0, health)
            state = row_state(row)
            self.seen.rows.append((state.word, state.attention, advise(row), health.stop_code))
            self.seen.texts.append(state.why)


def run() -> Seen:
    """Let operators disagree, stop and release; return what came of it."""
    base = Base()
    base.bus.publish(base.keys.lease_request, LeaseRequest(operator="bob", robots=("r1",), hold=True))
    base.lockstep.run(0.2)
    assert base.ask("move_to_goal", FAR).code == Code.HELD
    base.bus.publish(base.keys.lease_request, LeaseRequest(operator="bob", robots=("r1",), hold=False))
    base.lockstep.run(0.2)
    assert base.ask("move_to_goal", {"gaol": [1.0, 1.0]}).code == Code.PARAMETERS
    assert base.ask("move_to_goal", FAR).phase == "running"
    base.bus.publish(base.keys.stop, StopRequest(id="s1", source="bob"))
    base.look()
    assert base.seen.rows[-1][3] == Code.STOPPED
    assert base.ask("move_to_goal", FAR).phase == "running"
    base.bus.publish(base.keys.estop, EStop(id="e1", engaged=True, source="bob"))
    base.look()
    assert base.ask("move_to_goal", FAR).code == Code.ESTOP_LATCHED
    base.bus.publish(base.keys.estop, EStop(id="e2", engaged=False, source="bob"))
    base.look()
    base.ask("drive_bc", {"linear": 0.1, "angular": 0.0})
    base.look()
    return base.seen


@pytest.fixture
def changed(monkeypatch: pytest.MonkeyPatch) -> None:
    for code, text in TEXTS.items():
        monkeypatch.setitem(TEXTS, code, meaningless(text))
    for hazard, (what, mend) in robot_controller.HAZARDS.items():
        monkeypatch.setitem(robot_controller.HAZARDS, hazard, (meaningless(what), meaningless(mend)))


@pytest.fixture(scope="module")
def usual() -> Seen:
    return run()


@pytest.mark.usefixtures("changed")
def test_a_swarm_does_the_same_with_every_text_changed(usual: Seen) -> None:
    seen = run()
    assert seen.statuses == usual.statuses
    assert seen.exits == usual.exits == [2, 2, 4]
    assert seen.rows == usual.rows
    assert seen.texts != usual.texts
    assert any("wibble" in each for each in seen.texts)


@pytest.mark.parametrize("code", [*TEXTS, "one that only a newer version knows"])
def test_what_is_shown_of_a_robot_follows_the_code_and_not_the_text(code: str) -> None:
    def shown(text: str) -> tuple[str, bool, str]:
        health = RobotHealth(
            robot="r1", driver="sim://r1", make="m", model="m", firmware="f", lifecycle="READY", behaviour="flocking",
            stop_reason=text, stop_code=code,
        )  # fmt: skip
        row = RobotRow("r1", 0.1, 0.0, 0.0, 0.0, 0.0, health)
        state = row_state(row)
        return state.word, state.attention, advise(row)

    assert shown("wibble") == shown("the hub is lost") == shown("it was stopped by ann: no fresh command")


def test_each_reason_of_the_table_can_be_worded() -> None:
    for code, text in TEXTS.items():
        names = [name for _, name, _, _ in string.Formatter().parse(text) if name]
        made = reason(code, **dict.fromkeys(names, "x"))
        assert made.code == code
        assert "{" not in made.text
        assert bool(made) is bool(code)


def test_every_hazard_that_stops_a_robot_has_a_code_of_its_own_or_needs_the_driver_s_words() -> None:
    named = {str(each.name).lower() for each in robot_controller.HAZARDS} - {"estop_button"}
    assert named <= set(Code)
    assert all(hazard & STOPPING_HAZARDS for hazard in robot_controller.HAZARDS)
    assert Hazard.BUMP not in robot_controller.HAZARDS


def test_reasons_of_several_robots_are_one_where_they_agree() -> None:
    latched, flat = reason(Code.ESTOP_LATCHED), reason(Code.BATTERY)
    same = joined({"r1": latched, "r2": latched})
    assert (same.code, same.text) == (Code.ESTOP_LATCHED, f"r1, r2: {latched}")
    several = joined({"r1": latched, "r2": flat})
    assert (several.code, several.parameters) == (Code.SEVERAL, {"r1": Code.ESTOP_LATCHED, "r2": Code.BATTERY})
    assert reasons.holds(several.code, several.parameters, Code.ESTOP_LATCHED)
    assert not reasons.holds(several.code, several.parameters, Code.HELD)
    assert not reasons.holds(flat.code, {"robot": "held"}, Code.HELD)


def test_no_text_is_no_reason() -> None:
    assert not given("")
    assert not Reason()
    assert given("x").code == Code.GIVEN


# ------------------------------------------------------------------ the source
def test_no_code_looks_for_words_in_the_texts_of_messages() -> None:
    """No `"…" in health.fault`, no `.startswith("…")` and the like on a field that holds a text for people."""
    found = {
        f"{path.relative_to(PACKAGE)}: {ast.unparse(node)}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if _reads_words(node)
    }
    assert found == set()


def _reads_words(node: ast.AST) -> bool:
    if isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.In | ast.NotIn | ast.Eq | ast.NotEq):
        sides = (node.left, node.comparators[0])
        words = any(isinstance(each, ast.Constant) and isinstance(each.value, str) and each.value for each in sides)
        return words and any(isinstance(each, ast.Attribute) and each.attr in TOLD for each in sides)
    if (
        isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and isinstance(node.func.value, ast.Attribute)
    ):
        return node.func.value.attr in TOLD and node.func.attr in {"startswith", "find", "index", "partition", "split"}
    return False


def test_the_check_itself_sees_what_it_looks_for() -> None:
    def reads(line: str) -> bool:
        return any(_reads_words(node) for node in ast.walk(ast.parse(line)))

    assert reads('"held by" in status.reason')
    assert reads('health.stop_reason.startswith("law")')
    assert not reads('health.stop_code == "law"')
