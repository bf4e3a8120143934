"""What stands on a robot outside every release: the installer, ``fullswarm-robot``, units, udev rules.

``kit.py``                    packs it for one robot, with its fleet file and the keys that it trusts
``install.sh``                spreads a kit; safe to run again
``fullswarm-robot``           takes releases in, switches between them, goes back by itself (POSIX sh)
``robot-shipping.sh``         its `want` and `receive`: a signed release comes in, whole or not at all
``robot-facts.sh``            its `facts` and `health`: what the base asks for
``fullswarm-agent.service``   runs the agent of the release that `current` names
``fullswarm-boot.service``    before it: undoes a switch that a power cut left without a verdict
``60-fullswarm-ports.rules``  stable names for serial adapters, for the group dialout
``60-fullswarm-journal.conf`` a cap on the journal
``60-fullswarm-sshd.conf``    sshd notices that a base went away

In flow a kit and releases over SSH or from a card; out flow JSON facts and an agent that runs.
"""

from fullswarm.deploy.robot.kit import check_hub, kit, kit_id

__all__ = ["check_hub", "kit", "kit_id"]
