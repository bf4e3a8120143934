"""Timers and mailbox on a simulated and on a real clock."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.clock import MonotonicClock, SimClock
from fullswarm.runtime import ROOM, Lane, Mailbox, Runtime, RuntimeThread


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


def test_an_urgent_message_runs_on_its_bringers_thread_while_the_runtime_waits() -> None:
    mailbox = Mailbox()
    runtime = Runtime(MonotonicClock(), mailbox)
    ran_on: list[int] = []
    outcome: list[bool] = []

    def bring() -> None:
        while not mailbox.run_now(lambda _: ran_on.append(threading.get_ident()), None):
            waiting.wait(0.001)
        outcome.append(True)
        mailbox.put(lambda _: runtime.stop(), None)

    waiting = threading.Event()
    bringer = threading.Thread(target=bring)
    runtime.after(30.0, runtime.stop)
    runtime.after(0.0, bringer.start)
    runtime.run()
    bringer.join()
    assert outcome == [True]
    assert ran_on == [bringer.ident]


def test_nobody_runs_a_handler_while_the_runtime_is_busy_or_not_running() -> None:
    mailbox = Mailbox()
    runtime = Runtime(MonotonicClock(), mailbox)
    refused: list[bool] = []

    def try_now() -> None:
        thread = threading.Thread(target=lambda: refused.append(not mailbox.run_now(lambda _: None, None)))
        thread.start()
        thread.join()

    try_now()
    runtime.after(0.0, try_now)
    runtime.after(0.0, runtime.stop)
    runtime.run()
    try_now()
    assert refused == [True, True, True]


def test_waiting_for_a_moment_always_ends() -> None:
    """`SimpleQueue.get` with a timeout does not: a few thousand times are enough."""
    mailbox, done = Mailbox(), threading.Event()

    def wait_often() -> None:
        for _ in range(20_000):
            mailbox.put(lambda _: None, None)
            for timeout_s in (1e-7, 1e-7, 1e-7):
                mailbox.deliver_one(timeout_s)
        done.set()

    threading.Thread(target=wait_often, daemon=True).start()
    assert done.wait(30.0)


def test_a_stream_of_messages_that_others_run_does_not_keep_the_loop_out() -> None:
    """Two threads bring one after the other; without a turn of its own the loop waits until they pause."""
    mailbox = Mailbox()
    runtime = Runtime(MonotonicClock(), mailbox)
    stop, ran = threading.Event(), [0, 0]

    def work(_: object) -> None:
        sum(range(2000))

    def bring(number: int) -> None:
        while not stop.is_set():
            ran[number] += mailbox.run_now(work, None)

    bringers = [threading.Thread(target=bring, args=(number,)) for number in (0, 1)]
    timer = runtime.every(0.01, lambda: None)
    for each in bringers:
        runtime.after(0.0, each.start)
    runtime.run(2.0)
    stop.set()
    for each in bringers:
        each.join()
    assert sum(ran) > 100
    assert timer.ticks > 50


def test_a_loop_that_is_always_late_works_its_messages_off() -> None:
    """Each tick takes two periods. With one message a tick, five hundred would take ten times as long."""
    clock = Jumpy()
    runtime = Runtime(clock)
    done: list[int] = []

    def tick() -> None:
        clock.now += 0.02

    timer = runtime.every(0.01, tick, first_s=0.0)
    for number in range(500):
        runtime.mailbox.put(done.append, number)
    runtime.mailbox.put(lambda _: runtime.stop(), None)
    runtime.run()
    assert done == list(range(500))
    assert 20 <= timer.ticks <= 60


def test_an_urgent_message_does_not_overtake_one_that_waits() -> None:
    mailbox = Mailbox()
    mailbox.put(lambda _: None, None)
    assert not mailbox.run_now(lambda _: None, None)


def test_what_an_urgent_handler_raises_ends_the_loop() -> None:
    mailbox = Mailbox()
    runtime = Runtime(MonotonicClock(), mailbox)

    def fail(_: object) -> None:
        raise ZeroDivisionError

    def bring() -> None:
        while not mailbox.run_now(fail, None):
            pause.wait(0.001)

    pause = threading.Event()
    bringer = threading.Thread(target=bring)
    runtime.after(30.0, runtime.stop)
    runtime.after(0.0, bringer.start)
    with pytest.raises(ZeroDivisionError):
        runtime.run()
    bringer.join()


def test_a_timer_set_by_an_urgent_handler_is_not_slept_through() -> None:
    mailbox = Mailbox()
    runtime = Runtime(MonotonicClock(), mailbox)

    def set_timer(_: object) -> None:
        runtime.after(0.0, runtime.stop)

    def bring() -> None:
        while not mailbox.run_now(set_timer, None):
            pause.wait(0.001)

    pause = threading.Event()
    bringer = threading.Thread(target=bring)
    runtime.after(30.0, runtime.stop)
    runtime.after(0.0, bringer.start)
    began_s = runtime.now_s()
    runtime.run()
    bringer.join()
    assert runtime.now_s() - began_s < 10.0


def test_a_signal_that_another_thread_gets_ends_an_idle_loop() -> None:
    script = (
        "import signal, threading\n"
        "from fullswarm.clock import MonotonicClock\nfrom fullswarm.runtime import Runtime\n"
        "runtime = Runtime(MonotonicClock())\nruntime.stop_on_signals()\n"
        "never = threading.Event()\n"
        "other = threading.Thread(target=never.wait, daemon=True)\nother.start()\n"
        # The kernel picks a thread; here it is told which: not the one that waits for messages.
        "threading.Timer(0.3, lambda: signal.pthread_kill(other.ident, signal.SIGTERM)).start()\n"
        "runtime.run()\nprint(runtime.exit_signal)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=20, check=True)
    assert done.stdout.strip() == str(int(signal.SIGTERM))


HUNG_UP = """
import signal
from fullswarm.clock import MonotonicClock
from fullswarm.runtime import Runtime
signal.signal(signal.SIGHUP, signal.{before})
runtime = Runtime(MonotonicClock())
runtime.stop_on_signals()
runtime.after(0.0, lambda: signal.raise_signal(signal.SIGHUP))
runtime.run({limit_s})
signal.raise_signal(signal.SIGHUP)  # the shell sends one and the kernel another: the second is no second wish
print(runtime.exit_signal)
"""


@pytest.mark.parametrize(
    ("before", "limit_s", "ended_by"),
    [("SIG_DFL", 20.0, int(signal.SIGHUP)), ("SIG_IGN", 0.1, None)],
)
def test_a_closed_terminal_ends_it_in_order_unless_it_runs_under_nohup(
    before: str, limit_s: float, ended_by: int | None
) -> None:
    script = HUNG_UP.format(before=before, limit_s=limit_s)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=20, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, str(ended_by))


def test_a_thread_of_its_own_carries_out_calls_until_it_is_closed() -> None:
    ended: list[int] = []
    thread = RuntimeThread(MonotonicClock(), "served", lambda: ended.append(threading.get_ident()))
    there = thread.call(threading.get_ident).result(5.0)
    assert there != threading.get_ident()
    with pytest.raises(ZeroDivisionError):
        thread.call(lambda: 1 / 0).result(5.0)
    late = threading.Event()
    thread.call(lambda: thread.runtime.after(0.01, late.set)).result(5.0)
    assert late.wait(5.0), "its timers fire meanwhile"
    last: list[int] = []
    for _ in range(2):
        thread.close(lambda: last.append(threading.get_ident()))
    assert (last, ended) == ([there], [there])
    assert "served" not in {each.name for each in threading.enumerate()}
    with pytest.raises(RuntimeError, match="ended"):
        thread.call(lambda: None)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_handler_that_fails_ends_its_thread_and_says_so() -> None:
    ended = threading.Event()
    thread = RuntimeThread(MonotonicClock(), "served", ended.set)

    def fail(_: object) -> None:
        raise ValueError("on purpose")

    thread.runtime.mailbox.put(fail, None)
    assert ended.wait(5.0)
    with pytest.raises(RuntimeError, match="ended"):
        thread.call(lambda: None)
    thread.close(lambda: None)


def test_stops_and_orders_come_before_states_and_these_before_questions_each_in_its_order() -> None:
    mailbox, seen = Mailbox(), list[str]()
    sent = [
        (Lane.READS, "read 1"), (Lane.STATES, "state 1"), (Lane.ORDERS, "request"), (Lane.READS, "read 2"),
        (Lane.ORDERS, "stop"), (Lane.STATES, "state 2"),
    ]  # fmt: skip
    for lane, text in sent:
        mailbox.put_into(lane, seen.append, text, seen.append, always=text == "stop")
    mailbox.put(seen.append, "local")
    assert mailbox.drain() == 7
    assert seen == ["request", "stop", "state 1", "state 2", "read 1", "read 2", "local"]


@pytest.mark.parametrize("lane", [Lane.STATES, Lane.READS])
def test_a_full_lane_drops_its_oldest_and_counts_it(lane: Lane) -> None:
    mailbox, seen, lost = Mailbox(), list[int](), list[int]()
    for number in range(ROOM[lane] + 5):
        mailbox.put_into(lane, seen.append, number, lost.append)
    assert lost == [0, 1, 2, 3, 4]
    assert mailbox.dropped == {lane.name.lower(): 5}
    assert mailbox.drain() == ROOM[lane]
    assert seen == list(range(5, ROOM[lane] + 5))
    assert mailbox.run_now(seen.append, 1) is False  # the runtime is not waiting
    mailbox.put_into(lane, seen.append, 9, lost.append)
    assert mailbox.deliver_one(0.0)
    assert not mailbox.deliver_one(0.0)


def test_orders_beyond_the_room_are_dropped_but_no_stop_is() -> None:
    mailbox, seen, lost = Mailbox(), list[object](), list[object]()
    for number in range(ROOM[Lane.ORDERS]):
        mailbox.put_into(Lane.ORDERS, seen.append, number, lost.append)
    mailbox.put_into(Lane.ORDERS, seen.append, "late", lost.append)
    mailbox.put_into(Lane.ORDERS, seen.append, "stop", lost.append, always=True)
    assert lost == ["late"]
    mailbox.drain()
    assert seen[-1] == "stop"
    assert len(seen) == ROOM[Lane.ORDERS] + 1
