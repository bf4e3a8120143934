"""Keeps the requests that the node of the centralised behaviours computes equal to those that the core has active.

The node's heartbeat names the requests that it computes. The core sends a missing one again and ends a superfluous one,
so that messages may be lost and either side may be restarted.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import msgspec

from fullswarm.bus import Bus
from fullswarm.keys import Keys
from fullswarm.messages import CentralisedRequest, Heartbeat
from fullswarm.recent import Recent
from fullswarm.runtime import Scheduler
from fullswarm.store import Store

NODE = "centralised"
REFRESH_S = 1.0
GRACE_S = 2.0
"""A new core leaves unknown requests running this long: their robots may still report them."""

MEMORY = 1024
KEPT = "centralised/"


class Remapper:
    """Sends each active centralised request to its node until the node has it.

    Parameters
    ----------
    store
        The local database: the robots carry no parameters of what is computed here, so a restart needs them from it.
    process
        Name of this start of the core.
    """

    def __init__(self, bus: Bus, keys: Keys, scheduler: Scheduler, store: Store, process: str) -> None:
        self._bus, self._keys, self._scheduler, self._process = bus, keys, scheduler, process
        self._store = store
        self._active: dict[str, CentralisedRequest] = {}
        self._kept: set[str] = set()  # requests with an entry in the database
        self._ended: Recent[str, str] = Recent(MEMORY)  # request id → behaviour
        self._held_elsewhere: Recent[str, None] = Recent(MEMORY)
        self._counter = itertools.count(1)
        self._started_s = scheduler.now_s()
        self._subscription = bus.subscribe(keys.heartbeat(NODE), Heartbeat, self._on_heartbeat)
        self._timer = scheduler.every(REFRESH_S, self._refresh)

    def start(self, request: CentralisedRequest, *, lasting: bool) -> None:
        """Have the node compute `request` from now on; if `lasting`, also after a restart of the core."""
        self._active[request.request_id] = msgspec.structs.replace(request, enable=True, core=self._process)
        if lasting:
            self._kept.add(request.request_id)
            self._keep(request.request_id)
        self._send(request.request_id)

    def restore(self, holders: Callable[[str], tuple[str, ...]]) -> None:
        """Continue the stored requests, for those of their robots that still hold them."""
        for entry in self._store.list(KEPT):
            request_id = entry.key.removeprefix(KEPT)
            self._kept.add(request_id)
            try:
                request = msgspec.convert(entry.value, CentralisedRequest)
            except msgspec.ValidationError:  # another version wrote it
                continue
            robots = holders(request_id)
            if robots:
                left = tuple(robot for robot in request.robots if robot in robots)
                self._active[request_id] = msgspec.structs.replace(request, robots=left, core=self._process)
                self._send(request_id)
            else:
                self._end(request_id, request.behaviour)

    def requests(self) -> tuple[str, ...]:
        """Return the ids of the requests that the node shall compute."""
        return tuple(self._active)

    def narrow(self, request_id: str, robots: tuple[str, ...]) -> None:
        """Leave only `robots` in a request; without robots it ends."""
        request = self._active.get(request_id)
        if request is None and not robots:
            self._held_elsewhere.pop(request_id, None)  # its node gets the end when it next names the request
        if request is None or request.robots == robots:
            return
        if robots:
            self._active[request_id] = msgspec.structs.replace(request, robots=robots)
            self._keep(request_id)
            self._send(request_id)
        else:
            del self._active[request_id]
            self._end(request_id, request.behaviour)

    def spare(self, request_id: str) -> None:
        """Leave a request running whose parameters this core lacks: robots found running it were adopted."""
        self._held_elsewhere[request_id] = None

    def close(self) -> None:
        """Stop keeping the node in step."""
        self._subscription.close()
        self._timer.cancel()

    def _send(self, request_id: str) -> None:
        request = msgspec.structs.replace(self._active[request_id], sequence=next(self._counter))
        self._bus.publish(self._keys.centralised_request(request.behaviour), request)

    def _keep(self, request_id: str) -> None:
        if request_id not in self._kept:
            return
        request = self._active.get(request_id)
        kept = None if request is None else msgspec.to_builtins(request)
        if kept is None:
            self._kept.discard(request_id)
        self._store.keep({KEPT + request_id: kept}, f"core {self._process}")

    def _end(self, request_id: str, behaviour: str) -> None:
        self._keep(request_id)
        self._ended[request_id] = behaviour
        request = CentralisedRequest(
            request_id=request_id,
            behaviour=behaviour,
            law="",
            enable=False,
            core=self._process,
            sequence=next(self._counter),
        )
        self._bus.publish(self._keys.centralised_request(behaviour), request)

    def _on_heartbeat(self, heartbeat: Heartbeat) -> None:
        for request_id in self._active:
            if request_id not in heartbeat.active:
                self._send(request_id)
        grace = self._scheduler.now_s() - self._started_s < GRACE_S
        for request_id in heartbeat.active:
            if request_id in self._active or request_id in self._held_elsewhere:
                continue
            if request_id in self._ended or not grace:
                # The node uses the id only; a behaviour that only an earlier core knew is "stop" here.
                self._end(request_id, self._ended.get(request_id, "stop"))

    def _refresh(self) -> None:
        """Repeat all requests: the heartbeat does not show whether a narrowed request arrived."""
        for request_id in self._active:
            self._send(request_id)
