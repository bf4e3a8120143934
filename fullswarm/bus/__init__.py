"""Publish and subscribe. In: messages of a node. Out: the same messages, in the mailbox of every subscriber.

Two implementations pass one test suite: :class:`~fullswarm.bus.local.LocalBus` (one process, deterministic
order, for lockstep) and :class:`~fullswarm.bus.zenoh_bus.ZenohBus` (live, through a
:class:`~fullswarm.bus.hub.Hub`). Both carry the name of the publishing process beside each message. Import the live
ones from their modules: this package does not load zenoh.

Files:

``arrivals.py``        when messages arrived that are looked at later
``base.py``            the interface of a bus, wrappers that name the sender or count, matching of key expressions
``certificates.py``    renews certificates: processes ask, that of the authority answers
``codec.py``           messages as bytes: MessagePack, with errors that name what does not match
``endpoint.py``        where the hub listens: default address, syntax, which computers reach it, whether secured
``hub.py``             the hub: a zenoh router in a process of its own; agents, core and operators are its clients
``lanes.py``           which messages are delivered first, and how many of one sender are taken in
``local.py``           the bus within one process: every message is delivered once, in the order of publishing
``network_faults.py``  injected faults of the network: their text, and a bus that loses, delays, doubles, reorders and
                       partitions
``refusals.py``        logs what a secured hub refuses, by certificate
``report_query.py``    has a node publish on request what it otherwise publishes seldom
``renewal.py``         starts the renewal of certificates in a process
``tls.py``             settings of a secured link, and why a client and a secured hub do not connect
``versions.py``        finds processes of another release, whose messages this one cannot read
``zenoh_bus.py``       the live bus: a client's session with the hub, its settings and subscriptions
"""

from fullswarm.bus.base import Bus, Subscription
from fullswarm.bus.endpoint import DEFAULT_HUB, check_endpoint
from fullswarm.bus.local import LocalBus

__all__ = ["DEFAULT_HUB", "Bus", "LocalBus", "Subscription", "check_endpoint"]
