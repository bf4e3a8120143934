"""What a release costs: ``python -m benchmarks.release [--target rpi-arm64] [--with can,mavlink] [--json]``.

Needs a package index. The reference for the size is what uv installs for the same target before we trim it; for an
update it is the whole release, which is what a wheelhouse, a container layer or an image carries each time. Sizes on
air are of the gzipped tar that robots get.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from fullswarm.deploy.release import bundle, contents, manifest, targets
from fullswarm.deploy.release.keys import Keys
from fullswarm.deploy.release.packages import Wanted, install_packages
from fullswarm.deploy.release.store import HEAD, Store, gzipped_archive


@dataclass
class Row:
    """One release against its references; sizes in bytes."""

    target: str
    files: int
    disk: int
    disk_untrimmed: int
    air: int
    air_untrimmed: int
    first_s: float  # with a cache of wheels that may be cold
    again_s: float
    update_air: int  # after a change of one file of fullswarm
    update_disk: int
    update_s: float


def _disk(folder: Path, paths: list[str]) -> int:
    return sum((folder / each).stat().st_size for each in paths)


def _air(folder: Path, paths: list[str]) -> int:
    return sum(map(len, gzipped_archive(folder, paths)))


def _timed(request: bundle.BundleRequest, store: Store, keys: Keys) -> tuple[Path, float]:
    began = time.perf_counter()
    return bundle.make(request, store, keys), time.perf_counter() - began


def _untrimmed(request: bundle.BundleRequest, store: Store, place: Path) -> Path:
    """Return a folder with the same packages as uv leaves them, and all of fullswarm."""
    work, tree = place / "work", place / "untrimmed"
    work.mkdir()
    wanted = Wanted(request.target, request.extras)
    install_packages(wanted, bundle.plan(request, store), work, tree / "lib")
    shutil.copytree(contents.OWN, tree / "app" / "fullswarm", ignore=shutil.ignore_patterns("__pycache__"))
    return tree


def measure(request: bundle.BundleRequest, place: Path) -> Row:
    """Return the figures of a release, of its making, and of an update that changes one file."""
    store, keys = Store(place / "store"), Keys(place / "keys")
    first, first_s = _timed(request, store, keys)
    _, again_s = _timed(request, store, keys)
    paths = sorted(manifest.read_sums(first))
    raw = _untrimmed(request, store, place)
    raw_paths = list(manifest.files_of(raw))
    changed = place / "fullswarm"
    shutil.copytree(contents.OWN, changed, ignore=shutil.ignore_patterns("__pycache__"))
    with (changed / "agent" / "node.py").open("a") as file:
        file.write("# a change\n")
    contents.OWN = changed
    second, update_s = _timed(request, store, keys)
    old, new = manifest.read_sums(first), manifest.read_sums(second)
    update = [path for path in new if old.get(path) != new[path]]
    sole = [each for each in manifest.files_of(second) if (second / each).stat().st_nlink == 1]
    return Row(
        request.target.name,
        len(paths),
        _disk(first, paths),
        _disk(raw, raw_paths),
        _air(first, [*HEAD]) + _air(first, paths),
        _air(raw, raw_paths),
        first_s,
        again_s,
        _air(second, [*HEAD]) + _air(second, update),
        _disk(second, [*sole, manifest.SUMS, manifest.SIGNATURE]),
        update_s,
    )


def main() -> int:
    """Print the figures; return 1 when an update that changes one file carries a megabyte or more."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--target", default="rpi-arm64")
    parser.add_argument("--with", dest="extras", default="can,mavlink")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    extras = tuple(filter(None, options.extras.split(",")))
    with tempfile.TemporaryDirectory() as place:
        row = measure(bundle.BundleRequest(targets.target(options.target), extras), Path(place))
    if options.json:
        print(json.dumps(asdict(row), indent=2))
    else:
        print(
            f"{row.target} [{options.extras}]: {row.files} files; first {row.first_s:.1f} s, again {row.again_s:.1f} s"
        )
        for name, ours, theirs, reference in (
            ("on disk", row.disk, row.disk_untrimmed, "untrimmed"),
            ("on air", row.air, row.air_untrimmed, "untrimmed"),
            ("update, on air", row.update_air, row.air, "the whole release"),
            ("update, on disk", row.update_disk, row.disk, "the whole release"),
        ):
            print(f"{name:16} {ours / 1e6:8.3f} MB   {theirs / 1e6:8.3f} MB {reference:18} ratio {ours / theirs:.4f}")
    return 0 if row.update_air < 1_000_000 else 1


if __name__ == "__main__":
    raise SystemExit(main())
