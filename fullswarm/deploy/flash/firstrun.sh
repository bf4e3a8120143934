#!/bin/sh
# Raspberry Pi OS without cloud-init runs this once, alone, before its first usual boot: name, user, keys, Wi-Fi, and a
# service that installs the robot's software from the card. It always ends with success: what it could not do is in
# fullswarm-report.txt on this partition, and the usual system starts.
set -u
ROOT=${FULLSWARM_ROOT-}
BOOT=$(cd "$(dirname "$0")" && pwd)
CARD=$BOOT/fullswarm
. "$CARD/card.env" # ROBOT NAME ADMIN COUNTRY SUDO: plain words only
failed=

try() { # DESCRIPTION COMMAND...: go on after an error, but note it
    what=$1
    shift
    "$@" || failed="$failed$what; "
}

there() { command -v "$1" >/dev/null 2>&1; }

name_it() {
    echo "$NAME" >"$ROOT/etc/hostname" || return 1
    grep -v '^127\.0\.1\.1' "$ROOT/etc/hosts" >"$ROOT/etc/hosts.new" 2>/dev/null
    printf '127.0.1.1\t%s\n' "$NAME" >>"$ROOT/etc/hosts.new" && mv "$ROOT/etc/hosts.new" "$ROOT/etc/hosts"
}

add_admin() {
    if [ "$ADMIN" = root ]; then
        home=$ROOT/root
    else
        id "$ADMIN" >/dev/null 2>&1 || useradd -m -s /bin/bash "$ADMIN" || return 1
        home=$ROOT$(getent passwd "$ADMIN" | cut -d: -f6)
        usermod -L -a -G adm,systemd-journal "$ADMIN"
        rule='ALL=(root) NOPASSWD: /opt/fullswarm/bin/fullswarm-robot'
        [ "$SUDO" != all ] || rule='ALL=(ALL) NOPASSWD:ALL'
        printf '%s %s\n' "$ADMIN" "$rule" >"$ROOT/etc/sudoers.d/fullswarm-admin" || return 1
        chmod 440 "$ROOT/etc/sudoers.d/fullswarm-admin"
    fi
    mkdir -p -m 700 "$home/.ssh" && cp "$CARD/secret/authorized_keys" "$home/.ssh/authorized_keys" || return 1
    chmod 600 "$home/.ssh/authorized_keys"
    [ "$ADMIN" = root ] || chown -R "$ADMIN:" "$home/.ssh"
}

open_ssh() {
    # The host key that the base knows; the service that would replace it must not run again.
    systemctl -q disable regenerate_ssh_host_keys 2>/dev/null
    rm -f "$ROOT"/etc/ssh/ssh_host_*_key "$ROOT"/etc/ssh/ssh_host_*_key.pub
    cp "$CARD/secret/host_key" "$ROOT/etc/ssh/ssh_host_ed25519_key" || return 1
    chmod 600 "$ROOT/etc/ssh/ssh_host_ed25519_key"
    cp "$CARD/secret/host_key.pub" "$ROOT/etc/ssh/ssh_host_ed25519_key.pub"
    mkdir -p "$ROOT/etc/ssh/sshd_config.d"
    echo 'PasswordAuthentication no' >"$ROOT/etc/ssh/sshd_config.d/10-fullswarm.conf"
    systemctl -q enable ssh
}

join_wifi() {
    for file in "$CARD"/secret/*.nmconnection; do
        [ -f "$file" ] || continue
        place=$ROOT/etc/NetworkManager/system-connections
        mkdir -p "$place" && cp "$file" "$place/" && chmod 600 "$place/${file##*/}" || return 1
    done
    [ -n "$COUNTRY" ] || return 0
    ! there raspi-config || raspi-config nonint do_wifi_country "$COUNTRY"
    ! there rfkill || rfkill unblock wifi
    for file in "$ROOT"/var/lib/systemd/rfkill/*:wlan; do
        [ ! -f "$file" ] || echo 0 >"$file"
    done
    state=$ROOT/var/lib/NetworkManager/NetworkManager.state
    [ ! -f "$state" ] || sed -i 's/^WirelessEnabled=.*/WirelessEnabled=true/' "$state"
}

no_wizard() { # it would ask for a user on the screen
    systemctl -q is-enabled userconfig 2>/dev/null || return 0
    systemctl -q disable userconfig
    systemctl -q enable getty@tty1
}

install_later() {
    mkdir -p "$ROOT/opt/fullswarm/flash" "$ROOT/etc/systemd/system" || return 1
    cp "$CARD/first_boot.sh" "$CARD/card.env" "$ROOT/opt/fullswarm/flash/" || return 1
    cp "$CARD/first-boot.service" "$ROOT/etc/systemd/system/fullswarm-first-boot.service" || return 1
    systemctl -q enable fullswarm-first-boot.service
}

try "its name could not be set" name_it
try "user $ADMIN could not be made" add_admin
try "ssh could not be set up" open_ssh
try "Wi-Fi could not be set up" join_wifi
try "the user wizard could not be switched off" no_wizard
try "the installation could not be prepared" install_later

if [ -n "$failed" ]; then
    {
        echo "fullswarm, first boot of $ROBOT: FAILED before the installation"
        echo "what: ${failed%; }"
        echo "what to do: is this Raspberry Pi OS, 64 bit? Flash the card again; if it fails again, report it with this file."
    } >"$BOOT/fullswarm-report.txt"
else
    rm -rf "$CARD/secret/authorized_keys" "$CARD"/secret/*.nmconnection
fi
# In this order, each on the disk before the next: a command line that runs a script which is gone boots for ever.
sed 's| systemd\.[^ ]*||g' "$BOOT/cmdline.txt" >"$BOOT/cmdline.txt.new" && sync &&
    mv -f "$BOOT/cmdline.txt.new" "$BOOT/cmdline.txt" && sync &&
    rm -f "$BOOT/firstrun.sh"
sync
exit 0
