"""Checks and test doubles for the tests of behaviours, drivers and nodes, here and in outside packages; without pytest.

``check_behaviour(module, parameters)`` and ``check_driver(make)`` return when all checks pass and otherwise raise
``AssertionError`` with a sentence that states the problem and the remedy. Given a :class:`Rig` in place of `make`,
the check of a driver also interrupts its link; its :class:`Report` lists what was checked and what was not.
``serial_wire`` and ``udp_wire`` are cables that can be interrupted. ``LoopbackBus``, ``FakeClock`` and
``simulated_runtime`` run one node on a simulated clock::

    bus = LoopbackBus()
    runtime = simulated_runtime(bus.mailbox)
    node = MyNode(bus, runtime)
    runtime.run(10.0)
    assert bus.sent(Summary)[-1].finished

Files:

``behaviour.py``  the check that every behaviour on board must pass: a pure function of each robot's own view
``driver.py``     the check that every driver must pass: its lifecycle, the claims of its description, its faults
``actuators.py``  the check of what a robot has beside wheels
``trial.py``      a driver under check: the rig that injects faults, the report, and the one place that waits
``faults.py``     interrupts the link and lets the clock jump
``process.py``    pauses and kills a driver's process while it drives
``drives_on.py``  the process that is paused and killed; run as ``python -m fullswarm.testing.drives_on``
``wire.py``       a cable that can be interrupted: a relay between a driver and its device
``node.py``       a bus and a clock for the test of one node
``pad.py``        a virtual gamepad
"""

from fullswarm.testing.behaviour import check_behaviour
from fullswarm.testing.driver import check_driver
from fullswarm.testing.node import FakeClock, LoopbackBus, simulated_runtime
from fullswarm.testing.trial import Report, Rig, emulated_rig, emulator_rig
from fullswarm.testing.wire import Wire, serial_wire, udp_wire

__all__ = [
    "FakeClock",
    "LoopbackBus",
    "Report",
    "Rig",
    "Wire",
    "check_behaviour",
    "check_driver",
    "emulated_rig",
    "emulator_rig",
    "serial_wire",
    "simulated_runtime",
    "udp_wire",
]
