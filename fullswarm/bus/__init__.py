"""Publish and subscribe. In: messages of a node. Out: the same messages, in the mailbox of every subscriber.

Two implementations pass one test suite: :class:`~fullswarm.bus.local.LocalBus` (one process, deterministic
order, for lockstep) and :class:`~fullswarm.bus.zenoh_bus.ZenohBus` (live, through a
:class:`~fullswarm.bus.hub.Hub`). Both carry the name of the publishing process beside each message. Import the live
ones from their modules: this package does not load zenoh.
"""

from fullswarm.bus.base import Bus, Subscription
from fullswarm.bus.endpoint import DEFAULT_HUB, check_endpoint
from fullswarm.bus.local import LocalBus

__all__ = ["DEFAULT_HUB", "Bus", "LocalBus", "Subscription", "check_endpoint"]
