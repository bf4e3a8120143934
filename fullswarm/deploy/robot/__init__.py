"""The files that are on a robot outside every release: the installer, ``fullswarm-robot``, units, udev rules.

``support_package.py``        packs them for one robot, with its fleet file, and signs it
``install.sh``                installs a robot support package; may be run again
``fullswarm-robot``           receives releases, switches between them, rolls back by itself (POSIX sh)
``robot-shipping.sh``         its `want` and `receive`: receives a signed release, completely or not at all
``robot-trust.sh``            its `trust` and `install`: the keys that the robot trusts, and what they have signed
``robot-facts.sh``            its `facts` and `health`, which the base queries
``fullswarm-agent.service``   runs the agent of the release that `current` names
``fullswarm-boot.service``    before it: reverts a switch that a power cut left unconfirmed
``60-fullswarm-ports.rules``  stable names for serial adapters, for the group dialout
``60-fullswarm-journal.conf`` a cap on the journal
``60-fullswarm-sshd.conf``    sshd closes sessions of a base station that no longer responds

A support package is called `kit` in the names of files and fields on robots, for compatibility with older versions.

In: a robot support package and releases, over SSH or from a card. Out: JSON facts and an agent that runs.
"""
