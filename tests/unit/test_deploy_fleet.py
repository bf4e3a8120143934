"""The fleet without a network: what robots say, which keys they show, what is asked of a shell."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import asyncssh
import pytest

from fullswarm.config import SwarmConfig
from fullswarm.deploy.fleet.choose import choose, misfit
from fullswarm.deploy.fleet.desired import Desired
from fullswarm.deploy.fleet.facts import Facts, Health, bare
from fullswarm.deploy.fleet.hostkeys import Pins, fingerprint, name_of
from fullswarm.deploy.fleet.login import Address, Login
from fullswarm.deploy.fleet.people import login, pick
from fullswarm.deploy.fleet.remote import Answer, NoRoot, Remote, root_script
from fullswarm.deploy.fleet.report import size
from fullswarm.deploy.fleet.ship import missing_of
from fullswarm.deploy.fleet.status import line
from fullswarm.deploy.fleet.terminal import json_line
from fullswarm.deploy.fleet.untrusted import clean, clean_log_line, last_words, strict_json
from fullswarm.deploy.release import sums
from fullswarm.deploy.release.keys import Keys
from fullswarm.deploy.release.manifest import Manifest, Target
from fullswarm.deploy.release.store import Store
from fullswarm.errors import ConfigError, FullswarmError, MessageError

KEY = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIJ4mWTLtnLS1f9gqhPp7uNfbZ2Y6vYkqYw9yUkFJ0nVd"
OTHER = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIB4mWTLtnLS1f9gqhPp7uNfbZ2Y6vYkqYw9yUkFJ0nVd"
RELEASE, NEWER = "1.0-0123456789ab", "1.1-0123456789ab"


# ---------------------------------------------------------------- what a robot says
def test_words_of_a_robot_are_one_printable_line() -> None:
    assert clean(b"\x1b[2Jowned\r\n\x07 by \xe2\x80\xae evil\xff") == "[2Jowned by evil�"
    assert clean("x" * 10_000_000, limit=5) == "xxxx…"
    assert clean_log_line(b"  \x1b]0;title\x07 text\n") == "   ]0;title  text"
    assert last_words(b"first\nlast one\n\n") == "last one"
    assert last_words(b"refused (no signature.\r )\n") == "refused (no signature. )"


@pytest.mark.parametrize(
    "said", [b"", b"nonsense", b"[]", b'{"protocol": "1"}', b"[" * 100_000, b'{"releases": [1]}', b"\xff"]
)
def test_answers_that_are_none(said: bytes) -> None:
    with pytest.raises(MessageError, match="r1: its answer cannot be read"):
        strict_json(said, Facts, "r1")


def test_facts_may_hold_more_than_we_know() -> None:
    said = {
        "protocol": 1,
        "current": RELEASE,
        "pending": None,
        "news": {"a": 1},
        "health": {"moving": True, "behaviour": "flocking"},
    }
    facts = strict_json(json.dumps(said).encode(), Facts, "r1")
    assert (facts.installed, facts.settled, facts.busy_with) == (True, True, "moving (flocking)")


def test_a_bare_computer_says_what_it_is() -> None:
    said = b"arch=aarch64\nglibc=2.36\npython=3.11\npython3.13=yes\ndisk_free_kb=2048\nclock_utc=12\nsystemd=yes\n"
    tools = b"has_ssh-keygen=yes\nhas_tar=yes\nhas_gzip=yes\nhas_awk=yes\n"
    facts = bare(said + tools, "r1")
    assert (facts.arch, facts.pythons, facts.disk_free_bytes, facts.installed) == (
        "aarch64",
        ["3.13"],
        2 * 2**20,
        False,
    )
    with pytest.raises(FullswarmError, match="r1: ssh-keygen, tar, gzip, awk not there"):
        bare(said, "r1")
    with pytest.raises(MessageError):
        bare(b"arch=\nclock_utc=soon\n", "r1")


def test_a_robot_may_ask_for_nothing_outside_the_release(tmp_path: Path) -> None:
    (tmp_path / sums.FILE).write_text(f"{'0' * 64}  lib/a.py\n{'1' * 64}  lib/b.py\n")
    assert missing_of(tmp_path, b"lib/b.py\nlib/a.py\nlib/a.py\n", "r1") == ("lib/a.py", "lib/b.py")
    with pytest.raises(MessageError, match="which is not in the release"):
        missing_of(tmp_path, b"lib/a.py\n../../keys/release_ed25519\n", "r1")


# ---------------------------------------------------------------- host keys
@pytest.fixture
def pins(tmp_path: Path) -> Pins:
    return Pins(tmp_path / "known_hosts", tmp_path / "hosts")


def test_a_pinned_key_holds_for_its_name_and_port_alone(pins: Pins) -> None:
    pins.pin("10.0.0.1", 22, KEY + " comment")
    pins.pin("10.0.0.1", 2222, OTHER)
    assert pins.known_hosts.read_text() == f"10.0.0.1 {KEY}\n[10.0.0.1]:2222 {OTHER}\n"
    assert pins.keys("r1", "10.0.0.1", 22) == [KEY]
    assert pins.keys("r1", "10.0.0.1", 2222) == [OTHER]
    assert pins.keys("r1", "10.0.0.1", 23) == []
    assert name_of("r1.local", 22) == "r1.local"


def test_a_line_may_have_several_names(pins: Pins) -> None:
    pins.known_hosts.write_text(f"# ours\nr1.local,10.0.0.1 {KEY}\n|1|hash= {OTHER}\n@revoked * {OTHER}\n\n")
    assert pins.keys("r1", "10.0.0.1", 22) == pins.keys("r1", "r1.local", 22) == [KEY]


def test_a_flashed_robot_is_known_and_a_pinned_key_goes_before(pins: Pins) -> None:
    pins.flashed.mkdir()
    (pins.flashed / "r1_ed25519.pub").write_text(f"{KEY} fullswarm lab r1\n")
    assert pins.keys("r1", "anywhere", 22) == [KEY]
    assert pins.keys("r2", "anywhere", 22) == []
    assert "rm '" in str(pins.changed("r1", "anywhere", 22))
    pins.pin_flashed("r1", "anywhere", 22)
    pins.pin_flashed("r1", "anywhere", 22)
    assert pins.known_hosts.read_text() == f"anywhere {KEY}\n"
    assert "ssh-keygen -R 'anywhere'" in str(pins.changed("r1", "anywhere", 22))


@pytest.mark.skipif(shutil.which("ssh-keygen") is None, reason="needs ssh-keygen: sudo apt install openssh-client")
def test_fingerprints_are_those_of_ssh_keygen(tmp_path: Path) -> None:
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", tmp_path / "key"], check=True)
    public = tmp_path / "key.pub"
    said = subprocess.run(["ssh-keygen", "-lf", public], check=True, capture_output=True, text=True).stdout
    assert fingerprint(public.read_text()) in said.split()


def forbid(monkeypatch: pytest.MonkeyPatch, file: Path) -> None:
    """Let a file be another user's, for root too."""
    real_open, real_read = os.open, Path.read_text

    def refuse(path: object) -> None:
        if Path(str(path)) == file:
            raise PermissionError(13, "Permission denied", str(file))

    def opened(path: Any, *rest: Any, **more: Any) -> int:
        refuse(path)
        return real_open(path, *rest, **more)

    def read(path: Path, *rest: Any, **more: Any) -> str:
        refuse(path)
        return real_read(path, *rest, **more)

    monkeypatch.setattr(os, "open", opened)
    monkeypatch.setattr(Path, "read_text", read)


def test_files_that_root_has_left_are_named_with_what_gives_them_back(
    pins: Pins, monkeypatch: pytest.MonkeyPatch
) -> None:
    uses: dict[Path, tuple[Callable[[], object], ...]] = {
        pins.known_hosts: (
            lambda: pins.keys("r1", "10.0.0.1", 22),
            lambda: pins.pin("10.0.0.1", 22, KEY),
            lambda: pins.pin_flashed("r1", "10.0.0.1", 22),
            lambda: pins.changed("r1", "10.0.0.1", 22),
        ),
        pins.flashed / "r1_ed25519.pub": (lambda: pins.keys("r1", "10.0.0.1", 22),),
    }
    for file, calls in uses.items():
        with monkeypatch.context() as patched:
            forbid(patched, file)
            for call in calls:
                with pytest.raises(ConfigError, match="cannot be read or written: permission denied") as caught:
                    call()
                assert caught.value.where == str(file)
                assert caught.value.hint == f"sudo chown -R \"$USER\" '{file.parent}'"


@pytest.mark.skipif(shutil.which("ssh-keygen") is None, reason="needs ssh-keygen: sudo apt install openssh-client")
def test_a_fleet_key_that_root_has_left_is_no_robots_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keys = Keys(tmp_path / "keys")
    key = keys.fleet_key()
    assert login(FLEET, keys).fleet_key == key
    real_open = Path.open

    def opened(path: Path, *rest: Any, **more: Any) -> Any:
        if path == key:
            raise PermissionError(13, "Permission denied", str(key))
        return real_open(path, *rest, **more)

    monkeypatch.setattr(Path, "open", opened)
    with pytest.raises(ConfigError, match=r"fleet_ed25519: cannot be read.*sudo chown"):
        login(FLEET, keys)


# ---------------------------------------------------------------- jump hosts
@pytest.mark.parametrize(
    ("error", "arrives", "says"),
    [
        (asyncssh.HostKeyNotVerifiable("Host key is not trusted for host hop"), False, "jump host hop, .*`ssh hop`"),
        (asyncssh.KeyExchangeFailed("No matching host key algorithm found"), False, "jump host, .*`ssh JUMPHOST`"),
        (asyncssh.HostKeyNotVerifiable("Host key is not trusted for host 10.0.0.1"), True, "another host key"),
        (asyncssh.KeyExchangeFailed("No matching host key algorithm found"), True, "another host key"),
    ],
)  # fmt: skip
def test_a_jump_host_nobody_knows_is_not_taken_for_the_robot(
    pins: Pins, monkeypatch: pytest.MonkeyPatch, error: Exception, arrives: bool, says: str
) -> None:
    async def connect(*_: object, client_factory: Callable[[], object], **__: object) -> None:
        if arrives:  # asyncssh makes the client when the connection stands, before host keys are shown
            client_factory()
        raise error

    async def enter() -> None:
        async with Login(pins, Path("no key")).connect(HERE):
            pass

    pins.pin(HERE.host, HERE.port, KEY)
    monkeypatch.setattr(asyncssh, "connect", connect)
    with pytest.raises(FullswarmError, match=says) as caught:
        asyncio.run(enter())
    assert ("ssh-keygen -R" in caught.value.hint) == arrives


def test_who_only_asks_for_a_host_key_hears_of_the_jump_host_too(pins: Pins, monkeypatch: pytest.MonkeyPatch) -> None:
    async def ask(*_: object) -> None:
        raise asyncssh.HostKeyNotVerifiable("Host key is not trusted for host hop with alias bastion")

    monkeypatch.setattr(asyncssh, "get_server_host_key", ask)
    with pytest.raises(FullswarmError, match=r"jump host hop, .*`ssh hop` once"):
        asyncio.run(Login(pins, Path("no key")).host_key(HERE))


# ---------------------------------------------------------------- what is asked of a shell
def test_a_password_is_taken_off_the_input_whether_sudo_reads_it_or_not(tmp_path: Path) -> None:
    script, first = root_script("cat", "s3cret")
    for reads in ('IFS= read -r p; [ "$p" = s3cret ] || exit 1; echo asked >> asked\n', ""):
        sudo = tmp_path / "sudo"
        sudo.write_text(
            f'#!/bin/sh\n{reads}while :; do case $1 in -p) shift 2 ;; -*) shift ;; *) break ;; esac; done\nexec "$@"\n'
        )
        sudo.chmod(0o755)
        plain = script.replace("$(id -u)", "$(echo 1000)")
        done = subprocess.run(
            ["sh", "-c", plain], input=first + b"fullswarm-begins\ndata", capture_output=True, check=False,
            cwd=tmp_path, env={"PATH": f"{tmp_path}:/usr/bin:/bin"},
        )  # fmt: skip
        assert (done.returncode, done.stdout, done.stderr) == (0, b"fullswarm-begins\ndata", b"")
    assert (tmp_path / "asked").read_text() == "asked\n"


def test_root_needs_no_sudo_and_others_are_never_asked_for_a_password() -> None:
    script, first = root_script("cat", None)
    assert first == b""
    assert "sudo -n" in script
    asroot = script.replace("$(id -u)", "$(echo 0)")
    done = subprocess.run(
        ["sh", "-c", asroot], input=b"data", capture_output=True, check=True, env={"PATH": "/usr/bin:/bin"}
    )
    assert done.stdout == b"data"


HOSTNAME = b"sudo: unable to resolve host r1: Name or service not known\n"


def heard(answer: Answer, monkeypatch: pytest.MonkeyPatch) -> Answer:
    """Let a robot answer a command that shall run as root."""

    async def run(*_: object, **__: object) -> Answer:
        return answer

    monkeypatch.setattr(Remote, "run", run)
    return asyncio.run(Remote("r1", cast(Any, None)).program("health"))


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (1, b"sudo: a password is required\n"),
        (1, b"Sorry, try again.\nsudo: no password was provided\nsudo: 1 incorrect password attempt\n"),
        (1, HOSTNAME + b"Sorry, try again.\nsudo: 3 incorrect password attempts\n"),
        (1, b"pi is not in the sudoers file.  This incident will be reported.\n"),
        (1, b"Sorry, user pi is not allowed to execute '/bin/sh' as root on r1.\n"),
        (1, b"Sorry, user pi may not run sudo on r1.\n"),
        (1, b"sudo: sorry, you must have a tty to run sudo\n"),
        (1, b"sudo-rs: interactive authentication is required\n"),
        (127, b"sh: 1: exec: sudo: not found\n"),
        (127, b"bash: sudo: command not found\n"),
    ],
)
def test_sudo_that_refuses_is_no_root(code: int, said: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(NoRoot) as caught:
        heard(Answer(code, b"", said), monkeypatch)
    assert caught.value.what == f"may not become root there: {clean(said.splitlines()[-1])}"


@pytest.mark.parametrize(
    ("code", "out", "said", "why"),
    [
        (1, b"", b"fullswarm-robot: no health yet\n", "fullswarm-robot: no health yet"),
        (1, b"", HOSTNAME + b"fullswarm-robot: 9 s old\n", "fullswarm-robot: 9 s old"),
        (1, b"", b"sudo: no tty\nfullswarm-robot: 9 s old\n", "fullswarm-robot: 9 s old"),
        (1, b"", HOSTNAME + b"install.sh: the kit is damaged\n", "install.sh: the kit is damaged"),
        (1, b"lib/a.py\n", HOSTNAME, "sudo: unable to resolve host r1: Name or service not known"),
        (1, b"", HOSTNAME, "sudo: unable to resolve host r1: Name or service not known"),
        (1, b"", b"sudo: x: command not found\n", "sudo: x: command not found"),
        (127, b"", HOSTNAME + b"sh: 1: exec: x: not found\n", "sh: 1: exec: x: not found"),
        (3, b"", HOSTNAME + b"fullswarm-robot: refused: moving\n", "fullswarm-robot: refused: moving"),
    ],
)  # fmt: skip
def test_what_ran_as_root_is_heard_whatever_sudo_warned_of(
    code: int, out: bytes, said: bytes, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = heard(Answer(code, out, said), monkeypatch)
    assert (answer.code, answer.words) == (code, why)


# ---------------------------------------------------------------- who and what
FLEET = SwarmConfig.model_validate(
    {
        "robot": [{"id": "r1", "driver": "null://r1"}, {"id": "r2", "host": "10.0.0.2"}, {"id": "s1"}],
        "groups": {"all": ["r1", "s1"]},
    }
)


def test_robots_by_name_and_group() -> None:
    def ids(*named: str) -> list[str]:
        return [each.id for each in pick(FLEET, named, Path("lab.toml"))]

    assert ids() == ["r1", "r2"]  # a simulated one has no computer, unless somebody says so
    assert ids("r2,r1") == ["r2", "r1"]
    assert ids("@all", "r1") == ["r1", "s1"]
    with pytest.raises(ConfigError, match=r"lab.toml: no robot 'r3' in this fleet \(known: @all, r1, r2, s1\)"):
        ids("r3")


@pytest.mark.parametrize("named", [("",), (",",), ("@spare",), ("@spare", "")])
def test_a_name_that_stands_for_nobody_is_not_the_whole_fleet(named: tuple[str, ...]) -> None:
    fleet = FLEET.model_copy(update={"groups": {"spare": ()}})
    with pytest.raises(ConfigError) as caught:
        pick(fleet, named, Path("lab.toml"))
    assert f"'{' '.join(named)}' stands for no robot" in str(caught.value)
    assert [each.id for each in pick(fleet, (*named, "r1"), Path("lab.toml"))] == ["r1"]


def test_a_host_that_is_not_named_is_found_by_its_id() -> None:
    assert Address.of(FLEET.robot[0]) == Address("r1", "r1.local", 22, "fullswarm-admin")


def test_which_release_fits(tmp_path: Path) -> None:
    manifest = Manifest(RELEASE, "1.0", Target("rpi-arm64", "aarch64", "2.28", "3.11"))
    robot = Facts(arch="aarch64", glibc="2.36", python="3.11.2")
    assert misfit(manifest, robot) == ""
    assert misfit(manifest, Facts(arch="aarch64", python="3.10", pythons=["3.10", "3.11"])) == ""
    assert misfit(manifest, Facts(arch="armv7l", python="3.11")) == "is for aarch64, this computer is armv7l"
    assert misfit(manifest, Facts(arch="aarch64", glibc="2.9", python="3.11")) == "needs glibc 2.28, here is 2.9"
    assert misfit(manifest, Facts(arch="aarch64", python="3.13")) == "is for Python 3.11, here is 3.13"
    with pytest.raises(ConfigError, match=r"fullswarm bundle --target rpi-arm64 --python 3\.13"):
        choose(Store(tmp_path), None, Facts(arch="aarch64", python="3.13"), "r1")
    with pytest.raises(ConfigError, match="install a 64-bit system"):
        choose(Store(tmp_path), None, Facts(arch="armv7l", python="3.13"), "r1")


def test_what_robots_should_run_is_kept(tmp_path: Path) -> None:
    desired = Desired(tmp_path / "state/lab.json")
    assert desired.read() == {}
    desired.want({"r1": RELEASE, "r2": RELEASE})
    desired.want({"r2": "1.1-0123456789ab"})
    assert desired.read() == {"r1": RELEASE, "r2": "1.1-0123456789ab"}
    desired.file.write_text('{"r1": 3, "r2": "../x", "r3": "1.1-0123456789ab"}')
    assert desired.read() == {"r3": "1.1-0123456789ab"}
    desired.file.write_text("{")
    assert desired.read() == {}


def test_what_cannot_be_kept_is_a_warning_for_the_robots_have_done_their_part(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "state").write_text("no folder")
    desired = Desired(tmp_path / "state/lab.json")
    desired.want({"r1": RELEASE})
    assert f"warning: {desired.file}: cannot keep what robots should run" in capsys.readouterr().err


# ---------------------------------------------------------------- the table
WAIT = "wait a minute; its guard decides"
HERE = Address("r1", "10.0.0.1", 22, "me")
GOOD = Health(release=RELEASE, healthy=True)


@pytest.mark.parametrize(
    ("facts", "wanted", "health", "mend"),
    [
        (Facts(), "", "not installed", "fullswarm deploy r1"),
        (Facts(protocol=1, robot="r2"), "", "another robot", "`host` in the fleet file, or deploy it under this name"),
        (Facts(protocol=1, robot="r1"), "", "no release", "fullswarm deploy r1"),
        (Facts(protocol=1, robot="r1", current=RELEASE, pending=RELEASE), "", "pending", WAIT),
        (Facts(protocol=1, robot="r1", current=RELEASE), "", "silent", "fullswarm logs r1"),
        (Facts(protocol=1, robot="r1", current=RELEASE, health=Health()), "", "not healthy", "fullswarm logs r1"),
        (Facts(protocol=1, robot="r1", current=RELEASE, health=GOOD), RELEASE, "healthy", ""),
        (Facts(protocol=1, robot="r1", current=RELEASE, health=GOOD), NEWER, "healthy", "fullswarm update r1"),
    ],
)  # fmt: skip
def test_each_state_says_what_to_do(facts: Facts, wanted: str, health: str, mend: str) -> None:
    told = line(HERE, facts, wanted)
    assert (told.health, told.mend) == (health, mend)
    assert (told.exit_code == 0) == (health == "healthy" and not told.skew)


def test_warnings_stand_beside_a_healthy_robot() -> None:
    facts = Facts(
        protocol=1, robot="r1", current=RELEASE, health=GOOD, temperature_c=84.0, disk_free_bytes=1_000_000,
        clock_utc=time.time() - 3600,
    )  # fmt: skip
    told = line(HERE, facts, RELEASE)
    assert told.why == "clock off by -3600 s; 1 MB of disk free; 84 °C"


def test_sizes_for_people() -> None:
    assert [size(each) for each in (0, 999, 99_000, 40_800_000)] == ["-", "999 B", "99 kB", "40.8 MB"]


def test_a_line_of_the_journal_as_json() -> None:
    said = {"MESSAGE": "hub\x1b[2J lost", "__REALTIME_TIMESTAMP": "1800000000500000", "PRIORITY": "4"}
    assert json.loads(json_line(json.dumps(said).encode())) == {
        "time_s": 1.8e9 + 0.5, "priority": 4, "text": "hub [2J lost",
    }  # fmt: skip
    assert json.loads(json_line(b"sudo: no tty \xff")) == {"text": "sudo: no tty \ufffd"}
    assert json.loads(json_line(b'{"MESSAGE": [1, 2], "__REALTIME_TIMESTAMP": 1}'))["text"] == "bytes that are no text"
