#!/bin/busybox sh
# The guest's first process: kernel file systems, modules, udev, then the Python that tries the devices.
export PATH=/usr/bin:/bin:/usr/sbin:/sbin HOME=/root PYTHONPATH=/site:/app
/bin/busybox --install -s /usr/sbin 2>/dev/null
[ -e /bin/sh ] || ln -s busybox /bin/sh
for each in depmod modprobe insmod rmmod; do ln -sf /bin/kmod /sbin/$each; done
mkdir -p /proc /sys /dev /run /tmp /root
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev
mkdir -p /dev/pts /dev/shm
mount -t devpts pts /dev/pts
mount -t tmpfs run /run
ip link set lo up
depmod -a
/lib/systemd/systemd-udevd --daemon
python3.11 -m tests.machines.guest.main
sync
poweroff -f
