"""Judges what SSH found on a robot's computer: card, power, heat, clock, port, software, units. Pure."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator
from dataclasses import replace

from fullswarm.bringup.checks import Check, Status, took
from fullswarm.bringup.preflight_ssh import Board
from fullswarm.deploy.fleet.untrusted import clean

LEAST_FREE, LITTLE_FREE = 100e6, 500e6
"""Bytes: without the first no update goes through, with less than the second the one after next may not."""
HOT_C, TOO_HOT_C = 70.0, 80.0
"""From 80 °C on a Raspberry Pi slows down."""
CLOCK_OFF_S, CLOCK_WRONG_S = 0.5, 60.0
SLOW_SSH_S = 0.5
USER = "fullswarm"
POWER = {0: "the voltage is too low now", 1: "its clock rate is held down now", 2: "it is slowed down now",
         3: "it is close to its highest temperature"}  # fmt: skip
POWER_WAS = {16: "the voltage was too low", 17: "its clock rate was held down", 18: "it was slowed down"}
"""Bits of the Raspberry Pi's ``get_throttled``; the second row stays until it is switched off."""
LOW_VOLTAGE = 1 << 0 | 1 << 16


def checks(board: Board, robot: str, version: str, *, port: str = "", net: str = "") -> Iterator[Check]:
    """Judge a computer.

    Parameters
    ----------
    version
        Of fullswarm here.
    port, net
        Where the robot's driver shall find its serial port, or its CAN interface.
    """
    for check in _checks(board, robot, version, port, net):
        yield replace(check, what=clean(check.what))  # much of it comes from the robot


def _checks(board: Board, robot: str, version: str, port: str, net: str) -> Iterator[Check]:
    yield _ssh(board)
    yield from _card(board, robot)
    yield _power(board.facts.throttled)
    yield _temperature(board.facts.temperature_c)
    yield _clock(board)
    if port:
        yield _port(port, board.said.get("port", ""), board.said.get("groups", "").split())
    if net:
        yield _net(net, board.said.get("net", ""))
    yield from _software(board, robot, version)


def _ssh(board: Board) -> Check:
    middle_s, worst_s = statistics.median(board.trips_s), max(board.trips_s)
    what = f"half of {len(board.trips_s)} within {took(middle_s)}, all within {took(worst_s)}"
    if middle_s > SLOW_SSH_S:
        return Check("round trip (ssh)", "warning", what, "a slow network, or a computer that is busy")
    return Check("round trip (ssh)", "ok", what)


# ---------------------------------------------------------------- the computer
def _card(board: Board, robot: str) -> Iterator[Check]:
    facts, said = board.facts, board.said
    anew = f"save what you need and write a new card: fullswarm flash {robot}"
    options = said.get("state", "").split(",")
    if "ro" in options:
        # On purpose only the system is read-only, never the folder of what must outlive a release.
        what = "what its agent must remember (a latched e-stop) lies on a file system that is read-only"
        fell = "rw" in said.get("meant", "").split(",") or "errors=remount-ro" in options
        yield Check("card", "failure", what, anew if fell else "mount /var/lib/fullswarm so that it can be written")
    logged = int(said["card_log"]) if said.get("card_log", "").isdecimal() else 0
    errors = max(facts.disk_errors or 0, facts.card_errors or 0, logged)
    if errors:
        yield Check("card", "failure", f"{errors} errors of its card or file system since it was started", anew)
    if facts.installed and not facts.disk_writable and not facts.pending:
        yield Check("card", "warning", "/opt/fullswarm cannot be written: no update will go through", "remount it rw")
    free = facts.disk_free_bytes
    if free is None:
        yield Check("card", "warning", "how much is free is not known", "")
        return
    seen = (
        "" if "card_log" in said or facts.card_errors is not None else "; its kernel's log cannot be read by this user"
    )
    status: Status = "failure" if free < LEAST_FREE else "warning" if free < LITTLE_FREE else "ok"
    mend = "" if status == "ok" else f"make room: fullswarm shell {robot}, then du -xh / | sort -h | tail"
    yield Check("card", status, f"{free / 1e9:.1f} GB free{seen}", mend)


def _power(throttled: str) -> Check:
    """Judge the bits of a Raspberry Pi's ``get_throttled``, in hexadecimal."""
    try:
        bits = int(throttled.removeprefix("throttled=").removeprefix("0x"), 16)
    except ValueError:
        return Check("power", "ok", "not known: this computer does not watch its voltage")
    now = [text for bit, text in POWER.items() if bits >> bit & 1]
    was = [text for bit, text in POWER_WAS.items() if bits >> bit & 1]
    if not bits:
        return Check("power", "ok", "the voltage has never been too low since it was switched on")
    mend = "a stronger supply, a shorter and thicker cable" if bits & LOW_VOLTAGE else "cool it: a heat sink, a fan"
    if now:
        return Check("power", "failure" if bits & 1 else "warning", "; ".join(now), mend)
    return Check("power", "warning", f"since it was switched on {'; '.join(was) or 'it ran hot'}", mend)


def _temperature(celsius: float | None) -> Check:
    if celsius is None or not math.isfinite(celsius):
        return Check("temperature", "ok", "not known: this computer does not report it")
    status: Status = "failure" if celsius >= TOO_HOT_C else "warning" if celsius >= HOT_C else "ok"
    mend = "" if status == "ok" else "a heat sink, a fan, or open its case; it will slow down"
    return Check("temperature", status, f"{celsius:.0f} °C", mend)


def _clock(board: Board) -> Check:
    off_s, doubt_s = board.clock_off_s, board.clock_doubt_s
    if off_s is None:
        return Check("clock", "warning", "its clock could not be read", "")
    mend = "let it reach a time server: timedatectl there; its logs cannot be compared with others until then"
    if abs(off_s) - doubt_s > CLOCK_WRONG_S:
        days = abs(off_s) / 86400.0
        size = f"{days:.0f} days" if days >= 2.0 else took(abs(off_s))
        return Check("clock", "failure", f"{size} {'ahead of' if off_s > 0 else 'behind'} ours", mend)
    what = f"{off_s:+.3f} s from ours, give or take {took(doubt_s)}"
    if abs(off_s) - doubt_s > CLOCK_OFF_S:
        return Check("clock", "warning", what, mend)
    return Check("clock", "ok", what)


# ---------------------------------------------------------------- its driver's port
def _port(path: str, said: str, groups: list[str]) -> Check:
    if not said or said == "none":
        mend = "plug it in and switch the robot on; `fullswarm robots find` there shows what there is"
        return Check("port", "failure", f"{path} does not exist there", mend)
    mode, owner, group, kind = (*said.split(" ", 3), "", "", "")[:4]
    what = f"{path}: {mode}, {owner}:{group}"
    if not mode.isdecimal() or "character" not in kind:
        return Check("port", "failure", f"{path} is a {kind or 'thing that cannot be looked at'}, no port", "")
    if not groups:
        return Check("port", "failure", f"{what}; there is no user '{USER}'", "`fullswarm deploy` makes it")
    bits = int(mode, 8)
    may = bits >> 6 if owner == USER else bits >> 3 if group in groups else bits
    if may & 0o6 == 0o6:
        return Check("port", "ok", f"{what}; '{USER}' may open it")
    mend = (
        f"sudo usermod -aG {group} {USER} there, then restart its agent"
        if bits >> 3 & 0o6 == 0o6 and group != "root"
        else "`fullswarm deploy` brings the udev rules; then unplug it and plug it in again"
    )
    return Check("port", "failure", f"{what}; '{USER}' may not open it", mend)


def _net(name: str, said: str) -> Check:
    if said == "1":
        return Check("port", "ok", f"{name} is up")
    if said == "0":
        mend = f"sudo ip link set {name} up type can bitrate 250000   # the bus's own rate"
        return Check("port", "failure", f"{name} is there but down", mend)
    return Check("port", "failure", f"there is no {name}", "plug the adapter in, or load its driver (`dmesg` there)")


# ---------------------------------------------------------------- software
def _software(board: Board, robot: str, version: str) -> Iterator[Check]:
    facts = board.facts
    if board.trouble is not None:
        yield Check("software", "failure", board.trouble.what, board.trouble.hint)
        return
    if not facts.installed:
        yield Check("software", "failure", "nothing of fullswarm is installed there", f"fullswarm deploy {robot}")
        return
    yield _release(board, robot, version)
    yield from _units(board, robot)
    health = facts.health
    if health is None:
        yield Check("agent", "failure", "it has sent no health report lately", f"fullswarm logs {robot}")
    elif not health.healthy:
        why = "; ".join(health.why) or "it gives no reason"
        yield Check("agent", "failure", f"not healthy: {why}", f"see the other lines; fullswarm logs {robot} has more")
    else:
        yield Check("agent", "ok", f"healthy, {health.lifecycle}")


def _release(board: Board, robot: str, version: str) -> Check:
    facts = board.facts
    if facts.robot != robot:
        what = f"this computer reports that it is '{facts.robot}'"
        return Check("software", "failure", what, f"`host` in the fleet file, or fullswarm deploy {robot}")
    if facts.current is None:
        return Check("software", "failure", "no release is installed", f"fullswarm deploy {robot}")
    what = f"{facts.current}, python {facts.python}, {facts.arch}"
    if facts.pending:
        mend = "wait a minute: it is approved or goes back by itself"
        return Check("software", "warning", f"{what}; {facts.pending} waits for its verdict", mend)
    running = facts.health.release if facts.health is not None else ""
    if running and running != facts.current:
        return Check("software", "failure", f"{what}, but its agent runs {running}", "restart its agent")
    theirs = facts.current.rpartition("-")[0]
    if theirs != version:
        return Check("software", "warning", f"{what}; here it is {version}", f"fullswarm update {robot}")
    back = f"; the last switch went back: {facts.back_because}" if facts.back_because else ""
    return Check("software", "ok", f"{what}{back}")


def _units(board: Board, robot: str) -> Iterator[Check]:
    agent, said = board.facts.agent, board.said
    if not agent.active:
        what = f"fullswarm-agent.service is {agent.state or 'not active'}"
        yield Check("units", "failure", what, f"fullswarm logs {robot}")
        return
    if said.get("boot_LoadState", "loaded") != "loaded" or said.get("boot_Result", "success") != "success":
        what = "fullswarm-boot.service did not run: after a power cut in an update nothing would go back"
        yield Check("units", "failure", what, f"fullswarm deploy {robot}")
    if said.get("agent_WatchdogUSec", "") in ("0", "infinity"):
        what = "no watchdog restarts its agent if it hangs (WatchdogSec)"
        yield Check("watchdog", "warning", what, f"fullswarm deploy {robot}")
    elif "agent_WatchdogUSec" in said:
        yield Check("watchdog", "ok", f"systemd starts it again when it hangs for {said['agent_WatchdogUSec']}")
    if agent.restarts:
        what = f"the agent runs, but was started again {agent.restarts} times"
        yield Check("units", "warning", what, f"fullswarm logs {robot} says why")
    else:
        yield Check("units", "ok", "the agent runs")
