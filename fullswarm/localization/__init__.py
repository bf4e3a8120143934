"""Publishes external pose measurements, such as motion capture, as pose fixes on the bus.

``mocap.py``  the datagrams of motion capture, parsed; no I/O
``fixes.py``  `fullswarm fixes`: receives them on a UDP port and publishes the fixes
"""
