"""Takes a robot from a blank card to a running agent: releases, cards, first installs, updates that roll back.

``release/``      one signed, reproducible directory per target: what a robot runs, complete without a network
``robot/``        what is on a robot outside every release: the installer, ``fullswarm-robot``, units, udev rules
``flash/``        writes a card for an unattended first boot in the lab's network
``fleet/``        the same over SSH, many robots at a time: deploy, update in waves, roll back, show

In: a fleet file and wheels. Out: releases, cards and robots that run an agent. Nothing here runs on board but the shell
scripts in ``robot/``: whether a release is good is reported by the agent (``agent/telemetry/health_file.py``), and a
robot whose release is not committed in time rolls back by itself.
"""
