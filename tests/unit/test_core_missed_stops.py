"""Stops that were sent while the core was down: the next core must not undo them, whatever it had kept."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from fullswarm.agent.orders.estops import LatchFolder
from fullswarm.config.mission_file import parse_mission
from fullswarm.messages import (
    STOP,
    BehaviourRequest,
    ControlRequest,
    EStop,
    Message,
    MissionRequest,
    MissionStatus,
    StopRequest,
    Value,
)
from fullswarm.operator.client import Operator
from fullswarm.operator.missions import MissionClient
from tests.unit.mission_lab import Killed, MortalStore
from tests.unit.whole_swarm import KEYS, Whole

MISSION = """
name = "tour"
[[steps]]
name = "go"
behaviour = "move_to_goal_bc"
parameters = { goal = [40.0, 10.0] }
done = { time_s = 1.5 }
on_failed = "continue"
[[steps]]
name = "flock"
behaviour = "flocking_bc"
done = { time_s = 1.5 }
on_failed = "continue"
[[steps]]
name = "back"
behaviour = "move_to_goal_bc"
parameters = { goal = [-40.0, 10.0] }
done = { time_s = 60.0 }
"""


@dataclass
class Life:
    """Lets a database's process die at a write."""

    left: int
    armed: bool = False

    def write(self, _moment: str) -> None:
        self.left -= self.armed
        if self.armed and not self.left:
            raise Killed


class Lab:
    """A whole swarm with a mission, and an operator whose stops reach the robots and no core."""

    def __init__(self, path: Path) -> None:
        self.whole = Whole(path=path, latches=path.with_suffix(".latches"))
        self.missions = MissionClient(
            self.whole.bus, KEYS, self.whole.runtime, "anna", clock="lab", on_status=self._received
        )
        self.status: MissionStatus | None = None

    def _received(self, status: MissionStatus) -> None:
        self.status = status

    def start(self) -> None:
        self.missions.ask("start", plan=parse_mission(MISSION, "tour.toml", "tour").plan)
        self.whole.run(0.5)
        assert self.whole.driven()

    def stop(self) -> None:
        self.whole.operator.stop()

    def estop(self) -> None:
        self.whole.operator.estop(True, reason="a child in the arena")
        self.whole.run(1.0)
        self.whole.operator.estop(False)

    def close(self) -> None:
        self.missions.close()
        self.whole.close()


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    made = Lab(tmp_path / "core.db")
    yield made
    made.close()


@pytest.mark.parametrize("act", [Lab.stop, Lab.estop])
@pytest.mark.parametrize("silent_s", [0.02, 0.9, 1.4])
@pytest.mark.parametrize("ran_s", [0.1, 0.95, 2.4])
def test_a_mission_stopped_while_the_core_is_down_stays_stopped(
    lab: Lab, act: Callable[[Lab], None], silent_s: float, ran_s: float
) -> None:
    """The stop comes before and after the robots have missed the core; the step may be over by then."""
    lab.start()
    lab.whole.run(ran_s)
    lab.whole.kill_core()
    lab.whole.run(silent_s)
    act(lab)
    lab.whole.run(0.7)
    lab.whole.start_core()
    assert lab.whole.drives_within(5.0) == []
    assert lab.status is not None
    assert lab.status.phase == "paused", lab.status
    assert " by op" in lab.status.reason


@pytest.mark.parametrize("stopped_after", [True, False])
def test_a_resumption_that_reaches_the_next_core_is_as_old_as_it_is(lab: Lab, stopped_after: bool) -> None:
    """The new core receives it before the robots report the stop; whichever was asked last holds."""
    lab.start()
    lab.missions.ask("pause")
    lab.whole.run(0.5)
    lab.whole.kill_core()
    lab.whole.run(0.1)
    stopper = Operator(lab.whole.bus, KEYS, lab.whole.runtime, "op", clock="lab")  # of the same computer
    stopper = Operator(lab.whole.bus, KEYS, lab.whole.runtime, "op", clock="lab")  # of the same computer
    if not stopped_after:
        stopper.stop()
        lab.whole.run(0.3)
    resume = MissionRequest(
        id="late", op="resume", source="anna", operator="anna", clock="lab", stamp_s=lab.whole.runtime.now_s()
    )
    lab.whole.run(0.3)
    if stopped_after:
        stopper.stop()
        lab.whole.run(0.5)
    lab.whole.start_core()
    lab.whole.bus.publish(KEYS.mission_request, resume)
    driven = lab.whole.drives_within(5.0)
    assert lab.status is not None
    assert (driven == [], lab.status.phase) == (stopped_after, "paused" if stopped_after else "running")
    stopper.close()


def test_a_stop_of_one_robot_pauses_the_mission_of_all(lab: Lab) -> None:
    lab.start()
    lab.whole.kill_core()
    lab.whole.run(0.1)
    lab.whole.operator.stop(["r1"])
    lab.whole.run(0.7)
    lab.whole.start_core()
    assert "r1" not in lab.whole.drives_within(1.0)
    assert lab.whole.drives_within(4.0) == []
    assert lab.status is not None
    assert lab.status.phase == "paused"


@pytest.mark.parametrize("act", [Lab.stop, Lab.estop])
@pytest.mark.parametrize("silent_s", [0.1, 1.4])
def test_a_stop_outlives_the_agents_as_well(lab: Lab, act: Callable[[Lab], None], silent_s: float) -> None:
    """Core and agents are killed around the stop; both come back in either order."""
    lab.start()
    lab.whole.kill_core()
    lab.whole.run(silent_s)
    act(lab)
    lab.whole.run(0.3)
    for robot in list(lab.whole.agents):
        lab.whole.kill_agent(robot)
        lab.whole.start_agent(robot)
    lab.whole.run(0.5)
    lab.whole.start_core()
    assert lab.whole.drives_within(5.0) == []
    assert lab.status is not None
    assert lab.status.phase == "paused", lab.status


@pytest.mark.parametrize("act", [Lab.stop, Lab.estop])
def test_a_stop_of_a_behaviour_outlives_core_and_agents(lab: Lab, act: Callable[[Lab], None]) -> None:
    whole = lab.whole
    whole.operator.request("move_to_goal_bc", (), {"goal": [40.0, 10.0]}, lambda _status: None)
    whole.run(2.0)
    assert whole.driven()
    whole.kill_core()
    act(lab)
    whole.run(0.1)
    for robot in list(whole.agents):
        whole.kill_agent(robot)
    whole.run(0.5)
    for robot in whole.worlds:
        whole.start_agent(robot)
    whole.start_core()
    assert whole.drives_within(5.0) == []


@pytest.mark.parametrize("rebooted", [False, True])
def test_what_was_asked_for_after_a_stop_outlives_an_agent(lab: Lab, tmp_path: Path, rebooted: bool) -> None:
    """The agent is down while it is asked; the core knows the stop, also when the time that is kept means nothing."""
    whole = lab.whole
    whole.operator.stop()
    whole.run(0.5)
    whole.kill_agent("r1")
    whole.run(0.5)
    whole.operator.request("move_to_goal_bc", ("r1",), {"goal": [40.0, 10.0]}, lambda _status: None)
    whole.run(0.5)
    if rebooted:
        for file in whole.latches.glob("*.stop") if whole.latches else ():
            file.write_text(file.read_text().replace('"clock":"lab"', '"clock":"boot before"'))
    whole.start_agent("r1")
    assert whole.drives_within(3.0) == ["r1"]
    assert whole.latches is not None
    kept = LatchFolder(whole.latches, "lab")
    assert [kept.halt_of(robot, 0.0).halt is None for robot in ("r0", "r1", "r2")] == [False, True, False]


def test_a_core_killed_at_any_write_of_a_stop_does_not_undo_it(tmp_path: Path) -> None:
    """The stop reaches the core as well, which dies before or after one of the writes that follow from it."""
    for instant in itertools.count(1):
        path = tmp_path / f"{instant}.db"
        lab, life = Lab(path), Life(instant)
        lab.whole.kill_core()
        lab.whole.start_core(MortalStore(path, life.write))
        lab.whole.run(0.6)
        lab.start()
        life.armed = True
        with contextlib.suppress(Killed):
            lab.stop()
            lab.whole.run(0.5)
        life.armed = False
        lab.whole.kill_core()
        lab.whole.run(0.6)
        lab.whole.start_core()
        assert lab.whole.drives_within(5.0) == [], instant
        assert lab.status is not None
        assert (lab.status.phase, lab.status.reason) == ("paused", "stopped by op"), instant
        lab.close()
        if life.left > 0:
            break
    assert instant > 3


def test_a_request_that_no_robot_has_received_does_not_start_after_a_stop(lab: Lab) -> None:
    """The core has kept it, and is killed before it is sent: the robots cannot know that the stop concerns it."""
    whole = lab.whole
    whole.operator.request("flocking_bc")
    whole.run(0.5)
    publish = whole.bus.publish

    def lose(key: str, message: Message, *, sender: str = "") -> None:
        if not isinstance(message, ControlRequest):
            publish(key, message, sender=sender)

    whole.bus.publish = lose  # type: ignore[method-assign]
    late = whole.operator.request("move_to_goal_bc", parameters={"goal": [40.0, 10.0]})
    whole.run(0.3)
    whole.kill_core()
    whole.bus.publish = publish  # type: ignore[method-assign]
    whole.run(0.1)
    whole.operator.stop()
    whole.run(0.7)
    whole.start_core()
    assert whole.drives_within(5.0) == []
    assert whole.status(late.request.id).phase in ("ended", "superseded")


def test_what_is_requested_after_the_stop_starts(lab: Lab) -> None:
    """Before the first report of a robot reaches the new core, which tells it of the stop."""
    lab.whole.kill_core()
    lab.whole.operator.stop()
    lab.whole.run(0.7)
    lab.whole.start_core()
    newer = lab.whole.operator.request("move_to_goal_bc", parameters={"goal": [40.0, 10.0]})
    lab.whole.run(1.0)
    assert lab.whole.status(newer.request.id).phase == "running"
    assert sorted(lab.whole.driven()) == ["r0", "r1", "r2"]


@pytest.mark.parametrize("copies", [1, 5])
def test_a_resumed_mission_goes_on_although_its_robots_still_report_the_stop(lab: Lab, copies: int) -> None:
    lab.start()
    lab.whole.kill_core()
    lab.stop()
    lab.whole.run(0.7)
    lab.whole.start_core()
    lab.whole.run(1.0)
    for _ in range(copies):
        lab.missions.ask("resume")
    lab.whole.run(1.0)
    assert lab.status is not None
    assert lab.status.phase == "running", lab.status
    assert lab.whole.driven()


def test_a_stop_that_reaches_the_core_only_as_a_request_pauses_the_mission(lab: Lab) -> None:
    lab.start()
    for robots in (("@nobody",), ("r1",)):  # the first is refused, and nothing follows from it
        lab.whole.bus.publish(
            KEYS.behaviour_request, BehaviourRequest(id=f"s{robots}", behaviour=STOP, robots=robots, source="op")
        )
        lab.whole.run(0.3)
        assert lab.status is not None
        assert lab.status.phase == ("running" if robots == ("@nobody",) else "paused")
    assert lab.whole.drives_within(3.0) == []


def test_a_request_made_before_a_stop_that_only_the_robot_received_starts_nothing(lab: Lab) -> None:
    whole = lab.whole
    goal: dict[str, Value] = {"goal": [40.0, 10.0]}

    def ask(request_id: str, stamp_s: float) -> None:
        request = BehaviourRequest(
            id=request_id, behaviour="move_to_goal_bc", robots=("r0",), parameters=goal, source="op", clock="lab",
            stamp_s=stamp_s,
        )  # fmt: skip
        whole.bus.publish(KEYS.behaviour_request, request)

    ask("first", 1.0)
    assert whole.drives_within(0.5) == ["r0"]
    # Straight to the agent: on the way to the core it is lost.
    whole.agents["r0"].inbox._on_stop(StopRequest(id="s", source="op", clock="lab", stamp_s=3.0))
    ask("late", 2.0)
    assert whole.drives_within(2.0) == []
    assert whole.order_of("r0") != "late"
    ask("newer", 4.0)
    assert whole.drives_within(0.5) == ["r0"]
    assert whole.running("r0") == "newer"


@pytest.mark.parametrize("kind", [StopRequest, EStop])
def test_a_request_made_before_a_stop_starts_nothing_when_it_arrives_after_it(
    lab: Lab, kind: type[StopRequest | EStop]
) -> None:
    """It was repeated while the core could not be reached; the stop arrived first."""
    whole = lab.whole
    if kind is StopRequest:
        whole.bus.publish(KEYS.stop, StopRequest(id="s", source="op", clock="lab", stamp_s=3.0))
    else:
        whole.bus.publish(KEYS.estop, EStop(id="s", engaged=True, source="op", clock="lab", stamp_s=3.0))
        whole.run(0.5)
        whole.bus.publish(KEYS.estop, EStop(id="c", engaged=False, source="op", clock="lab", stamp_s=4.0))
    whole.run(1.5)
    for request_id, stamp_s, drives in (("before", 2.0, []), ("after", 5.0, ["r1"])):
        request = BehaviourRequest(
            id=request_id, behaviour="move_to_goal_bc", robots=("r1",), parameters={"goal": [40.0, 10.0]},
            source="other", clock="lab", stamp_s=stamp_s,
        )  # fmt: skip
        whole.bus.publish(KEYS.behaviour_request, request)
        assert whole.drives_within(0.5) == drives
