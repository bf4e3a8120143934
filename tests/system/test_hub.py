"""Real processes: leaving in time whatever happens, and a hub that dies and comes back."""

from __future__ import annotations

import functools
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.messages import Heartbeat
from fullswarm.runtime import Mailbox
from tests.waiting import until

DEADLINE_S = 5.0
EXIT_S = 3.0  # the promise is 1 s; a noisy machine gets more

HUB = """
import signal, sys
from fullswarm.bus.hub import Hub
with Hub(sys.argv[1]):
    print("ready", flush=True)
    signal.pause()
"""

# Two subscriptions, incoming and outgoing traffic, and nobody who closes the bus.
NODE = """
import signal, sys, threading
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.messages import Heartbeat
from fullswarm.runtime import Runtime

def fail():
    raise RuntimeError("boom")

runtime = Runtime(MonotonicClock())
bus = ZenohBus(runtime.mailbox, hub=sys.argv[1])
bus.subscribe("test/heartbeat/*", Heartbeat, lambda message: None)
bus.subscribe("test/**", Heartbeat, lambda message: None, latest=True)
if sys.argv[2] != "lonely":
    bus.wait_connected(5.0)
if sys.argv[2] == "orderly":
    runtime.stop_on_signals()
if sys.argv[2] == "failing":
    runtime.after(0.2, fail)
runtime.every(0.005, lambda: bus.publish("test/heartbeat/node", Heartbeat(node="node", process="p", sequence=1)))
runtime.after(0.05, lambda: print("ready", flush=True))
runtime.run()
print("left", flush=True)
"""


@pytest.fixture
def endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@contextmanager
def process(script: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run a script that says "ready"; kill it at the end."""
    with subprocess.Popen(
        [sys.executable, "-c", script, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as child:
        try:
            assert child.stdout is not None
            assert child.stdout.readline() == "ready\n", child.communicate(timeout=EXIT_S)
            yield child
        finally:
            child.kill()


@pytest.mark.parametrize(
    ("how", "number", "code", "words"),
    [
        ("careless", signal.SIGINT, -signal.SIGINT, "KeyboardInterrupt"),
        ("careless", signal.SIGTERM, -signal.SIGTERM, ""),
        ("orderly", signal.SIGINT, 0, ""),
        ("orderly", signal.SIGTERM, 0, ""),
        ("failing", None, 1, "RuntimeError: boom"),
    ],
)
def test_a_process_with_open_subscriptions_leaves_at_once(
    endpoint: str, how: str, number: signal.Signals | None, code: int, words: str
) -> None:
    with process(HUB, endpoint), process(NODE, endpoint, "careless"), process(NODE, endpoint, how) as node:
        if number is not None:
            node.send_signal(number)
        out, errors = node.communicate(timeout=EXIT_S)
    assert node.returncode == code
    assert out == ("left\n" if how == "orderly" else "")
    assert words in errors
    assert words or not errors, "zenoh or Python complained on the way out"
    assert "panicked" not in errors


def test_a_process_that_never_found_a_hub_leaves_at_once(endpoint: str) -> None:
    with process(NODE, endpoint, "lonely") as node:
        node.send_signal(signal.SIGINT)
        node.communicate(timeout=EXIT_S)
    assert node.returncode == -signal.SIGINT


def test_a_process_leaves_although_the_hub_is_frozen(endpoint: str) -> None:
    with Talk(endpoint) as talk, process(HUB, endpoint) as hub, process(NODE, endpoint, "orderly") as node:
        until(talk.connected)
        hub.send_signal(signal.SIGSTOP)
        until(lambda: not talk.connected())  # from here on zenoh's own closing takes seconds
        node.send_signal(signal.SIGTERM)
        out, errors = node.communicate(timeout=EXIT_S)
    assert (node.returncode, out, errors) == (0, "left\n", "")


def test_a_process_that_ends_while_zenoh_looks_for_a_hub_ends_in_order(endpoint: str) -> None:
    """Even if the bus did not get the time to close: a machine under load, and a slow end of the interpreter."""
    script = """
import sys, time
from fullswarm.bus import zenoh_bus
from fullswarm.runtime import Mailbox

class Slow:
    def __del__(self, sleep=time.sleep):
        sleep(1.0)

slow, zenoh_bus.CLOSE_S = Slow(), 0.0
zenoh_bus.ZenohBus(Mailbox(), hub=sys.argv[1]).close()
print("ready", flush=True)
"""
    with process(script, endpoint) as child:
        out, errors = child.communicate(timeout=EXIT_S)
    assert (child.returncode, out, errors) == (0, "", "")


class Talk:
    """A talker and a listener on buses of their own."""

    def __init__(self, endpoint: str) -> None:
        self._mailbox, self._seen = Mailbox(), set[int]()
        self._talker, self._listener = ZenohBus(Mailbox(), hub=endpoint), ZenohBus(self._mailbox, hub=endpoint)
        self._listener.subscribe("test/x", Heartbeat, lambda message: self._seen.add(message.sequence))

    def __enter__(self) -> Talk:
        return self

    def __exit__(self, *_: object) -> None:
        self._talker.close()
        self._listener.close()

    def connected(self) -> bool:
        return self._talker.connected() and self._listener.connected()

    def cut(self) -> bool:
        return not self._talker.connected() and not self._listener.connected()

    def passes(self, sequence: int) -> bool:
        """Say `sequence`; tell whether it has been heard by now."""
        self._talker.publish("test/x", Heartbeat(node="test", process="p", sequence=sequence))
        self._mailbox.drain()
        return sequence in self._seen


def test_a_bus_survives_its_hub(endpoint: str) -> None:
    with Talk(endpoint) as talk:
        assert talk.cut()  # opened before there is a hub
        for life in (1, 2, 3):
            with process(HUB, endpoint) as hub:
                until(talk.connected)
                until(functools.partial(talk.passes, life))
                hub.kill()
                hub.wait()
                assert until(talk.cut) < 0.5  # 3 ms on a quiet machine
            assert not talk.passes(-life)


def test_traffic_is_back_within_a_second(endpoint: str) -> None:
    with Talk(endpoint) as talk:
        with process(HUB, endpoint):
            until(functools.partial(talk.passes, 1))
        until(talk.cut)
        with process(HUB, endpoint):
            assert until(functools.partial(talk.passes, 2)) < 2.0  # the promise is 1 s


def test_a_frozen_hub_is_noticed_by_its_silence(endpoint: str) -> None:
    bus = ZenohBus(Mailbox(), hub=endpoint)
    try:
        with process(HUB, endpoint) as hub:
            bus.wait_connected(DEADLINE_S)
            hub.send_signal(signal.SIGSTOP)
            frozen_s = until(lambda: not bus.connected())
            assert 0.3 < frozen_s < 2.5
            hub.send_signal(signal.SIGCONT)
            bus.wait_connected(DEADLINE_S)
    finally:
        bus.close()
