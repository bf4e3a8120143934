"""Timers and mailbox on a simulated and on a real clock."""

from __future__ import annotations

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.clock import MonotonicClock, SimClock
from fullswarm.runtime import Mailbox, Runtime


def test_simulated_timers_fire_on_an_absolute_grid_in_order() -> None:
    runtime = Runtime(SimClock())
    seen: list[tuple[str, float]] = []
    runtime.every(0.02, lambda: seen.append(("a", runtime.now_s())))
    runtime.every(0.05, lambda: seen.append(("b", runtime.now_s())), first_s=0.0)
    runtime.after(0.03, lambda: seen.append(("once", runtime.now_s())))
    runtime.run(0.1)
    assert [name for name, _ in seen] == ["b", "a", "once", "a", "b", "a", "a", "b", "a"]
    assert runtime.now_s() == 0.1


@given(st.integers(1, 400))
def test_a_rate_does_not_drift(rate: int) -> None:
    runtime = Runtime(SimClock())
    ticks: list[float] = []
    runtime.every(1.0 / rate, lambda: ticks.append(runtime.now_s()))
    runtime.run(10.0 + 0.5 / rate)
    assert len(ticks) == 10 * rate


def test_messages_are_delivered_before_the_next_timer_and_may_cause_more() -> None:
    runtime = Runtime(SimClock())
    order: list[str] = []

    def first(_: object) -> None:
        order.append("first")
        runtime.mailbox.put(lambda _: order.append("second"), None)

    def tick() -> None:
        order.append("tick")
        runtime.mailbox.put(first, None)

    runtime.every(0.1, tick)
    runtime.run(0.2)
    assert order == ["tick", "first", "second"] * 2


def test_a_cancelled_timer_is_silent() -> None:
    runtime = Runtime(SimClock())
    count: list[int] = []
    timer = runtime.every(0.1, lambda: count.append(1))
    runtime.after(0.25, timer.cancel)
    runtime.run(1.0)
    assert len(count) == 2


class Jumpy:
    """A live clock that a test moves: what a suspended laptop or a busy machine looks like."""

    def __init__(self) -> None:
        self.now = 100.0

    def now_s(self) -> float:
        return self.now


def test_missed_ticks_are_skipped_and_counted() -> None:
    clock = Jumpy()
    runtime = Runtime(clock)
    ticks: list[float] = []

    def tick() -> None:
        ticks.append(clock.now)
        if len(ticks) == 1:
            clock.now += 1.05  # ten periods and a half pass within one callback
        elif len(ticks) == 3:
            runtime.stop()

    runtime.every(0.1, tick, first_s=0.0)
    runtime.mailbox.put(lambda _: None, None)
    pump = runtime.mailbox.deliver_one

    def advance(timeout_s: float) -> bool:
        clock.now += max(timeout_s, 0.0)
        return pump(0.0)

    runtime.mailbox.deliver_one = advance  # type: ignore[method-assign]  # time passes only by waiting
    runtime.run()
    stats = runtime.stats()
    assert (stats.ticks, stats.missed) == (3, 9)
    assert stats.late >= 1
    assert ticks[2] - 100.0 == pytest.approx(1.1)


def test_a_message_from_another_thread_wakes_the_loop() -> None:
    mailbox = Mailbox()
    runtime = Runtime(MonotonicClock(), mailbox)
    sender = threading.Thread(target=lambda: mailbox.put(lambda _: runtime.stop(), None))
    runtime.after(30.0, runtime.stop)
    sender.start()
    began = runtime.now_s()
    runtime.run()
    sender.join()
    assert runtime.now_s() - began < 10.0
