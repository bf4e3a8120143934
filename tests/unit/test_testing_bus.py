"""Stand-ins for the test of one node: a clock that is moved, a bus that encodes what it carries."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from fullswarm.bus import Bus
from fullswarm.clock import SimClock
from fullswarm.messages import BehaviourRequest, Heartbeat, StopRequest
from fullswarm.runtime import Mailbox
from fullswarm.testing import FakeClock, LoopbackBus, simulated_runtime


def beat(sequence: int = 1) -> Heartbeat:
    return Heartbeat(node="n", process="p", sequence=sequence)


def test_a_node_runs_on_a_fake_clock_and_a_loopback_bus() -> None:
    bus = LoopbackBus()
    runtime = simulated_runtime(bus.mailbox, start_s=100.0)
    heard: list[tuple[float, int]] = []
    bus.subscribe("*/beat", Heartbeat, lambda message: heard.append((runtime.now_s(), message.sequence)))
    runtime.every(0.5, lambda: bus.publish("s/beat", beat(len(heard))))
    runtime.run(1.2)
    assert heard == [(100.5, 0), (101.0, 1)]
    assert runtime.now_s() == pytest.approx(101.2)
    assert isinstance(runtime.clock, FakeClock)
    assert FakeClock is SimClock


def test_what_arrives_on_a_loopback_bus_has_been_on_the_wire() -> None:
    mailbox = Mailbox()
    bus = LoopbackBus(mailbox)
    contract: Bus = bus
    heard: list[BehaviourRequest] = []
    contract.subscribe("s/request", BehaviourRequest, heard.append)
    said = BehaviourRequest(id="1", behaviour="b", parameters={"goal": [1.0, 2.0]})
    contract.publish("s/request", said)
    bus.publish("s/stop", StopRequest(id="2"))
    bus.publish("elsewhere", said)
    assert heard == []  # nobody runs on the publisher's stack
    assert bus.drain() == 1
    assert heard == [said]
    assert heard[0] is not said
    assert bus.sent(BehaviourRequest) == [said, said]
    assert bus.sent(BehaviourRequest, "elsewhere") == [said]
    assert [each.id for each in bus.sent(StopRequest)] == ["2"]
    bus.close()
    bus.publish("s/request", said)
    assert (bus.connected(), bus.drain(), len(bus.sent(BehaviourRequest))) == (False, 0, 2)


def test_what_does_not_survive_the_wire_is_said_with_its_key() -> None:
    bus = LoopbackBus()
    for sequence in (np.int64(3), "3", 2**70):
        with pytest.raises(AssertionError, match=r"Heartbeat on 'a/b' does not survive the wire"):
            bus.publish("a/b", Heartbeat(node="n", process="p", sequence=sequence))  # type: ignore[arg-type]  # the point
    assert bus.sent(Heartbeat) == []


def test_losses_repeat_with_their_seed() -> None:
    def arrived(loss: float, seed: int) -> list[int]:
        bus, heard = LoopbackBus(loss=loss, seed=seed), list[int]()
        bus.subscribe("k", Heartbeat, lambda message: heard.append(message.sequence))
        for sequence in range(200):
            bus.publish("k", beat(sequence))
        bus.drain()
        assert len(bus.sent(Heartbeat)) == 200
        return heard

    assert arrived(0.3, 1) == arrived(0.3, 1) != arrived(0.3, 2)
    assert 110 < len(arrived(0.3, 1)) < 170
    assert (len(arrived(0.0, 1)), arrived(1.0, 1)) == (200, [])
    with pytest.raises(ValueError, match="from 0 to 1"):
        LoopbackBus(loss=1.5)


def test_the_kit_needs_no_pytest() -> None:
    code = "import sys; sys.modules['pytest'] = None; import fullswarm.testing"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=30).returncode == 0
