"""Groups of robots in the core's database: ``@name`` names a group wherever a request names robots."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from fullswarm.core.settings import GROUP
from fullswarm.errors import ConfigError, RequestRefused, did_you_mean
from fullswarm.keys import ROBOT_ID, TRUTH
from fullswarm.messages import ParamEntry
from fullswarm.store import Store, Stored

MARK = "@"
MOST = 10_000
"""Robots of a group at most."""


class Groups:
    """The groups as they are now; looking one up costs nothing until the database changes."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._robots: dict[str, tuple[str, ...] | None] = {}
        store.watch(self._changed)

    def _changed(self, entry: ParamEntry) -> None:
        if entry.key.startswith(GROUP):
            self._robots.clear()

    def get(self, name: str) -> tuple[str, ...] | None:
        """Return the robots of group `name`; None: there is no such group."""
        if name not in self._robots:
            if not ROBOT_ID.match(name):
                return None  # made-up names must not fill the memory
            value = self._store.get(GROUP + name)
            robots = value.get("robots") if isinstance(value, dict) else None
            found = tuple(map(str, robots)) if isinstance(robots, list) else None
            if found is None:
                return None
            self._robots[name] = found
        return self._robots[name]

    def holding(self, robots: Iterable[str]) -> tuple[str, ...]:
        """Return the names of the groups that hold all of `robots`, without the mark."""
        wanted = set(robots)
        names = (entry.key.removeprefix(GROUP) for entry in self._store.list(GROUP))
        return tuple(name for name in names if wanted <= set(self.get(name) or ()))

    def expand(self, names: Sequence[str]) -> Sequence[str]:
        """Replace the names of groups by their robots.

        Raises
        ------
        RequestRefused
            No such group, or it is empty: an empty list would mean the whole swarm.
        """
        if not any(name.startswith(MARK) for name in names):
            return names
        robots: list[str] = []
        for name in names:
            if not name.startswith(MARK):
                robots.append(name)
                continue
            members = self.get(name[len(MARK) :])
            if members is None:
                raise RequestRefused(f"unknown group '{name}'", hint=self._guess(name))
            if not members:
                raise RequestRefused(f"group '{name}' has no robots", hint=f"see `params get '{GROUP}*'`")
            robots.extend(members)
        return robots

    def known(self, names: Iterable[str], robots: Sequence[str]) -> tuple[str, ...]:
        """Return those of `robots` that `names` mean; what is unknown is left out."""
        meant: dict[str, None] = {}
        for name in names:
            members = (self.get(name[len(MARK) :]) or ()) if name.startswith(MARK) else (name,)
            meant |= dict.fromkeys(members)
        present = set(robots)
        return tuple(robot for robot in meant if robot in present)

    def check(self, key: str, value: object) -> Stored:
        """Return a group fit to be stored under ``group/<name>``; None takes it away.

        Raises
        ------
        ConfigError
            The name or a robot's id cannot be one, or the value is no ``{"robots": [...]}``.
        """
        name = key.removeprefix(GROUP)
        if not ROBOT_ID.match(name):
            raise ConfigError(f"'{name}' cannot name a group", hint="letters, digits, '-' and '_', 64 at most")
        if value is None:
            return None
        robots = value.get("robots") if isinstance(value, dict) and set(value) == {"robots"} else None
        if not isinstance(robots, list) or len(robots) > MOST:
            raise ConfigError(f"{key}: {value!r:.80} is no group", hint='give {"robots": ["r1", "r2"]}')
        wrong = [each for each in robots if not isinstance(each, str) or not ROBOT_ID.match(each) or each == TRUTH]
        if wrong:
            raise ConfigError(f"{key}: {wrong[0]!r:.80} cannot name a robot", hint="letters, digits, '-' and '_'")
        return {"robots": list(dict.fromkeys(robots))}

    def _guess(self, name: str) -> str:
        groups = [MARK + entry.key.removeprefix(GROUP) for entry in self._store.list(GROUP)]
        if not groups:
            return 'there are no groups: `params set group/NAME \'{"robots": ["r1"]}\'` makes one'
        return did_you_mean(name, groups)
