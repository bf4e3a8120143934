"""One robot, one step over a connection: install, stage, switch under guard, commit, roll back.

Each may be done again: a robot that has it already says so. What a robot refuses raises `Refused`.
"""

from __future__ import annotations

import gzip
import shlex
from pathlib import Path

from fullswarm.deploy.fleet.facts import Facts, Health, facts_of
from fullswarm.deploy.fleet.remote import Answer, LinkBroke, Remote
from fullswarm.deploy.fleet.ship import Parcels, missing_of, size_of
from fullswarm.deploy.fleet.untrusted import strict_json
from fullswarm.deploy.release.manifest import Manifest
from fullswarm.deploy.release.store import head_archive
from fullswarm.errors import FullswarmError, MessageError

UNPACK = 'd=$(mktemp -d) && trap "rm -rf $d" EXIT && tar -xf - -C "$d" && sh "$d/install.sh"'
ADMIT = """umask 077; mkdir -p "$HOME/.ssh" && cd "$HOME/.ssh" && IFS= read -r k || exit 1
grep -qxF "$k" authorized_keys 2>/dev/null && exit 0
[ -s authorized_keys ] && [ -n "$(tail -c 1 authorized_keys)" ] && echo >> authorized_keys
printf '%s\\n' "$k" >> authorized_keys"""
INSTALL_S, WANT_S, RECEIVE_S, SWITCH_S = 180.0, 180.0, 240.0, 150.0
"""The longest a step may take after all was sent, on the slowest card that we would wait for."""
LACKS, REFUSED, WENT_BACK = 1, 3, 4


class Refused(FullswarmError):
    """The robot said no, and nothing has changed there."""

    exit_code = 3


class WentBack(FullswarmError):
    """The robot tried the release, its agent did not start, and it runs the one before again."""


async def admit(remote: Remote, public_key: str) -> None:
    """Let the fleet's key in from now on."""
    answer = await remote.run(ADMIT, feed=f"{public_key}\n".encode())
    _done(answer, remote, "cannot write ~/.ssh/authorized_keys")


async def install(remote: Remote, archive: bytes, *, installed: bool) -> None:
    """Spread a kit: our program, units, rules, the fleet file. Restarts nothing that it need not."""
    if installed:  # the one program that a plain user may run as root
        answer = await remote.program("install", feed=archive, within_s=INSTALL_S)
    else:
        answer = await remote.as_root(f"sh -c {shlex.quote(UNPACK)}", feed=archive, within_s=INSTALL_S)
    _done(answer, remote, "the installer failed")


async def stage(remote: Remote, release: Path, parcels: Parcels, facts: Facts) -> None:
    """Bring a release to a robot, beside the one that it runs. After a cut: only what is still missing."""
    name = Manifest.read(release).id
    nearest = ("--from", facts.current) if facts.current else ()
    # Hashes in hex: half of them is air.
    head, size = gzip.compress(head_archive(release), mtime=0), size_of(release)
    answer = await remote.program("want", name, *nearest, "--bytes", str(size), feed=head, within_s=WANT_S)
    _done(answer, remote, "does not take the release")
    # A file that it has of the release that it runs may turn out to be damaged there: then it asks for that one, too.
    for _ in range(2):
        missing = missing_of(release, answer.out, remote.robot)
        archive = await parcels.of(release, missing, zstd=facts.zstd)
        answer = await remote.program("receive", name, feed=archive, within_s=RECEIVE_S)
        if answer.code != LACKS or not answer.out.strip():
            break
    _done(answer, remote, "did not get the release whole")


async def switch(remote: Remote, release: str, guard_s: float, *, force: bool) -> None:
    """Make a release the current one; the robot goes back by itself unless it is committed in `guard_s`."""
    forced = ("--force",) if force else ()
    answer = await remote.program("switch", release, "--guard", f"{guard_s:.0f}", *forced, within_s=SWITCH_S)
    _done(answer, remote, "did not switch")


async def health(remote: Remote) -> tuple[Health | None, str]:
    """Ask how the agent is; without a fresh word of the right release: None and why."""
    answer = await remote.program("health", within_s=10.0)
    if answer.code == 0:
        said = strict_json(answer.out, Health, remote.robot)
        return said, "; ".join(said.why) or ("" if said.healthy else "it says it is not healthy, and not why")
    return None, answer.words


async def commit(remote: Remote, release: str) -> None:
    """Keep what it runs: guard and pending mark are taken away."""
    _done(await remote.program("commit", release), remote, "cannot be told to keep the release")


async def roll_back(remote: Remote, because: str) -> str | None:
    """Go back to the release before; return what it runs now."""
    answer = await remote.program("rollback", "--because", because[:200], within_s=SWITCH_S)
    if answer.code != WENT_BACK:
        _done(answer, remote, "cannot go back")
    return (await facts_of(remote)).current


def _done(answer: Answer, remote: Remote, what: str) -> None:
    if answer.code == 0:
        return
    if answer.code == REFUSED:
        raise Refused(answer.words, where=remote.robot)
    if answer.code == WENT_BACK:
        raise WentBack(answer.words, where=remote.robot)
    if b": busy: " in answer.err[-4096:]:
        # After a cut the other end of the old link may not have noticed yet.
        raise LinkBroke(answer.words, where=remote.robot, hint="try again")
    if answer.code < 0:  # killed there, by whomever: it may have done its work, or a part of it
        raise LinkBroke(f"{what}: it was killed", where=remote.robot, hint="try again")
    if answer.code == 127:
        raise MessageError("our program is not there", where=remote.robot, hint=f"`fullswarm deploy {remote.robot}`")
    raise FullswarmError(f"{what}: {answer.words}", where=remote.robot)
