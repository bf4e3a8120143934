"""Whole machines: a guest with devices, another processor, a card that boots. QEMU in software, so no KVM is needed.

`debian` makes root filesystems from Debian packages, `packages` the Python packages for them, `initramfs` packs them,
`machine` boots them and listens. What runs inside is in `guest`.
"""
