"""From one release to another and back: by a word, the guard, a boot."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.unit.deploy_robot.script import Robot


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
    assert "not committed within 7 s" in str(robot.facts["last_rollback"])
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
    robot.asked()
    robot.ok("switch", new.name)
    order = [line for line in robot.asked().splitlines() if "run " in line or line.startswith("stop ")]
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


def test_wrong_words_are_usage(robot: Robot) -> None:
    for words in ([], ["fly"], ["switch"], ["switch", "1-2", "--guard"], ["rollback", "x"], ["logs", "--root=/"]):
        robot.no(2, *words)
