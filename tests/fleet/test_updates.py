"""A fleet of real systemds and sshds, deployed, updated and rolled back through the front door."""

from __future__ import annotations

import hashlib
import shutil
import statistics
import time
from pathlib import Path

from fullswarm.deploy.release.store import head_archive
from tests.fleet.fleet import MODULE, Fleet, results, row_of
from tests.fleet.lab import when
from tests.fleet.tools import until

GUARD_S = 20
START_S = 90.0
"""For one agent on a machine that may have other work."""


def test_the_first_deploy(whole_fleet: Fleet) -> None:
    fleet, done = whole_fleet, whole_fleet.deployed
    assert set(results(done).values()) == {"updated"}
    assert set(fleet.deployed_releases.values()) == {fleet.first}
    robots = len(fleet.lab.robots)
    fleet.figures.note(f"first deploy of {robots}", f"{done.took_s:.1f} s", "60 s for 16")
    fleet.figures.note("  moved per robot", f"{fleet.deployed_bytes / robots / 1e6:.1f} MB")
    fleet.figures.note("  all READY in `status` after another", f"{fleet.ready_s:.1f} s")


def test_the_second_deploy_moves_next_to_nothing_and_restarts_nothing(fleet: Fleet) -> None:
    starts, before = fleet.lab.starts(), fleet.moved_bytes()
    done = fleet.lab.cli("deploy", "--release", fleet.first, "--allow-older", "--json")
    sent = (fleet.moved_bytes() - before) / len(fleet.lab.robots)
    assert set(results(done).values()) == {"unchanged"}
    assert fleet.lab.starts() == starts
    assert sent < 100_000
    fleet.figures.note("second deploy of the same", f"{done.took_s:.1f} s")
    fleet.figures.note("  moved per robot", f"{sent / 1e3:.1f} kB", "100 kB")


def test_an_update_of_the_app_only(fleet: Fleet) -> None:
    lab, first, second = fleet.lab, fleet.first, fleet.second
    took_s = [
        lab.cli("update", robot, "--release", second, "--allow-older", "--json").took_s for robot in lab.robots[:3]
    ]
    before = fleet.moved_bytes()
    done = lab.cli("update", "--release", second, "--allow-older", "--json")
    sent = (fleet.moved_bytes() - before) / (len(lab.robots) - 3)
    assert set(results(done).values()) <= {"updated", "unchanged"}
    assert set(lab.releases().values()) == {second}
    assert sent < 1_000_000
    lab.wait_ready()
    back = lab.cli("rollback", "--json")
    assert set(lab.releases().values()) == {first}, back.out
    lab.wait_ready()
    fleet.figures.note("app-only update of one robot", f"{statistics.median(took_s):.1f} s", "10 s")
    fleet.figures.note(f"  of {len(lab.robots)}, canary, wave, rest", f"{done.took_s:.1f} s", "120 s for 32")
    fleet.figures.note("  moved per robot", f"{sent / 1e3:.1f} kB", "1 MB")
    fleet.figures.note("rollback of all", f"{back.took_s:.1f} s")


def test_a_broken_release_goes_back_by_itself(fleet: Fleet) -> None:
    lab = fleet.lab
    careful = lab.cli("update", "--release", fleet.broken, "--allow-older", "--json", code=1)
    tried = [robot for robot, result in results(careful).items() if result == "rolled back"]
    assert tried == lab.robots[: len(tried)]
    assert len(tried) == 2, "a canary, then another in its place; then it is enough"
    everywhere = ("--canary", "0", "--wave", "100%", "--stop-at", "64", "--at-a-time", "16")
    bold = lab.cli("update", "--release", fleet.broken, "--allow-older", *everywhere, "--json", code=1)
    assert set(results(bold).values()) == {"rolled back"}
    assert set(lab.releases().values()) == {fleet.first}
    lab.wait_ready()
    fleet.figures.note("broken release on all at once, all back", f"{bold.took_s:.1f} s")


def test_a_foreign_signature_is_refused_before_anything_is_written(fleet: Fleet, tmp_path: Path) -> None:
    lab, before = fleet.lab, fleet.listing()
    keys, releases = tmp_path / "keys", tmp_path / "releases"
    foreign = lab.bundle({MODULE: "\n# of another key\n"}, FULLSWARM_KEYS=str(keys), FULLSWARM_RELEASES=str(releases))
    done = lab.cli("update", "--release", releases / foreign, "--json", code=None)
    assert done.code in (1, 2, 3)
    assert "signature" in done.out + done.words
    _refused_on_board(fleet, releases / foreign)
    assert fleet.listing() == before
    assert set(lab.releases().values()) == {fleet.first}


def test_a_stale_signature_is_refused_before_anything_is_written(fleet: Fleet, tmp_path: Path) -> None:
    lab, before = fleet.lab, fleet.listing()
    forged = tmp_path / fleet.second
    shutil.copytree(lab.folder / "releases" / fleet.second, forged)
    file, sums = forged / "app" / MODULE, forged / "SHA256SUMS"
    old = hashlib.sha256(file.read_bytes()).hexdigest()
    file.unlink()  # it is a hard link
    file.write_text("import os\n")
    text = sums.read_text()
    sums.unlink()
    sums.write_text(text.replace(old, hashlib.sha256(file.read_bytes()).hexdigest()))
    done = lab.cli("update", "--release", forged, "--json", code=None)
    assert done.code in (1, 2, 3)
    assert "signature" in done.out + done.words
    _refused_on_board(fleet, forged)
    assert fleet.listing() == before


def _refused_on_board(fleet: Fleet, release: Path) -> None:
    """A base that lies about the signature gets no further: the robot looks itself, and keeps a record of it."""
    robot, head = fleet.lab.computers[fleet.lab.robots[-1]], fleet.lab.folder / "head.tar"
    head.write_bytes(head_archive(release))
    want = f'/opt/fullswarm/bin/fullswarm-robot want {release.name} 2>&1 || echo "exit $?"'
    answer = robot.do("sh", "-c", want, feed=head)
    assert "exit 3" in answer
    assert "signature" in answer or "signed" in answer  # also: signed before the newest that it has verified
    kept = robot.do("tail", "-n", "1", "/opt/fullswarm/trust/refused")
    assert " want: " in kept
    assert kept.split(" want: ")[1].strip() in answer


def test_a_robot_that_is_cut_off_in_mid_update_goes_back_by_itself(fleet: Fleet) -> None:
    lab, robot = fleet.lab, fleet.lab.robots[2]
    update = lab.start(
        "update", robot, "--release", fleet.second, "--allow-older", "--guard", str(GUARD_S), "--json", log="cut.log"
    )
    until(when(lab.computers[robot], "switched", fleet.second), START_S, "the switch")
    lab.network.cut(robot)
    began_s = time.monotonic()
    fleet.wait_runs(robot, fleet.first, GUARD_S + START_S, f"{robot} goes back by itself")
    fleet.figures.note(
        "cut off after the switch, back on the old", f"{time.monotonic() - began_s:.1f} s", f"guard {GUARD_S} s"
    )
    assert update.wait(GUARD_S + START_S) in (1, 3)
    said = (lab.folder / "cut.log").read_text()
    assert robot in said
    lab.network.mend()
    lab.wait_ready()


def test_one_that_cannot_take_it_is_named_and_the_rest_go_on(fleet: Fleet) -> None:
    lab, full, mute = fleet.lab, fleet.lab.robots[1], fleet.lab.robots[-1]
    new = fleet.changed("for all but two", kilobytes=200)  # nobody has any of it yet
    lab.computers[full].fill()
    lab.mute(mute)
    done = lab.cli("update", "--release", new, "--allow-older", "--guard", str(GUARD_S), "--json", code=1)
    said = results(done)
    assert said.pop(full) == "failed"
    assert "disk" in str(row_of(done, full)["what"])
    assert said.pop(mute) == "rolled back"
    assert "driver" in str(row_of(done, mute)["what"])
    assert set(said.values()) == {"updated"}
    runs = lab.releases()
    assert {runs.pop(full), runs.pop(mute)} == {fleet.first}
    assert set(runs.values()) == {new}
    lab.creates.order("speak", len(lab.robots) - 1)
    lab.wait_ready()


def test_a_power_cut_between_switch_and_commit(fleet: Fleet) -> None:
    lab, robot = fleet.lab, fleet.lab.robots[3]
    computer = lab.computers[robot]
    update = lab.start("update", robot, "--release", fleet.second, "--allow-older", "--json", log="power.log")
    until(when(computer, "switched", fleet.second), START_S, "the switch")
    computer.pull()
    assert (computer.root / "opt/fullswarm/pending").exists()
    assert lab.releases()[robot] == fleet.second
    computer.boot()
    took_s = fleet.wait_runs(robot, fleet.first, START_S, f"{robot} runs what was approved")
    fleet.figures.note("power cut after the switch, up on the old", f"{took_s:.1f} s")
    assert update.wait(START_S + 60.0) == 1
    assert "rolled back" in (lab.folder / "power.log").read_text()
    lab.wait_ready()


def test_a_latched_emergency_stop_outlives_an_update(fleet: Fleet) -> None:
    lab, robot = fleet.lab, fleet.lab.robots[0]
    lab.cli("estop")
    assert set(lab.stopped().values()) == {True}
    lab.cli("update", robot, "--release", fleet.second, "--allow-older")
    lab.wait_ready()
    assert lab.releases()[robot] == fleet.second
    assert set(lab.stopped().values()) == {True}
    lab.cli("estop", "--clear")
    assert set(lab.stopped().values()) == {False}


def test_who_was_away_comes_later(fleet: Fleet) -> None:
    lab, away = fleet.lab, fleet.lab.robots[1]
    lab.network.cut(away)
    done = lab.cli("update", *lab.robots[:3], "--release", fleet.second, "--allow-older", "--json", code=1)
    assert results(done) == {lab.robots[0]: "updated", away: "unreachable", lab.robots[2]: "updated"}
    lab.network.mend()
    later = lab.cli("update", *lab.robots[:3], "--release", fleet.second, "--allow-older", "--json")
    assert results(later) == {lab.robots[0]: "unchanged", away: "updated", lab.robots[2]: "unchanged"}
