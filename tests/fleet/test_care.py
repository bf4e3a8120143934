"""A fleet's everyday care through the front door: logs, shell, reboot, preflight, sudo's password, a read-only root.

On robots with real systemd, sshd and sudo; what updates do is in ``test_updates.py``.
"""

from __future__ import annotations

import signal
import subprocess

import pytest

from tests.fleet.fleet import Fleet, results, row_of
from tests.fleet.lab import PYTHON, Lab
from tests.fleet.rootfs import ADMIN
from tests.fleet.terminal import Terminal
from tests.fleet.tools import until

BACK_S = 120.0
SOON_S = 30.0
PASSWORD = "correct horse"
WRITABLE = ("/opt/fullswarm", "/var/lib/fullswarm")


def test_logs(fleet: Fleet) -> None:
    lab, robot = fleet.lab, fleet.lab.robots[0]
    last = lab.cli("logs", robot, "-n", "5").out.splitlines()
    assert 1 <= len(last) <= 5
    entry = lab.cli("logs", robot, "-n", "1", "--json").json
    assert {"time_s", "priority", "text"} <= set(entry)


def test_logs_follow_until_ctrl_c(fleet: Fleet) -> None:
    lab, robot = fleet.lab, fleet.lab.robots[0]
    follower = lab.start("logs", robot, "--follow", "-n", "0", log="follow.log")
    said = lab.folder / "follow.log"

    def hears_of_it() -> bool:
        # What the agent says when it is asked to end comes only after somebody listens.
        lab.computers[robot].do("systemctl", "kill", "--signal=SIGTERM", "fullswarm-agent")
        return "stop" in said.read_text().lower()

    until(hears_of_it, SOON_S, "the end of the agent is in the log", said.read_text)
    follower.send_signal(signal.SIGINT)
    assert follower.wait(SOON_S) == 130
    assert "Traceback" not in said.read_text()
    lab.wait_ready()


def test_a_shell_on_a_robot(fleet: Fleet) -> None:
    lab, robot = fleet.lab, fleet.lab.robots[0]
    assert lab.cli("shell", robot, "hostname").out == f"{robot}\n"
    lab.cli("shell", robot, "--", "sh", "-c", "'exit 7'", code=7)
    with Terminal(lab.command("shell", robot), lab.environment) as terminal:
        terminal.expect("$", SOON_S)
        terminal.type("echo on-$(hostname) $(tty); exit 5")
        terminal.expect(f"on-{robot} /dev/pts", SOON_S)
        assert terminal.wait(SOON_S) == 5


def test_a_reboot(fleet: Fleet) -> None:
    lab, robot = fleet.lab, fleet.lab.robots[1]
    before = lab.computers[robot].facts()["boot_id"]
    done = lab.cli("reboot", robot, "--wait", str(int(BACK_S)), "--json")
    assert results(done) == {robot: "rebooted"}, done.out
    assert lab.computers[robot].facts()["boot_id"] != before
    lab.wait_ready([robot], BACK_S)
    assert lab.release_of(robot) == fleet.first
    fleet.figures.note("reboot of one", str(row_of(done, robot)["what"]))


def test_a_reboot_of_one_that_moves_is_refused(fleet: Fleet) -> None:
    lab, robot = fleet.lab, fleet.lab.robots[1]
    lab.cli("request", "flocking", "--set", "cruise_m_s=0.05", "--robots", robot)
    until(lambda: lab.status().get(robot) == "ACTIVE", SOON_S, f"{robot} is active")
    done = lab.cli("reboot", robot, "--json", code=3)
    lab.cli("stop")
    assert results(done) == {robot: "refused"}
    assert "flocking" in str(row_of(done, robot)["what"])


def test_the_preflight_of_a_real_computer(fleet: Fleet) -> None:
    lab, robot = fleet.lab, fleet.lab.robots[0]
    done = lab.cli("doctor", "--robot", robot, "--yes", "--json", code=None)
    found = {check["name"]: check for check in done.json["checks"]}
    failed = {name: check["what"] for name, check in found.items() if check["status"] == "failure"}
    assert done.json["reached"] == {"bus": True, "ssh": True}, done.out
    assert not failed
    assert done.code == 0
    assert {"ssh", "bus", "software", "card", "clock", "units", "e-stop"} <= set(found), sorted(found)
    lab.computers[robot].do("systemctl", "stop", "fullswarm-agent")
    broken = lab.cli("doctor", "--robot", robot, "--no-estop", "--json", code=1)
    lab.computers[robot].do("systemctl", "start", "fullswarm-agent")
    mends = [check.get("mend", "") for check in broken.json["checks"] if check["status"] == "failure"]
    assert any("fullswarm logs" in mend for mend in mends), broken.out


@pytest.mark.parametrize("module", ["app/fullswarm/agent/node", "lib/msgspec/__init__"])
def test_torn_bytecode_keeps_no_agent_from_starting(fleet: Fleet, module: str) -> None:
    lab, robot = fleet.lab, fleet.lab.robots[1]
    computer, tag = lab.computers[robot], PYTHON.replace(".", "")
    torn = f"/var/cache/fullswarm/opt/fullswarm/releases/{fleet.first}/{module}.cpython-{tag}.pyc"
    computer.do("rm", "-f", "/run/fullswarm/agent-failed", "/run/fullswarm/bytecode-dropped")
    computer.do("truncate", "--size=64", torn)  # as by a full disk, which Python does not notice
    computer.do("systemctl", "restart", "fullswarm-agent", check=False)
    took_s = fleet.wait_runs(robot, fleet.first, BACK_S, f"{robot} starts in spite of it")
    fleet.figures.note("torn bytecode, runs again", f"{took_s:.1f} s")
    assert int(computer.do("stat", "-c", "%s", torn)) > 64
    lab.wait_ready([robot])


def test_an_update_of_a_computer_whose_root_is_read_only(fleet: Fleet) -> None:
    lab, robot = fleet.lab, fleet.lab.robots[2]
    computer = lab.computers[robot]
    computer.pull()
    computer.boot(writable=WRITABLE)
    computer.wait()
    computer.do("sh", "-c", "! touch /etc/anything 2>/dev/null")
    lab.wait_ready([robot])
    done = lab.cli("update", robot, "--release", fleet.second, "--allow-older", "--json")
    assert results(done) == {robot: "updated"}, done.out
    lab.cli("estop", robot)
    computer.do("systemctl", "restart", "fullswarm-agent")
    lab.wait_ready([robot])
    assert lab.stopped()[robot], "the latch is kept where it may be written"
    lab.cli("estop", "--clear")
    assert results(lab.cli("rollback", robot, "--json")) == {robot: "rolled back"}
    computer.pull()


def test_a_first_deploy_where_sudo_wants_a_password(fleet: Fleet) -> None:
    lab, robot = fleet.lab, fleet.lab.robots[-1]
    computer = lab.computers[robot]
    lab.blank(robot, f"{ADMIN} ALL=(ALL) ALL\n")
    computer.boot()
    computer.wait()
    computer.do("sh", "-c", f"echo '{ADMIN}:{PASSWORD}' | chpasswd")
    unasked = lab.cli("deploy", robot, "--release", fleet.first, "--allow-older", "--json", code=3)
    assert "--ask-sudo-password" in str(row_of(unasked, robot))
    wrong = _with_password(lab, "wrong", robot, fleet.first)
    assert wrong.returncode == 3
    assert "password is wrong" in wrong.stdout
    right = _with_password(lab, PASSWORD, robot, fleet.first)
    assert right.returncode == 0, right.stdout + right.stderr
    assert PASSWORD not in right.stdout + right.stderr + computer.journal("sudo", 1000)
    lab.wait_ready([robot])
    # From then on its own program may be run without.
    lab.cli("update", robot, "--release", fleet.second, "--allow-older")
    lab.blank(robot)
    lab.heal(robot)


def _with_password(lab: Lab, password: str, robot: str, release: str) -> subprocess.CompletedProcess[str]:
    words = lab.command("deploy", robot, "--release", release, "--allow-older", "--ask-sudo-password", "--json")
    return subprocess.run(
        words, input=f"{password}\n", capture_output=True, text=True, check=False, env=lab.environment, cwd=lab.folder
    )
