"""What became of each request: published at every change, kept to answer a repeated request."""

from __future__ import annotations

from collections import OrderedDict

import msgspec

from fullswarm.bus import Bus
from fullswarm.keys import Keys
from fullswarm.messages import RequestStatus
from fullswarm.runtime import Scheduler

AGAIN_S, FRESH_S, MANY = 0.5, 3.0, 8
"""A status is said again at this interval while it is so young, for the newest few: the first word may be lost."""


class StatusBoard:
    """The newest status of the last `remember` requests.

    Remembering is what makes a request happen once although it is sent until it is answered.
    """

    def __init__(self, bus: Bus, keys: Keys, scheduler: Scheduler, remember: int = 8192) -> None:
        self._bus, self._keys, self._scheduler, self._remember = bus, keys, scheduler, remember
        self._newest: OrderedDict[str, RequestStatus] = OrderedDict()
        self._said: OrderedDict[str, None] = OrderedDict()  # lately, not only remembered
        self._timer = scheduler.every(AGAIN_S, self._again)

    def close(self) -> None:
        """Say nothing more."""
        self._timer.cancel()

    def _again(self) -> None:
        since_s = self._scheduler.now_s() - FRESH_S
        for request_id in tuple(self._said):
            status = self._newest.get(request_id)
            if status is not None and status.stamp_s >= since_s:
                self._bus.publish(self._keys.behaviour_status, status)

    def get(self, request_id: str) -> RequestStatus | None:
        """Return the newest status of a request; None when it is unknown or forgotten."""
        return self._newest.get(request_id)

    def publish(self, status: RequestStatus) -> None:
        """Send `status` with the present time, unless it says what the last one said."""
        old = self._newest.get(status.request_id)
        if old is not None and msgspec.structs.replace(status, stamp_s=old.stamp_s) == old:
            return
        self._said[status.request_id] = None
        self._said.move_to_end(status.request_id)
        while len(self._said) > MANY:
            self._said.popitem(last=False)
        self._bus.publish(self._keys.behaviour_status, self.remember(status))

    def remember(self, status: RequestStatus) -> RequestStatus:
        """Keep `status` without sending it; return it with the present time."""
        stamped = msgspec.structs.replace(status, stamp_s=self._scheduler.now_s())
        self._newest[status.request_id] = stamped
        self._newest.move_to_end(status.request_id)
        while len(self._newest) > self._remember:
            self._newest.popitem(last=False)
        return stamped

    def repeat(self, request_id: str) -> bool:
        """Send the newest status of a request again; False when there is none."""
        status = self._newest.get(request_id)
        if status is not None:
            self._bus.publish(self._keys.behaviour_status, status)
        return status is not None
