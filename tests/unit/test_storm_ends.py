"""What a flood must not leave behind: late answers, old releases that count, orders of robots that never were."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from fullswarm.agent.orders.estops import LatchFolder
from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.core.request_handler import WANTED
from fullswarm.core.settings import ParamServer
from fullswarm.keys import Keys
from fullswarm.messages import (
    BehaviourRequest,
    EStop,
    Halt,
    HealthReport,
    Heartbeat,
    ParamReply,
    ParamRequest,
    StopRequest,
)
from fullswarm.operator.client import Operator
from fullswarm.operator.console.world import World
from fullswarm.recent import FORGET_S
from fullswarm.runtime import Runtime
from fullswarm.store import Store
from tests.unit.agent_bench import Bench
from tests.unit.core_swarm import KEYS, Swarm, health

LAB = Keys("lab")


def dated(order: str, stamp_s: float, *robots: str, engaged: bool) -> EStop:
    return EStop(id=order, engaged=engaged, robots=robots, source="ann", clock="lab-1", stamp_s=stamp_s)


def test_a_release_that_is_older_than_the_e_stop_releases_nothing() -> None:
    bench = Bench([(5.0, 5.0, 0.0), (8.0, 5.0, 0.0)])
    bench.bus.publish(bench.keys.estop, dated("first", 10.0, "r1", engaged=True))
    bench.bus.publish(bench.keys.estop, dated("off", 11.0, engaged=False))
    bench.run(0.1)
    assert not bench.agent.controller.estop.any()
    bench.bus.publish(bench.keys.estop, dated("second", 12.0, "r1", engaged=True))
    for number in range(300):  # until no order is remembered by its id
        bench.bus.publish(bench.keys.estop, dated(f"more{number}", 12.0 + number, "r2", engaged=True))
    bench.run(0.1)
    bench.bus.publish(bench.keys.estop, dated("off", 11.0, engaged=False))
    bench.run(0.1)
    assert bench.agent.controller.estop.tolist() == [True, True]
    # Of the other robot's e-stop it knows nothing: r1 is released by what is newer than its own.
    bench.bus.publish(bench.keys.estop, dated("off2", 13.0, "r1", engaged=False))
    bench.run(0.1)
    assert bench.agent.controller.estop.tolist() == [False, True]


def test_a_flood_of_stops_is_written_now_and_then_and_the_last_one_is_kept(tmp_path: Path) -> None:
    bench, written = Bench([(5.0, 5.0, 0.0)]), []

    class Counting(LatchFolder):
        def keep_halt(self, robot: str, halt: Halt | None, voided: Iterable[str] = ()) -> None:
            written.append(halt)
            super().keep_halt(robot, halt, voided)

    bench.agent.inbox.remember_latches(Counting(tmp_path))
    for number in range(500):
        bench.bus.publish(bench.keys.stop, StopRequest(id=f"s{number}", source="ann"))
    bench.run(1.0)
    assert 1 <= len(written) <= 5
    kept = LatchFolder(tmp_path).halt_of("r1", 1e6).halt
    assert kept is not None
    assert kept.id == "s499"


def test_a_robot_that_never_was_leaves_no_order_and_no_entry() -> None:
    swarm = Swarm(1)
    swarm.run(0.5)
    swarm.bus.publish(
        KEYS.health("ghost"), HealthReport(host="ghost", process="p", version="1", robots=(health("ghost"),))
    )
    swarm.run(0.1)
    swarm.ask("q1", "flocking")
    swarm.run(0.2)
    assert swarm.core.handler.order_of("ghost") is not None
    assert swarm.store.get(WANTED + "ghost") is not None
    swarm.run(FORGET_S + 1.0)
    assert swarm.core.roster.known() == ("r0",)
    assert swarm.core.handler.order_of("ghost") is None
    assert swarm.store.history(WANTED + "ghost") == ()
    assert swarm.status("q1").phase == "running"
    swarm.close()


def test_e_stops_of_invented_robots_fill_no_database() -> None:
    swarm = Swarm(1)
    swarm.run(0.5)
    for number in range(40):
        names = tuple(f"x{number}-{each}" for each in range(100))
        swarm.bus.publish(KEYS.estop, EStop(id=f"e{number}", engaged=True, robots=names))
    swarm.bus.publish(KEYS.estop, EStop(id="real", engaged=True, robots=("r0",)))
    swarm.run(1.0)
    assert len(swarm.store.list("estop/")) <= 1001
    assert swarm.store.get("estop/r0") is not None
    swarm.close()


def test_copies_of_a_question_that_wait_together_are_answered_once() -> None:
    runtime = Runtime(SimClock(10.0))
    bus, store, replies = LocalBus(runtime.mailbox), Store(), list[ParamReply]()
    server = ParamServer(bus, LAB, "core", store, now_s=runtime.now_s)
    bus.subscribe(LAB.param_reply("core"), ParamReply, replies.append)
    for _ in range(50):
        bus.publish(LAB.param_request("core"), ParamRequest(id="q", op="get", key="*"))
    runtime.run(0.05)
    assert len(replies) == 1
    runtime.run(0.2)
    bus.publish(LAB.param_request("core"), ParamRequest(id="q", op="get", key="*"))  # its answer was lost
    runtime.run(0.05)
    assert len(replies) == 2
    server.close()


def test_cores_that_alternate_have_a_console_read_the_database_ever_more_seldom() -> None:
    runtime = Runtime(SimClock(10.0))
    bus, asked = LocalBus(runtime.mailbox), list[float]()

    def answer(question: ParamRequest) -> None:
        asked.append(runtime.now_s())
        bus.publish(LAB.param_reply("core", question.id), ParamReply(id=question.id, ok=True))

    bus.subscribe(LAB.param_request("core"), ParamRequest, answer)
    world = World(bus, LAB, runtime, "console", on_world=lambda: None, on_orders=lambda _: None)
    for number in range(6000):  # a hundred a second for a minute
        bus.publish(LAB.heartbeat("core"), Heartbeat(node="core", process=f"core{number % 2}", sequence=number))
        runtime.run(0.01)
    assert len(asked) < 16
    runtime.run(20.0)
    quiet = len(asked)
    bus.publish(LAB.heartbeat("core"), Heartbeat(node="core", process="another", sequence=1))
    runtime.run(0.01)
    assert len(asked) == quiet + 1  # after some calm at once again
    world.close()


def test_a_request_that_no_core_answers_is_sent_more_seldom_after_a_while() -> None:
    runtime = Runtime(SimClock(10.0))
    bus, sent = LocalBus(runtime.mailbox), list[BehaviourRequest]()
    operator = Operator(bus, LAB, runtime, "test")
    bus.subscribe(LAB.behaviour_request, BehaviourRequest, sent.append)
    operator.request("flocking")
    runtime.run(9.9)
    assert len(sent) == 50
    runtime.run(10.0)
    assert 59 <= len(sent) <= 61
