"""Updates that go wrong: what is done to a robot or its base, and when, drawn from a seed."""

from __future__ import annotations

import random
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.fleet.containers import Container
from tests.fleet.lab import Lab, when
from tests.fleet.tools import POLL_S, run

MOMENTS = ("start", "shipping", "shipped", "armed", "switched", "committed")
MOMENT_S = 60.0
"""A moment that has not come by then does not come: the update has ended otherwise."""
LATER_S = 1.5
CUT_S = 4.0
PAST = "1970-01-01 00:10:00"


@dataclass(frozen=True)
class Fault:
    """What, when, and whether the base is told to take its time."""

    number: int
    kind: str
    moment: str
    later_s: float

    def __str__(self) -> str:
        return f"#{self.number} {self.kind} {self.later_s:.2f} s after '{self.moment}'"


@dataclass
class Case:
    """One update of one robot that a fault will meet."""

    lab: Lab
    computer: Container
    release: str
    update: subprocess.Popen[str]


def kill_script(case: Case) -> None:
    """Kill the robot's program and all that it has started, wherever it is."""
    for pid in _scripts(case.computer):
        run("kill", "-KILL", str(pid), check=False)


def kill_script_for_a_while(case: Case) -> None:
    """Kill it again and again: the guard's and the base's next ones too."""
    end_s = time.monotonic() + CUT_S
    while time.monotonic() < end_s:
        kill_script(case)
        time.sleep(POLL_S)


def pull_power(case: Case) -> None:
    """Take the power, and give it back."""
    case.computer.pull()
    case.computer.boot()


def pull_power_twice(case: Case) -> None:
    """Take the power while it comes back."""
    pull_power(case)
    time.sleep(1.0)
    pull_power(case)


def cut_for_a_while(case: Case) -> None:
    """Let nothing pass for some seconds."""
    case.lab.network.cut(case.computer.name)
    time.sleep(CUT_S)
    case.lab.network.mend(case.computer.name)


def cut_for_good(case: Case) -> None:
    """Let nothing pass until the test mends it."""
    case.lab.network.cut(case.computer.name)


def kill_base(case: Case) -> None:
    """Kill the base's command; nobody there takes the robot back."""
    case.update.send_signal(signal.SIGKILL)


def kill_agent(case: Case) -> None:
    """Kill the robot's agent."""
    case.computer.do("systemctl", "kill", "--signal=KILL", "fullswarm-agent", check=False)


def fill_disk(case: Case) -> None:
    """Leave no room on its disk."""
    case.computer.fill()


AT_A_MOMENT: dict[str, Callable[[Case], None]] = {
    "script killed": kill_script,
    "script killed for a while": kill_script_for_a_while,
    "power pulled": pull_power,
    "power pulled twice": pull_power_twice,
    "cut for a while": cut_for_a_while,
    "cut for good": cut_for_good,
    "base killed": kill_base,
    "agent killed": kill_agent,
    "disk full": fill_disk,
}
BEFOREHAND = ("clock at 1970", "broken release", "another machine's release", "Create says nothing", "nothing")
KINDS = (*AT_A_MOMENT, *BEFOREHAND)


def faults(count: int, seed: int) -> Iterator[Fault]:
    """Draw faults; each kind comes as often as any other, in an order of its own."""
    draw = random.Random(seed)
    kinds: list[str] = []
    for number in range(count):
        if not kinds:
            kinds = draw.sample(KINDS, len(KINDS))
        yield Fault(number, kinds.pop(), draw.choice(MOMENTS), draw.uniform(0.0, LATER_S))


def strike(fault: Fault, case: Case) -> bool:
    """Wait for the fault's moment and do what it says; return whether the moment came."""
    begun = when(case.computer, fault.moment, case.release)
    end_s = time.monotonic() + MOMENT_S
    while not begun():
        if case.update.poll() is not None or time.monotonic() > end_s:
            return False
        time.sleep(POLL_S / 5)
    time.sleep(fault.later_s)
    AT_A_MOMENT[fault.kind](case)
    return True


def _scripts(computer: Container) -> list[int]:
    found = []
    for pid in computer.processes():
        try:
            words = Path(f"/proc/{pid}/cmdline").read_bytes()
        except OSError:
            continue
        # `run` has become the agent by then, or is about to.
        if b"fullswarm-robot" in words and b"fullswarm-robot\0run" not in words:
            found.append(pid)
    return found
