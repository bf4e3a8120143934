"""Writes cards: an image, an unattended first boot in the lab's network, and a report when it fails.

``run.py``         `fullswarm flash`: checks everything, asks, writes, reads back, pins host keys, waits
``plan.py``        the options, the confirmation, and all decisions before a byte is written
``card.py``        which devices may be written
``image.py``       reads images: decompression, checksums
``fat.py``         partition tables and FAT file systems; edits the boot partition with mtools, checked by fsck.vfat
``wifi.py``        networks, passphrases, countries
``first_boot.py``  a robot's first-boot configuration: cloud-init, or Raspberry Pi's firstrun.sh
``payload.py``     all files that go onto the boot partition of one robot
``write.py``       one decompression, many cards, read back and compared
``result.py``      the robot's first health report, or the report that its card carries
``first_boot.sh`` ``firstrun.sh``  what runs on the robot, once

The boot partition is edited in a copy and checked before the first byte of a card is overwritten; the card is then
written in one pass, edits included, so that what is read back is all that the robot will see.
"""
