"""The kit on the robot: it is installed whole, again and again, whatever cuts it short."""

from __future__ import annotations

import io
import os
import shutil
import subprocess
import tarfile
from pathlib import Path

import pytest

from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.deploy.robot.support_package import package_id, support_package
from fullswarm.errors import ConfigError
from tests.unit.deploy_robot.script import PROGRAMS, Robot

SCRIPTS = ("fullswarm-robot", "robot-trust.sh", "robot-shipping.sh", "robot-facts.sh", "install.sh")


@pytest.mark.parametrize("name", SCRIPTS)
def test_the_scripts_are_posix_shell(name: str) -> None:
    assert subprocess.run(["dash", "-n", PROGRAMS / name], check=False).returncode == 0
    assert len((PROGRAMS / name).read_text().splitlines()) <= 400


def test_the_same_robot_gets_the_same_kit_and_the_robot_names_it(robot: Robot) -> None:
    config = SwarmConfig(robot=(RobotConfig(id="r1", driver="null://r1"),))
    one = support_package(config.robot[0], config, robot.keys.roots()[-1])
    assert one == support_package(config.robot[0], config, robot.keys.roots()[-1])
    assert robot.facts["kit"] == package_id(one)
    (robot.root / "etc/udev/rules.d/60-fullswarm-ports.rules").write_text("# somebody was here\n")
    assert robot.facts["kit"] is None


def test_installing_again_changes_nothing(robot: Robot) -> None:
    assert robot.install_kit() == ""
    (robot.root / "etc/systemd/system/fullswarm-agent.service").unlink()
    assert robot.install_kit() == "changed: etc/systemd/system/fullswarm-agent.service\n"


def test_a_damaged_kit_changes_nothing(robot: Robot, tmp_path: Path) -> None:
    config = SwarmConfig(robot=(RobotConfig(id="r2", driver="null://r2"),))
    with tarfile.open(fileobj=io.BytesIO(support_package(config.robot[0], config, ""))) as tar:
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
    assert robot.asked()
    assert robot.install(swarm="other").returncode == 0
    asked = robot.asked()
    assert "daemon-reload" in asked
    assert "try-restart fullswarm-agent.service" in asked
    assert robot.install(swarm="other").returncode == 0
    assert "restart" not in robot.asked()
    assert not list(robot.root.rglob("*~"))


def test_a_reader_that_is_gone_does_not_stop_an_installation(robot: Robot) -> None:
    (robot.root / "etc/systemd/system/fullswarm-agent.service").unlink()
    reader, writer = os.pipe()
    os.close(reader)
    done = robot.install(stdout=writer)
    os.close(writer)
    assert done.returncode == 0, done.stderr
    assert robot.facts["kit"] is not None


@pytest.mark.parametrize("value", ['a"b', "a$b", "a\nb"])
def test_an_environment_that_a_shell_would_misread_is_refused(value: str) -> None:
    config = SwarmConfig(robot=(RobotConfig(id="r1"),))
    with pytest.raises(ConfigError, match="environment"):
        support_package(config.robot[0], config, "", environment={"X": value})
