"""``fullswarm logs`` and ``fullswarm shell``: one robot's words, and its shell."""

from __future__ import annotations

import asyncio
import json
import os
import shlex
import shutil

from fullswarm import output
from fullswarm.deploy.fleet.commands import Fleet, Order
from fullswarm.deploy.fleet.login import Address
from fullswarm.deploy.fleet.untrusted import clean_log_line
from fullswarm.errors import ConfigError, FullswarmError


def logs(order: Order, lines: int, *, follow: bool) -> int:
    """Print what a robot's agent has said, as it stands or as JSON lines; return the exit code."""
    fleet = Fleet.of(order)
    address = fleet.addresses[fleet.ids[0]]

    async def read() -> int:
        words = ("logs", *(("--json",) if order.as_json else ()), *(("-f",) if follow else ()), "-n", str(lines))
        tell = json_line if order.as_json else clean_log_line
        async with fleet.login.connect(address) as remote:
            answer = await remote.program(
                *words, within_s=None if follow else 60.0, line=lambda said: output.data(tell(said))
            )
        if answer.code:
            raise FullswarmError(f"no logs: {answer.words}", where=address.robot, hint="fullswarm deploy")
        return 0

    return asyncio.run(read())


def json_line(said: bytes) -> str:
    """Return one line of the journal's own JSON as ours: when (s since 1970), how bad (syslog's 0 to 7), what."""
    try:
        entry = json.loads(said)
        text = entry["MESSAGE"]
        when_s, priority = int(entry["__REALTIME_TIMESTAMP"]) / 1e6, int(entry.get("PRIORITY", 6))
    except (ValueError, TypeError, KeyError):
        return json.dumps({"text": clean_log_line(said)})
    text = clean_log_line(text.encode()) if isinstance(text, str) else "bytes that are no text"
    return json.dumps({"time_s": when_s, "priority": priority, "text": text})


def shell(order: Order, command: list[str]) -> int:
    """Hand the terminal over to ``ssh``, which takes the place of this process."""
    fleet = Fleet.of(order)
    address = fleet.addresses[fleet.ids[0]]
    pins = fleet.login.pins
    pins.pin_flashed(address.robot, address.host, address.port)
    if not pins.keys(address.robot, address.host, address.port):
        raise pins.unknown(address.robot, address.host, asyncio.run(fleet.login.host_key(address)))
    program = shutil.which("ssh")
    if program is None:
        raise ConfigError("ssh is not installed here", hint="sudo apt install openssh-client")
    words = ssh_words(fleet, address)
    if not order.dry_run:
        os.execv(program, [program, *words, *command])  # noqa: S606 - the user's own terminal, no shell between
    output.data(shlex.join([program, *words, *command]))
    return 0


def ssh_words(fleet: Fleet, address: Address) -> list[str]:
    """``ssh``'s arguments: our pinned keys and no others, the fleet's key, then the user's own."""
    return [
        *("-o", f"UserKnownHostsFile={fleet.login.pins.known_hosts}"),
        *("-o", "GlobalKnownHostsFile=/dev/null"),
        *("-o", "StrictHostKeyChecking=yes"),
        *("-o", "UpdateHostKeys=no"),
        *("-i", str(fleet.login.fleet_key)),
        *("-p", str(address.port)),
        *("-l", address.user),
        *("--", address.host),
    ]
