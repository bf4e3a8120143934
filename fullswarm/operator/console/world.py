"""Mirrors the core's database: arena, boxes, behaviours, groups, and what each robot shall run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from fullswarm.bus.base import Bus
from fullswarm.errors import ConfigError
from fullswarm.kept import CHECKS, MOST_KEPT, PLACE, SAVED
from fullswarm.keys import Keys
from fullswarm.messages import Heartbeat, ParamEntry, ParamReply
from fullswarm.operator.params import ParamClient, Stored
from fullswarm.runtime import Scheduler
from fullswarm.store import SEED

EVERYTHING = "*"
BEHAVIOUR, GROUP, ORDER = "behaviour/", "group/", "wanted/"
BOUNDS, BOXES, SENSING, ORIGIN = "world/bounds", "world/boxes", "agent/sensing_radius_m", "world/origin"
MOST = 20_000
"""Entries that are kept."""
LONGEST_GAP_S, CALM_S = 8.0, 10.0
"""Between two questions for all entries; twice as long each time, until none was asked for a while."""
SETTLE_S = 0.2
"""Records that change together are read in one answer."""

_SHOWN = (BEHAVIOUR, GROUP, PLACE, SAVED, "world/", "agent/")
FILTERED = "_bc"
"""Ends the name of a behaviour that is another one behind the safety filter."""
MOST_OWN_GROUPS = 64
"""Groups that consoles have made."""


def title_of(name: str, record: Mapping[str, Any], *, plain: bool) -> str:
    """Return the title of a behaviour: of its record, else made of its name; the `plain` one of two says that it is."""
    if title := record.get("title"):
        return str(title)
    words = name.removesuffix(FILTERED).replace("_", " ").strip() or name
    return f"{words[:1].upper()}{words[1:]}{', unfiltered' if plain else ''}"


class World:
    """A copy of the core's database, read again when the core was restarted.

    Parameters
    ----------
    on_world
        Called when what the page shows of it has changed.
    on_orders
        Called with the robots whose orders have changed.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        scheduler: Scheduler,
        author: str,
        *,
        on_world: Callable[[], None],
        on_orders: Callable[[Iterable[str]], None],
    ) -> None:
        self._scheduler, self._on_world, self._on_orders = scheduler, on_world, on_orders
        self._params = ParamClient(bus, keys, scheduler, author)
        self._values: dict[str, Stored] = {}
        self._authors: dict[str, str] = {}  # of groups
        self._core = ""
        self._asking = self._again = self._waits = self._closed = False
        self._asked_s, self._gap_s = -math.inf, SETTLE_S
        self.known = False
        """Whether the core has answered yet."""
        self._subscriptions = [
            self._params.watch(EVERYTHING, self._changed),
            bus.subscribe(keys.heartbeat("core"), Heartbeat, self._beat, latest=True),
        ]
        self._ask()

    def close(self) -> None:
        """Unsubscribe."""
        self._closed = True
        for subscription in self._subscriptions:
            subscription.close()

    # ---------------------------------------------------------------- reading
    def shown(self) -> dict[str, Any]:
        """Return what the page shows of it; what is unknown is None or empty."""
        return {
            "arena": self._arena(),
            "boxes": self._boxes(),
            "origin": self._origin(),
            "sensing_radius_m": self._values.get(SENSING),
            "behaviours": {name: self.record(name) for name in self._names(BEHAVIOUR)},
            "groups": {name: list(self.group(name) or ()) for name in self._names(GROUP)},
            "own_groups": self.own_groups(),
            "places": self._tables(PLACE),
            "saved": self._tables(SAVED),
        }

    def record(self, name: str) -> dict[str, Any] | None:
        """Return a behaviour's record, defaults from the database filled in; None: no such behaviour."""
        raw = self._values.get(BEHAVIOUR + name)
        if not isinstance(raw, dict):
            return None
        parameters = raw.get("parameters")
        filled = {
            each: self._with_default(spec)
            for each, spec in (parameters.items() if isinstance(parameters, dict) else ())
            if isinstance(spec, dict)
        }
        return {**raw, "title": self.title(name), "parameters": filled}

    def title(self, name: str) -> str:
        """Return the title of a behaviour for people; its name if there is no such behaviour."""
        raw = self._values.get(BEHAVIOUR + name)
        if not isinstance(raw, dict):
            return name
        return title_of(name, raw, plain=not raw.get("filtered") and f"{BEHAVIOUR}{name}{FILTERED}" in self._values)

    def expires(self, behaviour: str) -> bool:
        """Return whether a behaviour is an intent, which ends unless it is repeated."""
        record = self._values.get(BEHAVIOUR + behaviour)
        expires_s = record.get("expires_s") if isinstance(record, dict) else None
        return isinstance(expires_s, int | float) and expires_s > 0.0

    def group(self, name: str) -> tuple[str, ...] | None:
        """Return a group's robots; None: no such group."""
        value = self._values.get(GROUP + name)
        robots = value.get("robots") if isinstance(value, dict) else None
        return tuple(map(str, robots)) if isinstance(robots, list | tuple) else None

    def own_groups(self) -> list[str]:
        """Return the groups that operators have made, and not the fleet file."""
        return [name for name in self._names(GROUP) if self._authors.get(GROUP + name, SEED) != SEED]

    def set_group(
        self, name: str, robots: tuple[str, ...] | None, author: str, on_reply: Callable[[ParamReply], None]
    ) -> str:
        """Have the core keep a group, or take it away (None); return why that is not asked for, empty: it is."""
        own, there = self.own_groups(), GROUP + name in self._values
        if not self.known:
            return "the core has not reported its groups yet"
        if robots is None and name not in own:
            return f"the group {name} is in the fleet file: it can be changed there" if there else f"no group {name}"
        if robots is not None and there and name not in own:
            return f"the group {name} is in the fleet file: choose another name"
        if robots is not None and not there and len(own) >= MOST_OWN_GROUPS:
            return f"there are {MOST_OWN_GROUPS} groups already: delete one first"
        value: Stored = None if robots is None else {"robots": list(robots)}
        self._params.ask("set", GROUP + name, on_reply, value, author=author)
        return ""

    def keep(self, key: str, value: dict[str, Any] | None, author: str, on_reply: Callable[[ParamReply], None]) -> str:
        """Have the core keep a place or a request, or take it away (None); return why that is not asked for."""
        prefix = PLACE if key.startswith(PLACE) else SAVED
        if not self.known:
            return "the core has not answered yet"
        if value is None and key not in self._values:
            return f"there is no {key.removeprefix(prefix)}"
        if value is not None and key not in self._values and len(self._names(prefix)) >= MOST_KEPT:
            return f"there are {MOST_KEPT} already: delete one first"
        try:
            stored: Stored = CHECKS[prefix](key, value)
        except ConfigError as error:
            return str(error)
        self._params.ask("set", key, on_reply, stored, author=author)
        return ""

    def orders(self) -> dict[str, dict[str, Any]]:
        """Return robot → its order of the core: `request_id`, `behaviour`, `parameters` and more."""
        return {
            key.removeprefix(ORDER): value
            for key, value in self._values.items()
            if key.startswith(ORDER) and isinstance(value, dict)
        }

    def entries(self, pattern: str) -> dict[str, Stored]:
        """Return the entries under a key, or under all that begin with it up to its ``*``, by key."""
        if not pattern.endswith("*"):
            return {key: value for key, value in self._values.items() if key == pattern}
        return {key: value for key, value in sorted(self._values.items()) if key.startswith(pattern[:-1])}

    def _names(self, prefix: str) -> list[str]:
        return sorted(key.removeprefix(prefix) for key in self._values if key.startswith(prefix))

    def _tables(self, prefix: str) -> dict[str, dict[str, Any]]:
        found = ((name, self._values[prefix + name]) for name in self._names(prefix))
        return {name: value for name, value in found if isinstance(value, dict)}

    def _with_default(self, spec: dict[str, Any]) -> dict[str, Any]:
        stored = self._values.get(str(spec.get("default_from", "")))
        return spec if stored is None else {**spec, "default": stored}

    def _arena(self) -> list[float] | None:
        bounds: Any = self._values.get(BOUNDS)
        try:
            return [float(value) for corner in bounds for value in corner]
        except (TypeError, ValueError):
            return None

    def _boxes(self) -> list[Any]:
        boxes = self._values.get(BOXES)
        found = boxes.get("boxes") if isinstance(boxes, dict) else None
        return list(found) if isinstance(found, list | tuple) else []

    def _origin(self) -> list[float] | None:
        """Return latitude and longitude (degrees) of the swarm's (0, 0)."""
        origin = self._values.get(ORIGIN)
        found = [origin.get(each) for each in ("latitude_deg", "longitude_deg")] if isinstance(origin, dict) else []
        return [float(each) for each in found if isinstance(each, int | float)] if len(found) == 2 else None

    # ---------------------------------------------------------------- staying up to date
    def _ask_soon(self, delay_s: float) -> None:
        """Ask for all entries after `delay_s`, or later if that was needed often: cores that alternate, many changes.

        One question at a time, and one that waits.
        """
        now_s = self._scheduler.now_s()
        if self._waits or self._closed:
            return
        if now_s - self._asked_s > CALM_S:
            self._gap_s = SETTLE_S
        wait_s = max(delay_s, self._asked_s + self._gap_s - now_s)
        self._waits = True
        if wait_s <= 0.0:
            self._ask()
        else:
            self._scheduler.after(wait_s, self._ask)

    def _ask(self) -> None:
        """Ask for all entries; a further question waits for the answer."""
        if self._closed:
            return
        self._again, self._waits = self._asking, False
        if not self._asking:
            self._asking, self._asked_s = True, self._scheduler.now_s()
            self._gap_s = min(2.0 * self._gap_s, LONGEST_GAP_S)
            self._params.ask("get", EVERYTHING, self._answered)

    def _answered(self, reply: ParamReply) -> None:
        self._asking = False
        if self._closed:
            return
        if reply.ok:
            self._values = {entry.key: entry.value for entry in reply.entries if entry.value is not None}
            self._authors = {entry.key: entry.author for entry in reply.entries if entry.key.startswith(GROUP)}
            self.known = True
            self._on_world()
            self._on_orders(self.orders())
        if self._again:
            self._ask_soon(0.0)

    def _beat(self, beat: Heartbeat) -> None:
        if self._core and beat.process != self._core:
            self._ask_soon(0.0)
        self._core = beat.process

    def _changed(self, entry: ParamEntry) -> None:
        key = entry.key
        if key.startswith(BEHAVIOUR):
            # Others may inherit from this one: only the core can resolve them.
            self._ask_soon(SETTLE_S)
            return
        if key not in self._values and len(self._values) >= MOST:
            return
        if entry.value is None:
            self._values.pop(key, None)
            self._authors.pop(key, None)
        else:
            self._values[key] = entry.value
            if key.startswith(GROUP):
                self._authors[key] = entry.author
        if key.startswith(ORDER):
            self._on_orders((key.removeprefix(ORDER),))
        elif key.startswith(_SHOWN):
            self._on_world()
