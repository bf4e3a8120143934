"""A sender beyond its rate is throttled, the others are not; it is named once a second."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.agent.messaging.throttle import BURST_S, SLACK, Throttle


def taken(throttle: Throttle, times_s: list[float], rate_hz: float, row: int = 0) -> int:
    rows, rates = np.array([row]), np.array([rate_hz])
    return sum(int(throttle.admit(rows, rates, at_s)[0]) for at_s in times_s)


@given(st.floats(0.5, 10.0), st.floats(20.0, 500.0), st.floats(2.0, 20.0))
def test_a_flood_gets_no_more_than_the_rate(rate_hz: float, flood_hz: float, span_s: float) -> None:
    times_s = np.arange(0.0, span_s, 1.0 / flood_hz).tolist()
    throttle = Throttle()
    found = taken(throttle, times_s, rate_hz)
    assert found <= SLACK * rate_hz * span_s + rate_hz * BURST_S + 1.0
    assert throttle.dropped == len(times_s) - found > 0


@given(st.floats(0.5, 10.0), st.lists(st.floats(0.0, 0.4), min_size=50, max_size=50))
def test_a_sender_at_its_rate_loses_nothing_to_a_network_that_delays(rate_hz: float, late_s: list[float]) -> None:
    times_s = sorted(number / rate_hz + delay for number, delay in enumerate(late_s))
    assert taken(Throttle(), times_s, rate_hz) == len(times_s)


def test_only_the_flooding_sender_is_throttled_and_named_once_a_second() -> None:
    throttle = Throttle()
    names = []
    rates = np.array([10.0, 10.0])
    for tick in range(500):  # 10 s at 50 Hz: sender 3 floods, sender 1 keeps to 10 Hz
        now_s = tick / 50.0
        rows = np.array([3, 1]) if tick % 5 == 0 else np.array([3])
        admitted = throttle.admit(rows, rates[: len(rows)], now_s)
        assert admitted[1:].all()
        names += [(row, now_s, per_s) for row, per_s in throttle.named(now_s)]
    assert {row for row, _, _ in names} == {3}
    assert 8 <= len(names) <= 10
    assert all(abs(per_s - 50.0) < 2.0 for _, _, per_s in names[1:])
