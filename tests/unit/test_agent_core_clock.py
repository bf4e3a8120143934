"""How an agent measures the age of states that come from computers with other clocks."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.agent.core_clock import ENOUGH, PERIOD_S, WINDOW_S, CoreClock
from fullswarm.agent.neighbours.estimates import Assumed, Neighbours
from fullswarm.bus import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config import SwarmConfig
from fullswarm.core.clock import ClockServer
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import ClockProbe, ClockReply, RobotStates
from fullswarm.runtime import Mailbox, Runtime

KEYS, ASSUMED_S = Keys("s"), 0.07
delays = st.floats(0.0, 0.5)


class Bench:
    """An agent's clock and a wire on which probes and replies take as long as they are told to."""

    def __init__(self, offset_s: float) -> None:
        mailbox = Mailbox()
        self.runtime, self.bus = Runtime(SimClock(), mailbox), LocalBus(mailbox)
        self.offset_s, self.probes = offset_s, list[ClockProbe]()
        self.bus.subscribe(KEYS.clock_probe(), ClockProbe, self.probes.append)
        self.wall_s, self.ahead_s = 1.8e9, 0.0
        self.clock = CoreClock(
            self.bus, KEYS, self.runtime, "me", ASSUMED_S, lambda: self.wall_s + self.runtime.now_s()
        )

    def exchange(self, there_s: float, back_s: float, core: str = "core-1") -> None:
        """Carry one probe to the core, whose clock is ahead by `offset_s`, and its reply back."""
        sent_s = self.runtime.now_s()
        self.runtime.run(there_s + back_s)
        reply = ClockReply(
            host="me", sent_s=sent_s, core=core, core_s=sent_s + there_s + self.offset_s,
            wall_s=self.wall_s + sent_s + there_s - self.ahead_s,
        )  # fmt: skip
        self.bus.publish(KEYS.clock_reply("me"), reply)
        self.runtime.run(0.0)


def states(host: str, stamp_s: float, core: str = "", offset_s: float = 0.0, speed_m_s: float = 0.5) -> RobotStates:
    return RobotStates(
        host=host, sequence=1, stamp_s=stamp_s, robots=(host,), x_m=(0.0,), y_m=(0.0,), heading_rad=(0.0,),
        speed_m_s=(speed_m_s,), turn_rad_s=(0.0,), radius_m=(0.17,), core=core, offset_s=offset_s,
    )  # fmt: skip


@given(ahead_s=st.floats(-1e6, 1e6), there_s=delays, back_s=delays)
def test_the_time_of_day_is_compared_to_half_a_round_trip(ahead_s: float, there_s: float, back_s: float) -> None:
    bench = Bench(0.0)
    assert bench.clock.wall_offset_s is None
    bench.ahead_s = ahead_s
    bench.exchange(there_s, back_s)
    assert bench.clock.wall_offset_s == pytest.approx(ahead_s, abs=0.5 * (there_s + back_s) + 1e-5)


@given(offset_s=st.floats(-1e4, 1e4), trips=st.lists(st.tuples(delays, delays), min_size=1, max_size=8))
def test_the_error_is_at_most_half_of_the_shortest_round_trip(
    offset_s: float, trips: list[tuple[float, float]]
) -> None:
    bench = Bench(offset_s)
    for trip in trips:
        bench.exchange(*trip)
    shortest_s = min(there_s + back_s for there_s, back_s in trips)
    assert bench.clock.round_trip_s == pytest.approx(shortest_s, abs=1e-6)
    assert abs(bench.clock.offset_s - offset_s) <= 0.5 * shortest_s + 1e-6


def test_two_agents_with_other_clocks_know_how_old_a_state_is() -> None:
    receiver, sender = Bench(offset_s=1000.0), Bench(offset_s=-50.0)
    receiver.exchange(0.1, 0.1)
    sender.exchange(0.2, 0.2)
    now_s = receiver.runtime.now_s()
    measured_s = now_s + 1000.0 - 0.3 + 50.0  # on the sender's clock, 0.3 s ago
    message = states("other", measured_s, sender.clock.core, sender.clock.offset_s)
    assert receiver.clock.delay_s(message, now_s) == pytest.approx(0.3)
    assert receiver.clock.delay_s(states("me", now_s - 0.01), now_s) == pytest.approx(0.01)


def test_without_a_measurement_the_configured_delay_counts() -> None:
    bench = Bench(0.0)
    assert bench.clock.delay_s(states("other", 0.0, "core-1"), 0.0) == ASSUMED_S, "no reply yet"
    bench.exchange(0.0, 0.0)
    assert bench.clock.delay_s(states("other", 0.0), 0.0) == ASSUMED_S, "the sender knows no core"
    assert bench.clock.delay_s(states("other", 0.0, "core-2"), 0.0) == ASSUMED_S, "another core's clock"


def test_a_core_that_is_started_again_has_another_clock() -> None:
    bench = Bench(5.0)
    bench.exchange(0.01, 0.01)
    bench.offset_s = 77.0
    bench.exchange(0.2, 0.2, core="core-2")
    assert bench.clock.core == "core-2"
    assert bench.clock.offset_s == pytest.approx(77.0)


def test_a_clock_that_drifts_is_followed() -> None:
    bench = Bench(0.0)
    bench.exchange(0.0, 0.0)
    for tick in range(int(3 * WINDOW_S)):
        bench.offset_s = 1e-4 * tick
        bench.runtime.run(1.0)
        bench.exchange(0.05, 0.05)
    assert bench.clock.offset_s == pytest.approx(bench.offset_s, abs=1e-4 * 2 * WINDOW_S)


def test_the_core_answers_each_probe_and_probing_slows_down() -> None:
    bench = Bench(0.0)
    server = ClockServer(bench.bus, KEYS, bench.runtime, "core-9")
    bench.runtime.run(1.0)
    assert (bench.clock.core, bench.clock.offset_s, bench.clock.round_trip_s) == ("core-9", 0.0, 0.0)
    first = len(bench.probes)
    bench.runtime.run(10.0 * PERIOD_S)
    assert ENOUGH <= first <= ENOUGH + 2
    assert 9 <= len(bench.probes) - first <= 11
    server.close()
    bench.clock.close()


def test_a_late_state_is_predicted_from_when_it_was_measured() -> None:
    for delay_s, x_m in ((0.0, 0.05), (0.2, 0.15)):
        table = Neighbours(("me",), 1.0, Assumed(2.0, 0.5, 4.0, 1.3))
        table.delay_of = lambda _states, _now_s, late_s=delay_s: late_s  # type: ignore[misc]
        table.receive(states("other", 0.0), 10.0)
        table.set_time(10.1)
        table.around(table.predicted[:1], 3.0)
        assert table.predicted[0, 0] == pytest.approx(x_m)
        assert table.longest_delay_s(10.1) == delay_s
    assert table.spread_m[0] > 0.08, "what may have changed since then"


def test_agents_on_a_slow_network_measure_its_delay() -> None:
    robots = [{"id": f"r{row}", "pose": [2.0 + row, 5.0, 0.0]} for row in range(2)]
    config = SwarmConfig.model_validate(
        {"world": {"engine": "kinematic"}, "robot": robots, "network": {"conditions": "delay=150ms±50,loss=20%"}}
    )
    swarm = Lockstep(config)
    swarm.run(3.0)
    for agent, other in itertools.permutations(swarm.agents, 2):
        row = agent.neighbours.names.index(other.identity.host)
        assert agent.neighbours.delay_s[row] == pytest.approx(0.15, abs=0.09)
        assert agent.core_clock.round_trip_s < 0.35
    swarm.close()
