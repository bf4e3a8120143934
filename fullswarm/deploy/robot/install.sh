#!/bin/sh
# Installs a robot support package; run as root in the folder that its tar was unpacked to. Safe to run again: it prints `changed: …` for
# what it changed, and nothing when all is as it should be. Afterwards only /opt/fullswarm, /var/lib/fullswarm and /run
# need to be writable; the root file system may be read-only.
#
# An agent that ran before and does not start with new settings gets its old ones back, and this exits with 1. With
# --settings-stay (a card's first boot, which switches the release next) the new ones stay even if the agent fails.
#
# Run directly, by root or from a card, it makes the robot trust the keys in `root`. With --verified (fullswarm-robot has
# verified the package with the keys that the robot trusts) those stay.
set -eu
LC_ALL=C
export LC_ALL
umask 022

ROOT=${FULLSWARM_ROOT:-}
SYSTEMCTL=${FULLSWARM_SYSTEMCTL:-systemctl}
# Holds the line of a file once every program that reads the file has been notified.
NOTIFIED=$ROOT/opt/fullswarm/bin/kit.sums
AGENT=fullswarm-agent.service
IDENTITY=etc/fullswarm/identity
SETTINGS="etc/systemd/system/$AGENT etc/fullswarm/fleet.toml etc/fullswarm/robot.env"
SETTINGS="$SETTINGS $IDENTITY/authority.pem $IDENTITY/certificate.pem $IDENTITY/key.pem"
START_S=60
stay='' verified=''
case ${1-} in
--settings-stay) stay=yes ;;
--verified) verified=yes ;;
esac
cd "$(dirname "$(readlink -f "$0")")"
trap '' PIPE HUP # a broken link must not end the installation

say() { printf '%s\n' "install.sh: $*" >&2 || :; }
changed() { printf 'changed: %s\n' "$*" 2> /dev/null || :; }
cannot() { say "cannot write $1: is the file system read-only or full?"; exit 1; }

(cd files && sha256sum -c --quiet ../kit.sums >&2) || { say "the support package is damaged; nothing was changed"; exit 1; }
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
    "$IDENTITY"/*) printf 0600 ;;
    *) printf 0644 ;;
    esac
}

owner_of() { # PATH: the agent reads its private key, and no other user does
    case $1 in "$IDENTITY"/*) [ -n "$ROOT" ] || printf fullswarm ;; esac
}

unmark() { # PATH: before it changes, so that a run after a killed one notifies what that one did not
    grep -q "  $1\$" "$NOTIFIED" 2> /dev/null || return 0
    sed "\\|  $1\$|d" "$NOTIFIED" > "$NOTIFIED.new~" && mv -fT "$NOTIFIED.new~" "$NOTIFIED" || cannot "$NOTIFIED"
}

keep() { # PATH: the agent's present settings, until it runs with the new ones
    case " $SETTINGS " in *" $1 "*) ;; *) return 0 ;; esac
    [ -n "$running" ] && [ -e "$ROOT/$1" ] && [ ! -e "$ROOT/$1.was~" ] || return 0
    cp -p "$ROOT/$1" "$ROOT/$1.new~" && mv -fT "$ROOT/$1.new~" "$ROOT/$1.was~" || cannot "$ROOT/$1.was~"
}

put_back() { # the kept settings; fails when there are none
    back=''
    for path in $SETTINGS; do
        [ -e "$ROOT/$path.was~" ] || continue
        mv -fT "$ROOT/$path.was~" "$ROOT/$path" || cannot "$ROOT/$path"
        back=yes
    done
    [ -n "$back" ]
}

put() { # PATH LINE: copies one file to its place in one step, unless it is there
    to=$ROOT/$1
    mode=$(mode_of "$1") owner=$(owner_of "$1")
    if ! cmp -s "files/$1" "$to" || [ "$(stat -c 0%a "$to")" != "$mode" ] ||
        { [ -n "$owner" ] && [ "$(stat -c %U "$to")" != "$owner" ]; }; then
        unmark "$1"
        keep "$1"
        # A name with a dot in it: neither sudo nor udev nor systemd reads a half-written one.
        mkdir -p "$(dirname "$to")" && (umask 077 && cp "files/$1" "$to.new~") && chmod "$mode" "$to.new~" &&
            { [ -z "$owner" ] || chown "$owner:" "$to.new~"; } && mv -fT "$to.new~" "$to" || cannot "$to"
        changed "$1"
    fi
    if grep -qxF "$2" "$NOTIFIED" 2> /dev/null; then
        return 0
    fi
    case $1 in
    etc/systemd/system/*) units=yes ;;
    etc/udev/*) rules=yes ;;
    etc/systemd/journald.conf.d/*) journal=yes ;;
    etc/ssh/sshd_config.d/*) ssh=yes ;;
    esac
    case " $SETTINGS " in *" $1 "*) agent=yes ;; esac
}

make_user() { # the agent's own, with the groups of ports and gamepads that this system has
    if ! id fullswarm > /dev/null 2>&1; then
        useradd --system --home-dir /var/lib/fullswarm --no-create-home --shell /usr/sbin/nologin fullswarm
        changed "user fullswarm"
    fi
    for group in dialout input plugdev gpio i2c spi; do
        if getent group "$group" > /dev/null && ! id -nG fullswarm | tr ' ' '\n' | grep -qx "$group"; then
            unmark etc/fullswarm/robot.env
            usermod -aG "$group" fullswarm
            changed "group $group"
            agent=yes
        fi
    done
}

put_trust() { # before all else: without it, the installed tools accept nothing
    trust=$ROOT/opt/fullswarm/trust
    [ -z "$verified" ] || return 0
    [ -z "$stay" ] || rm -f "$trust/newest-release" "$trust/newest-support" # whoever has the card may go back
    if cmp -s root "$trust/root"; then
        return 0
    fi
    mkdir -p "$trust" && cp root "$trust/root.new~" && rm -f "$trust/newest-release" "$trust/newest-support" &&
        mv -fT "$trust/root.new~" "$trust/root" || cannot "$trust/root"
    changed "trusted keys"
}

reload_sshd() { # connections that are open stay; a server that rejects our lines must not stay down
    sshd=$(command -v sshd || command -v /usr/sbin/sshd) || return 0
    if ! "$sshd" -t 2> /dev/null; then # because of our lines, or was it broken before?
        ours=/etc/ssh/sshd_config.d/60-fullswarm.conf
        mv -f "$ours" "$ours.off~"
        if "$sshd" -t 2> /dev/null; then
            say "sshd does not accept $ours; it is named $ours.off~ now"
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

start_agent() { # restart|try-restart: waits until it says READY, has failed, or hangs
    timeout --foreground "$START_S" "$SYSTEMCTL" "$1" "$AGENT"
}

last_log_line() { # SINCE: of the agent, in seconds since the epoch
    ! command -v journalctl > /dev/null ||
        journalctl -q --no-pager -o cat -n 1 --since "@$1" "_SYSTEMD_UNIT=$AGENT" 2> /dev/null | tail -n 1 | cut -c1-160
}

units='' rules='' journal='' ssh='' agent='' running=''
if [ -e "$ROOT/opt/fullswarm/current" ] && [ -z "$stay" ] && "$SYSTEMCTL" is-active --quiet "$AGENT"; then
    running=yes
fi
mkdir -p "$ROOT/opt/fullswarm/releases" "$ROOT/opt/fullswarm/bin"
put_trust
[ -n "$ROOT" ] || make_user
while read -r digest path; do
    case $path in
    etc/sudoers.d/*)
        if command -v visudo > /dev/null && ! visudo -cqf "files/$path" > /dev/null; then
            say "sudo does not accept $path"
            exit 1
        fi
        ;;
    esac
    put "$path" "$digest  $path"
done < kit.sums
if [ -z "$ROOT" ]; then
    for folder in /var/lib/fullswarm /var/cache/fullswarm; do
        [ ! -d "$folder" ] || continue
        install -d -o fullswarm -g fullswarm -m 0755 "$folder" || cannot "$folder"
        changed "$folder"
    done
fi
sync

# Programs that run already are notified only of what has changed.
if [ -n "$units" ]; then
    "$SYSTEMCTL" daemon-reload
fi
for unit in fullswarm-boot.service "$AGENT"; do
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
began=$(date +%s)
if [ -n "$agent" ] && ! start_agent try-restart; then
    why="the agent does not start with the new settings"
    line=$(last_log_line "$began")
    if [ -z "$stay" ] && put_back; then
        "$SYSTEMCTL" daemon-reload
        why="$why; the old ones are back"
        start_agent restart || why="$why, and it does not start with them either"
        say "$why; do they need a newer release? \`fullswarm update\` first, deploy then.${line:+ Its last log line: $line}"
        exit 1
    fi
    say "$why${line:+: $line}"
    [ -z "$running" ] || exit 1
fi
for path in $SETTINGS; do
    rm -f "$ROOT/$path.was~"
done

rm -f "$ROOT/etc/fullswarm/allowed_signers" 2> /dev/null || : # of older tools: nothing reads it any more

# Last, so that this file is there only when all others are.
if ! cmp -s kit.sums "$NOTIFIED"; then
    cp kit.sums "$NOTIFIED.new~" && mv -fT "$NOTIFIED.new~" "$NOTIFIED" || cannot "$NOTIFIED"
fi
