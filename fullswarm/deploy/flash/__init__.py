"""Writes cards: an image, a first boot that needs nothing from outside, and a card that says why when it fails.

``partitions.py`` ``fat.py`` ``image.py``   what is inside an image: pure reading, nothing trusted
``mtools.py``                                editing a FAT with mtools, judged by fsck.vfat
``card.py`` ``order.py``                     which devices may be written, what was asked for, and who has agreed to it
``wifi.py`` ``seed.py`` ``firstrun.py``      what a robot is told: cloud-init, or Raspberry Pi's firstrun.sh
``payload.py``                               all files that go onto the boot partition of one robot
``write.py``                                 one decompression, many cards, read back and compared
``wait.py`` ``report.py``                    the robot's hello, or the report that its card carries
``first_boot.sh`` ``firstrun.sh``            what runs on the robot, once

The boot partition is edited in a copy and checked before the first byte of a card is overwritten; the card is then
written in one pass, edits included, so that what is read back is all that the robot will see.
"""
