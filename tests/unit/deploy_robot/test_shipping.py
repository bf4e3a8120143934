"""A release comes in: only what differs, whole, signed by us, for this machine, and without tricks."""

from __future__ import annotations

import io
import shutil
import subprocess
import tarfile
from pathlib import Path

import pytest

from fullswarm.deploy.release.keys import Keys
from fullswarm.deploy.release.manifest import Target
from fullswarm.deploy.release.store import head_archive, plain_archive
from tests.deploy_release import tiny_release
from tests.unit.deploy_robot.script import Robot


def test_only_what_differs_is_wanted(two: tuple[Robot, Path, Path]) -> None:
    robot, old, new = two
    third = robot.make("1.0.2")
    assert robot.want(third) == ["app/fullswarm/__init__.py"]
    robot.ship(third)
    inside = robot.root / "opt/fullswarm/releases"
    assert (inside / old.name / "lib/big.py").samefile(inside / third.name / "lib/big.py")
    assert robot.make("1.0.1") == new  # signed anew
    assert robot.want(new) == []  # it is there
    robot.check()


def test_a_shipment_that_was_cut_goes_on(robot: Robot) -> None:
    release = robot.make("1.0.0", {"app/one.bin": bytes(300_000), "app/two.py": "2"})
    missing = robot.want(release)
    archive = b"".join(plain_archive(release, sorted(missing)))
    assert robot.call("receive", release.name, feed=archive[:150_000]).returncode == 1
    assert set(robot.want(release)) == set(missing)  # the half file is not taken for a whole one
    robot.ok("receive", release.name, feed=archive)
    robot.check()
    assert robot.releases == {release.name}


def test_a_file_that_rotted_comes_again(two: tuple[Robot, Path, Path]) -> None:
    robot, old, _ = two
    (robot.root / "opt/fullswarm/releases" / old.name / "lib/big.py").write_text("rotten")
    third = robot.make("1.0.2")
    missing = robot.want(third)
    done = robot.call("receive", third.name, feed=b"".join(plain_archive(third, missing)))
    assert (done.returncode, done.stdout.decode().split()) == (1, ["lib/big.py"])
    robot.ok("receive", third.name, feed=b"".join(plain_archive(third, ["lib/big.py"])))


def test_a_file_that_cannot_be_read_comes_again_too(two: tuple[Robot, Path, Path]) -> None:
    robot, _, _ = two
    third = robot.make("1.0.2")
    missing = robot.want(third)
    (robot.root / "rot").touch()
    robot.program(
        "sha256sum",
        f"""
        [ -e "$FULLSWARM_ROOT/rot" ] && case "$*" in
        *--status*) exit 1 ;;
        *--quiet*) rm "$FULLSWARM_ROOT/rot"; echo 'lib/big.py: FAILED open or read'; exit 1 ;;
        esac
        exec {shutil.which("sha256sum")} "$@\"""",
    )
    done = robot.call("receive", third.name, feed=b"".join(plain_archive(third, missing)))
    assert (done.returncode, done.stdout.decode().split()) == (1, ["lib/big.py"])
    robot.ok("receive", third.name, feed=b"".join(plain_archive(third, ["lib/big.py"])))
    robot.check()


def test_nothing_is_called_a_release_that_is_damaged_for_good(robot: Robot) -> None:
    release = robot.make("1.0.0")
    missing = robot.want(release)
    robot.program("sha256sum", f'case "$*" in *-c*) exit 1 ;; esac\nexec {shutil.which("sha256sum")} "$@"')
    robot.no(1, "receive", release.name, feed=b"".join(plain_archive(release, missing)))
    assert robot.releases == set()


def test_room_that_two_releases_share_counts_once(two: tuple[Robot, Path, Path]) -> None:
    robot, _, _ = two
    third = robot.make("1.0.2")
    free_kb = 65536 + 5  # beyond what stays free: 5 kB, for 20 kB of which 8 are there already, in two releases
    robot.program("df", f"printf 'head\\nx 1 1 {free_kb} 1 /\\n'")
    said = robot.no(3, "want", third.name, "--bytes", str(20 * 1024), feed=head_archive(third))
    assert "too full" in said
    robot.ok("want", third.name, "--bytes", str(12 * 1024), feed=head_archive(third))


def test_a_foreign_or_stale_signature_is_refused_before_anything_is_written(robot: Robot, tmp_path: Path) -> None:
    foreign = robot.make("1.0.0", keys=Keys(tmp_path / "others"))
    said = robot.no(3, "want", foreign.name, feed=head_archive(foreign))
    assert "signature" in said
    stale = robot.make("1.0.1")
    (stale / "SHA256SUMS").write_bytes((stale / "SHA256SUMS").read_bytes().replace(b"0", b"1"))
    robot.no(3, "want", stale.name, feed=head_archive(stale))
    assert list((robot.root / "opt/fullswarm/releases").iterdir()) == []


def test_a_release_under_another_name_is_refused(robot: Robot) -> None:
    release = robot.make("1.0.0")
    robot.no(3, "want", "1.0.0-000000000000", feed=head_archive(release))
    for evil in ("../../etc", ".hidden", "-n", "a/b", ""):
        robot.no(2, "want", evil, feed=head_archive(release))


def test_a_release_for_another_machine_is_refused(robot: Robot) -> None:
    for target, word in (
        (Target("rpi-arm64", "aarch64", "2.28", "3.11"), "aarch64"),
        (Target("x86_64", "x86_64", "9.99", "3.11"), "glibc 9.99"),
        (Target("x86_64", "x86_64", "2.28", "3.99"), "python 3.99"),
    ):
        release = tiny_release(robot.store, robot.keys, target=target)
        assert word in robot.no(3, "want", release.name, feed=head_archive(release))
    assert list((robot.root / "opt/fullswarm/releases").iterdir()) == []


def test_a_disk_without_room_is_known_before(robot: Robot) -> None:
    release = robot.make("1.0.0")
    assert "too full" in robot.no(3, "want", release.name, "--bytes", str(10**16), feed=head_archive(release))


def _tar(*members: tuple[tarfile.TarInfo, bytes]) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        for entry, content in members:
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))
    return buffer.getvalue()


def _entry(name: str, kind: bytes = tarfile.REGTYPE, link: str = "", mode: int = 0o644) -> tarfile.TarInfo:
    entry = tarfile.TarInfo(name)
    entry.type, entry.linkname, entry.mode = kind, link, mode
    return entry


TRICKS = {
    "absolute": _entry("/etc/owned"),
    "dots": _entry("../../../etc/owned"),
    "dots within": _entry("app/../../owned"),
    "nobody asked": _entry("app/more.py"),
    "symlink": _entry("app/fullswarm/__init__.py", tarfile.SYMTYPE, "/etc/passwd"),
    "folder link": _entry("app", tarfile.SYMTYPE, "/tmp"),
    "hard link": _entry("app/fullswarm/__init__.py", tarfile.LNKTYPE, "/etc/passwd"),
    "device": _entry("app/fullswarm/__init__.py", tarfile.CHRTYPE),
    "fifo": _entry("app/fullswarm/__init__.py", tarfile.FIFOTYPE),
    "setuid": _entry("app/fullswarm/__init__.py", mode=0o4755),
    "newline": _entry("app/fullswarm/__init__.py\nx"),
}


@pytest.mark.parametrize("trick", sorted(TRICKS))
def test_a_tar_with_tricks_is_refused(robot: Robot, trick: str) -> None:
    release = robot.make("1.0.0")
    missing = robot.want(release)
    content = b"x" if TRICKS[trick].type == tarfile.REGTYPE else b""
    good = b"".join(plain_archive(release, missing))[: -2 * 512]  # without its end
    robot.no(3, "receive", release.name, feed=good + _tar((TRICKS[trick], content)))
    assert list((robot.root / "opt/fullswarm/releases").iterdir()) == []
    assert not list(robot.folder.rglob("owned"))


def test_gzip_zstd_and_plain_are_all_taken(robot: Robot) -> None:
    for version, squeeze in (("1.0.0", ["gzip", "-c"]), ("1.0.1", ["zstd", "-qc"]), ("1.0.2", ["cat"])):
        release = robot.make(version)
        plain = b"".join(plain_archive(release, robot.want(release)))
        squeezed = subprocess.run(squeeze, input=plain, capture_output=True, check=True).stdout
        robot.ok("receive", release.name, feed=squeezed)
    robot.check()
    assert len(robot.releases) == 3
