"""`fullswarm bundle`: makes signed releases."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from fullswarm.cli.options import Json, shell_command

FIT_ON_AIR = 6
"""Compression level of the size that is printed: what a robot gets is compressed with it."""


@shell_command(needs="posix")
def bundle(
    target: Annotated[str, typer.Option("--target", metavar="NAME", help="rpi-arm64, jetson or x86_64.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            envvar="FULLSWARM_RELEASES",
            metavar="DIR",
            help="Folder of the releases (default: the user's data folder).",
        ),
    ] = None,
    python: Annotated[
        str | None,
        typer.Option("--python", metavar="3.13", help="Python version of the robots (default: the target's)."),
    ] = None,
    extras: Annotated[
        list[str] | None,
        typer.Option("--with", metavar="EXTRA", help="Extras, separated by commas: keys, mavlink, can, core."),
    ] = None,
    packages: Annotated[
        list[Path] | None,
        typer.Option(
            "--package", metavar="WHEEL|FOLDER", help="Add a package with behaviours or drivers; may be repeated."
        ),
    ] = None,
    wheels: Annotated[
        Path | None, typer.Option("--wheels", metavar="DIR", help="Take all wheels from this folder: no internet.")
    ] = None,
    upgrade: Annotated[
        bool, typer.Option("--upgrade", help="Take the newest packages, not those of the latest release.")
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the contents, make nothing.")] = False,
    as_json: Json = False,
) -> int:
    """Make a release: all that a robot runs, in one signed folder. The same input gives the same bytes.

    64-bit systems only. Raspberry Pi OS Bookworm has Python 3.11, Trixie 3.13; JetPack 7 has 3.12, JetPack 6 needs
    `apt install python3.11`.
    """
    from fullswarm.deploy.release import targets
    from fullswarm.deploy.release.bundle import BundleRequest
    from fullswarm.deploy.release.store import Store

    names = tuple(name.strip() for each in extras or () for name in each.split(",") if name.strip())
    request = BundleRequest(targets.target(target, python), names, tuple(packages or ()), upgrade, wheels)
    store = Store.default() if out is None else Store(out)
    return _print_plan(request, store, as_json) if dry_run else _make(request, store, as_json)


def _print_plan(request: Any, store: Any, as_json: bool) -> int:
    from fullswarm import output
    from fullswarm.deploy.release import bundle as maker

    packages = maker.plan(request, store)
    if as_json:
        output.data_json({"target": request.target.name, "python": request.target.python, "packages": dict(packages)})
    else:
        for name, version in sorted(packages.items()):
            output.data(f"{name} {version}")
    return 0


def _make(request: Any, store: Any, as_json: bool) -> int:
    from fullswarm import output
    from fullswarm.deploy.release import bundle as maker
    from fullswarm.deploy.release import manifest
    from fullswarm.deploy.release.keys import Keys
    from fullswarm.deploy.release.manifest import Manifest
    from fullswarm.deploy.release.store import HEAD, gzipped_archive

    before = store.latest(request.target.name, request.target.python)
    old = {} if before is None else manifest.read_sums(before)
    made = maker.make(request, store, Keys.default(), output.progress)
    new = manifest.read_sums(made)
    changed = [path for path, digest in new.items() if old.get(path) != digest]
    facts = {
        "id": made.name,
        "folder": str(made),
        "target": request.target.name,
        "python": request.target.python,
        "packages": dict(Manifest.read(made).packages),
        "files": len(new),
        "bytes": _size(made, new),
        "since": None if before is None else before.name,
        "changed_files": len(changed),
        "changed_bytes_gzipped": sum(
            len(block) for paths in (HEAD, changed) for block in gzipped_archive(made, paths, FIT_ON_AIR)
        ),
    }
    if as_json:
        output.data_json(facts)
        return 0
    if made == before:
        output.progress("nothing changed: this release exists already")
        output.data(str(made))
        return 0
    since = "a first install carries" if before is None else f"an update from {before.name} carries"
    output.progress(
        f"{facts['files']} files, {_megabytes(facts['bytes'])}; {since} {_megabytes(facts['changed_bytes_gzipped'])}"
    )
    output.data(str(made))
    return 0


def _size(folder: Path, paths: Any) -> int:
    return sum((folder / each).stat().st_size for each in paths)


def _megabytes(size: Any) -> str:
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{size / 1e3:.0f} kB"
