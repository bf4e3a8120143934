"""A fleet of 16 robots on one machine: real systemd, real sshd, a real network, emulated Creates.

``tools.py``       running programs, waiting, what is missing on this machine
``rootfs.py``      what is on a robot's card before fullswarm comes, built once
``network.py``     a bridge with a cable to each robot: cut it, lose frames
``containers.py``  one robot's computer: boot it, pull its power, fill its disk, turn its clock back
``creates.py``     the emulated Creates, outside the computers as real ones are
``lab.py``         all of it, with a base that runs ``fullswarm``

Needs root, and Debian's systemd-container, mmdebstrap, nftables, iproute2; without them the tests say so and skip.
"""
