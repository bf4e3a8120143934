# Sourced by robot-shipping.sh: what this robot trusts, and whether something signed may be installed.
#
#   trust/root             root metadata: who signs releases and support packages, who signs the next root metadata
#   trust/newest-release   "<number> <digest> <key>" of the newest statement that was verified; newest-support likewise
#   trust/log              accepted root metadata and older releases that were asked for, with the time
#   trust/refused          what was refused and why, with the time
#
# The first root metadata come with the first support package; each later version is signed by a threshold of the root
# keys of the version before. Nothing here runs or unpacks what it has not verified.
# shellcheck shell=sh disable=SC2154

TRUST=$HOME_DIR/trust
MOST_TRUST=1048576    # bytes of all root metadata
MOST_PACKAGE=16777216 # bytes of a support package

field() { # FILE NAME: the second word of its first line that begins with NAME
    awk -v name="$2" '$1 == name { print $2; exit }' "$1"
}

is_number() { # of at most 12 digits, which a shell can compare
    case $1 in '' | *[!0-9]* | ?????????????*) return 1 ;; esac
}

note() { # TEXT: into the log, of which the last lines stay
    { tail -n 199 "$TRUST/log" 2>/dev/null; printf '%s %s\n' "$(date +%s)" "$*"; } > "$TRUST/log.new~" &&
        mv -fT "$TRUST/log.new~" "$TRUST/log"
    say "$*"
}

newest() { # KIND: the number of the newest statement that was verified, 0 before the first
    [ -e "$TRUST/newest-$1" ] || { printf '0\n'; return; }
    seen=$(cut -d' ' -f1 "$TRUST/newest-$1")
    is_number "$seen" || refuse "$TRUST/newest-$1 is damaged: write its card again (\`fullswarm flash --seed-only\`)"
    printf '%s\n' "$seen"
}

now_s() { # the clock, or the newest statement: a computer without a battery clock starts in the past
    now=$(date +%s)
    for each in release support; do
        seen=$(newest "$each") || exit
        [ "$seen" -le "$now" ] || now=$seen
    done
    printf '%s\n' "$now"
}

moment() { date -u -d "@$1" '+%F %T UTC'; }

split_document() { # FILE: to $work/text and $work/signature.1, .2 …
    rm -f "$work"/signature.*
    : > "$work/text"
    awk -v to="$work/" '
        /^-----BEGIN SSH SIGNATURE-----$/ { part++ }
        { if (!part) print > (to "text"); else if (part <= 16) print > (to "signature." part) }' "$1"
}

check_signed() { # DOCUMENT KIND: valid key, in time, not older than the newest; leaves $work/text, sets number, statement, signer
    [ -s "$TRUST/root" ] || refuse "this robot trusts no key: write its card again, or install the support package as root"
    now=$(now_s) || exit
    [ "$(field "$TRUST/root" expires)" -gt "$now" ] ||
        refuse "its root metadata expired on $(moment "$(field "$TRUST/root" expires)"): \`fullswarm signing rotate\`, then try again"
    namespace=fullswarm-statement
    [ "$2" = release ] || namespace=fullswarm-$2
    awk -v now="$now" -v space="$namespace" '
        $1 == "release" && $2 + 0 > now + 0 { print "fullswarm namespaces=\"" space "\" " $3 " " $4 }
        ' "$TRUST/root" > "$work/signers"
    split_document "$1"
    : > "$work/why"
    [ -s "$work/signature.1" ] && ssh-keygen -Y verify -f "$work/signers" -I fullswarm -n "$namespace" \
        -s "$work/signature.1" < "$work/text" > "$work/verified" 2> "$work/why" ||
        refuse "the signature is not one that this robot trusts ($(tr '\n' ' ' < "$work/why"))"
    signer=$(sed -n 's/.* key \(SHA256:[A-Za-z0-9+/]*\).*/\1/p' "$work/verified" | head -n 1)
    [ "$(head -n 1 "$work/text")" = "fullswarm-$2 1" ] || refuse "this is not the statement about a $2"
    number=$(field "$work/text" number) expires=$(field "$work/text" expires)
    is_number "$number" && is_number "$expires" || refuse "the statement about the $2 is damaged"
    [ "$expires" -gt "$now" ] ||
        refuse "its signature expired on $(moment "$expires"), and here it is $(moment "$now"): \`fullswarm bundle\` or \`deploy\` again"
    seen=$(newest "$2") || exit
    [ "$number" -ge "$seen" ] ||
        refuse "it was signed on $(moment "$number"), before the newest $2 that this robot has verified ($(moment "$seen")): \`fullswarm update --release ID --allow-older\` if it is meant"
    statement=$(sha256sum < "$work/text" | cut -c1-64)
    [ "$number" -gt "$seen" ] || [ "$seen" -eq 0 ] || [ "$(cut -d' ' -f2 "$TRUST/newest-$2")" = "$statement" ] ||
        refuse "another $2 has the same number"
}

known() { # KIND: the statement that check_signed has accepted is the newest that was verified before
    [ "$(cut -d' ' -f2 "$TRUST/newest-$1" 2>/dev/null)" = "$statement" ]
}

remember() { # KIND: the statement that check_signed has accepted
    known "$1" ||
        write_file "$TRUST/newest-$1" "$number $statement $signer" || fail "cannot write $TRUST"
}

check_release() { # FOLDER ID: its statement holds, and is about these checksums
    [ -s "$1/STATEMENT" ] || refuse "the release has no signed statement: bundle it with a newer fullswarm"
    check_signed "$1/STATEMENT" release
    [ "$(field "$work/text" id)" = "$2" ] || refuse "the statement is about $(field "$work/text" id), not about $2"
    [ "$(field "$work/text" sums)" = "$(sha256sum < "$1/SHA256SUMS" | cut -c1-64)" ] ||
        refuse "SHA256SUMS are not those that were signed"
}

check_not_revoked() { # ID: who signed it is still trusted, at whatever time that was
    [ -s "$RELEASES/$1/STATEMENT" ] || return 0 # installed by older tools
    awk '$1 == "release" { print "fullswarm namespaces=\"fullswarm-statement\" " $3 " " $4 }' "$TRUST/root" > "$work/signers"
    split_document "$RELEASES/$1/STATEMENT"
    ssh-keygen -Y verify -f "$work/signers" -I fullswarm -n fullswarm-statement -s "$work/signature.1" \
        < "$work/text" > /dev/null 2>&1 ||
        refuse "$1 is signed by a key that this robot no longer trusts: \`fullswarm update --release\` with another one"
}

# ---------------------------------------------------------------- root metadata
trust() { # stdin: tar of <version>.root, each signed by the version before; stdout: the version that holds now
    [ $# -eq 0 ] || usage "trust takes no arguments"
    lock trust 10
    private trust
    head -c "$MOST_TRUST" > "$work/roots.tar"
    [ -s "$TRUST/root" ] || refuse "this robot trusts no key: write its card again, or install the support package as root"
    while have=$(field "$TRUST/root" version) &&
        tar -xOf "$work/roots.tar" "$((have + 1)).root" > "$work/next" 2>/dev/null && [ -s "$work/next" ]; do
        take_root "$work/next" $((have + 1))
    done
    field "$TRUST/root" version
}

take_root() { # FILE VERSION: it becomes what this robot trusts, or is refused
    split_document "$1"
    check_root "$work/text" "$2"
    for metadata in "$TRUST/root" "$work/text"; do
        made=$(count_signers "$metadata") needed=$(field "$metadata" threshold)
        [ "$made" -ge "$needed" ] ||
            refuse "root metadata $2 are signed by $made of the $needed root keys that version $(field "$metadata" version) needs"
    done
    awk '$1 == "release" { print $3, $4 }' "$work/text" > "$work/keys"
    ssh-keygen -lf "$work/keys" 2>/dev/null | cut -d' ' -f2 > "$work/trusted"
    for kind in release support; do # a stolen key must not keep out its successors by a number far ahead
        [ ! -e "$TRUST/newest-$kind" ] || grep -qxF "$(cut -d' ' -f3 "$TRUST/newest-$kind")" "$work/trusted" ||
            rm -f "$TRUST/newest-$kind"
    done
    cp "$work/text" "$TRUST/root.new~" && settle "$TRUST/root.new~" && mv -fT "$TRUST/root.new~" "$TRUST/root" &&
        settle "$TRUST" || fail "cannot write $TRUST"
    note "trusts root metadata $2"
}

check_root() { # TEXT VERSION
    awk -v version="$2" '
        function bad(why) { print why; wrong = 1; exit }
        NR == 1 { if ($0 != "fullswarm-root 1") bad("they are of another format"); next }
        NR == 2 { if ($0 != "version " version) bad("they are not version " version); next }
        NR == 3 || NR == 4 {
            if ($0 !~ (NR == 3 ? "^expires [0-9]+$" : "^threshold [1-9][0-9]*$") || length($2) > 12) bad("line " NR)
            if (NR == 4) threshold = $2 + 0
            next
        }
        /^root [a-z0-9@.-]+ [A-Za-z0-9+\/=]+$/ { if ($3 in roots) bad("a root key twice"); roots[$3]; count++; next }
        /^release [0-9]+ [a-z0-9@.-]+ [A-Za-z0-9+\/=]+$/ && length($2) <= 12 { keys++; next }
        { bad("line " NR) }
        END { if (wrong) exit 1; if (!threshold || count < threshold || !keys) { print "too few keys"; exit 1 } }
        ' "$1" > "$work/why" || refuse "root metadata $2: $(head -n 1 "$work/why")"
}

count_signers() { # METADATA: how many of its root keys have signed $work/text
    count=0
    awk '$1 == "root" { print $2, $3 }' "$1" | sort -u > "$work/rootkeys"
    while IFS= read -r key; do
        printf 'fullswarm namespaces="fullswarm-root" %s\n' "$key" > "$work/signers"
        for made in "$work"/signature.*; do
            [ -f "$made" ] && ssh-keygen -Y verify -f "$work/signers" -I fullswarm -n fullswarm-root -s "$made" \
                < "$work/text" > /dev/null 2>&1 || continue
            count=$((count + 1))
            break
        done
    done < "$work/rootkeys"
    printf '%s\n' "$count"
}

# ---------------------------------------------------------------- the support package
install() { # stdin: a support package with its statement
    [ $# -eq 0 ] || usage "install takes no arguments"
    lock switch 30
    private kit
    head -c "$MOST_PACKAGE" > "$work/kit.tar"
    mkdir "$work/kit" || fail "cannot write $work"
    for name in kit.statement install.sh kit.sums; do # one by one to stdout: no path in the tar is ever used
        tar -xOf "$work/kit.tar" "$name" > "$work/kit/$name" 2>/dev/null && [ -s "$work/kit/$name" ] ||
            refuse "the support package has no $name: deploy with a newer fullswarm, which signs it"
    done
    check_signed "$work/kit/kit.statement" support
    # shellcheck disable=SC1091
    own=$(sed -n 's/^ROBOT="\([^"]*\)"$/\1/p' "$ETC/robot.env" 2>/dev/null)
    digests="$(sha256sum < "$work/kit/install.sh" | cut -c1-64) $(sha256sum < "$work/kit/kit.sums" | cut -c1-64)"
    robot=$(awk -v digests="$digests" '$1 == "package" && $3 " " $4 == digests { print $2 }' "$work/text")
    [ -n "$robot" ] || refuse "the support package is not the one that was signed"
    [ -z "$own" ] || [ "$(field "$work/text" rename)" = yes ] || printf '%s\n' "$robot" | grep -qxF "$own" ||
        refuse "the support package is for $robot, this is $own: \`fullswarm deploy --rename\` if it is meant"
    remember support
    while read -r digest path; do
        case /$path/ in *//* | */./* | */../*) refuse "the support package has the path $path" ;; esac
        mkdir -p "$work/kit/files/$(dirname "$path")" &&
            tar -xOf "$work/kit.tar" "files/$path" > "$work/kit/files/$path" 2>/dev/null || fail "cannot unpack $path"
    done < "$work/kit/kit.sums"
    sh "$work/kit/install.sh" --verified # which compares all files with kit.sums
}
