"""The verdict by which a release stays or goes."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from fullswarm.agent.telemetry import health_file
from fullswarm.agent.telemetry.health_file import Process, Rate, Vitals, why_not

GOOD = Vitals(
    robot="r1", lifecycle="READY", behaviour="", moving=False, estop=False, fault="", driver="null://r1",
    driver_answers=True, control_rate_hz=49.9, control_rate_wanted_hz=50.0, core_heard_s=0.1, neighbours=0,
    battery=-1.0,
)  # fmt: skip
SILENCE_S = 1.0


@pytest.mark.parametrize(
    "good",
    [
        GOOD,
        replace(GOOD, lifecycle="ACTIVE", behaviour="flock", moving=True),
        replace(GOOD, core_heard_s=-1.0, neighbours=1),  # any one link will do
        replace(GOOD, core_heard_s=1.0),
        replace(GOOD, control_rate_hz=45.0),
        replace(GOOD, estop=True),  # it outlives every release, and says nothing about one
        replace(GOOD, battery=0.02),
        replace(GOOD, fault="the charger is plugged in"),  # READY: it drives when that is mended
    ],
)
def test_healthy(good: Vitals) -> None:
    assert why_not(good, SILENCE_S) == ()


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (replace(GOOD, lifecycle="FAULT", fault="no such port"), "FAULT: no such port"),
        (replace(GOOD, lifecycle="OPEN"), "OPEN"),
        (replace(GOOD, driver_answers=False), "does not answer"),
        (replace(GOOD, control_rate_hz=44.9), "44.9 Hz instead of 50"),
        (replace(GOOD, core_heard_s=1.01), "neither the core nor another robot"),
        (replace(GOOD, core_heard_s=-1.0), "neither the core nor another robot"),
    ],
)
def test_unhealthy_says_why(bad: Vitals, words: str) -> None:
    (why,) = why_not(bad, SILENCE_S)
    assert words in why


def test_all_reasons_are_named() -> None:
    worst = replace(GOOD, lifecycle="FAULT", driver_answers=False, control_rate_hz=0.0, core_heard_s=-1.0)
    assert len(why_not(worst, SILENCE_S)) == 4


def test_the_rate_is_that_of_the_last_seconds() -> None:
    rate = Rate()
    assert rate.see(10.0, 500) == 0.0  # one look tells nothing
    assert rate.see(11.0, 550) == 50.0
    for second in range(12, 20):
        rate.see(float(second), 550)
    assert rate.see(20.0, 550) == 0.0  # a loop that hangs, whatever it did before
    for second in range(21, 25):
        latest = rate.see(float(second), 550 + 40 * (second - 20))
    assert latest == pytest.approx(40.0)


def test_the_file_is_json_that_a_shell_can_read(tmp_path: Path) -> None:
    process = Process("1.0.0-0123456789ab", 7, "some-boot", 12.5, 3.0)
    tricky = replace(GOOD, fault='"\n "moving": true,\n', behaviour="go_to")
    text = health_file.text_of(tricky, process, ("a", 'b"'))
    value = json.loads(text)
    assert (value["healthy"], value["why"], value["fault"], value["pid"]) == (False, ["a", 'b"'], tricky.fault, 7)
    # `fullswarm-robot` reads line by line: nothing within a text may look like a line of its own.
    assert re.findall(r'^ *"moving": (\w+)', text, re.MULTILINE) == ["false"]


def test_this_machine_has_a_boot_and_an_uptime() -> None:
    assert health_file.boot_id() == Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    assert abs(health_file.machine_s() - float(Path("/proc/uptime").read_text().split()[0])) < 1.0
