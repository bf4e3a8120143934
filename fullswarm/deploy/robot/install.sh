#!/bin/sh
# Spreads a kit; run as root in the folder that its tar was unpacked to. Safe to run again: it prints `changed: …` for
# what it changed, and nothing when all is as it should be. Afterwards only /opt/fullswarm, /var/lib/fullswarm and /run
# need to be writable; the root file system may be read-only.
set -eu
LC_ALL=C
export LC_ALL
umask 022

ROOT=${FULLSWARM_ROOT:-}
SYSTEMCTL=${FULLSWARM_SYSTEMCTL:-systemctl}
cd "$(dirname "$(readlink -f "$0")")"

say() { printf '%s\n' "install.sh: $*" >&2; }
changed() { printf 'changed: %s\n' "$*"; }

(cd files && sha256sum -c --quiet ../kit.sums >&2) || { say "the kit is damaged; nothing was changed"; exit 1; }
if [ -z "$ROOT" ] && [ "$(id -u)" -ne 0 ]; then
    say "must be run as root"
    exit 1
fi
for tool in awk flock gzip ssh-keygen tar; do
    command -v "$tool" > /dev/null || { say "'$tool' is missing on this system"; exit 1; }
done

mode_of() {
    case $1 in
    opt/fullswarm/bin/fullswarm-robot) printf 0755 ;;
    etc/sudoers.d/*) printf 0440 ;;
    *) printf 0644 ;;
    esac
}

put() { # PATH: copies one file to its place in one step, unless it is there
    to=$ROOT/$1
    mode=$(mode_of "$1")
    if cmp -s "files/$1" "$to" && [ "$(stat -c 0%a "$to")" = "$mode" ]; then
        return 0
    fi
    mkdir -p "$(dirname "$to")"
    # A name with a dot in it: neither sudo nor udev nor systemd reads a half-written one.
    cp "files/$1" "$to.new~" && chmod "$mode" "$to.new~" && mv -fT "$to.new~" "$to"
    changed "$1"
    case $1 in
    etc/systemd/system/*) units=yes ;;
    etc/udev/*) rules=yes ;;
    etc/systemd/journald.conf.d/*) journal=yes ;;
    etc/ssh/sshd_config.d/*) ssh=yes ;;
    esac
    case $1 in
    etc/systemd/system/fullswarm-agent.service | etc/fullswarm/fleet.toml | etc/fullswarm/robot.env) agent=yes ;;
    esac
}

make_user() { # the agent's own, with the groups of ports and gamepads that this system has
    if ! id fullswarm > /dev/null 2>&1; then
        useradd --system --home-dir /var/lib/fullswarm --no-create-home --shell /usr/sbin/nologin fullswarm
        changed "user fullswarm"
    fi
    for group in dialout input plugdev gpio i2c spi; do
        if getent group "$group" > /dev/null && ! id -nG fullswarm | tr ' ' '\n' | grep -qx "$group"; then
            usermod -aG "$group" fullswarm
            changed "group $group"
            agent=yes
        fi
    done
}

reload_sshd() { # connections that are open stay; a server that minds our lines must not end without them
    sshd=$(command -v sshd || command -v /usr/sbin/sshd) || return 0
    if ! "$sshd" -t 2> /dev/null; then # is it for our lines, or was something missing before?
        ours=/etc/ssh/sshd_config.d/60-fullswarm.conf
        mv -f "$ours" "$ours.off~"
        if "$sshd" -t 2> /dev/null; then
            say "sshd does not take $ours; it is named $ours.off~ now"
            return 0
        fi
        mv -f "$ours.off~" "$ours"
    fi
    for unit in ssh.service sshd.service; do
        "$SYSTEMCTL" is-active --quiet "$unit" || continue
        "$SYSTEMCTL" reload "$unit" || :
        return 0
    done
}

units='' rules='' journal='' ssh='' agent=''
mkdir -p "$ROOT/opt/fullswarm/releases" "$ROOT/opt/fullswarm/bin"
[ -n "$ROOT" ] || make_user
while read -r _ path; do
    case $path in
    etc/sudoers.d/*)
        if command -v visudo > /dev/null && ! visudo -cqf "files/$path" > /dev/null; then
            say "sudo does not take $path"
            exit 1
        fi
        ;;
    esac
    put "$path"
done < kit.sums
if [ -z "$ROOT" ]; then
    for folder in /var/lib/fullswarm /var/cache/fullswarm; do
        [ -d "$folder" ] || { install -d -o fullswarm -g fullswarm -m 0755 "$folder" && changed "$folder"; }
    done
fi
sync

# What runs already is told only of what has changed.
if [ -n "$units" ]; then
    "$SYSTEMCTL" daemon-reload
fi
for unit in fullswarm-boot.service fullswarm-agent.service; do
    if ! "$SYSTEMCTL" is-enabled --quiet "$unit" 2>/dev/null; then
        "$SYSTEMCTL" enable --quiet "$unit"
        changed "$unit enabled"
    fi
done
if [ -n "$rules" ] && command -v udevadm > /dev/null; then
    udevadm control --reload 2>/dev/null && udevadm trigger --subsystem-match=tty --action=change 2>/dev/null || :
fi
if [ -n "$journal" ]; then
    "$SYSTEMCTL" try-restart systemd-journald.service || :
fi
if [ -n "$ssh" ] && [ -z "$ROOT" ]; then
    reload_sshd
fi
if [ -n "$agent" ]; then
    "$SYSTEMCTL" try-restart fullswarm-agent.service || say "the agent does not start with the new settings"
fi

# Last: whoever finds it finds the rest, too.
if ! cmp -s kit.sums "$ROOT/opt/fullswarm/bin/kit.sums"; then
    cp kit.sums "$ROOT/opt/fullswarm/bin/kit.sums.new~"
    mv -fT "$ROOT/opt/fullswarm/bin/kit.sums.new~" "$ROOT/opt/fullswarm/bin/kit.sums"
fi
