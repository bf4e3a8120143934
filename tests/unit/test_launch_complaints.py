from __future__ import annotations

from pathlib import Path

import pytest

from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.keys import Keys
from fullswarm.launch.complaints import AGAIN_S, MOST, Complaints, last_line
from fullswarm.launch.supervisor import Child
from fullswarm.messages import HealthReport, RobotHealth
from fullswarm.runtime import Runtime


class Bench:
    """Complaints on a simulated clock and a local bus, with logs in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.lines = folder, list[str]()
        self.clock = SimClock()
        self.runtime = Runtime(self.clock)
        self.bus, self.keys = LocalBus(self.runtime.mailbox), Keys("lab")
        self.complaints = Complaints(self.runtime, lambda name: folder / f"{name}.log", self.lines.append)
        self.complaints.listen(self.bus, self.keys)

    def health(self, robot: str, fault: str = "") -> None:
        state = RobotHealth(robot=robot, driver="d", make="m", model="m", firmware="", lifecycle="OPEN", fault=fault)
        self.complaints.on_health(HealthReport(host=robot, process="p", version="v", robots=(state,)))

    def die(self, name: str, code: int = 70, log: str = "") -> None:
        if log:
            (self.folder / f"{name}.log").write_text(log)
        self.complaints.ended(Child(name, (), ended="exit", code=code))

    def run(self, seconds: float) -> None:
        self.runtime.run(seconds)


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def test_a_process_that_dies_is_reported_with_its_last_error_and_its_log(bench: Bench) -> None:
    bench.die("r1", log="2026 [info] starts\nerror: KeyError: 'k' (a bug in fullswarm)\nException ignored in: x\n")
    assert bench.lines == [
        (
            "r1: ended with exit code 70: KeyError: 'k' (a bug in fullswarm); it is started again "
            f"(log: {bench.folder}/r1.log)"
        )
    ]


def test_what_repeats_is_printed_once_and_counted_later(bench: Bench) -> None:
    for _ in range(7):
        bench.die("r1", log="error: boom\n")
    assert len(bench.lines) == 1
    bench.run(AGAIN_S + 1.0)
    assert bench.lines[1:] == ["r1: ended with exit code 70: boom; it is started again (7 times since 10 s)"]
    bench.run(5 * AGAIN_S)
    assert len(bench.lines) == 2, "nothing came again"


def test_a_fault_that_lasts_is_printed_within_a_second_and_its_end_too(bench: Bench) -> None:
    bench.health("c1", "/dev/ttyUSB7: there is no such port")
    bench.health("c1", "/dev/ttyUSB7: there is no such port")
    bench.run(0.9)
    assert bench.lines == ["c1: /dev/ttyUSB7: there is no such port"]
    bench.health("c1")
    assert bench.lines[1:] == ["c1: works again"]


def test_a_fault_of_a_moment_while_the_swarm_starts_is_not_printed(bench: Bench) -> None:
    bench.health("s1", "no reading")
    bench.run(0.3)
    bench.health("s1")
    bench.run(2.0)
    assert bench.lines == []


def test_hostile_reports_do_not_grow_what_is_remembered(bench: Bench) -> None:
    for number in range(10 * MOST):
        bench.health(f"r{number}", "\x1b[2J\n" + "x" * 1000)
        bench.die(f"p{number}")
    bench.run(1.0)
    assert len(bench.complaints._seen) <= MOST
    assert len(bench.complaints._faults) <= MOST
    assert max(map(len, bench.lines)) < 500
    assert all(line.isprintable() for line in bench.lines), "no control of the terminal"


def test_the_last_line_of_a_log_that_is_missing_or_binary(tmp_path: Path) -> None:
    assert last_line(tmp_path / "none.log") == ""
    (tmp_path / "a.log").write_bytes(b"\xff\xfe" * 10_000 + b"\nTraceback\nValueError: x\n\n")
    assert last_line(tmp_path / "a.log") == "ValueError: x"
