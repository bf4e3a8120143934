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

Further files:

``behaviour.py``  What every law must hold: a pure function of each robot's own view, finite whatever the neighbours
                  do
``claims.py``     What a description claims, held against what the robot does
``clock.py``      Time that passes when the test says so
``contract.py``   What every driver must hold while nothing is broken: lifecycle, limits, signs, silence, promptness
``drives_on.py``  Drives a robot straight on until it is killed: ``python -m fullswarm.testing.drives_on module:Class
                  URL SPEED``
``faults.py``     What a driver does when its link breaks: it says so, in time, and moves again only when told anew
``jumps.py``      Time that jumps: a machine that was suspended, and a wall clock that is set
``pad.py``        A virtual gamepad for tests: SDL's own, without hardware or display
``process.py``    A driver in a process of its own that is paused and killed while it drives: what its device does
                  then
``rig.py``        What a check may do to a robot, and what came of it
``sight.py``      A look at one reading or one answer of a driver: returns what is wrong with it, empty when nothing
                  is
``trial.py``      A driver under check: the one place that waits, and a look at each reading and each answer on the
                  way
``wire.py``       A cable to break: a relay between a driver and its device that is pulled, muted, talked into, cut in
                  mid-frame
``bus.py``        A bus for the test of one node: what is said goes through the wire format, and is kept to be looked
                  at
``driver.py``     The check that every driver must pass, built-in or from outside: as it lives, as it breaks, as it
                  says of itself
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
