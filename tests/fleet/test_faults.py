"""Updates that meet a fault at a random moment; whatever it is, the robot runs a complete release afterwards."""

from __future__ import annotations

import os
import statistics
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import pytest

from tests.fleet.faults import AT_A_MOMENT, PAST, Case, Fault, faults, strike
from tests.fleet.fleet import Fleet
from tests.fleet.tools import end, until

GUARD_S = 15
UPDATE_S = 240.0
RECOVERED_S = 180.0
"""From the end of the fault; the guard is within it. Generous, for four robots at a time on a busy machine."""
AT_A_TIME = 4


@dataclass(frozen=True)
class End:
    """What became of one update."""

    fault: Fault
    robot: str
    struck: bool
    runs: str
    took_s: float


class Campaign:
    """Faults in order, each at a robot that has recovered from the one before."""

    def __init__(self, fleet: Fleet) -> None:
        self.fleet, self.lab = fleet, fleet.lab
        self.good = [fleet.first, fleet.second, fleet.changed("third", kilobytes=3000)]
        self.broken = fleet.broken
        self.foreign = fleet.lab.bundle_for("rpi-arm64")
        self._free = list(fleet.lab.robots)
        self._lock = threading.Lock()

    def one(self, fault: Fault) -> End:
        """Update a robot, let the fault happen, and see it recover."""
        with self._lock:
            robot = self._free.pop(0)
        try:
            return self._one(fault, robot)
        finally:
            with self._lock:
                self._free.append(robot)

    def _one(self, fault: Fault, robot: str) -> End:
        computer, before = self.lab.computers[robot], self.lab.release_of(robot)
        release = self._release(fault, before)
        self._prepare(fault, robot)
        update = self.lab.start(
            "update",
            robot,
            "--release",
            release,
            "--allow-older",
            "--guard",
            str(GUARD_S),
            "--json",
            log=f"fault-{fault.number}.log",
        )
        struck = fault.kind not in AT_A_MOMENT or strike(fault, Case(self.lab, computer, release, update))
        try:
            update.wait(UPDATE_S)
        finally:
            end(update)
        runs, began_s = "", time.monotonic()
        allowed = {before} if release in (self.broken, self.foreign) else {before, release}

        def recovered() -> bool:
            nonlocal runs
            runs = self.fleet.runs(robot) or ""
            return runs in allowed and not (computer.root / "opt/fullswarm/pending").exists()

        # A robot that stays cut off, or that has no room, must get there all the same.
        until(recovered, RECOVERED_S, f"{robot} runs one of {allowed} after {fault}", lambda: self._story(robot, fault))
        took_s = time.monotonic() - began_s
        self._whole(robot)
        self._mend(robot)
        return End(fault, robot, struck, "the new one" if runs == release else "the old one", took_s)

    def _release(self, fault: Fault, before: str) -> str:
        if fault.kind == "broken release":
            return self.broken
        if fault.kind == "another machine's release":
            return self.foreign
        return next(each for each in self.good[fault.number % 3 :] + self.good if each != before)

    def _prepare(self, fault: Fault, robot: str) -> None:
        if fault.kind == "clock at 1970":
            self.lab.computers[robot].turn_clock(PAST)
        if fault.kind == "Create says nothing":
            self.lab.mute(robot)

    def _whole(self, robot: str) -> None:
        """Nothing is called a release that is not one."""
        check = "cd /opt/fullswarm/releases && for each in *; do (cd $each && sha256sum -c --quiet SHA256SUMS); done"
        self.lab.computers[robot].do("sh", "-ec", check)

    def _mend(self, robot: str) -> None:
        self.lab.heal(robot)

        def healthy() -> bool:
            told = self.lab.computers[robot].facts()["health"]
            return isinstance(told, dict) and bool(told["healthy"])

        until(healthy, RECOVERED_S, f"{robot} is healthy again", lambda: self.lab.story([robot]))

    def _story(self, robot: str, fault: Fault) -> str:
        said = (self.lab.folder / f"fault-{fault.number}.log").read_text()
        units = ("fullswarm-agent", "fullswarm-guard", "fullswarm-boot")
        journals = [self.lab.computers[robot].journal(unit) for unit in units]
        return "\n".join([said, str(self.lab.computers[robot].facts()), *journals])


@pytest.fixture
def campaign(fleet: Fleet) -> Iterator[Campaign]:
    """Yield a fleet that faults may come over, and leave it healed."""
    yield Campaign(fleet)
    fleet.lab.heal()


def test_10_faults(campaign: Campaign) -> None:
    _meet(campaign, 10, seed=1)


@pytest.mark.slow
def test_500_faults(campaign: Campaign) -> None:
    _meet(campaign, int(os.environ.get("FULLSWARM_TEST_FAULTS", "500")), seed=2)


def _meet(campaign: Campaign, count: int, seed: int) -> None:
    began_s, ends, lost = time.monotonic(), [], []
    with ThreadPoolExecutor(min(AT_A_TIME, len(campaign.lab.robots))) as pool:
        futures = {fault: pool.submit(campaign.one, fault) for fault in faults(count, seed)}
        for fault, future in futures.items():
            try:
                ends.append(future.result())
            except AssertionError as error:
                lost.append(f"{fault}: {error}")
    assert not lost, f"{len(lost)} of {count} robots did not recover\n" + "\n\n".join(lost)
    _note(campaign.fleet, ends, time.monotonic() - began_s)


def _note(fleet: Fleet, ends: list[End], took_s: float) -> None:
    fleet.figures.note(f"{len(ends)} updates with faults, all recovered", f"{took_s:.0f} s", "0 robots lost")
    struck = [each for each in ends if each.struck]
    fleet.figures.note("  where the fault's moment came", f"{len(struck)}")
    for kind, number in sorted(Counter(each.fault.kind for each in struck).items()):
        mine = [each for each in struck if each.fault.kind == kind]
        new = sum(each.runs == "the new one" for each in mine)
        wait_s = statistics.median(each.took_s for each in mine)
        fleet.figures.note(f"  {kind}", f"{number}", f"{new} on the new release; {wait_s:.1f} s until it runs")
