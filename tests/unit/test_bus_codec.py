"""Threads that decode: a process with two sessions receives on a thread for each."""

from __future__ import annotations

import subprocess
import sys

RACE = """
import sys, threading
import msgspec
from fullswarm.bus import codec

sys.setswitchinterval(1e-6)
for _ in range(200):
    class Kind(msgspec.Struct, tag="k"):
        a: "float"
        b: "str | None" = None
        c: "tuple[int, ...]" = ()
        d: "dict[str, float] | None" = None
    data, start = msgspec.msgpack.encode(Kind(1.0, "x", (1, 2))), threading.Barrier(4)
    def read():
        start.wait()
        codec._reader(Kind)[0].decode(data)
    threads = [threading.Thread(target=read) for _ in range(4)]
    for each in threads: each.start()
    for each in threads: each.join()
"""


def test_threads_that_meet_a_type_first_at_the_same_time_all_read_it() -> None:
    done = subprocess.run([sys.executable, "-c", RACE], capture_output=True, text=True, timeout=60.0, check=False)
    assert (done.returncode, done.stderr) == (0, "")
