"""Driving with a gamepad: pads (SDL) → pilot → requests, stops and e-stops.

In: the pads' state, sampled each 5 ms. Out: BehaviourRequest, StopRequest, EStop, LeaseRequest. Only ``pads`` uses SDL;
the rest runs on any clock.

``state.py``           the state of a gamepad, and the protocol of its source
``bindings.py``        reads which control requests what (``bindings.toml``, or the user's file);
                       a new binding is a line there, a new function of a button a field of ``Buttons`` and its rule in
                       ``pilot.py``. A gamepad in the browser has its own, ``BUTTON`` in ``console/page/drive.js``
``pilot.py``           converts the inputs of pads to requests, stops and e-stops: the rules of driving; read this first
``teleop_session.py``  drives the selected robots: leases, stream, zeros
``selection.py``       selects a robot, a group, a make or the whole swarm
``pads.py``            reads pads through SDL
``mapping.py``         maps pads that SDL does not know: the wizard, and SDL's lines
``devices.py``         finds pads that this user may not read
``show.py``            shows pads and the pilot's status in a terminal
"""
