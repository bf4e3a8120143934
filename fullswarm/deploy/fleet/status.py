"""``fullswarm fleet``: what each robot runs, what it should run, whether it is healthy, and what to do."""

from __future__ import annotations

import asyncio
import math
from dataclasses import asdict, dataclass

from fullswarm import output
from fullswarm.deploy.fleet.commands import FILE_COLUMNS, Fleet, FleetRequest, table
from fullswarm.deploy.fleet.facts import Facts, clock_error_s, facts_of
from fullswarm.deploy.fleet.login import Address
from fullswarm.deploy.fleet.releases import Desired
from fullswarm.deploy.fleet.remote import clean
from fullswarm.errors import FullswarmError, Unreachable

CLOCK_S = 60.0
LOW_DISK_BYTES = 500_000_000
HOT_C = 80.0


@dataclass(frozen=True, slots=True)
class Line:
    """One robot; `skew` is empty when it runs what it should."""

    robot: str
    host: str
    release: str
    desired: str
    skew: str
    health: str
    why: str = ""
    mend: str = ""
    temperature_c: float | None = None
    disk_free_bytes: int | None = None
    exit_code: int = 0


def fleet(order: FleetRequest) -> int:
    """Print the fleet; return 0 when all is well and as it should be, 3 when no robot was reached, else 1."""
    whole = Fleet.of(order)
    desired = Desired.of(whole.config.swarm).read()
    lines = asyncio.run(_look(whole, desired, order.at_a_time))
    codes = {each.exit_code for each in lines}
    code = codes.pop() if len(codes) == 1 else 1
    if order.as_json:
        robots = [{**asdict(each), "ok": not each.exit_code} for each in lines]
        for each in robots:
            del each["exit_code"]
        output.data_json({"ok": code == 0, "robots": robots})
        return code
    columns = ("robot", "host", "release", "skew", "health", "why", "what to do")
    cells = [
        (each.robot, each.host, each.release or "-", each.skew or "-", each.health, each.why, each.mend)
        for each in lines
    ]
    output.data_table(table(columns, cells), into_file=FILE_COLUMNS)
    return code


async def _look(whole: Fleet, desired: dict[str, str], at_a_time: int) -> list[Line]:
    room = asyncio.Semaphore(at_a_time)

    async def one(address: Address) -> Line:
        wanted = desired.get(address.robot, "")
        async with room:
            try:
                async with whole.login.connect(address) as remote:
                    return line(address, await facts_of(remote), wanted)
            except FullswarmError as error:
                state = "unreachable" if isinstance(error, Unreachable) else "unknown"
                skew = f"wants {wanted}" if wanted else ""
                return Line(address.robot, address.host, "", wanted, skew, state, error.what, error.hint, exit_code=3)

    return list(await asyncio.gather(*(one(each) for each in whole.addresses.values())))


def line(address: Address, facts: Facts, wanted: str) -> Line:
    """Judge what one robot says."""
    release = clean(facts.current or "", 80)
    skew = f"wants {wanted}" if wanted and wanted != release else ""
    state, why, mend = _health(address.robot, facts)
    if not mend and skew:
        mend = f"fullswarm update {address.robot}"
        why = why or (f"went back: {facts.back_because}" if facts.back_because else "")
    warnings = _warnings(facts)
    return Line(
        address.robot,
        address.host,
        release,
        wanted,
        skew,
        state,
        "; ".join(filter(None, (why, *warnings))),
        mend,
        facts.temperature_c,
        facts.disk_free_bytes,
        exit_code=0 if state == "healthy" and not skew else 1,
    )


def _health(robot: str, facts: Facts) -> tuple[str, str, str]:
    """State, why, what to do."""
    deploy, logs = f"fullswarm deploy {robot}", f"fullswarm logs {robot}"
    if not facts.installed:
        return "not installed", "", deploy
    if facts.robot != robot:
        name = clean(facts.robot, 64) or "nobody"
        return "another robot", f"it says it is {name}", "`host` in the fleet file, or deploy it under this name"
    if not facts.current:
        return "no release", facts.back_because, deploy
    if facts.pending:
        return "pending", f"{clean(facts.pending, 80)} waits for its verdict", "wait a minute; its guard decides"
    if facts.health is None:
        restarts = f", {facts.agent.restarts} restarts" if facts.agent.restarts else ""
        return "silent", f"the agent says nothing ({clean(facts.agent.state, 40) or 'no unit'}{restarts})", logs
    if not facts.health.healthy:
        return "not healthy", clean("; ".join(facts.health.why)), logs
    return "healthy", "", ""


def _warnings(facts: Facts) -> list[str]:
    warnings = []
    off_s = clock_error_s(facts)
    if not math.isnan(off_s) and abs(off_s) > CLOCK_S:
        warnings.append(f"clock off by {off_s:+.0f} s")
    if facts.disk_free_bytes is not None and facts.disk_free_bytes < LOW_DISK_BYTES:
        warnings.append(f"{facts.disk_free_bytes / 1e6:.0f} MB of disk free")
    if not facts.disk_writable:
        warnings.append("disk not writable")
    if facts.temperature_c is not None and facts.temperature_c > HOT_C:
        warnings.append(f"{facts.temperature_c:.0f} °C")
    return warnings
