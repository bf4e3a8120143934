"""Checks a robot's computer over SSH before it drives: card, power, heat, clock, port, software, units."""

from __future__ import annotations

import math
import shlex
import statistics
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import msgspec

from fullswarm.bringup.checks import Check, Status, took
from fullswarm.deploy.fleet.facts import Facts, facts_of
from fullswarm.deploy.fleet.login import Address, Login
from fullswarm.deploy.fleet.remote import Remote, clean, strict_json
from fullswarm.errors import FullswarmError, Unreachable

TRIPS = 5
TRIP_S = 5.0
SCRIPT_S = 20.0
CLOCK = "date -u +%s.%N"
# What `fullswarm-robot facts` does not report, as the user that logs in: no root, and nothing is changed.
SCRIPT = r"""
if [ -n "$1" ]; then stat -Lc 'port=%a %U %G %F' -- "$1" 2>/dev/null || echo port=none; fi
if [ -n "$2" ]; then
  if [ -r "/sys/class/net/$2/flags" ]; then echo "net=$(($(cat "/sys/class/net/$2/flags") & 1))"; else echo net=none; fi
fi
echo "groups=$(id -Gn fullswarm 2>/dev/null)"
echo "state=$(findmnt -nro OPTIONS -T "${FULLSWARM_ROOT-}/var/lib/fullswarm" 2>/dev/null)"
echo "meant=$(awk '$2 == "/" && $1 !~ /^#/ {print $4}' /etc/fstab 2>/dev/null)"
if log=$(dmesg 2>/dev/null || journalctl -kq --no-pager 2>/dev/null) && [ -n "$log" ]; then
  errors='mmc[0-9]+: .*([Ee]rror|[Tt]imeout|timed out)|I/O error, dev (mmcblk|sd)|EXT4-fs error|Remounting .* read-only'
  echo "card_log=$(printf '%s\n' "$log" | grep -Ec "$errors")"
fi
control=${FULLSWARM_SYSTEMCTL-systemctl}
"$control" show fullswarm-agent.service -p WatchdogUSec -p LoadState 2>/dev/null | sed 's/^/agent_/'
"$control" show fullswarm-boot.service -p LoadState -p Result 2>/dev/null | sed 's/^/boot_/'
exit 0
"""
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


class ComputerFacts(Facts, frozen=True):
    """What else ``fullswarm-robot facts`` reports that matters before driving."""

    disk_errors: int | None = None
    card_errors: int | None = None
    throttled: str = ""


@dataclass(frozen=True, slots=True)
class RobotComputer:
    """What was found on a robot's computer.

    Parameters
    ----------
    trouble
        Why its software is unknown; then `facts` are empty.
    answers
        The answers of `SCRIPT`.
    trips_s
        How long commands took that do nothing, there and back.
    clock_off_s, clock_doubt_s
        How far its clock is ahead of ours, and half the round trip in which that was asked; None: not reported.
    """

    trips_s: tuple[float, ...]
    facts: ComputerFacts = field(default_factory=ComputerFacts)
    answers: Mapping[str, str] = field(default_factory=dict)
    clock_off_s: float | None = None
    clock_doubt_s: float = 0.0
    trouble: FullswarmError | None = None


async def inspect(login: Login, address: Address, port: str = "", net: str = "") -> RobotComputer:
    """Log in and read everything.

    Parameters
    ----------
    port, net
        Path of the driver's serial port, name of its CAN interface; empty: it has none.

    Raises
    ------
    Unreachable, HostKeyProblem, LoginRefused
        As `Login.connect`.
    """
    async with login.connect(address) as remote:
        trips = [await _trip(remote) for _ in range(TRIPS)]
        answers = await _answers(remote, port, net)
        facts, trouble = ComputerFacts(), None
        try:
            facts = await _facts(remote)
        except FullswarmError as error:
            trouble = error
    timed = [trip for trip in trips if trip[1] is not None]
    # The shortest round trip bounds best when the other clock was read.
    took_s, off_s = min(timed, default=(0.0, None))
    return RobotComputer(tuple(each for each, _ in trips), facts, answers, off_s, took_s / 2.0, trouble)


async def _trip(remote: Remote) -> tuple[float, float | None]:
    """Return how long a command takes that reads the clock, s, and how far that was ahead of ours."""
    began_s, began_wall_s = time.monotonic(), time.time()
    answer = await remote.run(CLOCK, within_s=TRIP_S)
    took_s = time.monotonic() - began_s
    try:
        return took_s, float(answer.out) - (began_wall_s + took_s / 2.0)
    except ValueError:  # a `date` without nanoseconds
        return took_s, None


async def _answers(remote: Remote, port: str, net: str) -> dict[str, str]:
    script = f"set -- {shlex.quote(port)} {shlex.quote(net)}\n{SCRIPT}"
    answer = await remote.run(script, within_s=SCRIPT_S)
    lines = (clean(line, 200) for line in answer.out.splitlines()[:64])
    return dict(line.split("=", 1) for line in lines if "=" in line)


async def _facts(remote: Remote) -> ComputerFacts:
    known = await facts_of(remote)
    if not known.installed:
        return msgspec.convert(msgspec.to_builtins(known), ComputerFacts)
    answer = await remote.program("facts")
    if answer.code:
        raise Unreachable(f"fullswarm-robot fails: {answer.words}", where=remote.robot, hint="fullswarm deploy")
    return strict_json(answer.out, ComputerFacts, remote.robot)


# ---------------------------------------------------------------- the checks
def computer(found: RobotComputer, robot: str, version: str, *, port: str = "", net: str = "") -> Iterator[Check]:
    """Check a computer.

    Parameters
    ----------
    version
        Of fullswarm here.
    port, net
        The serial port of the robot's driver, or its CAN interface.
    """
    for check in _checks(found, robot, version, port, net):
        yield replace(check, what=clean(check.what))  # much of it comes from the robot


def _checks(found: RobotComputer, robot: str, version: str, port: str, net: str) -> Iterator[Check]:
    yield _ssh(found)
    yield from _card(found, robot)
    yield _power(found.facts.throttled)
    yield _temperature(found.facts.temperature_c)
    yield _clock(found)
    if port:
        yield _port(port, found.answers.get("port", ""), found.answers.get("groups", "").split())
    if net:
        yield _net(net, found.answers.get("net", ""))
    yield from _software(found, robot, version)


def _ssh(found: RobotComputer) -> Check:
    middle_s, worst_s = statistics.median(found.trips_s), max(found.trips_s)
    what = f"half of {len(found.trips_s)} within {took(middle_s)}, all within {took(worst_s)}"
    if middle_s > SLOW_SSH_S:
        return Check("round trip (ssh)", "warning", what, "a slow network, or a computer that is busy")
    return Check("round trip (ssh)", "ok", what)


# ---------------------------------------------------------------- the computer
def _card(found: RobotComputer, robot: str) -> Iterator[Check]:
    facts, answers = found.facts, found.answers
    new_card = f"save your data and write a new card: fullswarm flash {robot}"
    options = answers.get("state", "").split(",")
    if "ro" in options:
        # On purpose only the system is read-only, never the folder of what must outlive a release.
        what = "what its agent must remember (a latched e-stop) lies on a file system that is read-only"
        fell = "rw" in answers.get("meant", "").split(",") or "errors=remount-ro" in options
        yield Check("card", "failure", what, new_card if fell else "mount /var/lib/fullswarm so that it can be written")
    logged = int(answers["card_log"]) if answers.get("card_log", "").isdecimal() else 0
    errors = max(facts.disk_errors or 0, facts.card_errors or 0, logged)
    if errors:
        yield Check("card", "failure", f"{errors} errors of its card or file system since it was started", new_card)
    if facts.installed and not facts.disk_writable and not facts.pending:
        yield Check("card", "warning", "/opt/fullswarm cannot be written: no update will go through", "remount it rw")
    free = facts.disk_free_bytes
    if free is None:
        yield Check("card", "warning", "the free space is unknown", "")
        return
    seen = "" if "card_log" in answers or facts.card_errors is not None else "; this user cannot read its kernel's log"
    status: Status = "failure" if free < LEAST_FREE else "warning" if free < LITTLE_FREE else "ok"
    mend = "" if status == "ok" else f"make room: fullswarm shell {robot}, then du -xh / | sort -h | tail"
    yield Check("card", status, f"{free / 1e9:.1f} GB free{seen}", mend)


def _power(throttled: str) -> Check:
    """Check the bits of a Raspberry Pi's ``get_throttled``, in hexadecimal."""
    try:
        bits = int(throttled.removeprefix("throttled=").removeprefix("0x"), 16)
    except ValueError:
        return Check("power", "ok", "unknown: this computer does not watch its voltage")
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
        return Check("temperature", "ok", "unknown: this computer does not report it")
    status: Status = "failure" if celsius >= TOO_HOT_C else "warning" if celsius >= HOT_C else "ok"
    mend = "" if status == "ok" else "a heat sink, a fan, or open its case; it will slow down"
    return Check("temperature", status, f"{celsius:.0f} °C", mend)


def _clock(found: RobotComputer) -> Check:
    off_s, doubt_s = found.clock_off_s, found.clock_doubt_s
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
def _port(path: str, answers: str, groups: list[str]) -> Check:
    if not answers or answers == "none":
        mend = "plug it in and switch the robot on; `fullswarm robots find` there shows what there is"
        return Check("port", "failure", f"{path} does not exist there", mend)
    mode, owner, group, kind = (*answers.split(" ", 3), "", "", "")[:4]
    what = f"{path}: {mode}, {owner}:{group}"
    if not mode.isdecimal() or "character" not in kind:
        return Check("port", "failure", f"{path} is a {kind or 'file of unknown kind'}, no port", "")
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


def _net(name: str, answers: str) -> Check:
    if answers == "1":
        return Check("port", "ok", f"{name} is up")
    if answers == "0":
        mend = f"sudo ip link set {name} up type can bitrate 250000   # the bus's own rate"
        return Check("port", "failure", f"{name} is there but down", mend)
    return Check("port", "failure", f"there is no {name}", "plug the adapter in, or load its driver (`dmesg` there)")


# ---------------------------------------------------------------- software
def _software(found: RobotComputer, robot: str, version: str) -> Iterator[Check]:
    facts = found.facts
    if found.trouble is not None:
        yield Check("software", "failure", found.trouble.what, found.trouble.hint)
        return
    if not facts.installed:
        yield Check("software", "failure", "nothing of fullswarm is installed there", f"fullswarm deploy {robot}")
        return
    yield _release(found, robot, version)
    yield from _units(found, robot)
    health = facts.health
    if health is None:
        yield Check("agent", "failure", "it has sent no health report lately", f"fullswarm logs {robot}")
    elif not health.healthy:
        why = "; ".join(health.why) or "it gives no reason"
        yield Check("agent", "failure", f"not healthy: {why}", f"see the other lines; fullswarm logs {robot} has more")
    else:
        yield Check("agent", "ok", f"healthy, {health.lifecycle}")


def _release(found: RobotComputer, robot: str, version: str) -> Check:
    facts = found.facts
    if facts.robot != robot:
        what = f"this computer reports that it is '{facts.robot}'"
        return Check("software", "failure", what, f"`host` in the fleet file, or fullswarm deploy {robot}")
    if facts.current is None:
        return Check("software", "failure", "no release is installed", f"fullswarm deploy {robot}")
    what = f"{facts.current}, python {facts.python}, {facts.arch}"
    if facts.pending:
        mend = "wait a minute: it is approved or goes back by itself"
        return Check("software", "warning", f"{what}; {facts.pending} is not committed yet", mend)
    running = facts.health.release if facts.health is not None else ""
    if running and running != facts.current:
        return Check("software", "failure", f"{what}, but its agent runs {running}", "restart its agent")
    theirs = facts.current.rpartition("-")[0]
    if theirs != version:
        return Check("software", "warning", f"{what}; here it is {version}", f"fullswarm update {robot}")
    back = f"; the last switch went back: {facts.rollback_reason}" if facts.rollback_reason else ""
    return Check("software", "ok", f"{what}{back}")


def _units(found: RobotComputer, robot: str) -> Iterator[Check]:
    agent, answers = found.facts.agent, found.answers
    if not agent.active:
        what = f"fullswarm-agent.service is {agent.state or 'not active'}"
        yield Check("units", "failure", what, f"fullswarm logs {robot}")
        return
    if answers.get("boot_LoadState", "loaded") != "loaded" or answers.get("boot_Result", "success") != "success":
        what = "fullswarm-boot.service did not run: after a power cut in an update nothing would go back"
        yield Check("units", "failure", what, f"fullswarm deploy {robot}")
    if answers.get("agent_WatchdogUSec", "") in ("0", "infinity"):
        what = "no watchdog restarts its agent if it hangs (WatchdogSec)"
        yield Check("watchdog", "warning", what, f"fullswarm deploy {robot}")
    elif "agent_WatchdogUSec" in answers:
        yield Check("watchdog", "ok", f"systemd starts it again when it hangs for {answers['agent_WatchdogUSec']}")
    if agent.restarts:
        what = f"the agent runs, but was started again {agent.restarts} times"
        yield Check("units", "warning", what, f"see fullswarm logs {robot}")
    else:
        yield Check("units", "ok", "the agent runs")
