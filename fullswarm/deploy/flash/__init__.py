"""Writes cards: an image, a first boot that needs nothing from outside, and a card that says why when it fails.

``partitions.py`` ``fat.py`` ``image.py``   what is inside an image: pure reading, nothing trusted
``mtools.py``                                editing a FAT with mtools, judged by fsck.vfat
``card.py`` ``order.py``                     which devices may be written, what was asked for, and the confirmation
``wifi.py`` ``seed.py`` ``firstrun.py``      what a robot is told: cloud-init, or Raspberry Pi's firstrun.sh
``payload.py``                               all files that go onto the boot partition of one robot
``write.py``                                 one decompression, many cards, read back and compared
``wait.py`` ``report.py``                    the robot's hello, or the report that its card carries
``first_boot.sh`` ``firstrun.sh``            what runs on the robot, once

The boot partition is edited in a copy and checked before the first byte of a card is overwritten; the card is then
written in one pass, edits included, so that what is read back is all that the robot will see.

Further files:

``pins.py``        The host keys that flashed robots will show: pinned in place of what was known at their addresses
                   before
``plan.py``        Everything that is decided and checked before a byte is written: image, release, seeds, cards
``run.py``         `fullswarm flash`: decide and check everything, ask, write, read back, remember, wait
``seed_only.py``   `fullswarm flash --seed-only`: a card, an image or a mounted boot partition is told anew what robot
                   it is
``seed_rules.py``  The rules that a seed must keep, each learnt from a robot that never came up
"""
