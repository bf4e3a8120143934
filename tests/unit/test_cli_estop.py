"""``fullswarm estop`` on a simulated clock: the robots it names, when it ends, what it prints meanwhile."""

from __future__ import annotations

import json
import math
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from fullswarm.clock import SimClock
from fullswarm.errors import Unreachable
from fullswarm.messages import BehaviourRequest, EStop, EStopReceipt, RequestStatus
from fullswarm.operator import session
from fullswarm.operator.estop import EStopOrder, end_released
from fullswarm.operator.session import Session, Target
from fullswarm.runtime import Runtime
from tests.unit.test_cli_swarm import FakeSwarm, run


class Fleet(FakeSwarm):
    """Also a core that answers an e-stop with all it knows, a deaf robot that wakes up, and a hub that dies."""

    def __init__(self) -> None:
        super().__init__()
        self.deaf = ""
        self.core_knows: tuple[str, ...] = ()
        self.wakes_at_s: float | None = None
        self.hub_gone: tuple[float, float] | None = None
        self.pressed_again_at_s: float | None = None
        self.refusals = 0
        self.waits_s: list[float | None] = []

    @contextmanager
    def connect(self, target: Target, within_s: float | None = None) -> Iterator[Session]:
        if self.refusals:
            self.refusals -= 1
            self.waits_s.append(within_s)
            raise Unreachable("no hub answers", where="tcp/hub", hint="start one")
        with super().connect(target) as line:
            if self.wakes_at_s is not None:
                self.runtime.after(self.wakes_at_s, self._wake)
            if self.pressed_again_at_s is not None:
                self.runtime.after(self.pressed_again_at_s, self._press_again)
            yield line

    def _wake(self) -> None:
        self.deaf = ""

    def _press_again(self) -> None:
        receipt = EStopReceipt(id="another", robot="r1", engaged=True)
        self.bus.publish(self.keys.estop_receipt("r1"), receipt)

    def _on_estop(self, order: EStop) -> None:
        super()._on_estop(order)
        if self.core_knows and order.engaged:
            request = BehaviourRequest(id=order.id, behaviour="stop")
            self.status(request, phase="ended", robots=self.core_knows)


@pytest.fixture
def swarm(monkeypatch: pytest.MonkeyPatch) -> Fleet:
    fleet = Fleet()
    monkeypatch.setattr(session, "connect", fleet.connect)
    return fleet


def test_a_robot_that_never_reported_is_named_by_the_core(swarm: Fleet) -> None:
    swarm.core_knows = ("r1", "r2", "r9")
    result = run("estop", "--timeout", "2")
    assert result.exit_code == 4
    assert result.stderr.splitlines() == [
        "after 0.5 s nothing ever received from r9; still trying",
        "error: after 2 s nothing ever received from r9 (go there: they may still move)",
    ]


def test_without_a_core_the_fleet_file_names_it(swarm: Fleet, tmp_path: Path) -> None:
    fleet = tmp_path / "fleet.toml"
    fleet.write_text(
        'swarm = "lab"\n[hub]\nendpoint = "tcp/10.0.0.7:7447"\n[[robot]]\nid = "r1"\n[[robot]]\nid = "r9"\n'
    )
    result = run("estop", "--timeout", "1", "--fleet", str(fleet))
    assert result.exit_code == 4
    assert "nothing ever received from r9" in result.stderr
    assert swarm.targets == [Target("tcp/10.0.0.7:7447", "lab")]
    assert run("estop", "--timeout", "1", "--fleet", str(fleet), "r1").exit_code == 0, "only r1 was asked for"


def test_a_malformed_fleet_file_does_not_prevent_a_stop(swarm: Fleet, tmp_path: Path) -> None:
    fleet = tmp_path / "fleet.toml"
    fleet.write_text("robot = [")
    result = run("estop", "--fleet", str(fleet))
    assert result.exit_code == 0
    assert "continuing without the fleet file" in result.stderr


def test_it_is_pressed_until_the_deaf_one_wakes_up(swarm: Fleet) -> None:
    swarm.deaf, swarm.wakes_at_s = "r2", 23.0
    result = run("estop")
    assert result.exit_code == 0
    said = [line.split(" no answer")[0] for line in result.stderr.splitlines()]
    assert said == ["after 0.5 s", "after 5.5 s", "after 10.5 s", "after 15.5 s", "after 20.5 s"]
    assert result.stdout.splitlines()[-1] == "r2: at standstill after 0.030 m"


def test_ctrl_c_ends_it_with_the_names_and_4(swarm: Fleet) -> None:
    swarm.deaf, swarm.interrupt_after_s = "r2", 61.02
    before = signal.getsignal(signal.SIGINT)
    result = run("estop")
    assert result.exit_code == 4
    assert result.stderr.splitlines()[-1] == "error: after 61 s no answer from r2 (go there: they may still move)"
    assert signal.getsignal(signal.SIGINT) is before


def test_a_decelerating_robot_is_distinguished_from_a_silent_one(swarm: Fleet) -> None:
    swarm.standing, swarm.deaf = False, "r2"
    result = run("estop", "--timeout", "1")
    assert "after 0.5 s no answer from r2; latched, but standstill not confirmed: r1; still trying" in result.stderr


def test_json_has_names_and_times(swarm: Fleet) -> None:
    swarm.deaf, swarm.core_knows = "r2", ("r1", "r2", "r9")
    result = run("estop", "--json", "--timeout", "1")
    found = json.loads(result.stdout)
    assert result.exit_code == 4
    assert found["unconfirmed"] == found["silent"] == ["r2", "r9"]
    assert list(found["answered_s"]) == list(found["confirmed_s"]) == ["r1"]
    assert found["receipts"][0]["rolled_m"] == 0.03


def test_it_ends_by_itself_when_no_robot_is_known(swarm: Fleet) -> None:
    swarm.robots = ()
    result = run("estop")
    assert (result.exit_code, "no robot was received" in result.stderr) == (3, True)


def test_clearing_ends_by_itself(swarm: Fleet) -> None:
    swarm.deaf = "r2"
    result = run("estop", "--clear")
    assert result.exit_code == 4
    assert "error: after 5 s no answer from r2 (they stay stopped; try again)" in result.stderr


def test_a_release_gives_way_to_a_newer_e_stop(swarm: Fleet) -> None:
    swarm.deaf, swarm.pressed_again_at_s = "r2", 1.0
    result = run("estop", "--clear")
    assert result.exit_code == 4
    assert "r1 was latched again after this release" in result.stderr


def test_a_hub_that_is_away_is_waited_for(swarm: Fleet) -> None:
    swarm.refusals = 3
    result = run("estop")
    assert result.exit_code == 0
    assert swarm.waits_s == [0.5, 3.0, 3.0], "it is said at once"
    assert result.stderr.splitlines() == [
        "tcp/hub: no hub answers: robots without a hub stop by themselves, but they are not latched; still trying"
    ]


@pytest.mark.parametrize("args", [("--timeout", "4"), ("--clear",)])
def test_but_not_longer_than_asked(swarm: Fleet, args: tuple[str, ...]) -> None:
    swarm.refusals = 3
    result = run("estop", *args)
    assert result.exit_code == 3
    assert "error: tcp/hub: no hub answers (robots without a hub stop by themselves" in result.stderr


def test_a_hub_that_is_lost_meanwhile_is_reported(swarm: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    swarm.deaf = "r2"
    from fullswarm.bus import LocalBus

    monkeypatch.setattr(LocalBus, "connected", lambda bus: not 2.0 < swarm.runtime.now_s() < 3.0)
    result = run("estop", "--timeout", "4")
    assert [line for line in result.stderr.splitlines() if "hub" in line] == [
        "the hub is lost: robots without a hub stop by themselves, but they are not latched; still trying",
        "the hub is back",
    ]


def test_copies_of_receipts_that_come_late_take_nothing_back() -> None:
    runtime = Runtime(SimClock())
    order = EStopOrder(
        EStop(id="e", engaged=True, robots=("r1",)),
        send=lambda: None, scheduler=runtime, known=tuple, deadline_s=9.0,
    )  # fmt: skip
    order.start()
    latched = EStopReceipt(id="e", robot="r1", engaged=True)
    stands = EStopReceipt(id="e", robot="r1", engaged=True, standing=True, rolled_m=0.1)
    for receipt in (latched, stands, latched):
        order.receive(receipt)
    assert order.unconfirmed() == ()
    assert order.receipts["r1"].rolled_m == 0.1


@pytest.mark.parametrize("outage", [False, True])
def test_after_an_outage_it_listens_longer_for_robots_that_come_back_one_by_one(outage: bool) -> None:
    runtime, heard = Runtime(SimClock()), ["r1"]
    order = EStopOrder(
        EStop(id="e", engaged=True), send=lambda: None, scheduler=runtime, known=lambda: heard, deadline_s=9.0
    )
    order.start()
    if outage:
        order.hub_returned()
    order.receive(EStopReceipt(id="e", robot="r1", engaged=True, standing=True))
    runtime.after(2.0, lambda: heard.append("r2"))
    runtime.run(8.0)
    assert order.done is not outage, "r2, which came back late, has yet to confirm"
    if outage:
        order.receive(EStopReceipt(id="e", robot="r2", engaged=True, standing=True))
        assert order.done


def test_another_requests_status_adds_no_robot(swarm: Fleet) -> None:
    def stray() -> None:
        status = RequestStatus(request_id="other", behaviour="x", phase="ended", robots=("r77",))
        swarm.bus.publish(swarm.keys.behaviour_status, status)

    swarm._wake = stray  # type: ignore[method-assign]  # the same moment, another act
    swarm.wakes_at_s = 0.2
    assert run("estop").exit_code == 0


def test_a_release_ends_the_estops_of_its_robots_and_no_other() -> None:
    runtime = Runtime(SimClock())
    sent: list[str] = []

    def order(robot: str) -> EStopOrder:
        started = EStopOrder(
            EStop(id=robot, engaged=True, robots=(robot,)), send=lambda: sent.append(robot), scheduler=runtime,
            known=lambda: [robot], deadline_s=math.inf,
        )  # fmt: skip
        started.start()
        return started

    left = end_released([order("r1"), order("r2")], ("r2",))
    sent.clear()
    runtime.run(1.0)
    assert set(sent) == {"r1"}  # which is silent, and must find it when it is back
    assert end_released(left, ("r1",)) == []
    sent.clear()
    runtime.run(1.0)
    assert sent == []
