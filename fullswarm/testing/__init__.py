"""Checks and stand-ins for the tests of laws, drivers and nodes, here and in outside packages. Needs no pytest.

``check_behaviour(module, parameters)`` and ``check_driver(make)`` return when all is well and otherwise raise
``AssertionError`` with a sentence that says what is wrong and how to mend it. ``LoopbackBus``, ``FakeClock`` and
``simulated_runtime`` run a node by itself, in no time::

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

__all__ = ["FakeClock", "LoopbackBus", "check_behaviour", "check_driver", "simulated_runtime"]
