"""`fullswarm signing`: which keys robots trust, and how they are replaced."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fullswarm import output
from fullswarm.cli.options import Json, Yes, shell_command
from fullswarm.errors import ConfigError

if TYPE_CHECKING:
    from fullswarm.deploy.release.keys import Keys
    from fullswarm.deploy.release.trust import Root

signing_app = typer.Typer(help="List, replace and revoke the keys whose releases robots accept.", no_args_is_help=True)

RootKeys = Annotated[
    list[Path] | None,
    typer.Option("--root-key", metavar="FILE", help="A private root key on another medium; may be repeated."),
]
Fresh = Annotated[
    Path | None,
    typer.Option(
        "--key",
        metavar="FILE",
        help="A private key that `ssh-keygen` made, with a passphrase or for a FIDO security key (default: make one).",
    ),
]


@signing_app.command(name="list")
@shell_command()
def show(as_json: Json = False) -> int:
    """List the keys that robots trust, how long they hold, and where the private ones are."""
    from fullswarm.deploy.release.keys import Keys
    from fullswarm.deploy.release.trust import day_of

    keys = Keys.default()
    rows = _rows(keys)
    root = keys.root()
    if as_json:
        facts = {"version": root.version, "expires_s": root.expires_s, "threshold": root.threshold}
        output.data_json({**facts, "keys": rows})
        return 0
    table = output.plain_table("role", "key", "until", "private key", "state")
    for each in rows:
        until = "-" if each["until_s"] is None else day_of(each["until_s"])
        table.add_row(each["role"], each["fingerprint"], until, each["file"] or "not here", each["state"])
    output.data_table(table, into_file=140)
    output.progress(
        f"root metadata: version {root.version}, until {day_of(root.expires_s)}; "
        f"{root.threshold} of {len(root.roots)} root keys replace keys"
    )
    here = [each for each in rows if each["role"] == "root" and each["file"]]
    if len(here) >= root.threshold:
        output.progress(f"move the root keys to separate media, away from this computer: {keys.folder / 'root'}")
    return 0


def _rows(keys: Keys) -> list[dict[str, Any]]:
    import time

    from fullswarm.deploy.release.keys import fingerprint_of
    from fullswarm.deploy.release.trust import Root

    documents = keys.roots()
    now, root = time.time(), Root.parse(documents[-1])
    private = keys.private_files()
    rows: list[dict[str, Any]] = []

    def add(role: str, key: str, until_s: int | None, state: str) -> None:
        file = str(private[key]) if key in private else ""
        rows.append(
            {"role": role, "fingerprint": fingerprint_of(key), "until_s": until_s, "file": file, "state": state}
        )

    for number, each in enumerate(root.releases):
        state = "expired" if each.until_s <= now else "signs" if number == 0 else "accepted"
        add("release", each.key, each.until_s, state)
    for key in root.roots:
        add("root", key, root.expires_s, "accepted")
    held = {each.key for each in root.releases}
    for document in reversed(documents[:-1]):
        for each in Root.parse(document).releases:
            if each.key not in held:
                held.add(each.key)
                add("release", each.key, None, "expired" if each.until_s <= now else "revoked")
    return rows


@signing_app.command()
@shell_command(needs="posix")
def rotate(key: Fresh = None, root_key: RootKeys = None) -> int:
    """Make another key the release key; robots accept the old one until it expires.

    Renews the life of the root metadata, too. Robots learn of it with the next `deploy` or `update`.
    """
    from fullswarm.deploy.release.keys import Keys

    keys = Keys.default()
    return _changed(
        keys, keys.rotate_release_key(key, root_key or ()), "update the robots: `fullswarm bundle`, `update`"
    )


@signing_app.command()
@shell_command(needs="posix")
def revoke(
    fingerprint: Annotated[
        str | None, typer.Argument(metavar="[SHA256:…]", help="The release key (default: the one that signs now).")
    ] = None,
    key: Fresh = None,
    root_key: RootKeys = None,
    yes: Yes = False,
) -> int:
    """Let robots no longer accept a release key, for example a stolen one, and sign with another.

    Robots learn of it with the next `deploy` or `update`; what the key has signed must be bundled again.
    """
    from fullswarm.deploy.release.keys import Keys, fingerprint_of

    keys = Keys.default()
    root = keys.root()
    prints = {fingerprint_of(each.key): each.key for each in root.releases}
    wanted = fingerprint_of(root.releases[0].key) if fingerprint is None else fingerprint
    if wanted not in prints:
        raise ConfigError(
            f"robots trust no release key {wanted}", where="signing revoke", hint="`fullswarm signing list`"
        )
    if not yes:
        typer.confirm(f"Revoke {wanted}? What it has signed must be bundled again", abort=True, err=True)
    made = keys.rotate_release_key(key, root_key or (), revoked=[prints[wanted]])
    return _changed(keys, made, "now `fullswarm bundle`, and `fullswarm update` all robots")


@signing_app.command()
@shell_command(needs="posix")
def root(
    add: Annotated[
        list[Path] | None, typer.Option("--add", metavar="FILE.pub", help="Another root key; may be repeated.")
    ] = None,
    remove: Annotated[
        list[str] | None, typer.Option("--remove", metavar="SHA256:…", help="A lost or stolen root key.")
    ] = None,
    threshold: Annotated[
        int | None, typer.Option("--threshold", min=1, max=9, metavar="N", help="Root keys that replace keys.")
    ] = None,
    root_key: RootKeys = None,
) -> int:
    """Replace root keys, or renew the life of the root metadata.

    Needs as many root keys as the present threshold says, and as the new one says.
    """
    from dataclasses import replace

    from fullswarm.deploy.release.keys import Keys, bare_key, fingerprint_of

    keys = Keys.default()
    fresh = [bare_key(each.with_suffix("") if each.suffix == ".pub" else each) for each in add or ()]

    def change(before: Root) -> Root:
        prints = {fingerprint_of(each): each for each in before.roots}
        if unknown := [each for each in remove or () if each not in prints]:
            raise ConfigError(f"no root key {unknown[0]}", where="signing root", hint="`fullswarm signing list`")
        gone = {prints[each] for each in remove or ()}
        roots = tuple(each for each in (*before.roots, *fresh) if each not in gone)
        return replace(before, roots=roots, threshold=threshold or before.threshold)

    return _changed(keys, keys.change_root(change, root_key or ()), "update the robots: `fullswarm update`")


def _changed(keys: Keys, made: Root, then: str) -> int:
    from fullswarm.deploy.release.keys import fingerprint

    output.data(f"release key {fingerprint(keys.release_key())}, root metadata version {made.version}")
    output.progress(f"robots learn of it with the next `deploy` or `update`; {then}")
    return 0
