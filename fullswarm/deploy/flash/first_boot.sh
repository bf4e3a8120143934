#!/bin/sh
# Installs the robot's software from its card, offline, and leaves fullswarm-report.txt on the card's boot partition:
# for a robot that never appears in the network, any computer's card reader shows the reason. systemd runs it at each
# boot until it has succeeded once for this card; every step may be repeated.
#
# POSIX sh with coreutils, tar and gzip; the rest is /opt/fullswarm/bin/fullswarm-robot, which the support package installs.
set -u
LC_ALL=C
export LC_ALL
ROOT=${FULLSWARM_ROOT-}
SYSTEMCTL=${FULLSWARM_SYSTEMCTL:-systemctl}
HEALTH_TRIES=${FULLSWARM_HEALTH_TRIES:-60} # seconds
HERE=$ROOT/opt/fullswarm/flash
TOOL=$ROOT/opt/fullswarm/bin/fullswarm-robot
. "$HERE/card.env" # ROBOT RELEASE FILES BYTES HUB VOLUME INSTANCE: plain words only
DONE=$HERE/done-$INSTANCE
FORGOTTEN=$HERE/forgotten-$INSTANCE
boot='' work='' mounted='' step='looking for the card'

there() { command -v "$1" >/dev/null 2>&1; }

say() { echo "fullswarm-first-boot: $*" >&2; }

# ---------------------------------------------------------------- the card
find_card() {
    for place in "$ROOT/boot/firmware" "$ROOT/boot"; do
        if [ -f "$place/fullswarm/card.env" ]; then
            boot=$place
            [ -w "$boot" ] && touch "$boot/.fullswarm" 2>/dev/null || mount -o remount,rw "$boot"
            rm -f "$boot/.fullswarm"
            return 0
        fi
    done
    place=$ROOT/run/fullswarm-card
    mkdir -p "$place" && mount -t vfat -o umask=077 "/dev/disk/by-uuid/$VOLUME" "$place" || return 1
    mounted=$place
    [ -f "$place/fullswarm/card.env" ] && boot=$place
}

leave() { # CODE
    sync
    [ -z "$work" ] || rm -rf "$work"
    [ -z "$mounted" ] || umount "$mounted"
    exit "$1"
}

# ---------------------------------------------------------------- the report
network() {
    ! there ip || { ip -brief address 2>/dev/null; ip route 2>/dev/null | head -n 5; }
    ! there rfkill || rfkill list 2>/dev/null
    ! there iw || { iw reg get 2>/dev/null | grep -m 1 country; iw dev 2>/dev/null | grep -E 'Interface|ssid'; }
    ! there nmcli || nmcli -t -f DEVICE,STATE,CONNECTION device 2>/dev/null
}

has_address() { # other computers could reach us
    ! there ip || ip -brief address 2>/dev/null | grep -v '^lo ' | grep -qE ' ([0-9]{1,3}\.){3}[0-9]{1,3}/'
}

advice() {
    case $step in
    *looking*) echo "The card was changed after it was written. Flash it again." ;;
    *reading*) echo "The card loses data: use another one, or another card reader, and flash again." ;;
    *taking*) echo "The software does not fit this image (64 bit? Python version?) or was signed on another base." \
        "fullswarm-robot says which, below: bundle for this image with 'fullswarm bundle', flash again." ;;
    *committing*) echo "The robot rolls back to the release that it had; the last lines below say why this one was not" \
        "committed. Does the base run, at the address of 'hub' above?" ;;
    *agent*) echo "The software is on the robot, but does not start; the journal below says why. A missing robot on" \
        "the cable is no reason; a fleet file that does not fit the release is." ;;
    *) echo "See the last lines below. Switching the robot off and on tries again." ;;
    esac
}

report() { # VERDICT ADVICE
    [ -n "$boot" ] || return 0
    {
        echo "fullswarm, first boot of $ROBOT: $1"
        echo "release: $RELEASE"
        echo "hub: $HUB"
        echo "robot's clock: $(date -u '+%Y-%m-%d %H:%M:%S') UTC, $(cut -d. -f1 /proc/uptime) s after power-on"
        echo "what to do: $2"
        echo
        echo "--- network"
        network
        echo
        echo "--- agent"
        [ ! -x "$TOOL" ] || "$TOOL" health 2>&1 | head -c 4000
        echo
        echo "--- what was done"
        cat "$HERE/log" 2>/dev/null | tail -n 60
        if there journalctl && [ -z "$ROOT" ]; then
            echo
            echo "--- journal"
            journalctl -b --no-pager -o short-monotonic -n 120 -u fullswarm-agent -u fullswarm-first-boot \
                -u cloud-init -u cloud-final -u NetworkManager -u wpa_supplicant -u systemd-networkd -u ssh 2>/dev/null
        fi
    } >"$boot/fullswarm-report.new" 2>&1
    mv -f "$boot/fullswarm-report.new" "$boot/fullswarm-report.txt"
    sync
}

fail() {
    say "FAILED while $step"
    report "FAILED while $step" "$(advice) Then power it on again."
    leave 1
}

run() { # STEP COMMAND...
    step=$1
    shift
    say "$step"
    echo "* $step" >>"$HERE/log"
    "$@" >>"$HERE/log" 2>&1 || fail
}

# ---------------------------------------------------------------- the steps
read_card() { (cd "$boot/fullswarm" && sha256sum -c --quiet card.sha256); }

keep_host_key() { # the one that the base knows; the image's own first boot may have made another
    key=$ROOT/etc/ssh/ssh_host_ed25519_key
    [ -f "$boot/fullswarm/secret/host_key" ] || return 0
    if ! cmp -s "$boot/fullswarm/secret/host_key" "$key"; then
        mkdir -p "$ROOT/etc/ssh"
        (umask 077 && cp "$boot/fullswarm/secret/host_key" "$key.new") && mv -f "$key.new" "$key" || return 1
        cp "$boot/fullswarm/secret/host_key.pub" "$key.pub" && chmod 644 "$key.pub" || return 1
    fi
    for unit in ssh sshd; do
        "$SYSTEMCTL" -q enable "$unit" 2>/dev/null && "$SYSTEMCTL" restart "$unit" && return 0
    done
    echo "no SSH server is installed: the robot runs, but cannot be updated over the network"
}

install_kit() { # short: in memory. A previous release may reject the new settings: the next one follows
    mkdir "$work/kit" && tar -xf "$boot/fullswarm/kit.tar" -C "$work/kit" && sh "$work/kit/install.sh" --settings-stay
}

take_release() {
    rm -rf "$ROOT/opt/fullswarm/releases/.incoming-$RELEASE" # of an interrupted try; the card has all of it
    "$TOOL" want "$RELEASE" --bytes "$BYTES" <"$boot/fullswarm/head.tar" >"$work/missing" || return 1
    for _ in 1 2; do # files of a previous release may be damaged
        [ ! -d "$ROOT/opt/fullswarm/releases/$RELEASE" ] || return 0
        give_missing >"$work/still" || return 1
        head -n 5 "$work/still"
        mv -f "$work/still" "$work/missing"
    done
    [ -d "$ROOT/opt/fullswarm/releases/$RELEASE" ]
}

give_missing() { # the robot accepts only what it requested, and prints what it still lacks
    if [ "$(wc -l <"$work/missing")" -eq "$FILES" ]; then
        "$TOOL" receive "$RELEASE" <"$boot/fullswarm/release.tar.gz"
    else
        mkdir -p "$work/some" &&
            tar -xzf "$boot/fullswarm/release.tar.gz" -C "$work/some" --verbatim-files-from -T "$work/missing" &&
            tar -cf - -C "$work/some" --verbatim-files-from -T "$work/missing" | "$TOOL" receive "$RELEASE"
    fi
    [ $? -le 1 ]
}

commit() { # at once where there is no previous release; else only when healthy
    if [ -n "$was" ] && [ "$was" != "$RELEASE" ] && ! until_well "$TOOL" health --healthy; then
        echo "$RELEASE is not healthy: $(why_not)"
        "$TOOL" rollback --because "not healthy at its first boot from the card: $(why_not)"
        return 1
    fi
    "$TOOL" commit "$RELEASE"
}

forget() { # what is not needed again, the robot's private host key above all
    [ ! -f "$boot/fullswarm/after-user-data" ] || mv -f "$boot/fullswarm/after-user-data" "$boot/user-data"
    rm -rf "$boot/fullswarm/secret" "$boot/fullswarm/release.tar.gz" "$boot/fullswarm/head.tar" "$boot/fullswarm/kit.tar" &&
        sync && : >"$FORGOTTEN"
}

until_well() { # COMMAND...
    tries=0
    until "$@" >/dev/null 2>&1; do
        tries=$((tries + 1))
        [ "$tries" -lt "$HEALTH_TRIES" ] || return 1
        sleep 1
    done
}

why_not() { # the agent's reason, or that there is none
    if said=$("$TOOL" health 2>&1); then
        printf '%s\n' "$said" | sed -n '/^ "why": \[/,/^ \]/s/^  "\(.*\)",\{0,1\}$/\1/p' | tr '\n' ';' | sed 's/;$//; s/;/; /g'
    else
        printf '%s' "${said#fullswarm-robot: }"
    fi
}

well() { "$TOOL" health --healthy && has_address; }

verdict() {
    until_well well || :
    if ! has_address; then
        report "installed, but NO NETWORK" "Is the Wi-Fi name right (upper and lower case), its passphrase, the country? \
Is the access point on, does it have 2.4 GHz? Write them anew: fullswarm flash $ROBOT --seed-only --device /dev/sdX …"
    elif "$TOOL" health --healthy >/dev/null 2>&1; then
        report "OK" "nothing; 'fullswarm status' shows the robot while the base runs"
    else
        state="installed, the agent is not healthy yet"
        ! "$TOOL" health >/dev/null 2>&1 || state="installed and running, but not healthy yet"
        report "$state: $(why_not)" "Nothing, if the base was off. Does the base run, at the address of 'hub' above, and let \
others in (--insecure-network)? Is the robot's cable plugged in? 'agent' below says what it waits for."
    fi
}

if [ -e "$DONE" ]; then
    [ -e "$FORGOTTEN" ] || { find_card && forget; } # after a power cut
    leave 0
fi
mkdir -p "$HERE" && : >"$HERE/log"
find_card || { say "no card with a folder 'fullswarm': volume $VOLUME"; leave 1; }
mkdir -p "$ROOT/var/tmp"
work=$(mktemp -d "$ROOT/var/tmp/fullswarm-first-boot.XXXXXX") || fail
was=$(readlink "$ROOT/opt/fullswarm/current") && was=${was##*/} || was=''
run "reading the card" read_card
run "giving the robot the key that the base knows" keep_host_key
run "installing what stands outside the release" install_kit
run "taking the release" take_release
run "starting the agent" "$TOOL" switch "$RELEASE" --guard $((HEALTH_TRIES + 120))
run "committing the release" commit
verdict # before it is marked as done: after a power cut all of this is repeated, and the report is written
echo "$RELEASE" >"$DONE"
sync
forget
say "done"
leave 0
