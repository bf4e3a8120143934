"""The first boot itself: the scripts of a flashed card, run under a root folder with the real ``fullswarm-robot``."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from fullswarm.cli.main import app
from fullswarm.deploy.flash.first_boot import HOME
from fullswarm.deploy.release.keys import Keys
from fullswarm.deploy.release.store import Store
from fullswarm.deploy.robot.support_package import RULE
from tests.unit.flash_lab import FLEET, MEGA, PI_FILES, TRIXIE_FILES, files_of, make_image, make_release, tool

SYSTEMCTL = """\
#!/bin/sh
# The service manager of a system that does not run: notes what it is asked, and starts agents as told.
echo "$@" >>"$FULLSWARM_ROOT/asked"
case "$*" in
*is-enabled*) exit 1 ;;
*"restart fullswarm-agent"*) [ ! -e "$FULLSWARM_ROOT/agent-fails" ] ;;
esac || exit 1
[ -e "$FULLSWARM_ROOT/says" ] && [ -e "$FULLSWARM_ROOT/opt/fullswarm/current" ] || exit 0
release=$(readlink "$FULLSWARM_ROOT/opt/fullswarm/current")
mkdir -p "$FULLSWARM_ROOT/run/fullswarm"
cat >"$FULLSWARM_ROOT/run/fullswarm/health.json" <<HEALTH
{
 "release": "${release##*/}",
 "machine_s": $(cut -d' ' -f1 /proc/uptime),
$(cat "$FULLSWARM_ROOT/says")
}
HEALTH
"""
WELL = ' "healthy": true,\n "why": []\n'
LONELY = ' "healthy": false,\n "why": [\n  "it hears nobody",\n  "it is new"\n ]\n'
IP = "#!/bin/sh\necho 'eth0 UP 10.0.0.2/24'\n"


class Robot:
    """A flashed card's boot partition, mounted in an empty root."""

    def __init__(self, folder: Path, files: dict[str, bytes]) -> None:
        self.root, self.boot = folder / "root", folder / "root/boot/firmware"
        for name, content in files.items():
            (self.boot / name).parent.mkdir(parents=True, exist_ok=True)
            (self.boot / name).write_bytes(content)
        for name in ("etc", "run", "var", "opt", "bin"):
            (self.root / name).mkdir()
        for name, text in (("systemctl", SYSTEMCTL), ("systemd-run", "#!/bin/sh\nexit 0\n"), ("ip", IP)):
            (self.root / "bin" / name).write_text(text)
            (self.root / "bin" / name).chmod(0o755)

    def seed(self) -> None:
        """Do what cloud-init does with write_files."""
        for each in yaml.safe_load((self.boot / "user-data").read_bytes())["write_files"]:
            target = self.root / each["path"].lstrip("/")
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(each["content"])

    def run(self, script: Path) -> subprocess.CompletedProcess[str]:
        environment = {
            "PATH": f"{self.root / 'bin'}:{os.environ['PATH']}",
            "FULLSWARM_ROOT": str(self.root),
            "FULLSWARM_SYSTEMCTL": str(self.root / "bin/systemctl"),
            "FULLSWARM_SYSTEMD_RUN": str(self.root / "bin/systemd-run"),
            "FULLSWARM_HEALTH_TRIES": "1",
        }
        return subprocess.run(["sh", script], env=environment, capture_output=True, text=True, check=False)

    def boot_once(self) -> subprocess.CompletedProcess[str]:
        return self.run(self.root / HOME.lstrip("/") / "first_boot.sh")

    @property
    def report(self) -> str:
        return (self.boot / "fullswarm-report.txt").read_text()

    @property
    def current(self) -> str:
        return str((self.root / "opt/fullswarm/current").readlink())


@pytest.fixture(scope="module")
def cards(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, bytes]]:
    """Return the boot partitions that `fullswarm flash` writes, with and without cloud-init."""
    for name in ("flock", "gzip", "awk"):
        tool(name)
    folder = tmp_path_factory.mktemp("base")
    keys, store = Keys(folder / "keys"), Store(folder / "releases")
    make_release(store, keys)
    (folder / "lab.toml").write_text(FLEET)
    made = {}
    for name, files in (("cloud-init", TRIXIE_FILES), ("firstrun", PI_FILES)):
        picture = make_image(folder / f"{name}.img", files, fat=8 * MEGA, bits=12, root=MEGA)
        out = folder / f"{name}.out"
        words = ["flash", "r1", "--fleet", str(folder / "lab.toml"), "--target", "x86_64", "--image", str(picture)]
        words += ["--output", str(out), "--wifi", "lab", "--country", "DE"]
        given = {
            "FULLSWARM_KEYS": str(keys.folder),
            "FULLSWARM_RELEASES": str(store.folder),
            "FULLSWARM_WIFI_PASSPHRASE": "passphrase",
        }
        result = CliRunner().invoke(app, words, env=given)
        assert result.exit_code == 0, result.output
        made[name] = files_of(out)
    return made


@pytest.fixture
def robot(tmp_path: Path, cards: dict[str, dict[str, bytes]]) -> Robot:
    made = Robot(tmp_path, cards["cloud-init"])
    made.seed()
    return made


def test_the_first_boot_installs_everything_offline_and_forgets_its_secrets(robot: Robot) -> None:
    private = (robot.boot / "fullswarm/secret/host_key").read_bytes()
    done = robot.boot_once()
    assert done.returncode == 0, done.stderr + robot.report
    release = robot.root / "opt/fullswarm" / robot.current
    assert (release / "lib/thing/__init__.py").read_text() == "x = 1\n"
    assert not (robot.root / "opt/fullswarm/pending").exists()
    assert (robot.root / "etc/fullswarm/fleet.toml").exists()
    key = robot.root / "etc/ssh/ssh_host_ed25519_key"
    assert key.read_bytes() == private
    assert key.stat().st_mode & 0o077 == 0
    assert "restart fullswarm-agent.service" in (robot.root / "asked").read_text()
    # no agent runs in this root, so it cannot be healthy: the report says what is there and what is not
    assert robot.report.startswith("fullswarm, first boot of r1: installed, ")
    assert "hub: tcp/10.0.0.1:7447" in robot.report
    assert not (robot.boot / "fullswarm/secret").exists()
    assert not (robot.boot / "fullswarm/release.tar.gz").exists()
    assert b"PRIVATE" not in (robot.boot / "user-data").read_bytes()
    assert private not in b"".join(each.read_bytes() for each in robot.boot.rglob("*") if each.is_file())


@pytest.mark.parametrize(
    ("says", "verdict"),
    [(WELL, "OK"), (LONELY, "installed and running, but not healthy yet: it hears nobody; it is new")],
)
def test_the_report_says_whether_the_agent_is_well(robot: Robot, says: str, verdict: str) -> None:
    (robot.root / "says").write_text(says)
    assert robot.boot_once().returncode == 0
    assert robot.report.splitlines()[0] == f"fullswarm, first boot of r1: {verdict}"
    assert robot.current


def test_a_release_that_was_there_before_stays_until_the_new_one_is_well(robot: Robot) -> None:
    old = robot.root / "opt/fullswarm/releases/0.9-0123456789ab"
    old.mkdir(parents=True)
    (robot.root / "opt/fullswarm/current").symlink_to("releases/0.9-0123456789ab")
    (robot.root / "says").write_text(LONELY)
    assert robot.boot_once().returncode == 1
    assert "FAILED while committing the release" in robot.report.splitlines()[0]
    assert "is not healthy: it hears nobody" in robot.report
    assert robot.current == "releases/0.9-0123456789ab"
    (robot.root / "says").write_text(WELL)
    assert robot.boot_once().returncode == 0
    assert robot.report.splitlines()[0].endswith(": OK")
    assert robot.current != "releases/0.9-0123456789ab"


def test_a_power_cut_at_the_end_leaves_neither_a_key_nor_no_report(robot: Robot) -> None:
    """The power goes with the first file that is forgotten."""
    remove = robot.root / "bin/rm"
    remove.write_text(
        f'#!/bin/sh\ncase "$*" in *secret*) kill -KILL $PPID; exit ;; esac\nexec {shutil.which("rm")} "$@"\n'
    )
    remove.chmod(0o755)
    assert robot.boot_once().returncode == -9
    assert robot.report.startswith("fullswarm, first boot of r1: installed")
    assert (robot.boot / "fullswarm/secret/host_key").exists()
    remove.unlink()
    (robot.root / "asked").unlink()
    assert robot.boot_once().returncode == 0
    assert not (robot.boot / "fullswarm/secret").exists()
    assert not (robot.root / "asked").exists(), "it is not installed again"


def test_files_that_are_all_here_already_still_make_a_release(robot: Robot, cards: dict[str, dict[str, bytes]]) -> None:
    assert robot.boot_once().returncode == 0
    releases, name = robot.root / "opt/fullswarm/releases", robot.current.split("/")[1]
    (releases / name).rename(releases / "0.9-0123456789ab")  # another one that has all the files
    (robot.root / "opt/fullswarm/current").unlink()
    (robot.root / "opt/fullswarm/current").symlink_to("releases/0.9-0123456789ab")
    (robot.root / "says").write_text(WELL)
    reseed(robot, cards["cloud-init"])
    assert robot.boot_once().returncode == 0, robot.report
    assert robot.current == f"releases/{name}"


def test_a_file_that_has_rotted_here_comes_from_the_card(robot: Robot, cards: dict[str, dict[str, bytes]]) -> None:
    assert robot.boot_once().returncode == 0
    releases, name = robot.root / "opt/fullswarm/releases", robot.current.split("/")[1]
    (releases / name).rename(releases / "0.9-0123456789ab")
    (releases / "0.9-0123456789ab/lib/thing/__init__.py").write_text("rotten")
    (robot.root / "opt/fullswarm/current").unlink()
    reseed(robot, cards["cloud-init"])
    assert robot.boot_once().returncode == 0, robot.report
    assert (releases / name / "lib/thing/__init__.py").read_text() == "x = 1\n"


def reseed(robot: Robot, card: dict[str, bytes]) -> None:
    """Do what `flash --seed-only` does for the same card."""
    for name, content in card.items():
        (robot.boot / name).parent.mkdir(parents=True, exist_ok=True)
        (robot.boot / name).write_bytes(content.replace(b"fullswarm-r1-", b"fullswarm-r1-2"))
    robot.seed()


def test_it_runs_once_and_again_for_a_new_instance(robot: Robot, cards: dict[str, dict[str, bytes]]) -> None:
    assert robot.boot_once().returncode == 0
    (robot.root / "asked").unlink()
    assert robot.boot_once().returncode == 0
    assert not (robot.root / "asked").exists()
    reseed(robot, cards["cloud-init"])
    assert robot.boot_once().returncode == 0
    assert (robot.root / "asked").exists()


def test_a_card_that_loses_data_is_named_and_a_sound_one_mends_it(robot: Robot) -> None:
    body = robot.boot / "fullswarm/release.tar.gz"
    sound = body.read_bytes()
    body.write_bytes(sound[:1000] + b"?" + sound[1001:])
    assert robot.boot_once().returncode == 1
    assert "FAILED while reading the card" in robot.report
    assert "use another one" in robot.report
    assert "release.tar.gz: FAILED" in robot.report
    assert not (robot.root / "opt/fullswarm/current").exists()
    assert (robot.boot / "fullswarm/secret/host_key").exists()  # it is needed for the next try
    body.write_bytes(sound)
    assert robot.boot_once().returncode == 0


def test_a_release_of_another_base_is_not_taken(robot: Robot) -> None:
    head = robot.boot / "fullswarm/head.tar"
    data = head.read_bytes()
    at = data.rindex(b"-----BEGIN SSH SIGNATURE-----") + 200
    head.write_bytes(data[:at] + (b"A" if data[at : at + 1] != b"A" else b"B") + data[at + 1 :])
    (robot.boot / "fullswarm/card.sha256").write_text("")
    subprocess.run(
        f"cd '{robot.boot}/fullswarm' && sha256sum kit.tar head.tar release.tar.gz > card.sha256",
        shell=True,
        check=True,
    )
    assert robot.boot_once().returncode == 1
    assert "FAILED while taking the release" in robot.report
    assert "signature is not one that this robot trusts" in robot.report
    assert not (robot.root / "opt/fullswarm/current").exists()


def test_an_agent_that_does_not_start_is_told_and_tried_again(robot: Robot) -> None:
    (robot.root / "agent-fails").touch()
    assert robot.boot_once().returncode == 1
    assert "FAILED while starting the agent" in robot.report
    (robot.root / "agent-fails").unlink()
    assert robot.boot_once().returncode == 0
    assert robot.current


def test_a_power_cut_in_the_middle_starts_over(robot: Robot, cards: dict[str, dict[str, bytes]]) -> None:
    name = next(
        line.split("=")[1]
        for line in cards["cloud-init"]["fullswarm/card.env"].decode().splitlines()
        if line.startswith("RELEASE=")
    )
    cut = robot.root / f"opt/fullswarm/releases/.incoming-{name}"
    (cut / "lib/thing").mkdir(parents=True)
    (cut / "lib/thing/__init__.py").write_text("x = 1\n")
    assert robot.boot_once().returncode == 0, robot.report
    assert robot.current.endswith(name)


def test_bookworm_is_set_up_by_firstrun(tmp_path: Path, cards: dict[str, dict[str, bytes]]) -> None:
    robot = Robot(tmp_path, cards["firstrun"])
    seen = 'case "$*" in *firstrun.sh*) cp "$FULLSWARM_ROOT/boot/firmware/cmdline.txt" "$FULLSWARM_ROOT/at-rm" ;; esac'
    for name, text in (
        ("useradd", 'mkdir -p "$FULLSWARM_ROOT/home/$4"'),
        ("usermod", "exit 0"),
        ("id", "exit 1"),
        ("getent", 'echo "$2:x:1001:1001::/home/$2:/bin/bash"'),
        ("chown", "exit 0"),
        ("raspi-config", 'echo "$@" >>"$FULLSWARM_ROOT/asked"'),
        ("rfkill", "exit 0"),
        ("rm", f'{seen}\nexec {shutil.which("rm")} "$@"'),
    ):
        (robot.root / "bin" / name).write_text(f"#!/bin/sh\n{text}\n")
        (robot.root / "bin" / name).chmod(0o755)
    (robot.root / "etc/hosts").write_text("127.0.0.1\tlocalhost\n127.0.1.1\traspberrypi\n")
    (robot.root / "etc/sudoers.d").mkdir()
    (robot.root / "etc/ssh").mkdir()
    (robot.root / "etc/ssh/ssh_host_rsa_key").write_text("the image's own")
    state = robot.root / "var/lib/NetworkManager/NetworkManager.state"
    state.parent.mkdir(parents=True)
    state.write_text("[main]\nNetworkingEnabled=true\nWirelessEnabled=false\n")
    private = (robot.boot / "fullswarm/secret/host_key").read_bytes()

    done = robot.run(robot.boot / "firstrun.sh")
    assert done.returncode == 0, done.stderr
    assert not (robot.boot / "fullswarm-report.txt").exists(), robot.report
    assert (robot.root / "etc/hostname").read_text() == "r1\n"
    assert (robot.root / "etc/hosts").read_text() == "127.0.0.1\tlocalhost\n127.0.1.1\tr1\n"
    assert (robot.root / "home/fullswarm-admin/.ssh/authorized_keys").read_text().startswith("ssh-ed25519 ")
    assert (robot.root / "etc/sudoers.d/fullswarm-admin").read_text() == f"fullswarm-admin {RULE}\n"
    assert (robot.root / "etc/ssh/ssh_host_ed25519_key").read_bytes() == private
    assert not (robot.root / "etc/ssh/ssh_host_rsa_key").exists()
    wifi = robot.root / "etc/NetworkManager/system-connections/wifi-1.nmconnection"
    assert wifi.stat().st_mode & 0o777 == 0o600
    assert "WirelessEnabled=true" in state.read_text()
    asked = (robot.root / "asked").read_text()
    assert "nonint do_wifi_country DE" in asked
    assert "enable fullswarm-first-boot.service" in asked
    assert not (robot.boot / "firstrun.sh").exists()
    assert not list((robot.boot / "fullswarm/secret").glob("*.nmconnection"))
    line = (robot.boot / "cmdline.txt").read_text()
    assert (robot.root / "at-rm").read_text() == line, "nothing names the script any more when it goes"
    assert ("systemd" in line, "root=PARTUUID=35684e8a-02" in line, line.count("\n")) == (False, True, 1)

    assert robot.boot_once().returncode == 0, robot.report  # the usual boot that follows
    assert robot.current
