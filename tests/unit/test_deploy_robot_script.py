"""What ``fullswarm-robot`` does, on the real script in a folder of its own."""

from __future__ import annotations

import io
import os
import re
import shutil
import subprocess
import tarfile
from pathlib import Path

import pytest

from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.deploy.release import pack
from fullswarm.deploy.release.keys import Keys
from fullswarm.deploy.release.manifest import Target
from fullswarm.deploy.robot import kit, kit_id
from fullswarm.deploy.robot.kit import fleet_file
from fullswarm.errors import ConfigError
from tests.deploy_release import tiny_release
from tests.unit.robot_script import PROGRAMS, Robot

SCRIPTS = ("fullswarm-robot", "robot-shipping.sh", "robot-facts.sh", "install.sh")


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return Robot(tmp_path_factory.mktemp("bare"))


@pytest.fixture(scope="module")
def running(bare: Robot, tmp_path_factory: pytest.TempPathFactory) -> tuple[Robot, Path, Path]:
    robot = bare.copy(tmp_path_factory.mktemp("running") / "robot")
    old, new = robot.make("1.0.0"), robot.make("1.0.1")
    robot.run_release(old)
    robot.ship(new)
    return robot, old, new


@pytest.fixture
def robot(bare: Robot, tmp_path: Path) -> Robot:
    return bare.copy(tmp_path / "robot")


@pytest.fixture
def two(running: tuple[Robot, Path, Path], tmp_path: Path) -> tuple[Robot, Path, Path]:
    """A robot that runs the first of two releases and has the second."""
    robot, old, new = running
    return robot.copy(tmp_path / "robot"), old, new


@pytest.mark.parametrize("name", SCRIPTS)
def test_the_scripts_are_posix_shell(name: str) -> None:
    assert subprocess.run(["dash", "-n", PROGRAMS / name], check=False).returncode == 0
    assert len((PROGRAMS / name).read_text().splitlines()) <= 400


# ---------------------------------------------------------------------- the kit
def test_the_same_robot_gets_the_same_kit_and_the_robot_names_it(robot: Robot) -> None:
    config = SwarmConfig(robot=(RobotConfig(id="r1", driver="null://r1"),))
    one = kit(config.robot[0], config, robot.keys.allowed_signers())
    assert one == kit(config.robot[0], config, robot.keys.allowed_signers())
    assert robot.facts["kit"] == kit_id(one)
    (robot.root / "etc/udev/rules.d/60-fullswarm-ports.rules").write_text("# somebody was here\n")
    assert robot.facts["kit"] is None


def test_installing_again_changes_nothing(robot: Robot) -> None:
    assert robot.install_kit() == ""
    (robot.root / "etc/systemd/system/fullswarm-agent.service").unlink()
    assert robot.install_kit() == "changed: etc/systemd/system/fullswarm-agent.service\n"


def test_a_damaged_kit_changes_nothing(robot: Robot, tmp_path: Path) -> None:
    config = SwarmConfig(robot=(RobotConfig(id="r2", driver="null://r2"),))
    with tarfile.open(fileobj=io.BytesIO(kit(config.robot[0], config, ""))) as tar:
        tar.extractall(tmp_path / "spread", filter="data")
    (tmp_path / "spread/files/etc/fullswarm/robot.env").write_text('ROBOT="evil"\n')
    done = subprocess.run(["sh", tmp_path / "spread/install.sh"], env=robot.environment, capture_output=True, text=True)
    assert (done.returncode, "damaged" in done.stderr) == (1, True)
    assert 'ROBOT="r1"' in (robot.root / "etc/fullswarm/robot.env").read_text()


def test_a_file_that_cannot_be_written_ends_the_installation_and_says_so(robot: Robot) -> None:
    rules, whole = robot.root / "etc/udev/rules.d/60-fullswarm-ports.rules", robot.facts["kit"]
    rules.write_text("# somebody was here\n")
    robot.program("cp", f'case "$*" in *ports.rules*) exit 1 ;; esac\nexec {shutil.which("cp")} "$@"')
    done = robot.install()
    assert (done.returncode, "changed" in done.stdout) == (1, False)
    assert "60-fullswarm-ports.rules: is the file system read-only or full?" in done.stderr
    assert robot.facts["kit"] != whole


def test_an_installation_that_was_killed_is_made_good_by_the_next(two: tuple[Robot, Path, Path]) -> None:
    robot, _, _ = two
    (robot.root / "etc/systemd/system/fullswarm-agent.service").write_text("# somebody was here\n")
    for dies_at in ("daemon-reload", "try-restart"):
        (robot.root / "dies-at").write_text(dies_at)
        assert robot.install(swarm="other").returncode == -9
    assert robot.asked
    assert robot.install(swarm="other").returncode == 0
    asked = robot.asked
    assert "daemon-reload" in asked
    assert "try-restart fullswarm-agent.service" in asked
    assert robot.install(swarm="other").returncode == 0
    assert "restart" not in robot.asked
    assert not list(robot.root.rglob("*~"))


def test_a_reader_that_is_gone_does_not_stop_an_installation(robot: Robot) -> None:
    (robot.root / "etc/systemd/system/fullswarm-agent.service").unlink()
    reader, writer = os.pipe()
    os.close(reader)
    done = robot.install(stdout=writer)
    os.close(writer)
    assert done.returncode == 0, done.stderr
    assert robot.facts["kit"] is not None


def test_settings_that_the_agent_does_not_take_are_taken_back(two: tuple[Robot, Path, Path]) -> None:
    robot, old, _ = two
    fleet = robot.root / "etc/fullswarm/fleet.toml"
    before = fleet.read_text()
    robot.program("journalctl", "echo 'no driver for bad://'")
    done = robot.install(swarm="bad")
    assert done.returncode == 1
    assert "the old ones are back" in done.stderr.splitlines()[-1]
    assert "It said: no driver for bad://" in done.stderr.splitlines()[-1]
    assert (fleet.read_text(), robot.agent) == (before, old.name)
    assert not list(robot.root.rglob("*~"))
    assert robot.install().returncode == 0
    assert robot.install_kit() == ""


def test_settings_that_were_never_proven_are_taken_back_after_a_kill(two: tuple[Robot, Path, Path]) -> None:
    robot, old, _ = two
    before = (robot.root / "etc/fullswarm/fleet.toml").read_text()
    (robot.root / "dies-at").write_text("try-restart")
    assert robot.install(swarm="bad").returncode == -9
    assert robot.install(swarm="bad").returncode == 1
    assert ((robot.root / "etc/fullswarm/fleet.toml").read_text(), robot.agent) == (before, old.name)


def test_settings_stay_when_no_agent_ran_or_a_card_says_so(two: tuple[Robot, Path, Path]) -> None:
    robot, _, _ = two
    done = robot.install("--settings-stay", swarm="bad")
    assert (done.returncode, robot.agent) == (0, None)
    assert "does not start with the new settings" in done.stderr
    assert robot.install(swarm="other").returncode == 0
    assert robot.install(swarm="bad").returncode == 0
    assert '"bad"' in (robot.root / "etc/fullswarm/fleet.toml").read_text()


@pytest.mark.parametrize("value", ['a"b', "a$b", "a\nb"])
def test_an_environment_that_a_shell_would_misread_is_refused(value: str) -> None:
    config = SwarmConfig(robot=(RobotConfig(id="r1"),))
    with pytest.raises(ConfigError, match="environment"):
        kit(config.robot[0], config, "", environment={"X": value})


# ---------------------------------------------------------------------- a release comes in
def test_only_what_differs_is_wanted(two: tuple[Robot, Path, Path]) -> None:
    robot, old, new = two
    third = robot.make("1.0.2")
    assert robot.want(third) == ["app/fullswarm/__init__.py"]
    robot.ship(third)
    inside = robot.root / "opt/fullswarm/releases"
    assert (inside / old.name / "lib/big.py").samefile(inside / third.name / "lib/big.py")
    assert robot.want(new) == []  # it is there
    robot.check()


def test_a_shipment_that_was_cut_goes_on(robot: Robot) -> None:
    release = robot.make("1.0.0", {"app/one.bin": bytes(300_000), "app/two.py": "2"})
    missing = robot.want(release)
    archive = b"".join(pack.plain(release, sorted(missing)))
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
    done = robot.call("receive", third.name, feed=b"".join(pack.plain(third, missing)))
    assert (done.returncode, done.stdout.decode().split()) == (1, ["lib/big.py"])
    robot.ok("receive", third.name, feed=b"".join(pack.plain(third, ["lib/big.py"])))


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
    done = robot.call("receive", third.name, feed=b"".join(pack.plain(third, missing)))
    assert (done.returncode, done.stdout.decode().split()) == (1, ["lib/big.py"])
    robot.ok("receive", third.name, feed=b"".join(pack.plain(third, ["lib/big.py"])))
    robot.check()


def test_nothing_is_called_a_release_that_is_damaged_for_good(robot: Robot) -> None:
    release = robot.make("1.0.0")
    missing = robot.want(release)
    robot.program("sha256sum", f'case "$*" in *-c*) exit 1 ;; esac\nexec {shutil.which("sha256sum")} "$@"')
    robot.no(1, "receive", release.name, feed=b"".join(pack.plain(release, missing)))
    assert robot.releases == set()


def test_room_that_two_releases_share_counts_once(two: tuple[Robot, Path, Path]) -> None:
    robot, _, _ = two
    third = robot.make("1.0.2")
    free_kb = 65536 + 5  # beyond what stays free: 5 kB, for 20 kB of which 8 are there already, in two releases
    robot.program("df", f"printf 'head\\nx 1 1 {free_kb} 1 /\\n'")
    said = robot.no(3, "want", third.name, "--bytes", str(20 * 1024), feed=pack.head(third))
    assert "too full" in said
    robot.ok("want", third.name, "--bytes", str(12 * 1024), feed=pack.head(third))


def test_a_foreign_or_stale_signature_is_refused_before_anything_is_written(robot: Robot, tmp_path: Path) -> None:
    foreign = robot.make("1.0.0", keys=Keys(tmp_path / "others"))
    said = robot.no(3, "want", foreign.name, feed=pack.head(foreign))
    assert "signature" in said
    stale = robot.make("1.0.1")
    (stale / "SHA256SUMS").write_bytes((stale / "SHA256SUMS").read_bytes().replace(b"0", b"1"))
    robot.no(3, "want", stale.name, feed=pack.head(stale))
    assert list((robot.root / "opt/fullswarm/releases").iterdir()) == []


def test_a_release_under_another_name_is_refused(robot: Robot) -> None:
    release = robot.make("1.0.0")
    robot.no(3, "want", "1.0.0-000000000000", feed=pack.head(release))
    for evil in ("../../etc", ".hidden", "-n", "a/b", ""):
        robot.no(2, "want", evil, feed=pack.head(release))


def test_a_release_for_another_machine_is_refused(robot: Robot) -> None:
    for target, word in (
        (Target("rpi-arm64", "aarch64", "2.28", "3.11"), "aarch64"),
        (Target("x86_64", "x86_64", "9.99", "3.11"), "glibc 9.99"),
        (Target("x86_64", "x86_64", "2.28", "3.99"), "python 3.99"),
    ):
        release = tiny_release(robot.store, robot.keys, target=target)
        assert word in robot.no(3, "want", release.name, feed=pack.head(release))
    assert list((robot.root / "opt/fullswarm/releases").iterdir()) == []


def test_a_disk_without_room_is_known_before(robot: Robot) -> None:
    release = robot.make("1.0.0")
    assert "too full" in robot.no(3, "want", release.name, "--bytes", str(10**16), feed=pack.head(release))


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
    good = b"".join(pack.plain(release, missing))[: -2 * 512]  # without its end
    robot.no(3, "receive", release.name, feed=good + _tar((TRICKS[trick], content)))
    assert list((robot.root / "opt/fullswarm/releases").iterdir()) == []
    assert not list(robot.folder.rglob("owned"))


def test_gzip_zstd_and_plain_are_all_taken(robot: Robot) -> None:
    for version, squeeze in (("1.0.0", ["gzip", "-c"]), ("1.0.1", ["zstd", "-qc"]), ("1.0.2", ["cat"])):
        release = robot.make(version)
        plain = b"".join(pack.plain(release, robot.want(release)))
        squeezed = subprocess.run(squeeze, input=plain, capture_output=True, check=True).stdout
        robot.ok("receive", release.name, feed=squeezed)
    robot.check()
    assert len(robot.releases) == 3


# ---------------------------------------------------------------------- switching
def test_switch_and_commit(two: tuple[Robot, Path, Path]) -> None:
    robot, old, new = two
    robot.ok("switch", new.name)
    assert (robot.current, robot.agent, robot.pending) == (new.name, new.name, True)
    assert f'"release": "{new.name}"' in robot.ok("health")
    robot.ok("commit", new.name)
    assert (robot.pending, robot.link("previous"), robot.releases) == (False, old.name, {old.name, new.name})
    robot.fire_guard()
    assert robot.current == new.name
    third = robot.make("1.0.2")
    robot.run_release(third)
    assert robot.releases == {new.name, third.name}  # older ones are gone


def test_the_guard_goes_back(two: tuple[Robot, Path, Path]) -> None:
    robot, old, new = two
    robot.ok("switch", new.name, "--guard", "7")
    robot.fire_guard()
    assert (robot.current, robot.agent, robot.pending) == (old.name, old.name, False)
    assert "nobody approved it within 7 s" in str(robot.facts["last_rollback"])
    assert "last rollback" in robot.no(1, "commit", new.name)


def test_a_boot_goes_back_and_a_restart_of_the_boot_unit_does_not(two: tuple[Robot, Path, Path]) -> None:
    robot, old, new = two
    robot.ok("switch", new.name)
    robot.ok("boot")
    assert robot.pending
    robot.reboot()
    assert (robot.current, robot.agent, robot.pending) == (old.name, old.name, False)


def test_a_release_that_does_not_start_is_taken_back_at_once(robot: Robot) -> None:
    old, broken = robot.make("1.0.0"), robot.make("1.0.1", {"app/broken": "x"})
    robot.run_release(old)
    robot.ship(broken)
    assert "did not start" in robot.no(4, "switch", broken.name)
    assert (robot.current, robot.agent, robot.pending) == (old.name, old.name, False)


def test_one_that_hangs_at_its_start_is_taken_back_when_the_guard_is_due(robot: Robot) -> None:
    old, hangs = robot.make("1.0.0"), robot.make("1.0.1", {"app/hangs": "x"})
    robot.run_release(old)
    robot.ship(hangs)
    assert "did not start" in robot.no(4, "switch", hangs.name, "--guard", "1")
    assert (robot.current, robot.agent, robot.pending) == (old.name, old.name, False)


def test_a_guard_that_cannot_be_armed_changes_nothing(two: tuple[Robot, Path, Path]) -> None:
    robot, old, new = two
    (robot.root / "no-guards").touch()
    robot.no(1, "switch", new.name)
    assert (robot.current, robot.pending) == (old.name, False)


def test_a_repeated_switch_that_cannot_be_guarded_approves_nothing(two: tuple[Robot, Path, Path]) -> None:
    robot, old, new = two
    robot.ok("switch", new.name)
    (robot.root / "no-guards").touch()
    assert f"{old.name} stays" in robot.no(1, "switch", new.name)
    assert (robot.current, robot.agent, robot.pending) == (old.name, old.name, False)


def test_a_guard_stands_until_the_next_one_does(two: tuple[Robot, Path, Path]) -> None:
    robot, _, new = two
    robot.program(
        "systemd-run",
        """
        unit=$(printf '%s\\n' "$@" | sed -n 's/^--unit=//p')
        echo "run $unit" >> "$FULLSWARM_ROOT/systemctl.log"
        [ ! -e "$FULLSWARM_ROOT/$unit" ] && touch "$FULLSWARM_ROOT/$unit\"""",
    )
    robot.ok("switch", new.name)
    robot.asked  # noqa: B018  (empties it)
    robot.ok("switch", new.name)
    order = [line for line in robot.asked.splitlines() if "run " in line or line.startswith("stop ")]
    assert order[:3] == [
        "run fullswarm-guard", "run fullswarm-guard-2", "stop fullswarm-guard.timer fullswarm-guard.service"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("moving", "lifecycle", "behaviour"), [(True, "READY", ""), (True, "ACTIVE", "flock"), (False, "ACTIVE", "flock")]
)
def test_no_switch_while_the_robot_may_move(
    two: tuple[Robot, Path, Path], moving: bool, lifecycle: str, behaviour: str
) -> None:
    robot, old, new = two
    robot.tell(moving, lifecycle, behaviour)
    assert "stop it first" in robot.no(3, "switch", new.name)
    assert (robot.current, robot.pending) == (old.name, False)
    robot.ok("switch", new.name, "--force")
    assert robot.current == new.name


def test_an_old_word_that_it_moves_counts_for_nothing(two: tuple[Robot, Path, Path]) -> None:
    robot, _, new = two
    robot.tell(True, "ACTIVE", "flock")
    robot.age_health()
    robot.ok("switch", new.name)


def test_going_back_twice_is_going_back_once(two: tuple[Robot, Path, Path]) -> None:
    robot, old, new = two
    robot.ok("switch", new.name)
    robot.ok("commit", new.name)
    assert robot.ok("rollback").strip() == old.name
    assert robot.ok("rollback").strip() == old.name
    assert (robot.current, robot.agent) == (old.name, old.name)


def test_a_first_release_that_is_not_approved_leaves_none(robot: Robot) -> None:
    first = robot.make("1.0.0")
    robot.ship(first)
    robot.ok("switch", first.name)
    robot.fire_guard()
    assert (robot.current, robot.agent, robot.pending, robot.releases) == (None, None, False, {first.name})
    robot.ok("switch", first.name)  # nothing need be shipped again
    robot.ok("commit", first.name)
    assert robot.agent == first.name


def test_the_second_deploy_restarts_nothing(two: tuple[Robot, Path, Path]) -> None:
    robot, old, _ = two
    log = robot.root / "systemctl.log"
    log.write_text("")
    robot.ok("switch", old.name)
    assert "restart" not in log.read_text()


# ---------------------------------------------------------------------- settings
def test_new_settings_restart_the_agent_only_if_they_are_new(two: tuple[Robot, Path, Path]) -> None:
    robot, _, _ = two
    path, log = robot.root / "etc/fullswarm/fleet.toml", robot.root / "systemctl.log"
    log.write_text("")
    assert robot.ok("configure", feed=path.read_bytes()) == ""
    assert log.read_text() == ""
    config = SwarmConfig(swarm="other", robot=(RobotConfig(id="r1", driver="null://r1"),))
    robot.ok("configure", feed=fleet_file(config).encode())
    assert "restart fullswarm-agent.service" in log.read_text()
    assert robot.facts["kit"] is not None


def test_new_settings_whose_restart_was_killed_are_told_again(two: tuple[Robot, Path, Path]) -> None:
    robot, _, _ = two
    config = SwarmConfig(swarm="other", robot=(RobotConfig(id="r1", driver="null://r1"),))
    (robot.root / "dies-at").write_text("restart")
    assert robot.call("configure", feed=fleet_file(config).encode()).returncode == -9
    robot.asked  # noqa: B018  (empties it)
    robot.ok("configure", feed=fleet_file(config).encode())
    assert "restart fullswarm-agent.service" in robot.asked
    assert robot.facts["kit"] is not None
    robot.ok("configure", feed=fleet_file(config).encode())
    assert "restart" not in robot.asked


def test_health_is_asked_for_as_a_word_or_as_a_verdict(two: tuple[Robot, Path, Path]) -> None:
    robot, _, _ = two
    robot.tell(False)
    robot.ok("health", "--healthy")
    path = robot.root / "run/fullswarm/health.json"
    path.write_text(path.read_text().replace('"healthy": true', '"healthy": false'))
    robot.ok("health")
    done = robot.call("health", "--healthy")
    assert (done.returncode, b'"healthy": false' in done.stdout) == (1, True)
    robot.no(2, "health", "--well")


def test_health_that_is_old_or_of_another_release_is_none(two: tuple[Robot, Path, Path]) -> None:
    robot, _, new = two
    (robot.root / "agent").write_text(new.name)
    robot.tell(False)
    assert "still runs" in robot.no(1, "health")
    robot.age_health()
    assert re.search(r"health is 1\d s old", robot.no(1, "health"))
    (robot.root / "run/fullswarm/health.json").unlink()
    assert "no health yet" in robot.no(1, "health")


def test_wrong_words_are_usage(robot: Robot) -> None:
    for words in ([], ["fly"], ["switch"], ["switch", "1-2", "--guard"], ["rollback", "x"], ["logs", "--root=/"]):
        robot.no(2, *words)


# ---------------------------------------------------------------------- bytecode
@pytest.mark.parametrize(
    ("result", "status", "dropped"),
    [
        ("exit-code", "70", True),
        ("exit-code", "1", True),
        ("exit-code", "2", False),
        ("success", "0", False),
        ("watchdog", "ABRT", False),
        ("signal", "KILL", False),
    ],
)
def test_an_agent_that_fails_twice_gets_new_bytecode_but_not_each_time(
    robot: Robot, result: str, status: str, dropped: bool
) -> None:
    torn = robot.root / "var/cache/fullswarm/opt/fullswarm/releases/x/app/a.pyc"
    ended = {"SERVICE_RESULT": result, "EXIT_STATUS": status}
    for time in (1, 2, 3):
        torn.parent.mkdir(parents=True, exist_ok=True)
        torn.write_bytes(b"half")
        assert robot.call("ended", environment=ended).returncode == 0
        assert torn.exists() is not (dropped and time == 2)
