"""One stolen key installs nothing: what robots refuse, and what they accept after keys have changed."""

from __future__ import annotations

import io
import shutil
import tarfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.deploy.release import manifest
from fullswarm.deploy.release.keys import Keys
from fullswarm.deploy.release.signatures import (
    ROOT_NAMESPACE,
    STATEMENT_NAMESPACE,
    SUPPORT_NAMESPACE,
    sign,
    split,
)
from fullswarm.deploy.release.store import gzipped_archive, head_archive, roots_archive
from fullswarm.deploy.release.trust import Root, Statement, support_text
from fullswarm.deploy.robot.support_package import signed, support_package
from tests.unit.deploy_robot.script import Robot

OLD_TOOLS = Path(__file__).parents[2] / "data" / "robot_tools_0_1"
YEAR_S = 365 * 86_400
REFUSED = "opt/fullswarm/trust/refused"


def package(keys: Keys, name: str = "r1", swarm: str = "lab") -> bytes:
    """The support package of a robot, without a statement."""
    config = SwarmConfig(swarm=swarm, robot=(RobotConfig(id=name, driver=f"null://{name}"),))
    return support_package(config.robot[0], config, keys.roots()[-1])


def swarm_of(robot: Robot) -> str:
    return (robot.root / "etc/fullswarm/robot.env").read_text()


def state(folder: Path) -> list[tuple[str, bytes]]:
    """All that could have been installed."""
    files = [each for part in ("etc", "opt") for each in (folder / part).rglob("*") if each.is_file()]
    return sorted((str(each), each.read_bytes()) for each in files if each != folder / REFUSED)


def refused(robot: Robot) -> str:
    """What the robot itself has noted of attacks."""
    return (robot.root / REFUSED).read_text()


def edited(archive: bytes, change: Callable[[str, bytes], bytes | None]) -> bytes:
    """Pack an archive again, with other contents."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=io.BytesIO(archive)) as old, tarfile.open(fileobj=buffer, mode="w") as new:
        for each in old:
            file = old.extractfile(each)
            content = change(each.name, file.read() if file else b"")
            if content is not None:
                each.size = len(content)
                new.addfile(each, io.BytesIO(content))
    return buffer.getvalue()


def stated(release: Path, keys: Keys, **facts: object) -> Path:
    """Sign a statement about a release that says something else."""
    statement = Statement.parse((release / manifest.STATEMENT).read_text(), "test")
    text = replace(statement, **facts).text  # type: ignore[arg-type]
    (release / manifest.STATEMENT).write_text(text + sign(text.encode(), STATEMENT_NAMESPACE, keys.release_key()))
    return release


def send_roots(robot: Robot, keys: Keys) -> str:
    return robot.ok("trust", feed=roots_archive(keys.roots()[1:], 2)).strip()


@pytest.fixture
def at_1970(robot: Robot) -> Robot:
    """A robot without a battery clock, before the network has set it."""
    robot.program("date", f'[ "$1" = +%s ] && exec echo 60; exec {shutil.which("date")} "$@"')
    return robot


# ---------------------------------------------------------------- the support package
def test_a_signed_package_is_installed_and_again_it_changes_nothing(robot: Robot) -> None:
    archive = signed({"r1": package(robot.keys, swarm="hall")}, robot.keys)["r1"]
    assert "changed: etc/fullswarm/robot.env" in robot.ok("install", feed=archive)
    assert 'FULLSWARM_SWARM="hall"' in swarm_of(robot)
    assert robot.ok("install", feed=archive) == ""


def _unsigned(robot: Robot, _: Path) -> bytes:
    return package(robot.keys, swarm="evil")


def _by_a_stranger(robot: Robot, folder: Path) -> bytes:
    stranger = Keys(folder / "stranger")
    return signed({"r1": package(stranger, swarm="evil")}, stranger)["r1"]


def _with_another_installer(robot: Robot, _: Path) -> bytes:
    good = signed({"r1": package(robot.keys, swarm="evil")}, robot.keys)["r1"]
    return edited(good, lambda name, content: b"touch $FULLSWARM_ROOT/etc/owned\n" if name == "install.sh" else content)


def _with_another_file(robot: Robot, _: Path) -> bytes:
    good = signed({"r1": package(robot.keys, swarm="evil")}, robot.keys)["r1"]
    return edited(good, lambda name, content: content + b"\n" if name.endswith("fullswarm-robot") else content)


def _with_two_installers(robot: Robot, _: Path) -> bytes:
    good = signed({"r1": package(robot.keys, swarm="evil")}, robot.keys)["r1"]
    evil = io.BytesIO()
    with tarfile.open(fileobj=evil, mode="w") as tar:
        entry = tarfile.TarInfo("install.sh")
        entry.size = 1
        tar.addfile(entry, io.BytesIO(b"\n"))
    return evil.getvalue()[:1024] + good


def _of_another_robot(robot: Robot, _: Path) -> bytes:
    return signed({"r2": package(robot.keys, "r2", swarm="evil")}, robot.keys)["r2"]


def _with_the_statement_of_another_day(robot: Robot, _: Path) -> bytes:
    before = signed({"r1": package(robot.keys)}, robot.keys)["r1"]
    robot.ok("install", feed=signed({"r1": package(robot.keys)}, robot.keys)["r1"])
    return before


def _expired(robot: Robot, _: Path) -> bytes:
    return _stated_package(robot, int(time.time()) + 9, int(time.time()) - 1, SUPPORT_NAMESPACE)


def _signed_for_releases(robot: Robot, _: Path) -> bytes:
    return _stated_package(robot, int(time.time()) + 9, int(time.time()) + YEAR_S, STATEMENT_NAMESPACE)


def _stated_package(robot: Robot, number: int, expires_s: int, namespace: str) -> bytes:
    good = signed({"r1": package(robot.keys, swarm="evil")}, robot.keys)["r1"]
    with tarfile.open(fileobj=io.BytesIO(good)) as tar:
        file = tar.extractfile("kit.statement")
        assert file is not None
        line = next(each for each in file.read().decode().splitlines() if each.startswith("package r1 "))
    _, _, install, sums = line.split()
    text = support_text(number, expires_s, {"r1": (install, sums)}, rename=False)
    document = (text + sign(text.encode(), namespace, robot.keys.release_key())).encode()
    return edited(good, lambda name, content: document if name == "kit.statement" else content)


@pytest.mark.parametrize(
    ("attack", "why"),
    [
        (_unsigned, "has no kit.statement"),
        (_by_a_stranger, "not one that this robot trusts"),
        (_with_another_installer, "not the one that was signed"),
        (_with_two_installers, "not the one that was signed"),
        (_of_another_robot, "is for r2, this is r1"),
        (_with_the_statement_of_another_day, "before the newest support"),
        (_expired, "its signature expired"),
        (_signed_for_releases, "not one that this robot trusts"),
    ],
)
def test_an_ssh_key_alone_installs_no_package(
    robot: Robot, tmp_path: Path, attack: Callable[[Robot, Path], bytes], why: str
) -> None:
    archive = attack(robot, tmp_path)
    before = state(robot.root)
    assert why in robot.no(3, "install", feed=archive)
    assert state(robot.root) == before
    assert why in refused(robot)
    robot.ok("install", feed=signed({"r1": package(robot.keys, swarm="hall")}, robot.keys)["r1"])
    assert 'FULLSWARM_SWARM="hall"' in swarm_of(robot)


def test_a_file_that_was_changed_after_signing_is_not_installed(robot: Robot, tmp_path: Path) -> None:
    program = robot.root / "opt/fullswarm/bin/fullswarm-robot"
    before = program.read_bytes()
    assert "damaged" in robot.no(1, "install", feed=_with_another_file(robot, tmp_path))
    assert (program.read_bytes(), "evil" in swarm_of(robot)) == (before, False)


def test_a_robot_gets_another_name_only_if_that_is_signed(robot: Robot) -> None:
    other = {"r2": package(robot.keys, "r2")}
    robot.ok("install", feed=signed(other, robot.keys, rename=True)["r2"])
    assert 'ROBOT="r2"' in swarm_of(robot)


def test_a_robot_without_root_metadata_installs_nothing(robot: Robot) -> None:
    (robot.root / "opt/fullswarm/trust/root").unlink()
    assert "trusts no key" in robot.no(3, "install", feed=signed({"r1": package(robot.keys)}, robot.keys)["r1"])
    release = robot.make("1.0.0")
    assert "trusts no key" in robot.no(3, "want", release.name, feed=head_archive(release))


# ---------------------------------------------------------------- releases
def test_an_older_release_is_refused_unless_it_is_signed_for_that(robot: Robot) -> None:
    old = robot.make("1.0.0")
    robot.run_release(robot.make("1.0.1"))
    assert "--allow-older" in robot.no(3, "want", old.name, feed=head_archive(old))
    assert old.name not in robot.releases
    assert "want: it was signed on" in refused(robot)
    number = robot.keys.next_number()
    robot.run_release(stated(old, robot.keys, number=number, older=True))
    assert robot.current == old.name
    assert f"goes back to {old.name}" in (robot.root / "opt/fullswarm/trust/log").read_text()


def test_an_older_release_on_the_disk_is_not_switched_to(two: tuple[Robot, Path, Path]) -> None:
    robot, old, new = two
    robot.ok("switch", new.name)
    robot.ok("commit", new.name)
    assert "before the newest release" in robot.no(3, "switch", old.name)
    assert robot.current == new.name
    robot.ok("rollback")  # to what it ran before, as an operator may ask at any time
    assert robot.current == old.name


def test_a_frozen_release_is_refused_with_what_to_do(robot: Robot) -> None:
    release = stated(robot.make("1.0.0"), robot.keys, expires_s=int(time.time()) - 1)
    said = robot.no(3, "want", release.name, feed=head_archive(release))
    assert "its signature expired" in said
    assert "`fullswarm bundle`" in said
    assert "want: its signature expired" in refused(robot)
    robot.run_release(robot.make("1.0.1"))


def test_a_clock_in_the_past_does_not_make_a_frozen_release_good(at_1970: Robot) -> None:
    robot = at_1970
    first = robot.make("1.0.0")
    robot.run_release(first)  # which was signed long after what its clock shows
    number = Statement.parse((first / manifest.STATEMENT).read_text(), "test").number
    frozen = stated(robot.make("1.0.1"), robot.keys, number=number + 1, expires_s=number - 1)
    assert "its signature expired" in robot.no(3, "want", frozen.name, feed=head_archive(frozen))


def _statement_of_another(release: Path, other: Path) -> None:
    shutil.copy(other / manifest.STATEMENT, release / manifest.STATEMENT)


def _sums_of_another(release: Path, other: Path) -> None:
    for each in (manifest.SUMS, manifest.SIGNATURE):
        shutil.copy(other / each, release / each)


def _manifest_of_another(release: Path, other: Path) -> None:
    shutil.copy(other / manifest.MANIFEST, release / manifest.MANIFEST)


def _no_statement(release: Path, _: Path) -> None:
    (release / manifest.STATEMENT).write_text("\n")


def _edited_statement(release: Path, _: Path) -> None:
    statement = release / manifest.STATEMENT
    statement.write_text(statement.read_text().replace("expires 1", "expires 9"))


@pytest.mark.parametrize(
    "mix", [_statement_of_another, _sums_of_another, _manifest_of_another, _no_statement, _edited_statement]
)
def test_parts_of_two_releases_never_mix(robot: Robot, mix: Callable[[Path, Path], None]) -> None:
    release, other = robot.make("1.0.0"), robot.make("1.0.1")
    mix(release, other)
    robot.no(3, "want", release.name, feed=head_archive(release))
    robot.no(3, "want", other.name, feed=head_archive(release))
    assert not list((robot.root / "opt/fullswarm/releases").iterdir())
    assert refused(robot).count(" want: ") == 2
    robot.run_release(other)
    assert robot.current == other.name


def test_a_file_of_another_release_is_not_taken_for_the_own(robot: Robot) -> None:
    release, other = robot.make("1.0.0"), robot.make("1.0.1")
    stated(release, robot.keys, number=robot.keys.next_number())
    missing = robot.want(release)
    robot.no(1, "receive", release.name, feed=b"".join(gzipped_archive(other, missing)))
    assert release.name not in robot.releases


# ---------------------------------------------------------------- keys change
def test_a_new_release_key_is_trusted_and_the_old_one_until_it_is_revoked(robot: Robot) -> None:
    keys, old_key = robot.keys, (robot.keys.root().releases[0].key)
    first = robot.make("1.0.0")
    keys.rotate_release_key()
    assert send_roots(robot, keys) == "2"
    robot.run_release(first)
    keys.rotate_release_key(revoked=[old_key])
    assert send_roots(robot, keys) == "3"
    second = robot.make("1.0.1")
    robot.run_release(second)
    assert "not one that this robot trusts" in robot.no(3, "want", first.name, feed=head_archive(first))
    assert "no longer trusts" in robot.no(3, "rollback")
    assert robot.current == second.name
    assert (robot.root / "opt/fullswarm/trust/log").read_text().count("trusts root metadata") == 2


def test_a_release_key_that_robots_do_not_know_yet_is_refused(robot: Robot) -> None:
    robot.keys.rotate_release_key()
    release = robot.make("1.0.0")
    assert "not one that this robot trusts" in robot.no(3, "want", release.name, feed=head_archive(release))
    send_roots(robot, robot.keys)
    robot.run_release(release)


def test_an_expired_release_key_signs_nothing(robot: Robot) -> None:
    release = robot.make("1.0.0")
    trusted = robot.root / "opt/fullswarm/trust/root"
    root = Root.parse(trusted.read_text())
    trusted.write_text(replace(root, releases=(replace(root.releases[0], until_s=int(time.time()) - 1),)).text)
    robot.no(3, "want", release.name, feed=head_archive(release))
    trusted.write_text(replace(root, expires_s=int(time.time()) - 1).text)
    assert "root metadata expired" in robot.no(3, "want", release.name, feed=head_archive(release))


def test_a_stolen_release_key_does_not_keep_out_its_successor(robot: Robot) -> None:
    keys, stolen = robot.keys, robot.keys.root().releases[0].key
    robot.run_release(stated(robot.make("6.6.6"), keys, number=int(time.time()) + YEAR_S, expires_s=9_999_999_999))
    keys.rotate_release_key(revoked=[stolen])
    send_roots(robot, keys)
    robot.run_release(robot.make("1.0.0"))


def successor(keys: Keys, **facts: object) -> Root:
    root = keys.root()
    return replace(root, version=root.version + 1, **facts)  # type: ignore[arg-type]


def signed_by(root: Root, *private: Path) -> str:
    return root.text + "".join(sign(root.text.encode(), ROOT_NAMESPACE, each) for each in private)


def root_key(keys: Keys, number: int) -> Path:
    return keys.folder / f"root/{number}_ed25519"


def _one_of_the_root_keys(keys: Keys, thief: Keys) -> tuple[int, str]:
    return 2, signed_by(successor(keys, releases=thief.root().releases), root_key(keys, 1))


def _one_root_key_twice(keys: Keys, thief: Keys) -> tuple[int, str]:
    return 2, signed_by(successor(keys, releases=thief.root().releases), root_key(keys, 1), root_key(keys, 1))


def _the_release_key(keys: Keys, thief: Keys) -> tuple[int, str]:
    return 2, signed_by(successor(keys, releases=thief.root().releases), keys.release_key(), keys.release_key())


def _keys_of_the_thief(keys: Keys, thief: Keys) -> tuple[int, str]:
    root = replace(thief.root(), version=2)
    return 2, signed_by(root, *(root_key(thief, each) for each in (1, 2, 3)))


def _a_lower_threshold(keys: Keys, thief: Keys) -> tuple[int, str]:
    return 2, signed_by(successor(keys, threshold=1), root_key(keys, 1))


def _signed_for_another_purpose(keys: Keys, thief: Keys) -> tuple[int, str]:
    text = successor(keys, releases=thief.root().releases).text
    made = [sign(text.encode(), STATEMENT_NAMESPACE, root_key(keys, each)) for each in (1, 2)]
    return 2, text + "".join(made)


def _another_version(keys: Keys, thief: Keys) -> tuple[int, str]:
    root = replace(successor(keys), version=7)
    return 2, signed_by(root, root_key(keys, 1), root_key(keys, 2))


def _without_release_keys(keys: Keys, thief: Keys) -> tuple[int, str]:
    return 2, signed_by(successor(keys, releases=()), root_key(keys, 1), root_key(keys, 2))


def _changed_after_signing(keys: Keys, thief: Keys) -> tuple[int, str]:
    document = signed_by(successor(keys), root_key(keys, 1), root_key(keys, 2))
    text, signatures = split(document)
    return 2, text.replace("threshold 2", "threshold 1") + "".join(signatures)


@pytest.mark.parametrize(
    "attack",
    [
        _one_of_the_root_keys, _one_root_key_twice, _the_release_key, _keys_of_the_thief, _a_lower_threshold,
        _signed_for_another_purpose, _another_version, _without_release_keys, _changed_after_signing,
    ],
)  # fmt: skip
def test_one_stolen_key_changes_nothing_that_is_trusted(
    robot: Robot, tmp_path: Path, attack: Callable[[Keys, Keys], tuple[int, str]]
) -> None:
    thief = Keys(tmp_path / "thief")
    before = state(robot.root)
    number, document = attack(robot.keys, thief)
    robot.no(3, "trust", feed=roots_archive([document], number))
    assert state(robot.root) == before
    assert " trust: root metadata 2" in refused(robot)
    robot.keys.rotate_release_key()
    assert send_roots(robot, robot.keys) == "2"


def test_the_log_of_refusals_has_an_end_and_no_line_of_the_attacker(robot: Robot) -> None:
    (robot.root / REFUSED).write_text("".join(f"{number} old\n" for number in range(500)))
    release, other = robot.make("1.0.0"), robot.make("1.0.1")
    _statement_of_another(release, other)
    robot.no(3, "want", release.name, feed=head_archive(release))
    lines = refused(robot).splitlines()
    assert len(lines) == 200
    assert "want: the statement is about" in lines[-1]


def test_old_root_metadata_and_those_behind_a_gap_are_passed_over(robot: Robot) -> None:
    robot.keys.rotate_release_key()
    robot.keys.rotate_release_key()
    documents = robot.keys.roots()
    assert robot.ok("trust", feed=roots_archive(documents[2:], 3)) == "1\n"
    assert robot.ok("trust", feed=roots_archive(documents, 1)) == "3\n"
    assert robot.ok("trust", feed=roots_archive(documents[:2], 1)) == "3\n"
    assert robot.facts["root_version"] == 3


# ---------------------------------------------------------------- robots of older releases
def test_a_robot_with_older_tools_updates_and_trusts_after_its_next_deploy(robot: Robot) -> None:
    for each in OLD_TOOLS.iterdir():
        shutil.copyfile(each, robot.root / "opt/fullswarm/bin" / each.name)
    (robot.root / "opt/fullswarm/bin/robot-trust.sh").unlink()
    shutil.rmtree(robot.root / "opt/fullswarm/trust")
    (robot.root / "etc/fullswarm/allowed_signers").write_text(robot.keys.allowed_signers())
    robot.run_release(robot.make("1.0.0"))
    assert "root_version" not in robot.facts
    robot.ok("install", feed=signed({"r1": package(robot.keys)}, robot.keys)["r1"])
    assert robot.facts["root_version"] == 1
    assert not (robot.root / "etc/fullswarm/allowed_signers").exists()
    assert "has no kit.statement" in robot.no(3, "install", feed=package(robot.keys))
    robot.run_release(robot.make("1.0.1"))
    robot.ok("rollback")  # to a release that older tools have installed
