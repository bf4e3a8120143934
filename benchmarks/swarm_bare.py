"""One robot of the reference swarm: bare zenoh, 48 bytes on its cell's key, subscribed to the cells around.

``python -m benchmarks.swarm_bare <robot> <folder>``; ``<robot>.bare`` in the folder holds its settings.
"""

from __future__ import annotations

import json
import os
import random
import struct
import sys
import time
from pathlib import Path

import zenoh

from benchmarks.swarm_meet import GRACE_S, Meeting, Result, spent_since, threads_cpu_s
from fullswarm.bus.zenoh_bus import client_config

STATE = struct.Struct("<d5d")  # stamp, and as much as a pose with velocities: 48 bytes
LOOK_EACH = 4
Arrival = tuple[str, float, float]  # sender, stamp, arrival


def main() -> None:
    """Publish and listen until the parent ends us."""
    robot, folder = sys.argv[1], Path(sys.argv[2])
    settings = json.loads((folder / f"{robot}.bare").read_text())
    arrived: list[Arrival] = []

    def received(sample: zenoh.Sample) -> None:
        now_s = time.monotonic()
        sender = str(sample.key_expr).rpartition("/")[2]
        arrived.append((sender, STATE.unpack(sample.payload.to_bytes())[0], now_s))

    callback = zenoh.handlers.Callback(received, indirect=False)
    with zenoh.open(client_config(settings["endpoint"], multicast=False)) as session:
        for key in settings["listen"]:
            session.declare_subscriber(key, callback, allowed_origin=zenoh.Locality.REMOTE)
        publisher = session.declare_publisher(
            settings["publish"],
            congestion_control=zenoh.CongestionControl.DROP,
            allowed_destination=zenoh.Locality.REMOTE,
        )
        _serve(publisher, settings["period_s"], Meeting(folder, robot), arrived, set(settings["expected"]))


def _serve(
    publisher: zenoh.Publisher, period_s: float, meeting: Meeting, arrived: list[Arrival], missing: set[str]
) -> None:
    """Publish on an absolute grid; look into the folder until the window is known, report after it."""
    parent, result, reported = os.getppid(), Result(), False
    window: tuple[float, float] | None = None
    threads_s: dict[str, float] = {}
    due_s, count = time.monotonic() + random.random() * period_s, 0
    while os.getppid() == parent:
        time.sleep(max(0.0, due_s - time.monotonic()))
        now_s = time.monotonic()
        late_s, skipped = now_s - due_s, int((now_s - due_s) // period_s)
        due_s, count = due_s + period_s * (1 + skipped), count + 1
        publisher.put(STATE.pack(now_s, 0.0, 0.0, 0.0, 0.0, 0.0))
        if window is None and count % LOOK_EACH == 0:
            missing.difference_update(sender for sender, _, _ in arrived)
            if not missing:
                meeting.ready()
            window = meeting.window()
        elif window and window[0] <= now_s < window[1]:
            threads_s = threads_s or threads_cpu_s()
            result.sent += 1
            result.late_s.append(round(late_s, 6))
            result.missed += skipped
        elif window and now_s >= window[1] and not result.threads_cpu_s:
            result.threads_cpu_s = spent_since(threads_s)
        elif window and now_s >= window[1] + GRACE_S and not reported:
            reported = True
            _report(meeting, result, window, arrived)


def _report(meeting: Meeting, result: Result, window: tuple[float, float], arrived: list[Arrival]) -> None:
    result.window_s = window[1] - window[0]
    for arrival in list(arrived):
        if window[0] <= arrival[1] < window[1]:
            result.book(*arrival)
    meeting.report(result)


if __name__ == "__main__":
    main()
