"""The core's node: wires main controller, request handler, roster, database and heartbeat."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Protocol

from fullswarm import kept
from fullswarm.bus import Bus
from fullswarm.bus.report_query import ReportsOnQuery
from fullswarm.clock import wall_time_s
from fullswarm.config import SwarmConfig
from fullswarm.core.behaviours import PREFIX, Library
from fullswarm.core.charging import ChargingNode
from fullswarm.core.clock import ClockServer
from fullswarm.core.groups import Groups
from fullswarm.core.latches import Latches
from fullswarm.core.leases import Authority
from fullswarm.core.main_controller import MainController, adopted_order
from fullswarm.core.missions import Missions
from fullswarm.core.relay import StateRelay
from fullswarm.core.remap import Remapper
from fullswarm.core.request_handler import RequestHandler
from fullswarm.core.request_order import RequestOrder
from fullswarm.core.request_status import StatusBoard
from fullswarm.core.roster import Roster
from fullswarm.core.settings import GROUP, ParamServer, Settings
from fullswarm.keys import Keys
from fullswarm.messages import Heartbeat
from fullswarm.runtime import Scheduler
from fullswarm.store import Store

NODE = "core"
SAVE_S = 0.5
"""While the disk fails, what it has not taken is tried again this often."""


class Closing(Protocol):
    """Anything that runs beside the core and can be closed."""

    def close(self) -> None:
        """End it."""
        ...


class CoreNode:
    """The core layer on a bus.

    Parameters
    ----------
    store
        The local database; seeded here. Its opener closes it, after this node.
    process
        Name of this start, unique.
    extra
        Nodes that run beside it (summarizers, performance node), already built; closed with this one.
    wall_s
        Time of day, seconds since 1970: agents compare theirs with it.
    """

    def __init__(
        self,
        bus: Bus,
        scheduler: Scheduler,
        config: SwarmConfig,
        store: Store,
        process: str,
        extra: Iterable[Closing] = (),
        wall_s: Callable[[], float] = wall_time_s,
    ) -> None:
        self._bus, self._scheduler, self._keys, self._process = bus, scheduler, Keys(config.swarm), process
        keys, self._sequence = self._keys, 0
        self.settings = Settings(store, config)
        self.library = Library(store)
        self.roster = Roster(
            bus, keys, scheduler, config.robots, lambda: self.settings.presence_silence_s, process
        )  # fmt: skip
        self.remapper = Remapper(bus, keys, scheduler, store, process)
        latches = Latches(bus, keys, scheduler, store, self.roster, process)
        board, request_order = StatusBoard(bus, keys, scheduler), RequestOrder()
        self.handler = RequestHandler(
            bus,
            keys,
            scheduler,
            store,
            self.roster,
            board,
            process,
            interval_s=lambda: self.settings.schedule_interval_s,
            command_ttl_s=config.agent.command_ttl_s,
            adopted=lambda request_id, behaviour: adopted_order(self.library, self.remapper, request_id, behaviour),
            request_order=request_order,
        )
        self.remapper.restore(self.handler.holders)
        groups, roster = Groups(store), self.roster
        authority = Authority(bus, keys, scheduler, process, lambda names: groups.known(names, roster.known()))
        self.controller = controller = MainController(
            bus, keys, self.library, roster, board, self.handler, self.remapper, groups, authority, request_order,
            scheduler,
        )  # fmt: skip
        self.missions = Missions(
            bus, keys, scheduler, store, controller, self.handler, board, roster, authority, request_order, process
        )
        self.charging = ChargingNode(bus, keys, scheduler, config, store, roster, self.handler.halts_of, process)
        self.extra = tuple(extra)
        checks = {**self.settings.checks(), f"{PREFIX}*": self.library.check, f"{GROUP}*": groups.check}
        checks |= {f"{prefix}*": check for prefix, check in kept.CHECKS.items()}
        params = ParamServer(bus, keys, NODE, store, checks, self.library.expand, now_s=scheduler.now_s)
        self.relay = StateRelay(bus, keys, scheduler, config.agent.sensing_radius_m, config.state_cell_m)
        queries = ReportsOnQuery(bus, keys, scheduler, self._beat)
        self._parts: tuple[Closing, ...] = (
            self.charging, self.missions, controller, authority, self.handler, board, self.remapper, latches,
            self.relay, roster, params, queries, ClockServer(bus, keys, scheduler, process, wall_s),
            *reversed(self.extra),
        )  # fmt: skip
        self._timers = [
            scheduler.every(1.0 / config.core.heartbeat_hz, self._beat, first_s=0.0),
            scheduler.every(SAVE_S, lambda: store.save(wait=False)),
        ]

    def _beat(self) -> None:
        self._sequence += 1
        heartbeat = Heartbeat(
            node=NODE,
            process=self._process,
            sequence=self._sequence,
            active=self.handler.requests(),
            stamp_s=self._scheduler.now_s(),
        )
        self._bus.publish(self._keys.heartbeat(NODE), heartbeat)

    def close(self) -> None:
        """Close all parts; the robots stop by themselves when the heartbeat is silent."""
        for timer in self._timers:
            timer.cancel()
        for part in self._parts:
            part.close()
