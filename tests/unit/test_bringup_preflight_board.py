from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
import pytest

from fullswarm.bringup.checks import Check
from fullswarm.bringup.preflight_ssh import ComputerFacts, RobotComputer, computer
from fullswarm.errors import FullswarmError

PORT = "/dev/fullswarm/create"
SAID = {
    "port": "660 root dialout character special file",
    "groups": "fullswarm dialout input",
    "state": "rw,noatime",
    "meant": "defaults,noatime",
    "card_log": "0",
    "agent_WatchdogUSec": "10s",
    "agent_LoadState": "loaded",
    "boot_LoadState": "loaded",
    "boot_Result": "success",
}
FACTS: dict[str, Any] = {
    "protocol": 1,
    "robot": "r1",
    "python": "3.11",
    "arch": "aarch64",
    "disk_free_bytes": 20_000_000_000,
    "disk_errors": 0,
    "throttled": "0",
    "current": "1.2.3-0123456789ab",
    "agent": {"active": True, "state": "active/running", "restarts": 0},
    "health": {"healthy": True, "lifecycle": "READY", "release": "1.2.3-0123456789ab"},
    "temperature_c": 48.3,
}


def judged(
    facts: Mapping[str, Any] | None = None, said: Mapping[str, str] | None = None, **board: Any
) -> dict[str, Check]:
    """The checks by name; of those with the same name the worst."""
    known = msgspec.convert({**FACTS, **(facts or {})}, ComputerFacts)
    given: dict[str, Any] = {"trips_s": (0.01, 0.02, 0.03), "clock_off_s": 0.02, "clock_doubt_s": 0.01, **board}
    found = RobotComputer(facts=known, answers={**SAID, **(said or {})}, **given)
    order = ["ok", "warning", "failure"]
    every = computer(found, "r1", "1.2.3", port=PORT, net="can0" if said and "net" in said else "")
    return {each.name: each for each in sorted(every, key=lambda each: order.index(each.status))}


def test_a_robot_in_order_has_nothing_to_mend() -> None:
    found = judged()
    assert {each.status for each in found.values()} == {"ok"}
    assert not any(each.mend for each in found.values())
    assert {"card", "power", "temperature", "clock", "port", "software", "agent", "units", "watchdog"} <= set(found)


@pytest.mark.parametrize(
    ("name", "status", "facts", "said", "part"),
    [
        ("card", "failure", {"disk_free_bytes": 50_000_000}, {}, "0.1 GB free"),
        ("card", "warning", {"disk_free_bytes": 300_000_000}, {}, "0.3 GB free"),
        ("card", "failure", {"disk_errors": 3}, {}, "3 errors"),
        ("card", "failure", {}, {"card_log": "7"}, "7 errors"),
        ("card", "failure", {"card_errors": 2}, {"card_log": "0"}, "2 errors"),
        ("card", "failure", {}, {"state": "ro,noatime,errors=remount-ro"}, "read-only"),
        ("card", "warning", {"disk_writable": False}, {}, "no update will go through"),
        ("power", "failure", {"throttled": "50005"}, {}, "the voltage is too low now; it is slowed down now"),
        ("power", "warning", {"throttled": "0x50000"}, {}, "since it was switched on the voltage was too low"),
        ("power", "warning", {"throttled": "throttled=0x80008"}, {}, "close to its highest temperature"),
        ("power", "failure", {"throttled": "1"}, {}, "the voltage is too low now"),  # Linux' own low-voltage alarm
        ("power", "ok", {"throttled": ""}, {}, "unknown"),
        ("temperature", "warning", {"temperature_c": 72.0}, {}, "72 °C"),
        ("temperature", "failure", {"temperature_c": 84.9}, {}, "85 °C"),
        ("temperature", "ok", {"temperature_c": None}, {}, "unknown"),
        ("port", "failure", {}, {"port": "none"}, "does not exist"),
        ("port", "failure", {}, {"groups": "fullswarm"}, "may not open it"),
        ("port", "failure", {}, {"groups": ""}, "no user 'fullswarm'"),
        ("port", "failure", {}, {"port": "640 root dialout character special file"}, "may not open it"),
        ("port", "failure", {}, {"port": "755 root root directory"}, "is a directory"),
        ("port", "ok", {}, {"port": "666 root root character special file", "groups": "fullswarm"}, "may open it"),
        ("port", "failure", {}, {"port": "066 fullswarm root character special file"}, "may not open it"),
        ("port", "failure", {}, {"net": "none"}, "there is no can0"),
        ("port", "failure", {}, {"net": "0"}, "down"),
        ("software", "failure", {"protocol": 0}, {}, "nothing of fullswarm is installed"),
        ("software", "failure", {"robot": "r2"}, {}, "reports that it is 'r2'"),
        ("software", "failure", {"current": None}, {}, "no release"),
        ("software", "warning", {"pending": "1.2.4-ba9876543210"}, {}, "is not committed yet"),
        ("software", "warning", {"current": "1.2.2-0123456789ab", "health": None}, {}, "here it is 1.2.3"),
        ("software", "failure", {"health": {"healthy": True, "release": "1.2.2-f"}}, {}, "its agent runs 1.2.2-f"),
        ("agent", "failure", {"health": None}, {}, "no health report"),
        ("agent", "failure", {"health": {"why": ["driver is FAULT", "no link"]}}, {}, "driver is FAULT; no link"),
        ("units", "failure", {"agent": {"active": False, "state": "activating/auto-restart"}}, {}, "auto-restart"),
        ("units", "warning", {"agent": {"active": True, "restarts": 4}}, {}, "4 times"),
        ("units", "failure", {}, {"boot_LoadState": "not-found"}, "nothing would go back"),
        ("watchdog", "warning", {}, {"agent_WatchdogUSec": "0"}, "no watchdog"),
    ],
)
def test_what_is_wrong_is_told_with_what_mends_it(
    name: str, status: str, facts: dict[str, Any], said: dict[str, str], part: str
) -> None:
    check = judged(facts, said)[name]
    assert check.status == status
    assert part in check.what
    assert check.mend or status == "ok" or "is a directory" in check.what


@pytest.mark.parametrize(
    ("off_s", "doubt_s", "status", "part"),
    [
        (0.3, 0.01, "ok", "+0.300 s"),
        (-2.0, 0.01, "warning", "-2.000 s"),
        (1.5, 1.2, "ok", "give or take 1.2 s"),  # a slow link cannot tell
        (-1.7e9, 0.1, "failure", "days behind ours"),
        (90.0, 0.1, "failure", "90 s ahead of ours"),
    ],
)
def test_clocks(off_s: float, doubt_s: float, status: str, part: str) -> None:
    check = judged(clock_off_s=off_s, clock_doubt_s=doubt_s)["clock"]
    assert (check.status, part in check.what) == (status, True)


def test_a_slow_link_is_told() -> None:
    check = judged(trips_s=(0.4, 0.9, 1.1))["round trip (ssh)"]
    assert (check.status, check.what) == ("warning", "half of 3 within 900 ms, all within 1.1 s")


def test_software_that_cannot_be_asked_is_no_reason_not_to_look_at_the_rest() -> None:
    found = judged({"protocol": 0}, trouble=FullswarmError("may not become root there", hint="let ssh_user be root"))
    assert (found["software"].what, found["software"].mend) == ("may not become root there", "let ssh_user be root")
    assert found["port"].status == "ok"


def test_a_log_that_may_not_be_read_is_told() -> None:
    for errors, unread in ((None, True), (0, False)):  # root may read it, even if this user may not
        found = RobotComputer(
            facts=msgspec.convert({**FACTS, "card_errors": errors}, ComputerFacts), answers={}, trips_s=(0.1,)
        )
        card = next(each for each in computer(found, "r1", "1.2.3") if each.name == "card")
        assert (card.status, "cannot read its kernel" in card.what) == ("ok", unread)
