"""A robot before it drives, as SSH finds its computer: one login, some round trips, one small script."""

from __future__ import annotations

import shlex
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

import msgspec

from fullswarm.deploy.fleet.facts import Facts, facts_of
from fullswarm.deploy.fleet.login import Address, Login
from fullswarm.deploy.fleet.remote import Remote
from fullswarm.deploy.fleet.untrusted import clean, strict_json
from fullswarm.errors import FullswarmError, Unreachable

TRIPS = 5
TRIP_S = 5.0
LOOK_S = 20.0
CLOCK = "date -u +%s.%N"
# What `fullswarm-robot facts` does not report, as the user that logs in: no root, and nothing is changed.
LOOK = r"""
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


class BoardFacts(Facts, frozen=True):
    """What else ``fullswarm-robot facts`` reports that matters before driving."""

    disk_errors: int | None = None
    card_errors: int | None = None
    throttled: str = ""


@dataclass(frozen=True, slots=True)
class Board:
    """What was found.

    Parameters
    ----------
    trouble
        Why nothing is known of the software there; then `facts` are empty.
    said
        The answers of `LOOK`.
    trips_s
        How long commands took that do nothing, there and back.
    clock_off_s, clock_doubt_s
        How far its clock is ahead of ours, and half the round trip in which that was asked; None: not reported.
    """

    trips_s: tuple[float, ...]
    facts: BoardFacts = field(default_factory=BoardFacts)
    said: Mapping[str, str] = field(default_factory=dict)
    clock_off_s: float | None = None
    clock_doubt_s: float = 0.0
    trouble: FullswarmError | None = None


async def look(login: Login, address: Address, port: str = "", net: str = "") -> Board:
    """Log in and look.

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
        said = await _said(remote, port, net)
        facts, trouble = BoardFacts(), None
        try:
            facts = await _facts(remote)
        except FullswarmError as error:
            trouble = error
    timed = [trip for trip in trips if trip[1] is not None]
    # The shortest round trip bounds best when the other clock was read.
    took_s, off_s = min(timed, default=(0.0, None))
    return Board(tuple(each for each, _ in trips), facts, said, off_s, took_s / 2.0, trouble)


async def _trip(remote: Remote) -> tuple[float, float | None]:
    """Return how long a command takes that reads the clock, s, and how far that was ahead of ours."""
    began_s, began_wall_s = time.monotonic(), time.time()
    answer = await remote.run(CLOCK, within_s=TRIP_S)
    took_s = time.monotonic() - began_s
    try:
        return took_s, float(answer.out) - (began_wall_s + took_s / 2.0)
    except ValueError:  # a `date` without nanoseconds
        return took_s, None


async def _said(remote: Remote, port: str, net: str) -> dict[str, str]:
    script = f"set -- {shlex.quote(port)} {shlex.quote(net)}\n{LOOK}"
    answer = await remote.run(script, within_s=LOOK_S)
    lines = (clean(line, 200) for line in answer.out.splitlines()[:64])
    return dict(line.split("=", 1) for line in lines if "=" in line)


async def _facts(remote: Remote) -> BoardFacts:
    known = await facts_of(remote)
    if not known.installed:
        return msgspec.convert(msgspec.to_builtins(known), BoardFacts)
    answer = await remote.program("facts")
    if answer.code:
        raise Unreachable(f"fullswarm-robot fails: {answer.words}", where=remote.robot, hint="fullswarm deploy")
    return strict_json(answer.out, BoardFacts, remote.robot)
