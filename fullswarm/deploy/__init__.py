"""From a blank card to a robot that moves: releases, cards, first installs, updates that roll themselves back.

``release/``      one signed, reproducible directory per target: what a robot runs, and nothing it must fetch
``robot/``        what stands on a robot outside every release: the installer, ``fullswarm-robot``, units, udev rules
``flash/``        writes a card whose first boot needs no network but the lab's
``fleet/``        the same over SSH, many robots at a time: deploy, update in waves, roll back, look

Turns a fleet file and wheels into releases, cards and robots that run an agent. Nothing here
runs on board but the shell scripts in ``robot/``: whether a release is good is the agent's own word
(``agent/telemetry/health_file.py``), and a robot that hears no verdict goes back by itself.
"""
