"""The agent's user attacks root through the files that it owns: links, FIFOs, devices, swapped folders, texts."""

from __future__ import annotations

import json
import os
import pwd
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.unit.deploy_robot.script import Robot

NOBODY = pwd.getpwnam("nobody")
SECRET = "root:$6$the-secret-of-root"
UPTIME_S = 1000
"""What the robot takes for the time since power-on, so that a report of this age is a new one."""
TIME_S = 60.0
"""In which root must have ended whatever it finds; a FIFO would keep it for ever."""

pytestmark = pytest.mark.skipif(
    os.geteuid() != 0 or shutil.which("setpriv") is None, reason="only root can be attacked by another user"
)


class Hostile(Robot):
    """A robot whose agent's user is `nobody`, and hostile."""

    user = "nobody"

    @property
    def environment(self) -> dict[str, str]:
        return {**super().environment, "FULLSWARM_AGENT_USER": self.user}

    @property
    def own(self) -> Path:
        """The folder that systemd gives to the agent's user."""
        return self.root / "run/fullswarm"

    @property
    def report(self) -> Path:
        return self.own / "health.json"

    @property
    def cache(self) -> Path:
        return self.root / "var/cache/fullswarm"

    def give(self, folder: Path) -> None:
        """Let the agent's user own a folder."""
        folder.mkdir(parents=True, exist_ok=True)
        for each in (folder, *folder.rglob("*")):
            os.chown(each, NOBODY.pw_uid, NOBODY.pw_gid, follow_symlinks=False)

    def attack(self, script: str) -> None:
        """Run a script as the agent's user."""
        subprocess.run(
            ["setpriv", f"--reuid={NOBODY.pw_uid}", f"--regid={NOBODY.pw_gid}", "--clear-groups", "sh", "-ec", script],
            cwd=self.own, check=True, env={"PATH": os.environ["PATH"], "ROOT": str(self.root)},
        )  # fmt: skip


@pytest.fixture
def hostile(bare: Robot) -> Iterator[Hostile]:
    folder = Path(tempfile.mkdtemp(prefix="fullswarm-hostile-"))  # tmp_path lets no other user in
    folder.chmod(0o755)
    try:
        copied = bare.copy(folder / "robot")
        robot = Hostile.__new__(Hostile)
        robot.__dict__.update(copied.__dict__)
        for each in (robot.folder, robot.root, robot.root / "run"):
            each.chmod(0o755)
        robot.give(robot.own)
        secret = robot.root / "etc/shadow"
        secret.write_text(f'{{\n "healthy": true,\n "robot": "{SECRET}"\n}}\n')
        secret.chmod(0o600)
        robot.run_release(robot.make("1.0.0"))
        robot.give(robot.own)
        cut = shutil.which("cut")
        robot.program("cut", f'[ "$*" = "-d. -f1 /proc/uptime" ] && exec echo {UPTIME_S}; exec {cut} "$@"')
        yield robot
    finally:
        shutil.rmtree(folder)


def _link(robot: Hostile) -> None:
    robot.attack('ln -sf "$ROOT/etc/shadow" health.json')


def _link_in_a_link(robot: Hostile) -> None:
    robot.attack('mkdir d; ln -s "$ROOT/etc/shadow" d/x; ln -sf d/x health.json')


def _hard_link(robot: Hostile) -> None:
    robot.report.unlink()
    os.link(robot.root / "etc/shadow", robot.report)  # as a kernel without fs.protected_hardlinks permits


def _fifo(robot: Hostile) -> None:
    robot.attack("rm health.json; mkfifo health.json")


def _endless(robot: Hostile) -> None:
    robot.attack("ln -sf /dev/zero health.json")


def _huge(robot: Hostile) -> None:
    robot.attack("truncate -s 40G health.json")


def _folder(robot: Hostile) -> None:
    robot.attack("rm -f health.json; mkdir health.json; touch health.json/x")


def _nothing(robot: Hostile) -> None:
    robot.attack("rm health.json")


def _text(text: str) -> Callable[[Hostile], None]:
    def attack(robot: Hostile) -> None:
        robot.report.write_text(text)
        robot.give(robot.own)

    return attack


AGED = f'"machine_s": {UPTIME_S}'
ATTACKS = {
    "link": _link,
    "link in a link": _link_in_a_link,
    "hard link": _hard_link,
    "FIFO": _fifo,
    "endless": _endless,
    "huge": _huge,
    "folder": _folder,
    "nothing": _nothing,
    "other facts": _text(f'{{\n {AGED}\n}}, "current": "9.9-000000000000", "x": {{}}\n'),
    "other facts in a line": _text(f'{{\n {AGED}, "current": "9.9-000000000000"\n}},\n "current": "9.9"\n'),
    "other facts after the end": _text(f'{{\n {AGED}\n}}\n, "current": "9.9-000000000000"\n'),
    "unbalanced": _text(f'{{\n {AGED},\n "why": [\n'),
    "bad text": _text(f'{{\n {AGED},\n "why": "\\q"\n}}\n'),
    "bad number": _text(f'{{\n {AGED},\n "battery": 01.-e\n}}\n'),
    "open text": _text(f'{{\n {AGED},\n "why": "\\"\n}}\n'),
    "shell": _text('{\n "machine_s": "$(touch /tmp/owned)",\n "moving": "`reboot`"\n}\n'),
    "bytes": _text("\0\x1b[2J\u202e" * 1000),
}


@pytest.mark.parametrize("attack", ATTACKS.values(), ids=ATTACKS.keys())
def test_a_report_is_read_as_the_agents_user_and_misleads_nobody(
    hostile: Hostile, attack: Callable[[Hostile], None]
) -> None:
    release = hostile.current
    attack(hostile)
    began_s = time.monotonic()
    for word in ("facts", "health"):
        done = hostile.call(word)
        assert SECRET.encode() not in done.stdout + done.stderr
        assert len(done.stdout) < 100_000
    facts = hostile.facts  # JSON
    assert facts["current"] == release
    assert set(facts) == set(hostile.facts)
    assert time.monotonic() - began_s < TIME_S


@pytest.mark.parametrize("attack", [_link, _fifo, _endless])
def test_whatever_the_report_is_the_robot_is_updated_and_goes_back(
    hostile: Hostile, attack: Callable[[Hostile], None]
) -> None:
    first, newer = hostile.current, hostile.make("1.0.1")
    attack(hostile)
    hostile.ship(newer)
    attack(hostile)
    hostile.ok("switch", newer.name)
    hostile.give(hostile.own)
    attack(hostile)
    hostile.ok("commit", newer.name)
    hostile.ok("rollback")
    assert hostile.current == first


def test_a_report_that_is_swapped_all_the_time_shows_no_secret(hostile: Hostile) -> None:
    good = hostile.own / "good"
    hostile.tell(False)
    shutil.copy(hostile.report, good)
    hostile.give(hostile.own)
    words = 'cp good a; mv -f a health.json; ln -s "$ROOT/etc/shadow" b; mv -fT b health.json'
    swapping = subprocess.Popen(
        ["setpriv", f"--reuid={NOBODY.pw_uid}", f"--regid={NOBODY.pw_gid}", "--clear-groups", "sh", "-c",
         f"while :; do {words}; done"],
        cwd=hostile.own, env={"PATH": os.environ["PATH"], "ROOT": str(hostile.root)}, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        for _ in range(10):
            done = hostile.call("health")
            assert SECRET.encode() not in done.stdout + done.stderr
    finally:
        swapping.kill()
        swapping.wait()


def test_a_true_report_is_passed_on_as_it_is(hostile: Hostile) -> None:
    hostile.tell(False, "READY", "flocking")
    report = {**json.loads(hostile.report.read_text()), "machine_s": UPTIME_S + 0.5, "healthy": False}
    for why in ([], ['it "moves"', "a\\b", "\u00e9"]):
        report["why"] = why
        hostile.report.write_text(json.dumps(report, indent=1) + "\n")
        hostile.give(hostile.own)
        assert json.loads(hostile.ok("health")) == report
        assert hostile.facts["health"] == report


def test_what_is_dropped_from_the_cache_is_dropped_as_the_agents_user(hostile: Hostile) -> None:
    """The folder of bytecode leads to files of root under the name of an old release."""
    old = str(hostile.current)
    hostile.run_release(hostile.make("1.0.1"))
    precious = hostile.root / "srv" / old / "precious"
    precious.parent.mkdir(parents=True)
    precious.write_text("of root")
    hostile.give(hostile.cache)
    hostile.attack('mkdir -p "$ROOT/var/cache/fullswarm/opt/fullswarm"')
    hostile.attack('ln -s "$ROOT/srv" "$ROOT/var/cache/fullswarm/opt/fullswarm/releases"')
    hostile.run_release(hostile.make("1.0.2"))  # drops the first release
    assert old not in hostile.releases
    assert precious.read_text() == "of root"


def test_bytecode_is_kept_as_the_agents_user(hostile: Hostile) -> None:
    """What would be written for the next release leads to a folder of root."""
    victim = hostile.root / "srv/victim"
    (victim / str(hostile.current)).mkdir(parents=True)
    hostile.give(hostile.cache)
    hostile.attack('mkdir -p "$ROOT/var/cache/fullswarm/opt/fullswarm"')
    hostile.attack('ln -s "$ROOT/srv/victim" "$ROOT/var/cache/fullswarm/opt/fullswarm/releases"')
    before = sorted(victim.rglob("*"))
    hostile.run_release(hostile.make("1.0.1"))
    assert sorted(victim.rglob("*")) == before


def test_bytecode_of_the_own_cache_is_linked(hostile: Hostile) -> None:
    own = hostile.cache / "opt/fullswarm/releases" / str(hostile.current) / "app"
    own.mkdir(parents=True)
    (own / "hello.cpython-311.pyc").write_text("compiled")
    hostile.give(hostile.cache)
    newer = hostile.make("1.0.1")
    hostile.ship(newer)
    kept = hostile.cache / "opt/fullswarm/releases" / newer.name / "app/hello.cpython-311.pyc"
    assert kept.stat().st_uid == NOBODY.pw_uid


def test_without_its_user_there_is_no_report(hostile: Hostile) -> None:
    hostile.user = "fullswarm-no-such-user"
    assert hostile.facts["health"] is None
