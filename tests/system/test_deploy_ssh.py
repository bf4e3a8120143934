"""The fleet over real SSH: first installs, updates, links that are cut, keys that are wrong, robots that are away."""

from __future__ import annotations

import asyncio
import getpass
import hashlib
import random
import threading
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import TypeVar

import pytest

from fullswarm.deploy.fleet.login import Address, Login, Pins, key_fingerprint
from fullswarm.deploy.fleet.remote import Answer, LinkBroke, Remote
from fullswarm.deploy.release.keys import Keys, public
from fullswarm.deploy.release.manifest import Target
from fullswarm.deploy.release.store import head_archive
from fullswarm.deploy.robot.support_package import support_package
from fullswarm.drivers.fleet_file import load_fleet
from fullswarm.errors import Unreachable
from tests.system.ssh_lab import Lab
from tests.system.ssh_robots import (
    make_release,
    needs_sshd,
    new_host_key,
    wait_until,
)

T = TypeVar("T")
pytestmark = needs_sshd


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    for name, folder in (("HOME", "me"), ("XDG_STATE_HOME", "me/state"), ("XDG_CONFIG_HOME", "me/config")):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        monkeypatch.setenv(name, str(tmp_path / folder))
    monkeypatch.setenv("FULLSWARM_KEYS", str(tmp_path / "keys"))
    monkeypatch.setenv("FULLSWARM_RELEASES", str(tmp_path / "releases"))
    monkeypatch.delenv("SSH_AUTH_SOCK", raising=False)
    lab = Lab(tmp_path)
    yield lab
    for each in lab.robots:
        each.kill_all()


def test_a_first_deploy_installs_and_a_second_changes_nothing(lab: Lab) -> None:
    (robot,) = lab.add(1)
    first = lab.release("1.0")
    done = lab.deploy()
    assert done[""]["exit_code"] == 0, done
    assert (done["r1"]["result"], done["r1"]["release"]) == ("updated", first)
    assert (robot.current, robot.pending(), robot.restarts) == (first, False, 1)
    again = lab.deploy()
    assert again[""]["exit_code"] == 0
    assert again["r1"]["result"] == "unchanged"
    assert "nothing was changed" in again["r1"]["what"]
    assert again["r1"]["shipped_bytes"] < 100_000
    assert robot.restarts == 1


def test_an_update_ships_what_changed(lab: Lab) -> None:
    (robot,) = lab.add(1)
    lab.release("1.0", library_bytes=3_000_000)
    lab.deploy()
    second = lab.release("1.1", library_bytes=3_000_000)
    done = lab.ask("update")
    assert done["r1"]["result"] == "updated", done
    assert done["r1"]["shipped_bytes"] < 100_000
    assert (robot.current, robot.restarts) == (second, 2)


@pytest.mark.parametrize(("mode", "why"), [("fault", "fault: burnt"), ("dead", "did not start")])
def test_a_broken_release_is_taken_back(lab: Lab, mode: str, why: str) -> None:
    (robot,) = lab.add(1)
    first = lab.release("1.0")
    lab.deploy()
    lab.release("1.1", mode=mode)
    done = lab.ask("update")
    assert done[""]["exit_code"] == 1
    assert (done["r1"]["result"], done["r1"]["release"]) == ("rolled back", first), done
    assert why in done["r1"]["what"]
    assert (robot.current, robot.pending()) == (first, False)
    shown = lab.ask("fleet")["r1"]
    assert shown["health"] == "healthy"
    assert shown["skew"].startswith("wants 1.1-")
    assert why in shown["why"]
    assert shown["mend"] == "fullswarm update r1"


def test_a_robot_that_says_it_is_sick_is_taken_back_in_time(lab: Lab) -> None:
    (robot,) = lab.add(1)
    first = lab.release("1.0")
    lab.deploy()
    lab.release("1.1", mode="sick")
    done = lab.ask("update", "--guard", "12")
    assert done["r1"]["result"] == "rolled back"
    assert "the driver does not answer" in done["r1"]["what"]
    assert (robot.current, robot.pending()) == (first, False)


def test_a_moving_robot_is_left_alone_unless_forced(lab: Lab) -> None:
    (robot,) = lab.add(1)
    first = lab.release("1.0")
    lab.deploy()
    (robot.root / "moving").touch()
    wait_until(lambda: '"moving": true' in (robot.root / "run/fullswarm/health.json").read_text(), "it moves")
    second = lab.release("1.1")
    done = lab.ask("update")
    assert (done[""]["exit_code"], done["r1"]["result"]) == (3, "refused")
    assert "flocking" in done["r1"]["what"]
    assert (robot.current, robot.restarts) == (first, 1)
    for words in ("rollback", "reboot"):
        assert lab.ask(words)["r1"]["result"] == "refused"
    assert lab.ask("update", "--force")["r1"]["result"] == "updated"
    assert robot.current == second


def test_a_foreign_signature_is_refused_before_anything_is_written(lab: Lab, tmp_path: Path) -> None:
    (robot,) = lab.add(1)
    first = lab.release("1.0")
    lab.deploy()
    before = sorted(each.name for each in (robot.root / "opt/fullswarm/releases").iterdir())
    name = make_release(lab.store, Keys(tmp_path / "foreign"), "6.6")
    done = lab.ask("update", "--release", name)
    assert done["r1"]["result"] == "failed"
    assert "signature" in done["r1"]["what"]
    assert sorted(each.name for each in (robot.root / "opt/fullswarm/releases").iterdir()) == before == [first]


def test_a_stale_signature_is_refused(lab: Lab) -> None:
    (robot,) = lab.add(1)
    first = lab.release("1.0")
    lab.deploy()
    name = lab.release("1.1")
    signature = lab.store.get(first) / "SHA256SUMS.sig"
    (lab.store.get(name) / "SHA256SUMS.sig").write_bytes(signature.read_bytes())
    done = lab.ask("update", "--release", name)
    assert "signature" in done["r1"]["what"]
    assert robot.current == first
    assert not list((robot.root / "opt/fullswarm/releases").glob(".incoming-*"))


def test_a_cut_link_is_resumed_within_the_same_command(lab: Lab) -> None:
    (robot,) = lab.add(1)
    lab.release("1.0")
    lab.deploy()
    # Many files: what has arrived whole need not come again.
    files = {
        f"lib/part{number}.so": bytes([number]) + random.Random(number).randbytes(2_000_000) for number in range(12)
    }
    second = lab.release("1.1", files=files)
    total = sum(map(len, files.values()))
    incoming = robot.root / f"opt/fullswarm/releases/.incoming-{second}"

    def cut() -> None:
        wait_until(lambda: len(list(incoming.glob("lib/part*"))) >= 4, "parts arrive", within_s=60.0)
        robot.cut()

    cutter = threading.Thread(target=cut)
    cutter.start()
    done = lab.ask("update")
    cutter.join()
    assert done["r1"]["result"] == "updated", done
    assert robot.current == second
    assert total < done["r1"]["shipped_bytes"] < 1.95 * total


def test_another_host_key_is_an_error_that_says_what_to_do(lab: Lab) -> None:
    (robot,) = lab.add(1)
    lab.release("1.0")
    lab.deploy()
    robot.stop()
    new_host_key(robot.root)
    robot.start()
    done = lab.deploy()  # --accept-new-host-keys is for new ones, not for changed ones
    assert (done[""]["exit_code"], done["r1"]["result"]) == (3, "failed")
    assert "another host key" in done["r1"]["what"]
    command = done["r1"]["mend"]
    assert f"ssh-keygen -R '[127.0.0.1]:{robot.port}'" in command
    assert str(lab.keys.known_hosts) in command


def test_an_unknown_computer_is_not_logged_in_to(lab: Lab) -> None:
    (robot,) = lab.add(1)
    lab.release("1.0")
    done = lab.ask("deploy")  # no terminal that could be asked
    assert (done[""]["exit_code"], done["r1"]["result"]) == (3, "failed")
    assert key_fingerprint((robot.root / "host_key.pub").read_text()) in done["r1"]["what"]
    assert not (robot.root / "opt/fullswarm").exists()
    assert not lab.keys.known_hosts.exists()


def test_a_flashed_robot_is_known_by_the_key_that_was_made_for_it(lab: Lab) -> None:
    (robot,) = lab.add(1, start=False)
    made = lab.keys.host_key("lab", "r1")
    for end in ("", ".pub"):
        (robot.root / f"host_key{end}").write_bytes(Path(f"{made}{end}").read_bytes())
    robot.start()
    lab.release("1.0")
    assert lab.ask("deploy")["r1"]["result"] == "updated"
    shown = lab.run("shell", "r1", "--dry-run")
    assert shown.exit_code == 0
    assert f"[127.0.0.1]:{robot.port}" in lab.keys.known_hosts.read_text()


def test_a_release_for_another_machine_is_not_shipped(lab: Lab) -> None:
    (robot,) = lab.add(1)
    name = lab.release("1.0", target=Target("rpi", "armv7l", "2.17", "3.11"))
    done = lab.deploy("--release", name)
    assert (done[""]["exit_code"], done["r1"]["result"]) == (2, "failed")
    assert "is for armv7l" in done["r1"]["what"]
    done = lab.deploy()
    assert "no release fits" in done["r1"]["what"]
    assert "fullswarm bundle --target" in done["r1"]["mend"]
    assert robot.current is None


def test_one_of_three_is_away_and_converges_later(lab: Lab) -> None:
    one, two, three = lab.add(3)
    first = lab.release("1.0")
    lab.deploy()
    three.stop()
    second = lab.release("1.1")
    done = lab.ask("update")
    assert done[""]["exit_code"] == 1
    assert [done[each]["result"] for each in ("r1", "r2", "r3")] == ["updated", "updated", "unreachable"]
    assert (one.current, two.current, three.current) == (second, second, first)
    shown = lab.ask("fleet")
    assert (shown["r3"]["health"], shown["r3"]["skew"]) == ("unreachable", f"wants {second}")
    three.start()
    assert lab.ask("fleet")["r3"]["skew"] == f"wants {second}"
    done = lab.ask("update")
    assert [done[each]["result"] for each in ("r1", "r2", "r3")] == ["unchanged", "unchanged", "updated"]
    assert three.current == second


def test_a_robot_that_comes_back_is_updated_while_we_keep_trying(lab: Lab) -> None:
    _, two = lab.add(2)
    lab.release("1.0")
    lab.deploy()
    two.stop()
    second = lab.release("1.1")
    later = threading.Timer(3.0, two.start)
    later.start()
    done = lab.ask("update", "--keep-trying", "1")
    later.join()
    assert [done[each]["result"] for each in ("r1", "r2")] == ["updated", "updated"]
    assert two.current == second


def test_a_bad_release_stops_at_the_canary_and_the_rest_never_see_it(lab: Lab) -> None:
    robots = lab.add(3)
    first = lab.release("1.0")
    lab.deploy()
    lab.release("1.1", mode="dead")
    done = lab.ask("update", "--stop-at", "1")
    assert [done[each.name]["result"] for each in robots] == ["rolled back", "staged", "staged"]
    assert [each.restarts for each in robots] == [3, 1, 1]  # the one more is the way back
    assert {each.current for each in robots} == {first}


def test_back_to_the_release_before(lab: Lab) -> None:
    (robot,) = lab.add(1)
    first = lab.release("1.0")
    lab.deploy()
    lab.release("1.1")
    lab.ask("update")
    done = lab.ask("rollback")
    assert (done[""]["exit_code"], done["r1"]["result"], done["r1"]["release"]) == (0, "rolled back", first)
    assert robot.current == first
    assert lab.ask("fleet")["r1"]["skew"] == ""
    done = lab.ask("rollback")
    assert done["r1"]["result"] == "refused"
    assert "no release to roll back to" in done["r1"]["what"]


def test_an_older_release_comes_back_only_when_it_is_asked_for_by_name(lab: Lab) -> None:
    (robot,) = lab.add(1)
    first = lab.release("1.0")
    lab.deploy()
    second = lab.release("1.1")
    third = lab.release("1.2")
    assert lab.ask("update")["r1"]["release"] == third
    done = lab.ask("update", "--release", second)
    assert (done["r1"]["result"], robot.current) == ("failed", third)
    assert "--allow-older" in done["r1"]["what"]
    assert lab.run("update", "--allow-older").exit_code == 2
    done = lab.ask("update", "--release", first, "--allow-older")
    assert (done["r1"]["result"], robot.current) == ("updated", first)
    assert f"goes back to {first}" in (robot.root / "opt/fullswarm/trust/log").read_text()


def test_new_keys_reach_robots_with_the_next_update_and_the_stolen_one_is_worth_nothing(lab: Lab) -> None:
    (robot,) = lab.add(1)
    first = lab.release("1.0")
    lab.deploy()
    stolen = lab.keys.root().releases[0].key
    forged = lab.release("6.6")  # by who has the release key and the SSH key
    lab.keys.rotate_release_key(revoked=[stolen])
    second = lab.release("1.1")
    done = lab.ask("update")
    assert (done["r1"]["result"], robot.current) == ("updated", second), done
    assert "\nversion 2\n" in (robot.root / "opt/fullswarm/trust/root").read_text()
    head = head_archive(lab.store.get(forged))
    answer = over_the_link(lab, lambda remote: remote.program("want", forged, feed=head))
    assert (answer.code, "not one that this robot trusts" in answer.words) == (3, True)
    assert lab.deploy()["r1"]["result"] == "unchanged"
    assert lab.ask("rollback")["r1"]["result"] == "refused"  # the first one was signed by the stolen key
    assert robot.current == second != first


def test_an_ssh_key_alone_installs_no_support_package(lab: Lab) -> None:
    (robot,) = lab.add(1)
    lab.release("1.0")
    lab.deploy()
    config = load_fleet(lab.fleet)
    archive = support_package(config.robot[0], config, lab.keys.roots()[-1], environment={"X": "evil"})
    answer = over_the_link(lab, lambda remote: remote.program("install", feed=archive))
    assert (answer.code, "kit.statement" in answer.words) == (3, True)
    assert "evil" not in (robot.root / "etc/fullswarm/robot.env").read_text()


def test_a_dry_run_says_what_it_would_do_and_does_nothing(lab: Lab) -> None:
    (robot,) = lab.add(1)
    lab.release("1.0")
    lab.deploy()
    second = lab.release("1.1")
    done = lab.ask("update", "--dry-run")
    assert done["r1"]["what"] == f"would ship {second}, switch to it"
    assert robot.restarts == 1
    assert not (robot.root / f"opt/fullswarm/releases/{second}").exists()


def test_reboot_waits_until_the_robot_is_back(lab: Lab) -> None:
    (robot,) = lab.add(1)
    lab.release("1.0")
    lab.deploy()
    before = (robot.root / "boot_id").read_text()
    done = lab.ask("reboot", "--wait", "30")
    assert (done[""]["exit_code"], done["r1"]["result"]) == (0, "rebooted")
    assert (robot.root / "boot_id").read_text() != before


def test_the_users_own_key_opens_once_and_then_the_fleets(lab: Lab, tmp_path: Path) -> None:
    (robot,) = lab.add(1)
    mine = Keys(tmp_path / "mine").fleet_key()
    (tmp_path / "me/.ssh").mkdir()
    for end in ("", ".pub"):
        (tmp_path / f"me/.ssh/id_ed25519{end}").write_bytes(Path(f"{mine}{end}").read_bytes())
    (tmp_path / "me/.ssh/id_ed25519").chmod(0o600)
    admitted = robot.root / "home/.ssh/authorized_keys"
    admitted.write_text(Path(f"{mine}.pub").read_text().strip())  # and no newline at its end
    lab.release("1.0")
    refused = lab.ask("update")
    assert refused["r1"]["result"] == "failed"
    assert lab.deploy()["r1"]["result"] == "updated"
    lines = admitted.read_text().splitlines()
    assert lines == [Path(f"{mine}.pub").read_text().strip(), public(lab.keys.fleet_key())]
    (tmp_path / "me/.ssh/id_ed25519").unlink()
    assert lab.ask("fleet")["r1"]["health"] == "healthy"


# ---------------------------------------------------------------- the link itself
def over_the_link(lab: Lab, talk: Callable[[Remote], Awaitable[T]]) -> T:
    (robot,) = lab.robots or lab.add(1)
    key = (robot.root / "host_key.pub").read_text()
    pins = Pins(lab.keys.known_hosts, lab.keys.folder / "hosts/lab")
    if not pins.keys("r1", "127.0.0.1", robot.port):
        pins.pin("127.0.0.1", robot.port, key)

    async def main() -> T:
        login = Login(pins, lab.keys.fleet_key())
        async with login.connect(Address("r1", "127.0.0.1", robot.port, getpass.getuser())) as remote:
            return await talk(remote)

    return asyncio.run(main())


@pytest.mark.slow
def test_twenty_megabytes_arrive_whole_twenty_times(lab: Lab) -> None:
    file = lab.folder / "big"
    file.write_bytes(random.Random(0).randbytes(20_000_000))
    digest = hashlib.sha256(file.read_bytes()).hexdigest()

    async def talk(remote: Remote) -> list[tuple[int, str]]:
        answers = [await remote.run("sha256sum; echo done >&2", feed=file) for _ in range(20)]
        return [(each.code, each.out.decode().split()[0]) for each in answers]

    assert over_the_link(lab, talk) == [(0, digest)] * 20


def test_a_command_that_has_heard_enough_is_judged_by_its_exit_code(lab: Lab) -> None:
    async def talk(remote: Remote) -> list[Answer]:
        script = "head -c 10 > /dev/null; echo no >&2; exit 3"
        return [await remote.run(script, feed=bytes(8_000_000)) for _ in range(10)]

    assert [(each.code, each.words) for each in over_the_link(lab, talk)] == [(3, "no")] * 10


def test_a_robot_that_talks_while_it_is_fed_blocks_nobody(lab: Lab) -> None:
    async def talk(remote: Remote) -> Answer:
        return await remote.run("tee /dev/stderr", feed=bytes(3_000_000))

    answer = over_the_link(lab, talk)
    assert (answer.code, len(answer.out), len(answer.err)) == (0, 3_000_000, 3_000_000)


def test_a_robot_that_says_too_much_is_cut_short(lab: Lab) -> None:
    async def talk(remote: Remote) -> Answer:
        return await remote.run("exec cat /dev/zero")

    with pytest.raises(Unreachable, match="printed more than 4 MB"):
        over_the_link(lab, talk)


def test_a_robot_that_does_not_answer_ends_the_wait(lab: Lab) -> None:
    async def talk(remote: Remote) -> Answer:
        return await remote.run("exec sleep 60", within_s=0.5)

    with pytest.raises(Unreachable, match="stopped answering"):
        over_the_link(lab, talk)


def test_a_link_that_breaks_is_not_an_answer(lab: Lab) -> None:
    (robot,) = lab.add(1)

    async def talk(remote: Remote) -> Answer:
        def begun(_: bytes) -> None:
            robot.cut()

        return await remote.run("echo begun; exec sleep 60", line=begun)

    with pytest.raises(LinkBroke, match="the link broke"):
        over_the_link(lab, talk)
