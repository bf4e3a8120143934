"""Visits to robots that are no rollout: go back to the release before, reboot; so many at a time."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping

from fullswarm import output
from fullswarm.deploy.fleet import steps
from fullswarm.deploy.fleet.commands import Fleet, Order
from fullswarm.deploy.fleet.desired import Desired
from fullswarm.deploy.fleet.facts import Facts, facts_of
from fullswarm.deploy.fleet.login import Address, Login
from fullswarm.deploy.fleet.remote import LinkBroke, Remote
from fullswarm.deploy.fleet.report import Row, tell
from fullswarm.errors import FullswarmError, Unreachable

AGENT_S = 40.0
POLL_S = 1.0

Visit = Callable[[Address], Awaitable[Row]]


def rollback(order: Order) -> int:
    """Go back to the release before on each robot; return the exit code."""
    fleet = Fleet.of(order)

    async def visit(address: Address) -> Row:
        async with fleet.login.connect(address) as remote:
            facts = await _idle(remote, order)
            goal = "what it ran before" if facts.pending else facts.previous
            if goal is None:
                hint = "`fullswarm update --release` takes any release of the store"
                raise steps.Refused("there is no release to go back to", where=address.robot, hint=hint)
            if order.dry_run:
                return Row(address.robot, "would go back", f"to {goal}", release=facts.current or "")
            now = await steps.roll_back(remote, "asked for by the operator")
            why = await _why_not_healthy(remote)
        if why:
            return Row(address.robot, "rolled back", f"and not healthy: {why}", _logs(address), now or "", exit_code=1)
        return Row(address.robot, "rolled back", f"from {facts.current}", release=now or "")

    rows = asyncio.run(everybody(fleet.addresses, visit, order.at_a_time))
    if not order.dry_run:
        back = {each.robot: each.release for each in rows if each.result == "rolled back" and each.release}
        Desired.of(fleet.config.swarm).want(back)
    return tell(rows, as_json=order.as_json)


def reboot(order: Order, wait_s: float | None) -> int:
    """Restart the computers of robots, which must stand idle; return the exit code."""
    fleet = Fleet.of(order)

    async def visit(address: Address) -> Row:
        async with fleet.login.connect(address) as remote:
            facts = await _idle(remote, order)
            if order.dry_run:
                return Row(address.robot, "would reboot", release=facts.current or "")
            try:
                forced = ("--force",) if order.force else ()
                answer = await remote.program("reboot", *forced)
                if answer.code:
                    raise steps.Refused(answer.words, where=address.robot)
            except LinkBroke:
                pass  # it is on its way down
        if wait_s is None:
            return Row(address.robot, "reboots", release=facts.current or "")
        output.progress(f"{address.robot}: reboots")
        return await _back(fleet.login, address, facts.boot_id, wait_s)

    return tell(asyncio.run(everybody(fleet.addresses, visit, order.at_a_time)), as_json=order.as_json)


async def everybody(addresses: Mapping[str, Address], visit: Visit, at_a_time: int) -> list[Row]:
    """Visit all, `at_a_time`; an error is the robot's own row."""
    room = asyncio.Semaphore(at_a_time)

    async def one(address: Address) -> Row:
        async with room:
            try:
                return await visit(address)
            except Unreachable as error:
                return Row(address.robot, "unreachable", error.what, error.hint, exit_code=error.exit_code)
            except FullswarmError as error:
                result = "refused" if isinstance(error, steps.Refused) else "failed"
                return Row(address.robot, result, error.what, error.hint, exit_code=error.exit_code)

    return list(await asyncio.gather(*(one(each) for each in addresses.values())))


async def _idle(remote: Remote, order: Order) -> Facts:
    facts = await facts_of(remote)
    if not facts.installed:
        hint = f"`fullswarm deploy {remote.robot}` puts it there"
        raise FullswarmError("nothing of ours is installed there", where=remote.robot, hint=hint)
    if facts.busy_with and not order.force:
        hint = "stop it (`fullswarm stop`) first, or --force"
        raise steps.Refused(f"it is {facts.busy_with}", where=remote.robot, hint=hint)
    return facts


async def _why_not_healthy(remote: Remote) -> str:
    """Wait for the agent to be healthy; empty when it is."""
    now = asyncio.get_running_loop().time
    until_s = now() + AGENT_S
    while True:
        said, why = await steps.health(remote)
        if said is not None and said.healthy:
            return ""
        if now() >= until_s:
            return why
        await asyncio.sleep(POLL_S)


async def _back(login: Login, address: Address, boot_id: str, wait_s: float) -> Row:
    """Wait until a computer has booted anew."""
    now = asyncio.get_running_loop().time
    began_s = now()
    while now() < began_s + wait_s:
        try:
            async with login.connect(address) as remote:
                facts = await facts_of(remote)
                if facts.boot_id != boot_id:
                    release = facts.current or ""
                    return Row(address.robot, "rebooted", f"back after {now() - began_s:.0f} s", release=release)
        except FullswarmError:
            pass  # not up yet
        await asyncio.sleep(POLL_S)
    mend = "look at its screen, or put its card into a computer"
    return Row(address.robot, "not back", f"nothing heard for {wait_s:.0f} s", mend, exit_code=3)


def _logs(address: Address) -> str:
    return f"fullswarm logs {address.robot}"
