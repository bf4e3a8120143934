# Sourced by fullswarm-robot: the information that the base reads, and how root deals with files of the agent's user.
# shellcheck shell=sh disable=SC2154

AGENT_USER=${FULLSWARM_AGENT_USER:-fullswarm}
MOST_HEALTH=65536 # bytes

other_user() { # the agent is another user, whose files root must not touch
    [ "$(id -u)" -eq 0 ] && { [ -z "$ROOT" ] || [ -n "${FULLSWARM_AGENT_USER:-}" ]; }
}

as_agent() { # SECONDS COMMAND...: as the agent's user, among its files; killed after so long, even if it was stopped
    limit_s=$1
    shift
    ! other_user || set -- setpriv --reuid="$AGENT_USER" --regid="$(id -g "$AGENT_USER")" --init-groups --no-new-privs "$@"
    timeout --foreground -k 1 "$limit_s" "$@" 9>&-
}

take_health() { # sets health: the agent's report, or nothing. Its user may have put there a link, a FIFO, or any text
    health=''
    mkdir -p "$RUN" && chmod 700 "$RUN" && copy=$(mktemp "$RUN/health.XXXXXX") || return
    # Into a file: a pipe could be kept open for ever by a process of that user.
    as_agent 10 dd if="$HEALTH" iflag=nofollow,nonblock bs="$MOST_HEALTH" count=1 status=none > "$copy" 2> /dev/null &&
        health=$(head -c "$MOST_HEALTH" "$copy" | tr -cd '\n -~' | plain_json)
    rm -f "$copy"
    [ -n "$health" ]
}

plain_json() { # one object of plain values and lists of texts, written again: nothing in it ends the object early
    awk '
        BEGIN {
            hex = "[0-9a-fA-F]"
            text = "\"([^\"\\\\]|\\\\[\"\\\\/bfnrt]|\\\\u" hex hex hex hex ")*\""
            number = "-?(0|[1-9][0-9]*)([.][0-9]+)?([eE][-+]?[0-9]+)?"
            value = "(" text "|" number "|true|false|null|\\[\\]|\\[" text "\\])"
        }
        function bad() { wrong = 1; exit }
        NR == 1 { if ($0 != "{") bad(); next }
        closed { bad() }
        $0 == "}" && !list { closed = 1; next }
        { sub(/,$/, "") }
        list && $0 ~ "^  " text "$" { lines = lines comma "\n" $0; comma = ","; next }
        list && $0 == " ]" { lines = lines "\n ]"; list = 0; between = ",\n"; next }
        !list && /^ "[a-z0-9_]+": \[$/ { lines = lines between $0; list = 1; comma = ""; next }
        !list && $0 ~ "^ \"[a-z0-9_]+\": " value "$" { lines = lines between $0; between = ",\n"; next }
        { bad() }
        END { if (!wrong && closed) print "{\n" lines "\n}" }'
}

text() { # TEXT: as a JSON string
    printf '"%s"' "$(printf '%s' "$*" | tr -d '\000-\037\177' | sed 's/\\/\\\\/g; s/"/\\"/g')"
}

number() { # TEXT: as a JSON number, null when it is none
    case $1 in
    '' | *[!0-9.-]*) printf null ;;
    *) printf %s "$1" ;;
    esac
}

texts() { # lines of stdin as a JSON list
    between=''
    printf '['
    while IFS= read -r each; do
        [ -n "$each" ] || continue
        printf %s "$between"
        text "$each"
        between=', '
    done
    printf ']'
}

pythons() { # the installed minor versions that are supported
    python3_minor
    for minor in 10 11 12 13 14 15; do
        python_for "3.$minor" > /dev/null && printf '3.%s\n' "$minor"
    done
}

release_or_null() { # NAME of a link
    if id=$(target_of "$1"); then text "$id"; else printf null; fi
}

pending_or_null() { # the pending release
    if read_pending; then text "$new"; else printf null; fi
}

kit_json() { # the id of the installed support package while all its files are unchanged
    if (cd "${ROOT:-/}" && sha256sum -c --status "$HOME_DIR/bin/kit.sums") 2>/dev/null; then
        text "$(sha256sum "$HOME_DIR/bin/kit.sums" | cut -c1-12)"
    else
        printf null
    fi
}

agent_json() {
    "$SYSTEMCTL" show "$AGENT" -p ActiveState -p SubState -p NRestarts -p MainPID -p ActiveEnterTimestampMonotonic \
        -p ConditionResult 9>&- 2>/dev/null | awk -F= -v up="$(uptime_s)" '
        { value[$1] = $2 }
        END {
            since = value["ActiveEnterTimestampMonotonic"] / 1e6
            printf "{\"active\": %s, \"state\": \"%s/%s\", \"since\": %s, \"restarts\": %d, \"pid\": %d}",
                (value["ActiveState"] == "active" ? "true" : "false"), value["ActiveState"], value["SubState"],
                (since > 0 ? sprintf("%.0f", up - since) : "null"), value["NRestarts"], value["MainPID"]
        }'
}

temperature_c() {
    for each in /sys/class/thermal/thermal_zone*/temp; do
        [ -r "$each" ] && awk '{ printf "%.1f\n", $1 / 1000 }' "$each" 2>/dev/null
    done | sort -n | tail -n 1
}

throttled() { # the Raspberry Pi's bits of low voltage and heat, now and since it was switched on
    for each in /sys/devices/platform/soc/soc:firmware/get_throttled /sys/class/hwmon/hwmon*/in0_lcrit_alarm; do
        [ -r "$each" ] && head -n 1 "$each" && return
    done
}

disk_errors() {
    cat /sys/fs/ext4/*/errors_count 2>/dev/null | awk '{ sum += $1; seen = 1 } END { if (seen) print sum + 0 }'
}

card_errors() { # errors of the card or its file system in the kernel's log; nothing when it is not readable
    dmesg 2>/dev/null | awk '
        /mmc[0-9]+: .*([Ee]rror|[Tt]imeout|timed out)|I\/O error, dev (mmcblk|sd)|EXT4-fs error|Remounting .* read-only/ { bad++ }
        END { if (NR) print bad + 0 }'
}

health_or_null() {
    if take_health && fresh; then printf '%s' "$health"; else printf null; fi
}

facts() { # one JSON object
    [ $# -eq 0 ] || usage "facts takes no arguments"
    python3_minor
    # shellcheck disable=SC1091
    robot=$(. "$ETC/robot.env" 2>/dev/null && printf %s "${ROBOT:-}")
    system=$(sed -n 's/^PRETTY_NAME="\{0,1\}\([^"]*\)"\{0,1\}$/\1/p' /etc/os-release 2>/dev/null)
    glibc=$(getconf GNU_LIBC_VERSION 2>/dev/null)
    space=$(df -Pk "$HOME_DIR" 2>/dev/null | awk 'NR == 2 { printf "%.0f %.0f\n", $2 * 1024, $4 * 1024 }')
    writable=false
    [ ! -w "$HOME_DIR" ] || writable=true
    cat <<FACTS
{
 "protocol": $PROTOCOL,
 "kit": $(kit_json),
 "root_version": $(number "$(field "$TRUST/root" version 2>/dev/null)"),
 "robot": $(text "$robot"),
 "hostname": $(text "$(uname -n)"),
 "model": $(text "$(cat /proc/device-tree/model 2>/dev/null | tr -d '\000')"),
 "os": $(text "$system"),
 "kernel": $(text "$(uname -r)"),
 "arch": $(text "$(uname -m)"),
 "bits": $(number "$(getconf LONG_BIT)"),
 "glibc": $(text "${glibc#* }"),
 "python": $(text "$python3_minor"),
 "pythons": $(pythons | texts),
 "zstd": $(command -v zstd > /dev/null 2>&1 && printf true || printf false),
 "disk_bytes": $(number "$(printf %s "$space" | cut -d' ' -f1)"),
 "disk_free_bytes": $(number "$(printf %s "$space" | cut -d' ' -f2)"),
 "disk_writable": $writable,
 "disk_errors": $(number "$(disk_errors)"),
 "card_errors": $(number "$(card_errors)"),
 "memory_bytes": $(number "$(awk '/^MemTotal/ { printf "%.0f", $2 * 1024 }' /proc/meminfo)"),
 "memory_free_bytes": $(number "$(awk '/^MemAvailable/ { printf "%.0f", $2 * 1024 }' /proc/meminfo)"),
 "clock_utc": $(number "$(date +%s)"),
 "boot_id": $(text "$(boot_id)"),
 "machine_s": $(number "$(uptime_s)"),
 "current": $(release_or_null current),
 "previous": $(release_or_null previous),
 "pending": $(pending_or_null),
 "last_rollback": $(if [ -s "$HOME_DIR/last-rollback" ]; then text "$(cat "$HOME_DIR/last-rollback")"; else printf null; fi),
 "releases": $(find "$RELEASES" -mindepth 1 -maxdepth 1 -type d ! -name '.*' 2>/dev/null | sed 's|.*/||' | sort | texts),
 "incoming": $(find "$RELEASES" -mindepth 1 -maxdepth 1 -name '.incoming-*' 2>/dev/null | sed 's|.*/.incoming-||' | sort | texts),
 "groups": $(id -nG fullswarm 2>/dev/null | tr ' ' '\n' | texts),
 "systemd": $(text "$("$SYSTEMCTL" is-system-running 9>&- 2>/dev/null)"),
 "agent": $(agent_json),
 "temperature_c": $(number "$(temperature_c)"),
 "throttled": $(text "$(throttled)"),
 "health": $(health_or_null)
}
FACTS
}

health() { # [--healthy]: the health file while it is new and of the release that should run; 1: not healthy
    case $#${1:-} in 0 | 1--healthy) ;; *) usage "health [--healthy]" ;; esac
    take_health || fail "the agent has written no health yet"
    fresh || fail "the agent's health is $(health_age_s 2>/dev/null || printf '?') s old"
    [ "$(say_field release)" = "$(current)" ] || fail "the agent still runs $(say_field release)"
    printf '%s\n' "$health"
    [ $# -eq 0 ] || [ "$(say_field healthy)" = true ]
}

logs() {
    format=short-iso
    if [ "${1-}" = --json ]; then
        format=json
        shift
    fi
    for each in "$@"; do
        case $each in -f | -n | [0-9]*) ;; *) usage "logs [--json] [-f] [-n LINES]" ;; esac
    done
    exec journalctl --unit="$AGENT" --no-pager --output="$format" "$@"
}
