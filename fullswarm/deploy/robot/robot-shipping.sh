# Sourced by fullswarm-robot: a release comes in. Nothing is written below /opt before its signature and its fit to this
# machine are known; nothing gets the name of a release before every file of it has the digest that was signed.
# shellcheck shell=sh disable=SC2154

# shellcheck source=robot-trust.sh
. "$here/robot-trust.sh"

HEAD_FILES="manifest.json SHA256SUMS SHA256SUMS.sig STATEMENT"
MOST_HEAD=67108864 # bytes of these together: far more than any release needs
SPARE_KB=65536     # what must stay free for the journal and the latched e-stop
FLOOR_KB=16384     # below this a shipment that failed is removed: the disk is full

unpack() { # stdin, plain or gzip or zstd, to stdout
    dd bs=1 count=4 of="$work/magic" 2>/dev/null
    case $(od -An -tx1 "$work/magic" | tr -d ' \n') in
    1f8b*) set -- gzip -dc ;;
    28b52ffd) set -- zstd -dcq ;;
    *) set -- cat ;;
    esac
    cat "$work/magic" - | "$@"
}

private() { # a folder of root's in memory for this run
    mkdir -p "$RUN" && chmod 700 "$RUN" && work=$(mktemp -d "$RUN/$1.XXXXXX") || fail "cannot write $RUN"
    trap 'rm -rf "$work"' EXIT
    trap 'exit 1' HUP INT TERM
}

paths() { # SUMS: the paths it lists
    cut -c67- "$1"
}

check_sums() { # SUMS: lines of sha256sum, in order, none of which leads out of the release or through another file
    awk '
        function bad(why) { print "line " NR ": " why; wrong = 1; exit }
        length($0) < 67 || substr($0, 65, 2) != "  " || substr($0, 1, 64) !~ /^[0-9a-f]+$/ { bad("no line of sha256sum") }
        { path = substr($0, 67) }
        path ~ /[\\[:cntrl:]]/ || path ~ /^\// || path ~ /\/$/ || "/" path "/" ~ /\/\.?\.?\// { bad("path " path) }
        path !~ /^(app|lib|robot)\// && path != "manifest.json" { bad("does not belong here: " path) }
        path in seen { bad("twice: " path) }
        { seen[path] = 1; if (path == "manifest.json") named = 1 }
        END {
            if (wrong) exit 1
            for (path in seen) for (up = path; match(up, /\/[^\/]*$/); ) {
                up = substr(up, 1, RSTART - 1)
                if (up in seen) { print up " is a file and a folder"; exit 1 }
            }
            if (!named) { print "no manifest.json"; exit 1 }
        }' "$1" > "$work/why" || refuse "SHA256SUMS: $(head -n 1 "$work/why")"
}

check_manifest() { # FOLDER ID: it is what was signed, and its id is that of its content
    digest=$(sha256sum < "$1/manifest.json" | cut -c1-64)
    grep -qxF "$digest  manifest.json" "$1/SHA256SUMS" || refuse "manifest.json is not the one that was signed"
    grep -q "^ *\"id\": \"$2\",\{0,1\}\$" "$1/manifest.json" || refuse "the manifest is not that of $2"
    content=$({
        sed "s/^\( *\"id\": \)\"$2\"/\1\"\"/" "$1/manifest.json"
        printf '\0'
        grep -v '  manifest\.json$' "$1/SHA256SUMS"
    } | sha256sum | cut -c1-12)
    [ "$content" = "${2##*-}" ] || refuse "the id $2 is not that of its content, $content"
}

at_least() { # HAVE WANT: versions by number
    awk -v have="$1" -v want="$2" 'BEGIN {
        n = split(want, w, "."); split(have, h, ".")
        for (i = 1; i <= n; i++) if (h[i] + 0 != w[i] + 0) exit h[i] + 0 < w[i] + 0
    }'
}

check_machine() { # MANIFEST
    protocol=$(sed -n 's/^ *"robot_protocol": \([0-9]*\),\{0,1\}$/\1/p' "$1")
    [ "${protocol:-0}" -ge 1 ] && [ "$protocol" -le "$PROTOCOL" ] ||
        refuse "it needs protocol ${protocol:-?}, this robot's tools know $PROTOCOL: install the newer support package first"
    arch=$(target_field "$1" arch) glibc=$(target_field "$1" glibc) python=$(target_field "$1" python)
    [ "$(uname -m)" = "$arch" ] || refuse "it is for $arch, this computer is $(uname -m)"
    [ "$(getconf LONG_BIT)" = 64 ] || refuse "this system is a 32-bit one: write a card with a 64-bit image"
    have=$(getconf GNU_LIBC_VERSION 2>/dev/null) || refuse "this system has no glibc"
    at_least "${have#* }" "$glibc" || refuse "it needs glibc $glibc, this system has ${have#* }"
    python_for "$python" > /dev/null || refuse "it needs python $python; here: $(pythons | tr '\n' ' ')"
}

free_kb() { # [FOLDER]
    df -Pk "${1:-$HOME_DIR}" | awk 'NR == 2 { print $4 }'
}

missing() { # FOLDER: what its SHA256SUMS lists and it has not
    paths "$1/SHA256SUMS" | while IFS= read -r path; do
        [ -f "$1/$path" ] || printf '%s\n' "$path"
    done
}

plain_files() { # FOLDER: neither links nor devices: what is missing comes over the network
    find "$1" ! -type d ! -type f -exec rm -f {} +
}

whole() { # FOLDER: all that was signed is there, and has its digest
    (cd "$1" && sha256sum -c --status SHA256SUMS 2>/dev/null)
}

drop_damaged() { # FOLDER: remove files with another digest than the signed one, or that cannot be read
    (cd "$1" && sha256sum -c --quiet SHA256SUMS 2>/dev/null |
        sed -n 's/: FAILED\( open or read\)\{0,1\}$//p' | xargs -r -d '\n' rm -f)
}

link_from() { # RELEASE FOLDER: files that RELEASE has as well, as hard links
    missing "$2" | sort > "$work/missing"
    sort "$1/SHA256SUMS" > "$work/there"
    sort "$2/SHA256SUMS" | comm -12 - "$work/there" | cut -c67- | sort | comm -12 - "$work/missing" > "$work/same"
    # One that cannot be linked counts as missing.
    (cd "$1" && xargs -r -d '\n' cp -l --parents -t "$2" 2>/dev/null < "$work/same") || :
}

want() { # stdin: tar of manifest.json, SHA256SUMS, SHA256SUMS.sig, STATEMENT; stdout: the paths that are still missing
    need_id "${1:-}"
    id=$1 near='' bytes=0
    shift
    while [ $# -gt 1 ]; do
        case $1 in
        --from) need_id "$2"; near=$2 ;;
        --bytes) bytes=$2 ;; # how much the whole release takes
        *) usage "want does not know '$1'" ;;
        esac
        shift 2
    done
    case $# in 0) ;; *) usage "want ID [--from ID] [--bytes N]" ;; esac
    case $bytes in '' | *[!0-9]*) usage "--bytes takes a number" ;; esac
    lock ship 5
    private want
    head -c "$MOST_HEAD" | unpack | head -c "$MOST_HEAD" > "$work/head.tar"
    for name in $HEAD_FILES; do # one by one to stdout: no path in the tar is ever used
        tar -xOf "$work/head.tar" "$name" > "$work/$name" 2>/dev/null && [ -s "$work/$name" ] ||
            refuse "the tar has no $name"
    done
    check_release "$work" "$id"
    check_sums "$work/SHA256SUMS"
    check_manifest "$work" "$id"
    check_machine "$work/manifest.json"
    [ "$(field "$work/text" older)" != yes ] || known release || note "goes back to $id, asked for and signed by $signer"
    remember release
    if [ -d "$RELEASES/$id" ]; then # it may be signed anew
        cmp -s "$work/STATEMENT" "$RELEASES/$id/STATEMENT" || {
            cp "$work/STATEMENT" "$RELEASES/$id/.STATEMENT" && settle "$RELEASES/$id/.STATEMENT" &&
                mv -fT "$RELEASES/$id/.STATEMENT" "$RELEASES/$id/STATEMENT"
        } || fail "cannot write $RELEASES/$id"
        return 0
    fi
    incoming=$RELEASES/.incoming-$id
    mkdir -p "$RELEASES" || fail "cannot write $HOME_DIR"
    rm -rf "$work/head.tar"
    same_kb=0
    for each in "$RELEASES/$near" "$HOME_DIR/current" "$RELEASES"/*; do
        [ -n "$near" ] || [ "$each" != "$RELEASES/" ] || continue
        [ -f "$each/SHA256SUMS" ] || continue
        at=$(readlink -f "$each")
        case " ${bases:-} " in *" $at "*) ;; *) bases="${bases:-} $at" ;; esac
    done
    if [ ! -d "$incoming" ]; then
        need_kb=$((bytes / 1024)) have_kb=$(free_kb)
        # Without a size there is still a floor; files of a near release take no room again.
        [ -z "${bases:-}" ] || same_kb=$(shared_kb "$work/SHA256SUMS" $bases)
        [ "$need_kb" -gt "$same_kb" ] && need_kb=$((need_kb - same_kb)) || need_kb=0
        [ "$have_kb" -ge $((need_kb + SPARE_KB)) ] ||
            refuse "the disk is too full: $((have_kb / 1024)) MB free, $(((need_kb + SPARE_KB) / 1024)) MB needed"
        mkdir -m 755 "$incoming" || fail "cannot write $RELEASES"
    fi
    for name in $HEAD_FILES; do
        cp "$work/$name" "$incoming/.$name" && mv -fT "$incoming/.$name" "$incoming/$name" ||
            fail "cannot write $incoming"
    done
    plain_files "$incoming" # of an earlier try that was interrupted
    drop_damaged "$incoming"
    for each in ${bases:-}; do
        link_from "$each" "$incoming"
    done
    missing "$incoming"
}

shared_kb() { # SUMS FOLDER…: how much of a release need not be written again; what several have counts once
    sort "$1" > "$work/wanted"
    shift
    for each in "$@"; do
        (cd "$each" && sort SHA256SUMS | comm -12 - "$work/wanted" | cut -c67- | xargs -r -d '\n' stat -c '%s %n')
    done | sort -u -k 2 | awk '{ sum += $1 } END { printf "%d\n", sum / 1024 }'
}

check_listing() { # LISTING: of a tar -tv; plain files that were asked for, and folders on the way to them
    awk '
        NR == FNR { asked[$0] = 1; for (up = $0; match(up, /\/[^\/]*$/); ) { up = substr(up, 1, RSTART - 1); way[up] = 1 } next }
        { name = $0; sub(/^[^ ]+ +[^ ]+ +[^ ]+ +[^ ]+ +[^ ]+ /, "", name); sub(/^\.\//, "", name) }
        /^d/ { sub(/\/$/, "", name); if (!(name in way) && name != "." && name != "") { print name; exit 1 } next }
        !/^-/ || substr($1, 2, 9) ~ /[sStT]/ || !(name in asked) { print name; exit 1 }
    ' "$work/asked" "$1" > "$work/why"
}

receive() { # stdin: tar of missing files; stdout: what is still missing (exit 1)
    need_id "${1:-}"
    [ $# -eq 1 ] || usage "receive ID"
    id=$1 incoming=$RELEASES/.incoming-$1
    [ ! -d "$RELEASES/$id" ] || return 0
    lock ship 5
    private receive
    [ -f "$incoming/SHA256SUMS" ] || fail "$id is unknown: run \`want\` first"
    check_release "$incoming" "$id"
    missing "$incoming" > "$work/asked"
    mkfifo "$work/copy"
    { # opened once, and read to its end: a writer without a reader, or the reverse, would wait for ever
        tar -tvf - --numeric-owner --quoting-style=literal > "$work/listing" 2> /dev/null
        cat > /dev/null
    } < "$work/copy" &
    listing=$!
    # Only what is asked for, by its full name, is ever created, and never through a link: there is none here.
    unpack | tee "$work/copy" 2>/dev/null | tar -xf - -C "$incoming" --no-same-owner --no-same-permissions \
        --no-recursion --delay-directory-restore --verbatim-files-from -T "$work/asked" 2> "$work/errors" || :
    wait "$listing"
    if ! check_listing "$work/listing"; then
        rm -rf "$incoming"
        refuse "the tar holds a file that was not requested, or no plain file: $(head -n 1 "$work/why")"
    fi
    if [ "$(free_kb)" -lt "$FLOOR_KB" ] && grep -q 'No space left' "$work/errors"; then
        rm -rf "$incoming"
        refuse "the disk is full; the shipment was removed, $(current) stays"
    fi
    plain_files "$incoming"
    if ! whole "$incoming"; then
        drop_damaged "$incoming"
        missing "$incoming" > "$work/missing"
        [ -s "$work/missing" ] || fail "$incoming holds damaged files that cannot be removed: is the disk failing?"
        cat "$work/missing"
        exit 1
    fi
    finish "$incoming" "$id"
}

finish() { # FOLDER ID: nothing extra, plain modes, on the disk; then it gets its name
    { paths "$1/SHA256SUMS"; printf 'SHA256SUMS\nSHA256SUMS.sig\nSTATEMENT\n'; } | sort > "$work/wanted"
    (cd "$1" && find . -type f | cut -c3-) | sort | comm -13 "$work/wanted" - > "$work/extra"
    (cd "$1" && xargs -r -d '\n' rm -f < "$work/extra")
    find "$1" -mindepth 1 -type d -empty -delete
    find "$1" \( -perm /7022 -o -type f ! -perm -444 -o -type d ! -perm -555 \) -exec chmod u=rwX,go=rX {} +
    ! other_user || keep_bytecode "$1" "$2"
    sync -f "$1" 2>/dev/null || sync
    mv -T "$1" "$RELEASES/$2" || fail "cannot name $RELEASES/$2"
    settle "$RELEASES"
}

keep_bytecode() { # FOLDER ID: what Python has compiled of files that stay the same need not be compiled again
    was=$(target_of current) && [ -d "$CACHE/opt/fullswarm/releases/$was" ] || return 0
    tag=$(target_field "$1/manifest.json" python | tr -d .)
    sort "$RELEASES/$was/SHA256SUMS" > "$work/there"
    # All files have the same time, so Python would take the old bytecode of a changed file for the new: by name, too.
    sort "$1/SHA256SUMS" | comm -23 - "$work/there" | cut -c67- |
        sed -n "s|\.py\$|.cpython-$tag.pyc|p" > "$work/stale"
    # As the agent's user, whose folder that is: root follows no link that another has laid.
    as_agent 120 sh -c '
        cd "$1" && rm -rf "$3" "$3.new" && cp -al "$2" "$3.new" && cd "$3.new" && xargs -r -d "\n" rm -f &&
            mv -T "../$3.new" "../$3"
        ' sh "$CACHE/opt/fullswarm/releases" "$was" "$2" < "$work/stale" 2> /dev/null || :
}
