"""Checks and stand-ins for the tests of laws, drivers and nodes, here and in outside packages. Needs no pytest.

``check_behaviour(module, parameters)`` and ``check_driver(make)`` return when all is well and otherwise raise
``AssertionError`` with a sentence that says what is wrong and how to mend it. Given a :class:`Rig` in place of `make`,
the check of a driver also breaks its link; its :class:`Report` says what was checked and what was not.
``serial_wire`` and ``udp_wire`` are cables to break. ``LoopbackBus``, ``FakeClock`` and ``simulated_runtime`` run a
node by itself, in no time::

    bus = LoopbackBus()
    runtime = simulated_runtime(bus.mailbox)
    node = MyNode(bus, runtime)
    runtime.run(10.0)
    assert bus.sent(Summary)[-1].finished
"""

from fullswarm.testing.behaviour import check_behaviour
from fullswarm.testing.bus import LoopbackBus
from fullswarm.testing.clock import FakeClock, simulated_runtime
from fullswarm.testing.driver import check_driver
from fullswarm.testing.rig import Report, Rig
from fullswarm.testing.wire import Wire, serial_wire, udp_wire

__all__ = [
    "FakeClock",
    "LoopbackBus",
    "Report",
    "Rig",
    "Wire",
    "check_behaviour",
    "check_driver",
    "serial_wire",
    "simulated_runtime",
    "udp_wire",
]
