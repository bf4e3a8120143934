"""The demo's show gives way to people, and `fullswarm demo` fits the place it is run in."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from fullswarm.bus.base import OPERATOR
from fullswarm.config import SwarmConfig
from fullswarm.demo.live import DemoOptions
from fullswarm.demo.show import Show
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import LeaseRequest, StopRequest
from fullswarm.operator.client import Operator

KEYS = Keys("swarm")
SECONDS = 20.0
PERSON = "anna@lab"


class Stage:
    """Two kinematic robots, the show, and somebody else at another computer."""

    def __init__(self, yields: bool) -> None:
        world = {"engine": "kinematic", "bounds_m": (0.0, 0.0, 10.0, 10.0)}
        config = SwarmConfig.model_validate({"robot": [{"id": "r1"}, {"id": "r2"}], "world": world})
        self.lockstep = Lockstep(config)
        bus, runtime = self.lockstep.bus_of(OPERATOR), self.lockstep.runtime
        self.bus = bus
        self.person = Operator(bus, KEYS, runtime, "cli@lab:1", name=PERSON)
        self.demo = Operator(bus, KEYS, runtime, "demo")
        self.show = Show(bus, runtime, config, self.demo, SECONDS, yields=yields)
        self.lockstep.run(1.0)
        self.show.start()

    def run(self, seconds: float) -> None:
        self.lockstep.run(seconds)

    def behaviours(self) -> set[str]:
        rows = self.show.view.snapshot().robots
        return {row.health.behaviour for row in rows if row.health is not None}


@pytest.fixture
def stage() -> Iterator[Stage]:
    made = Stage(yields=True)
    yield made
    made.lockstep.close()


def lease(hold: bool, operator: str = PERSON) -> LeaseRequest:
    return LeaseRequest(operator=operator, robots=("r1",), hold=hold)


ASKED: dict[str, Callable[[Stage], object]] = {
    "a request": lambda stage: stage.person.request("move_to_goal_bc", ("r1",), {"goal": [5.0, 5.0]}),
    "a lease": lambda stage: stage.bus.publish(KEYS.lease_request, lease(hold=True)),
    "a stop": lambda stage: stage.person.stop(),
    "an e-stop": lambda stage: stage.person.estop(True, reason="test"),
}


@pytest.mark.parametrize("what", ASKED)
def test_whatever_somebody_else_asks_ends_the_show(stage: Stage, what: str) -> None:
    stage.run(2.0)
    assert not stage.show.yielded_to
    ASKED[what](stage)
    stage.run(0.1)
    assert stage.show.yielded_to in (PERSON, "cli@lab:1")
    stage.run(SECONDS)
    assert [sent.act.behaviour for sent in stage.show.sent] == ["move_to_goal_bc"], "no act comes after it"


def test_the_shows_own_stop_does_not_come_after_a_persons_request(stage: Stage) -> None:
    stage.run(2.0)
    stage.person.request("flocking_bc")
    stage.run(SECONDS + 2.0)
    assert stage.show.done
    assert stage.behaviours() == {"flocking_bc"}


def test_a_person_who_asks_before_the_first_act_has_the_robots(stage: Stage) -> None:
    later = Show(stage.bus, stage.lockstep.runtime, stage.show.config, stage.demo, SECONDS, yields=True)
    stage.person.request("flocking_bc")
    stage.run(0.5)
    later.start()
    stage.run(SECONDS / 2)
    assert later.sent == []


@pytest.mark.parametrize(
    "harmless",
    [
        lease(hold=False),
        lease(hold=True, operator="demo"),
        StopRequest(id="s1", robots=("r1",), source="r1"),  # a robot repeats a stop that still holds
        StopRequest(id="s2", robots=("r1",), source="core-7f"),
    ],
    ids=["lease given back", "own lease", "robot's stop", "core's stop"],
)
def test_what_no_operator_asked_for_does_not_end_it(stage: Stage, harmless: LeaseRequest | StopRequest) -> None:
    stage.run(2.0)
    if isinstance(harmless, LeaseRequest):
        stage.bus.publish(KEYS.lease_request, harmless)
    else:
        stage.lockstep.bus_of(harmless.source.partition("-")[0]).publish(KEYS.stop, harmless)
    stage.run(SECONDS)
    assert not stage.show.yielded_to
    assert len(stage.show.sent) == len(stage.show.acts)


def test_a_show_for_programs_goes_on() -> None:
    stage = Stage(yields=False)
    stage.run(2.0)
    stage.person.request("flocking_bc")
    stage.run(SECONDS)
    assert len(stage.show.sent) == len(stage.show.acts)
    stage.lockstep.close()


@pytest.mark.parametrize(
    ("manner", "terminal", "screen", "console", "stay", "opens"),
    [
        (DemoOptions(), True, True, True, True, True),
        (DemoOptions(), True, False, True, True, False),
        (DemoOptions(), False, True, True, False, False),
        (DemoOptions(stay=True), False, False, True, True, False),
        (DemoOptions(console=False), True, False, False, False, False),
        (DemoOptions(headless=True), True, True, False, False, False),
        (DemoOptions(as_json=True), True, True, False, False, False),
        (DemoOptions(as_json=True, console=True), True, True, True, False, False),
        (DemoOptions(open_browser=False), True, True, True, True, False),
    ],
)
def test_the_demo_fits_where_it_is_run(
    manner: DemoOptions, terminal: bool, screen: bool, console: bool, stay: bool, opens: bool
) -> None:
    settled = manner.settled(terminal, screen)
    assert (settled.console, settled.stay, settled.open_browser) == (console, stay, opens)
    assert settled.headless == (manner.headless or manner.as_json)
