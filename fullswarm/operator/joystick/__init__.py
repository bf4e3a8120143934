"""Driving with a gamepad: pads (SDL) → pilot (what it means) → requests, stops and e-stops.

In: what is pressed, read each 5 ms. Out: BehaviourRequest, StopRequest, EStop, LeaseRequest. Read ``state`` (what a pad
says), ``bindings`` (what that asks for), ``pilot`` (when it may). Only ``pads`` knows SDL; the rest runs on any clock.
"""
