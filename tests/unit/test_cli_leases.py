"""`fullswarm leases`, `--take` and the operator's name, on a real core and a simulated clock."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from typer.testing import CliRunner, Result

from fullswarm.cli.leases import duration
from fullswarm.cli.main import app
from fullswarm.messages import BehaviourRequest, LeaseRequest, StopRequest
from fullswarm.operator import session
from fullswarm.operator.leases import LeaseHolder
from fullswarm.operator.session import OPERATOR, Session, Target, usual_name
from fullswarm.store import Store
from tests.unit.core_swarm import KEYS, Swarm

ANNA, BOB = "anna@lab", "bob@lab"


class Lab:
    """A new swarm for each command, with bob, an operator that holds r0 when the command starts."""

    def __init__(self) -> None:
        self.swarm: Swarm | None = None
        self.core, self.loses_takes = True, False
        self.interrupt_after_s: float | None = None
        self.later: list[tuple[float, Callable[[LeaseHolder], None]]] = []

    @contextmanager
    def connect(self, target: Target, within_s: float | None = None) -> Iterator[Session]:
        del within_s
        store = Store()
        store.set("group/pair", {"robots": ["r0", "r1"]}, "test")
        self.swarm = swarm = Swarm(store=store)
        bob = LeaseHolder(swarm.bus, KEYS, swarm.runtime, BOB)
        bob.hold(["r0"])
        swarm.run(0.1)
        if self.loses_takes:
            swarm.bus.drop = lambda _key, message: isinstance(message, LeaseRequest) and message.take
        if not self.core:
            swarm.core.close()
        for delay_s, act in self.later:
            swarm.runtime.after(delay_s, lambda act=act: act(bob))  # type: ignore[misc]  # the default binds this turn's
        if self.interrupt_after_s is not None:
            swarm.runtime.after(self.interrupt_after_s, lambda: signal.raise_signal(signal.SIGINT))
        yield Session(swarm.bus, KEYS, swarm.runtime, "tcp/hub", target.operator)
        swarm.runtime.mailbox.drain()  # its last words

    def run(self, *arguments: str) -> Result:
        return CliRunner().invoke(app, list(arguments))

    def requests(self) -> list[BehaviourRequest]:
        assert self.swarm is not None
        return [each for each in self.swarm.sent(BehaviourRequest) if isinstance(each, BehaviourRequest)]

    def of_anna(self) -> list[LeaseRequest]:
        assert self.swarm is not None
        found = [each for each in self.swarm.sent(LeaseRequest) if isinstance(each, LeaseRequest)]
        return [each for each in found if each.operator == ANNA]


@pytest.fixture
def lab(monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    made = Lab()
    monkeypatch.setattr(session, "connect", made.connect)
    monkeypatch.setenv(OPERATOR, ANNA)
    yield made
    if made.swarm is not None:
        made.swarm.close()


def test_the_list_shows_holders_and_durations(lab: Lab) -> None:
    result = lab.run("leases")
    assert result.exit_code == 0
    assert result.stdout.splitlines()[0].split() == ["robot", "held", "by", "for", "taken", "from"]
    assert result.stdout.splitlines()[1].split()[:2] == ["r0", BOB]
    rows = json.loads(lab.run("leases", "--json").stdout)
    assert [(row["robot"], row["operator"], row["taken_from"]) for row in rows] == [("r0", BOB, "")]


def test_without_a_core_the_list_is_an_error_not_empty(lab: Lab) -> None:
    lab.core = False
    result = lab.run("leases")
    assert result.exit_code == 3
    assert "did not answer" in result.stderr


def test_options_before_the_subcommand_are_refused_because_they_would_do_nothing(lab: Lab) -> None:
    result = lab.run("leases", "--swarm", "other", "hold", "r1")
    assert result.exit_code == 2
    assert "behind 'hold'" in result.stderr


def test_holding_lasts_until_ctrl_c_and_is_given_back(lab: Lab) -> None:
    lab.interrupt_after_s = 6.0
    result = lab.run("leases", "hold", "r1", "r2")
    assert result.exit_code == 0
    assert f"{ANNA} holds r1, r2" in result.stderr
    assert f"{ANNA} released r1, r2" in result.stderr
    assert [each.hold for each in lab.of_anna()].count(True) >= 6
    assert lab.of_anna()[-1].hold is False


def test_holding_what_another_holds_is_refused(lab: Lab) -> None:
    result = lab.run("leases", "hold", "r0")
    assert result.exit_code == 2
    assert f"r0 held by {BOB}" in result.stderr
    assert "--take" in result.stderr


def test_a_group_of_which_a_part_is_held_is_held_in_part(lab: Lab) -> None:
    lab.interrupt_after_s = 4.0
    result = lab.run("leases", "hold", "r0", "r1")
    assert result.exit_code == 0
    assert f"refused: r0 held by {BOB}" in result.stderr
    assert f"{ANNA} released r1" in result.stderr


def test_a_take_over_is_reported_and_ends_it(lab: Lab) -> None:
    lab.later = [(2.0, lambda bob: bob.hold(["r1"], take=True))]
    result = lab.run("leases", "hold", "r1")
    assert result.exit_code == 1
    assert f"r1: taken over by {BOB}" in result.stderr


def test_taking_over(lab: Lab) -> None:
    lab.interrupt_after_s = 2.0
    result = lab.run("leases", "hold", "@pair", "--take")
    assert result.exit_code == 0
    assert f"{ANNA} holds r0, r1" in result.stderr


def test_an_unknown_robot_is_not_waited_for(lab: Lab) -> None:
    result = lab.run("leases", "hold", "r9")
    assert result.exit_code == 2
    assert "knows no r9" in result.stderr


def test_a_request_is_refused_with_a_way_out_which_works(lab: Lab) -> None:
    refused = lab.run("request", "flocking", "--robots", "@pair")
    assert refused.exit_code == 2
    assert f"r0 is held by {BOB} (to take over: `--take`" in refused.stderr
    assert lab.run("request", "flocking", "--robots", "@pair", "--take").exit_code == 0
    assert [(each.operator, each.take) for each in lab.requests()] == [(ANNA, True)]


def test_driving_holds_the_robots_named_and_gives_them_back(lab: Lab) -> None:
    assert lab.run("drive", "--linear", "0.5", "--robots", "r1", "--seconds", "1").exit_code == 0
    assert [(each.robots, each.hold) for each in lab.of_anna()] == [(("r1",), True), (("r1",), True), (("r1",), False)]


def test_driving_what_another_holds_is_refused_unless_it_is_taken(lab: Lab) -> None:
    refused = lab.run("drive", "--robots", "r0", "--seconds", "1")
    assert (refused.exit_code, f"r0 is held by {BOB}" in refused.stderr) == (2, True)
    assert lab.run("drive", "--seconds", "1", "--take").exit_code == 0, "the whole swarm"


def test_a_driver_that_is_taken_over_ends_and_does_not_take_back(lab: Lab) -> None:
    lab.later = [(1.0, lambda bob: bob.hold(["r1"], take=True))]
    result = lab.run("drive", "--robots", "r1", "--seconds", "5", "--take")
    assert (result.exit_code, f"r1 is held by {BOB}" in result.stderr) == (2, True)
    assert not any(each.take for each in lab.requests()[5:])


def test_the_first_frame_may_come_before_the_word_that_takes_over(lab: Lab) -> None:
    """Two keys of a bus keep no order between them; here that word does not come at all."""
    lab.loses_takes = True
    assert lab.run("drive", "--robots", "r0", "--seconds", "0.5", "--take").exit_code == 0


@pytest.mark.parametrize("command", [["stop"], ["estop"]])
def test_stops_take_robots_only_and_no_name(lab: Lab, monkeypatch: pytest.MonkeyPatch, command: list[str]) -> None:
    result = lab.run(*command, "@pair")
    assert (result.exit_code, "is a group" in result.stderr) == (2, True)
    monkeypatch.setenv(OPERATOR, "not a name")
    assert lab.run("request", "flocking").exit_code == 2
    assert lab.run("stop", "r0").exit_code == 0
    assert lab.swarm is not None
    assert lab.swarm.sent(StopRequest)


def test_the_operators_name() -> None:
    assert "@" in usual_name()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(OPERATOR, ANNA)
        assert usual_name() == ANNA
        patch.setenv(OPERATOR, "x" * 65)
        assert len(usual_name()) <= 64
        assert usual_name() != "x" * 65


@pytest.mark.parametrize(("seconds", "text"), [(0.9, "0 s"), (61.0, "1 min 01 s"), (7500.0, "2 h 05 min")])
def test_durations_read_like_times(seconds: float, text: str) -> None:
    assert duration(seconds) == text
