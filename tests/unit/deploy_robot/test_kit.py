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
from fullswarm.deploy.robot.support_package import ISSUED_TO, package_id, robot_credentials, support_package
from fullswarm.errors import ConfigError
from fullswarm.identity.authority import Authority, revoke
from fullswarm.identity.folder import IDENTITY, ISSUED, KeysFolder, credentials_for
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


# ---------------------------------------------------------------- certificates
SECURED = SwarmConfig.model_validate(
    {"hub": {"endpoint": "tls/10.0.0.1:7447"}, "robot": [{"id": "r1", "driver": "null://r1"}]}
)
NOW_S = 1_800_000_000.0


@pytest.fixture
def authority(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Authority:
    monkeypatch.setenv(IDENTITY, str(tmp_path / "identity"))
    made = Authority.make(KeysFolder.of(SECURED.swarm), wall_s=lambda: NOW_S)
    made.issue("r1", "robot")
    return made


def secured_kit(robot: Robot) -> bytes:
    credentials = robot_credentials(SECURED.robot[0], SECURED, NOW_S)
    assert credentials is not None
    return support_package(SECURED.robot[0], SECURED, robot.keys.roots()[-1], credentials=credentials)


def install(robot: Robot, kit: bytes, folder: Path) -> subprocess.CompletedProcess[str]:
    with tarfile.open(fileobj=io.BytesIO(kit)) as tar:
        tar.extractall(folder, filter="data")
    command = ["sh", str(folder / "install.sh")]
    return subprocess.run(command, env=robot.environment, capture_output=True, text=True, start_new_session=True)


def test_a_kit_brings_a_certificate_that_the_agent_finds(
    robot: Robot, authority: Authority, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kit = secured_kit(robot)
    assert kit == secured_kit(robot)
    with tarfile.open(fileobj=io.BytesIO(kit)) as tar:
        private = [each for each in tar.getmembers() if ISSUED_TO in each.name]
        assert [oct(each.mode) for each in private] == ["0o600"] * 3
    done = install(robot, kit, tmp_path / "one")
    assert done.returncode == 0, done.stderr
    assert robot.facts["kit"] == package_id(kit)
    for name in ("authority.pem", "certificate.pem", "key.pem"):
        assert (robot.root / ISSUED_TO / name).stat().st_mode & 0o777 == 0o600
    environment = (robot.root / "etc/fullswarm/robot.env").read_text()
    assert f'{ISSUED}="/{ISSUED_TO}"' in environment
    assert f'{IDENTITY}="/var/lib/fullswarm/identity"' in environment
    monkeypatch.setenv(ISSUED, str(robot.root / ISSUED_TO))
    monkeypatch.setenv(IDENTITY, str(robot.root / "var/lib/fullswarm/identity"))
    found = credentials_for(SECURED.swarm, "r1", "robot")
    assert found.key.read_bytes() == authority.folder.key_path("r1").read_bytes()
    assert install(robot, kit, tmp_path / "two").stdout == ""


def test_a_new_certificate_restarts_the_agent_and_a_killed_installation_is_made_good(
    two: tuple[Robot, Path, Path], authority: Authority, tmp_path: Path
) -> None:
    robot, _, _ = two
    assert install(robot, secured_kit(robot), tmp_path / "one").returncode == 0
    robot.asked()
    Authority.open(authority.folder, wall_s=lambda: NOW_S + 60.0).renew("r1")
    (robot.root / "dies-at").write_text("try-restart")
    assert install(robot, secured_kit(robot), tmp_path / "two").returncode != 0
    done = install(robot, secured_kit(robot), tmp_path / "three")
    assert done.returncode == 0, done.stderr
    assert "try-restart fullswarm-agent.service" in robot.asked()
    assert not list(robot.root.rglob("*~"))


def test_a_robot_without_a_usable_certificate_is_not_deployed(authority: Authority) -> None:
    robot = SECURED.robot[0]
    assert robot_credentials(robot, SwarmConfig(robot=(robot,)), NOW_S) is None
    with pytest.raises(ConfigError, match="has expired") as error:
        robot_credentials(robot, SECURED, NOW_S + 31 * 86400.0)
    assert error.value.hint == "fullswarm keys renew r1 --swarm swarm"
    revoke(authority.folder, "r1")
    with pytest.raises(ConfigError, match="is revoked") as error:
        robot_credentials(robot, SECURED, NOW_S)
    assert error.value.hint == "fullswarm keys issue r1 --role robot --swarm swarm"
    with pytest.raises(ConfigError, match="'r2' has no certificate"):
        robot_credentials(RobotConfig(id="r2"), SECURED, NOW_S)
