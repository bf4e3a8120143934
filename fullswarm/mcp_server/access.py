"""The connection to the swarm, and what of it several tools need."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fullswarm.errors import ConfigError, FullswarmError, RequestRefused, Unreachable, did_you_mean
from fullswarm.operator.swarm import Client
from fullswarm.operator.view import RobotRow, Snapshot

BEHAVIOUR = "behaviour/"
SLOW = 4
"""Calls that wait for another process at the same time; more are refused, so that a stop never waits for them."""


class Access:
    """A swarm as the tools see it.

    Parameters
    ----------
    client : owned by the caller
    fleet, results : what the operator has opened to the model beside the swarm; None: nothing

    Attributes
    ----------
    client : sends and receives
    """

    def __init__(self, client: Client, fleet: Path | None, results: Path | None) -> None:
        self.client, self.fleet, self.results = client, fleet, results
        self._settled = False
        self._waiting = 0

    async def snapshot(self) -> Snapshot:
        """Return the swarm as it is now; the first time when each robot has had the time to report.

        Raises
        ------
        Unreachable
            No hub answers.
        """
        if not self._settled:
            try:
                await asyncio.wrap_future(self.client.connected())
            except Unreachable:
                raise self._no_hub() from None
            self._settled = True
        found = self.client.state()
        if not found.connected:
            self._settled = False
            raise self._no_hub()
        return found

    def _no_hub(self) -> Unreachable:
        hint = "ask a person to start the swarm, `fullswarm up FLEET.toml`; robots without a hub stop by themselves"
        return Unreachable("no hub answers", where=self.client.hub, hint=hint)

    async def rows(self, robots: Iterable[str]) -> list[RobotRow]:
        """Return the named robots, none: all.

        Raises
        ------
        ConfigError
            There is no such robot.
        """
        found = {row.robot: row for row in (await self.snapshot()).robots}
        wanted = tuple(dict.fromkeys(robots)) or tuple(found)
        for robot in wanted:
            if robot not in found:
                raise ConfigError(f"no robot '{robot:.64}' is there", where="robots", hint=did_you_mean(robot, found))
        return [found[robot] for robot in wanted]

    async def record(self, behaviour: str) -> dict[str, Any]:
        """Return a behaviour's record, as the core has it.

        Raises
        ------
        ConfigError
            There is none.
        """
        records = await self.records()
        if behaviour not in records:
            raise ConfigError(
                f"no behaviour '{behaviour:.64}'", where="behaviour", hint=did_you_mean(behaviour[:64], records)
            )
        return records[behaviour]

    async def records(self) -> dict[str, dict[str, Any]]:
        """Return all behaviours' records by name, as the core has them."""
        entries = await asyncio.wrap_future(self.client.parameters(f"{BEHAVIOUR}*"))
        return {entry.key.removeprefix(BEHAVIOUR): entry.value for entry in entries if isinstance(entry.value, dict)}

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Do something that waits for another process.

        Raises
        ------
        RequestRefused
            Enough calls wait.
        """
        if self._waiting >= SLOW:
            raise RequestRefused(f"{SLOW} calls wait for an answer of the swarm", hint="wait for them, then call again")
        self._waiting += 1
        try:
            yield
        finally:
            self._waiting -= 1


def missing(option: str, what: str) -> FullswarmError:
    """Return the error for something that the operator has not opened to the model."""
    return ConfigError(
        f"{what} is not open to this server", where=option, hint=f"start it with `fullswarm mcp {option}`"
    )
