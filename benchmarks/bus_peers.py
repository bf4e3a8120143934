"""The two ends of the bus benchmark, each a process that obeys lines on stdin.

``python -m benchmarks.bus_peers <bare|ours> <pong|ping> <hub>``; a line ``paced <s>`` or ``chained <s>`` makes a
ping answer with a JSON list of round trips in microseconds.
"""

from __future__ import annotations

import functools
import json
import sys
import threading
import time
from collections.abc import Callable

import zenoh

from fullswarm.bus.codec import encode
from fullswarm.bus.zenoh_bus import ZenohBus, client_config, untyped
from fullswarm.clock import MonotonicClock
from fullswarm.keys import Keys
from fullswarm.messages import Command
from fullswarm.runtime import Runtime

PERIOD_S = 0.01
LOST_S = 0.05
"""A chained ping that gets no answer for this long is sent again."""


def command(sequence: int, stamp_s: float) -> Command:
    """Return the message under test, 130 bytes or so."""
    return Command(
        robot="r1",
        request_id="bench",
        linear_m_s=0.25,
        angular_rad_s=-0.5,
        ttl_s=0.3,
        sequence=sequence,
        stamp_s=stamp_s,
    )


def _key(kind: str, robot: str) -> str:
    return Keys(f"bench_{kind}").command(robot)


class Bare:
    """Zenoh with the same settings and nothing around it: bytes in a direct callback."""

    def __init__(self, hub: str, role: str) -> None:
        out, back = _key("bare", "out"), _key("bare", "back")
        self._session = zenoh.open(client_config(hub, multicast=False))
        self._publisher = self._session.declare_publisher(
            out if role == "ping" else back,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
        )
        self._payload, self._sent_s, self._chained = encode(command(1, 1.0)), 0.0, False
        self._trips_us: list[float] = []
        act = self._on_pong if role == "ping" else self._on_ping
        self._session.declare_subscriber(back if role == "ping" else out, zenoh.handlers.Callback(act, indirect=False))

    def _on_ping(self, sample: zenoh.Sample) -> None:
        self._publisher.put(sample.payload.to_bytes())

    def _on_pong(self, sample: zenoh.Sample) -> None:
        sample.payload.to_bytes()
        self._trips_us.append((time.perf_counter() - self._sent_s) * 1e6)
        if self._chained:
            self._send()

    def _send(self) -> None:
        self._sent_s = time.perf_counter()
        self._publisher.put(self._payload)

    def measure(self, mode: str, duration_s: float) -> list[float]:
        """Ping for `duration_s`; return the round trips in microseconds."""
        self._trips_us, self._chained = [], mode == "chained"
        now_s = time.perf_counter()
        end_s = now_s + duration_s
        while now_s < end_s:
            if not self._chained or now_s - self._sent_s > LOST_S:
                self._send()
            due_s = now_s + PERIOD_S
            time.sleep(max(0.0, due_s - time.perf_counter()))
            now_s = time.perf_counter()
        self._chained = False
        time.sleep(LOST_S)
        return self._trips_us

    def serve(self) -> None:
        """Answer pings until stdin ends."""
        sys.stdin.read()
        untyped(self._session.close)


class Ours:
    """A typed message through Bus, Mailbox and Runtime, as a node sees it."""

    def __init__(self, hub: str, role: str) -> None:
        out, back = _key("ours", "out"), _key("ours", "back")
        self._runtime = Runtime(MonotonicClock())
        self._bus = ZenohBus(self._runtime.mailbox, hub=hub)
        self._out, self._back = out, back
        self._sent_s, self._sequence, self._chained = 0.0, 0, False
        self._trips_us: list[float] = []
        if role == "ping":
            self._bus.subscribe(back, Command, self._on_pong)
        else:
            self._bus.subscribe(out, Command, self._on_ping)
        self._bus.wait_connected(5.0)

    def _on_ping(self, message: Command) -> None:
        self._bus.publish(self._back, message)

    def _on_pong(self, message: Command) -> None:
        self._trips_us.append((time.perf_counter() - message.stamp_s) * 1e6)
        if self._chained:
            self._send()

    def _send(self) -> None:
        self._sequence += 1
        self._sent_s = time.perf_counter()
        self._bus.publish(self._out, command(self._sequence, self._sent_s))

    def _tick(self) -> None:
        if not self._chained or time.perf_counter() - self._sent_s > LOST_S:
            self._send()

    def measure(self, mode: str, duration_s: float) -> list[float]:
        """Ping for `duration_s`; return the round trips in microseconds."""
        self._trips_us, self._chained = [], mode == "chained"
        timer = self._runtime.every(PERIOD_S, self._tick, first_s=0.0)
        self._runtime.run(duration_s)
        timer.cancel()
        self._chained = False
        self._runtime.run(LOST_S)
        return self._trips_us

    def serve(self) -> None:
        """Answer pings until stdin ends."""

        def until_end() -> None:
            sys.stdin.read()
            self._runtime.stop()

        threading.Thread(target=until_end, daemon=True).start()
        self._runtime.run()
        self._bus.close()


def main() -> None:
    kind, role, hub = sys.argv[1:4]
    make: Callable[[str, str], Bare | Ours] = Bare if kind == "bare" else Ours
    peer = make(hub, role)
    say = functools.partial(print, flush=True)
    say("ready")
    if role == "pong":
        peer.serve()
        return
    for line in sys.stdin:
        mode, duration_s = line.split()
        say(json.dumps(peer.measure(mode, float(duration_s))))


if __name__ == "__main__":
    main()
