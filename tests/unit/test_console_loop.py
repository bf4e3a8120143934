"""A runtime that another loop calls: nothing on foreign threads, nothing lost, nothing starved."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import pytest

from fullswarm.clock import MonotonicClock, SimClock
from fullswarm.operator.console.serve import GATHER_S, RuntimeLoop
from fullswarm.operator.console.server import LONGEST, Outbox
from fullswarm.runtime import AT_ONCE, FETCH_S, LONGEST_WAIT_S, Lane, Runtime


def test_serve_due_delivers_fires_and_returns_the_time_to_the_next_call() -> None:
    clock = SimClock()
    runtime = Runtime(clock)
    heard: list[object] = []
    assert runtime.serve_due() == LONGEST_WAIT_S
    runtime.every(0.5, lambda: heard.append("tick"))
    runtime.mailbox.put(heard.append, "message")
    assert runtime.serve_due() == pytest.approx(0.5)
    assert heard == ["message"]
    clock.advance_to(0.6)
    assert runtime.serve_due() == pytest.approx(0.4)
    assert heard == ["message", "tick"]


def test_what_waits_elsewhere_is_fetched_before_a_timer_fires_and_soon_again() -> None:
    clock = SimClock()
    runtime = Runtime(clock)
    heard: list[object] = []
    waiting = [3, 2, 1]

    def source() -> bool:
        if waiting:
            heard.append(waiting.pop())
        return bool(waiting)

    runtime.mailbox.add_source(source)
    runtime.every(10.0, lambda: heard.append("tick"), first_s=0.0)
    assert runtime.serve_due() == 0.0  # more waits
    assert heard == [1, "tick"]
    assert runtime.serve_due() == 0.0
    assert runtime.serve_due() == FETCH_S
    assert heard == [1, "tick", 2, 3]
    runtime.mailbox.remove_source(source)
    waiting.append(4)
    assert runtime.serve_due() == pytest.approx(10.0)
    assert heard == [1, "tick", 2, 3]


def test_a_loop_of_its_own_fetches_without_a_message_or_a_timer() -> None:
    runtime = Runtime(MonotonicClock())
    calls: list[float] = []

    def source() -> bool:
        calls.append(runtime.now_s())
        if len(calls) == 4:
            runtime.pause()
        return False

    runtime.mailbox.add_source(source)
    runtime.run(5.0)
    assert len(calls) >= 4
    assert calls[3] - calls[0] < 4.0


def test_a_flood_of_messages_does_not_starve_a_timer() -> None:
    clock = SimClock()
    runtime = Runtime(clock)
    heard: list[object] = []
    runtime.after(0.1, lambda: heard.append("tick"))
    for number in range(AT_ONCE + 10):
        runtime.mailbox.put(heard.append, number)
    clock.advance_to(0.2)
    assert runtime.serve_due() == 0.0
    assert heard[-1] == "tick"
    runtime.serve_due()
    assert len(heard) == AT_ONCE + 11


def test_while_a_loop_serves_it_no_foreign_thread_runs_a_handler() -> None:
    runtime = Runtime(MonotonicClock())
    runtime.serve_due()
    ran: list[bool] = []
    thread = threading.Thread(target=lambda: ran.append(runtime.mailbox.run_now(lambda _: None, None)))
    thread.start()
    thread.join()
    assert ran == [False]


def test_what_other_threads_put_is_delivered_on_the_loop_in_order() -> None:
    runtime = Runtime(MonotonicClock())
    heard: list[int] = []
    threads: set[int] = set()
    done: list[BaseException] = []

    def take(number: int) -> None:
        heard.append(number)
        threads.add(threading.get_ident())

    def put_all() -> None:
        for number in range(5000):
            runtime.mailbox.put(take, number)

    async def main() -> None:
        pump = RuntimeLoop(runtime, asyncio.get_running_loop(), done.append)
        sender = threading.Thread(target=put_all)
        sender.start()
        async with asyncio.timeout(20.0):
            while len(heard) < 5000:
                await asyncio.sleep(0.005)
        sender.join()
        pump.close()

    asyncio.run(main())
    assert heard == list(range(5000))
    assert threads == {threading.get_ident()}
    assert done == []


class StepLoop:
    """What of an asyncio loop is used, on a clock that stands still until it is moved."""

    def __init__(self) -> None:
        self.now_s, self.wakes = 0.0, 0
        self.soon: list[Callable[[], None]] = []
        self.timers: list[StepTimer] = []

    def time(self) -> float:
        return self.now_s

    def call_soon_threadsafe(self, call: Callable[[], None]) -> None:
        self.wakes += 1
        self.soon.append(call)

    def call_at(self, due_s: float, call: Callable[[], None]) -> StepTimer:
        self.timers.append(StepTimer(due_s, call))
        return self.timers[-1]

    def call_later(self, wait_s: float, call: Callable[[], None]) -> StepTimer:
        return self.call_at(self.now_s + wait_s, call)

    def step(self, to_s: float) -> None:
        """Call what is due until then."""
        while self.soon:
            self.soon.pop(0)()
        self.now_s = to_s
        for timer in [each for each in self.timers if each.due_s <= to_s and not each.cancelled]:
            timer.cancel()
            timer.call()


@dataclass
class StepTimer:
    due_s: float
    call: Callable[[], None]
    cancelled: bool = False

    def when(self) -> float:
        return self.due_s

    def cancel(self) -> None:
        self.cancelled = True


def test_states_gather_for_a_moment_and_an_order_is_delivered_at_once_with_them() -> None:
    runtime, loop, heard = Runtime(SimClock()), StepLoop(), list[str]()
    pump = RuntimeLoop(runtime, cast(asyncio.AbstractEventLoop, loop), lambda error: None)
    for number in range(50):
        runtime.mailbox.put_into(Lane.STATES, heard.append, f"state {number}", heard.append)
        loop.step(number * 0.0001)
    assert (loop.wakes, heard) == (1, []), "one wake-up for all"
    loop.step(GATHER_S + 0.001)
    assert len(heard) == 50
    runtime.mailbox.put_into(Lane.READS, heard.append, "read", heard.append)
    loop.step(loop.now_s)
    runtime.mailbox.put_into(Lane.ORDERS, heard.append, "stop", heard.append)
    loop.step(loop.now_s)
    assert heard[50:] == ["stop", "read"], "without waiting"
    runtime.mailbox.put_into(Lane.STATES, heard.append, "state", heard.append)
    loop.step(loop.now_s)
    loop.step(loop.now_s + GATHER_S)
    assert heard[52:] == ["state"], "the next one gathers again"
    pump.close()


def test_states_do_not_put_off_a_timer_that_is_due_before() -> None:
    clock, loop, heard = SimClock(), StepLoop(), list[str]()
    runtime = Runtime(clock)
    runtime.after(0.5 * GATHER_S, lambda: heard.append("tick"))
    pump = RuntimeLoop(runtime, cast(asyncio.AbstractEventLoop, loop), lambda error: None)
    runtime.mailbox.put(heard.append, "first")
    loop.step(0.0)
    runtime.mailbox.put_into(Lane.STATES, heard.append, "state", heard.append)
    loop.step(0.0)
    clock.advance_to(0.5 * GATHER_S)
    loop.step(0.5 * GATHER_S)
    assert heard == ["first", "state", "tick"]
    pump.close()


def test_a_page_that_was_busy_gets_the_newest_state_and_every_answer() -> None:
    async def main() -> list[str]:
        box = Outbox(lambda: 0.0)
        for number in range(5):
            box.put("state", f"state {number}")
            box.put("answer", f"answer {number}")
        sent: list[str] = []

        async def send(text: str) -> None:
            sent.append(text)

        task = asyncio.create_task(box.run(send))
        async with asyncio.timeout(5.0):
            while len(sent) < 6:
                await asyncio.sleep(0)
        task.cancel()
        return sent

    assert asyncio.run(main()) == [*(f"answer {number}" for number in range(5)), "state 4"]


def test_a_page_that_is_too_far_behind_is_given_up() -> None:
    async def main() -> None:
        box = Outbox(lambda: 0.0)
        for _ in range(LONGEST + 1):
            box.put("log", "x")
        assert box.overrun
        box.put("log", "x")
        async with asyncio.timeout(5.0):
            await box.run(_never)

    asyncio.run(main())


async def _never(_: str) -> None:
    raise AssertionError("nothing is sent to a page that was given up")
