"""What runs inside the devices guest, as root, with the kernel's own input, CAN and USB drivers."""
