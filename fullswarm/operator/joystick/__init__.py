"""Driving with a gamepad: pads (SDL) → pilot (what it means) → requests, stops and e-stops.

In: what is pressed, read each 5 ms. Out: BehaviourRequest, StopRequest, EStop, LeaseRequest. Read ``state`` (what a pad
says), ``bindings`` (what that asks for), ``pilot`` (when it may). Only ``pads`` knows SDL; the rest runs on any clock.

Further files:

``command.py``    What `fullswarm joystick` and its verbs do
``devices.py``    What the system says about gamepads that SDL cannot open: SDL itself is silent about permissions
``mapping.py``    SDL's text form of a pad's mapping: ``guid,name,a:b0,leftx:a0,…,platform:Linux,`` and files of such
                  lines
``reins.py``      The robots in hand: their leases, the stream of intents, and the zeros at its end
``selection.py``  What is driven: one robot, a group, a make, or the whole swarm; chosen by stepping through them
``show.py``       How pads and pilots look in a terminal
``wizard.py``     Teaches SDL an unknown pad: asks for each control in turn and notes which axis, button or hat
                  answers
"""
