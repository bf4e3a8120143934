"""Publish and subscribe. In: messages of a node. Out: the same messages, in the mailbox of every subscriber.

Two implementations pass one test suite: :class:`~fullswarm.bus.local.LocalBus` (one process, deterministic
order, for lockstep) and :class:`~fullswarm.bus.zenoh_bus.ZenohBus` (live, through a
:class:`~fullswarm.bus.hub.Hub`). Both carry the name of the publishing process beside each message. Import the live
ones from their modules: this package does not load zenoh.

Files:

``base.py``       What a node may ask of a bus, and how key expressions match
``codec.py``      Messages as bytes: MessagePack, with errors that say what does not fit
``counting.py``   A bus that counts what goes through it: one per process, around the real one
``endpoint.py``   Where the hub listens: the default address, its syntax, and which computers reach it
``faulty.py``     A bus on a bad network: loses, delays, doubles and reorders what comes in, and cuts processes off
                  from each other
``hub.py``        The hub: a zenoh router in a process of its own; every agent, the core and the operators are its
                  clients
``inbox.py``      A subscription of the live bus: from zenoh's threads into the node's mailbox
``local.py``      The bus within one process: every message is delivered once, in the order of publishing
``network.py``    What a bad network does, as people write it: ``loss=20%,delay=100ms±50,partition=r1+r2|*@5s-10s``
``session.py``    Zenoh's settings, one place for hub and clients, and the thread that keeps a client's session
``zenoh_bus.py``  The live bus: a zenoh client of the hub behind the interface that every node knows
"""

from fullswarm.bus.base import Bus, Subscription
from fullswarm.bus.endpoint import DEFAULT_HUB, check_endpoint
from fullswarm.bus.local import LocalBus

__all__ = ["DEFAULT_HUB", "Bus", "LocalBus", "Subscription", "check_endpoint"]
