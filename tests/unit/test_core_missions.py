"""Missions: steps follow one another, conditions, failures, stops, leases, and a core that dies at any instant."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from fullswarm.messages import EStop, LeaseRequest, MissionRequest, StopRequest, Summary
from fullswarm.operator.client import Operator
from fullswarm.store import Store
from tests.unit.core_swarm import KEYS
from tests.unit.mission_lab import FIVE, Killed, MissionLab, MortalStore

ONE = """
[[steps]]
name = "go"
robots = ["r0", "r1"]
behaviour = "move_to_goal_bc"
parameters = {{ goal = [4.0, 0.0] }}
{more}
"""

TWO_QUESTIONS = """
[[steps]]
name = "a"
done = { confirm = "Clear?" }
[[steps]]
name = "b"
done = { confirm = "And now?" }
"""


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[MissionLab]:
    made = MissionLab(tmp_path / "core.db")
    yield made
    made.close()


def order_of(lab: MissionLab) -> list[str]:
    """Return the steps' request ids in the order in which robots first began them, without the mission's id."""
    return list(dict.fromkeys(request_id.partition(".")[2] for _, request_id in lab.started()))


# ---------------------------------------------------------------- the way through
def test_five_steps_of_two_groups_run_in_order(lab: MissionLab) -> None:
    assert lab.ask("start", FIVE).ok
    lab.until("done")
    assert lab.status is not None
    assert all(step.phase == "done" for track in lab.status.tracks for step in track.steps)
    assert [name for name in order_of(lab) if name.startswith("west")] == ["west.1.1", "west.2.1", "west.3.1"]
    assert order_of(lab).index("east.2.1") > order_of(lab).index("west.1.1")
    assert Counter(lab.started()).most_common(1)[0][1] == 1
    lab.run(0.5)
    assert lab.swarm.behaviours() == ["", "", ""]
    assert lab.places["r2"] == pytest.approx((3.0, 0.0), abs=0.11)


def test_a_step_that_keeps_running_outlasts_the_mission_and_others_are_stopped(lab: MissionLab) -> None:
    assert lab.ask("start", ONE.format(more="done = { time_s = 0.5 }\nkeep_running = true")).ok
    lab.until("done")
    lab.run(1.0)
    assert lab.swarm.behaviours() == ["move_to_goal_bc", "move_to_goal_bc", ""]
    lab.kill_core()
    lab.run(1.0)
    assert lab.swarm.behaviours() == ["move_to_goal_bc", "move_to_goal_bc", ""]


def test_robots_that_the_next_step_does_not_need_are_stopped(lab: MissionLab) -> None:
    text = (
        ONE.format(more="done = { time_s = 0.5 }")
        + """
[[steps]]
robots = ["r1"]
behaviour = "flocking_bc"
done = { confirm = "Is it well?" }
"""
    )
    assert lab.ask("start", text).ok
    lab.run(1.5)
    assert lab.swarm.behaviours() == ["", "flocking_bc", ""]


# ---------------------------------------------------------------- conditions
def test_a_confirmation_is_waited_for_and_given_once(lab: MissionLab) -> None:
    text = (
        '[[steps]]\nname = "a"\ndone = { confirm = "Clear?" }\n[[steps]]\nname = "b"\ndone = { confirm = "And now?" }'
    )
    assert lab.ask("start", text).ok
    lab.run(3.0)
    assert lab.step("main", "a").confirm == "Clear?"
    given = lab.ask("confirm", id="yes")
    assert given.ok
    assert lab.ask("confirm", id="yes") == given  # a copy does not confirm the next step
    lab.run(1.0)
    assert (lab.step("main", "a").phase, lab.step("main", "b").confirm) == ("done", "And now?")
    assert not lab.ask("confirm", step="a").ok
    assert lab.ask("confirm", track="main", step="b").ok
    lab.until("done")


@pytest.mark.parametrize("delay_s", [0.0, 0.03, 0.2])
def test_a_step_that_is_over_at_once_is_followed_by_the_next_one(lab: MissionLab, delay_s: float) -> None:
    text = """
robots = ["r0", "r1"]
[[steps]]
name = "flock"
behaviour = "flocking_bc"
done = { confirm = "Enough?" }
[[steps]]
name = "meet"
behaviour = "rendezvous_bc"
done = { time_s = 0.5 }
"""
    assert lab.ask("start", text).ok
    lab.run(delay_s)
    assert lab.ask("confirm").ok  # requests of a robot are spread over 0.05 s: the next step's waits for that
    lab.run(0.3)
    assert lab.swarm.behaviours() == ["rendezvous_bc", "rendezvous_bc", ""]
    lab.until("done", 2.0)
    lab.run(0.3)
    assert lab.swarm.behaviours() == ["", "", ""]


def test_a_pause_while_a_step_waits_to_begin_stops_its_robots(lab: MissionLab) -> None:
    text = ONE.format(more='done = { confirm = "Well?" }') + TWO_QUESTIONS
    text = text.replace('name = "a"', 'name = "a"\nrobots = ["r0"]\nbehaviour = "flocking_bc"')
    assert lab.ask("start", text).ok
    assert lab.ask("confirm").ok
    assert lab.ask("pause").ok
    lab.run(0.5)
    assert lab.status is not None
    assert (lab.status.phase, lab.status.reason) == ("paused", "by anna")
    assert lab.swarm.behaviours() == ["", "", ""]


def test_a_copy_of_a_confirmation_after_a_restart_confirms_nothing_else(lab: MissionLab) -> None:
    text = (
        '[[steps]]\nname = "a"\ndone = { confirm = "Clear?" }\n[[steps]]\nname = "b"\ndone = { confirm = "And now?" }'
    )
    assert lab.ask("start", text).ok
    assert lab.ask("confirm", id="yes").ok
    lab.kill_core()
    assert lab.ask("confirm", id="yes").ok
    lab.run(1.0)
    assert lab.step("main", "b").phase == "running"


def test_a_metric_counts_from_a_report_after_the_step_began(lab: MissionLab) -> None:
    def report(value: float) -> None:
        lab.swarm.bus.publish(
            KEYS.summary("coverage"), Summary(metric="coverage", values={"fraction": value}, stamp_s=0)
        )

    text = '[[steps]]\nname = "a"\ndone = { metric = "coverage.fraction >= 0.5" }'
    report(0.9)
    assert lab.ask("start", text).ok
    lab.run(1.0)
    report(0.4)
    lab.run(1.0)
    assert lab.step("main", "a").phase == "running"
    assert "it is 0.4" in lab.step("main", "a").waits_for[0]
    report(0.5)
    lab.until("done", 2.0)


@pytest.mark.parametrize(("when", "expected"), [("any", "done"), ("all", "running")])
def test_conditions_hold_together_or_one_is_enough(lab: MissionLab, when: str, expected: str) -> None:
    text = f'[[steps]]\nname = "a"\ndone = {{ when = "{when}", time_s = 0.5, confirm = "Go?" }}'
    assert lab.ask("start", text).ok
    lab.run(2.0)
    assert lab.step("main", "a").phase == expected


def test_a_pause_does_not_count_as_time(lab: MissionLab) -> None:
    assert lab.ask("start", '[[steps]]\nname = "a"\ndone = { time_s = 2.0 }').ok
    lab.run(1.0)
    assert lab.ask("pause").ok
    lab.run(5.0)
    assert lab.ask("resume").ok
    lab.run(0.7)
    assert lab.step("main", "a").phase == "running"
    lab.until("done", 1.0)


# ---------------------------------------------------------------- failures
def test_a_late_step_pauses_the_mission_and_is_tried_again_when_resumed(lab: MissionLab) -> None:
    assert lab.ask("start", ONE.format(more='done = { confirm = "Well?" }\nfail_after_s = 1.0')).ok
    lab.until("paused", 3.0)
    lab.run(0.5)
    assert "not done within 1 s" in lab.step("main", "go").reason
    assert lab.swarm.behaviours() == ["", "", ""]
    assert lab.ask("resume").ok
    lab.run(0.5)
    assert lab.swarm.behaviours() == ["move_to_goal_bc", "move_to_goal_bc", ""]
    assert order_of(lab) == ["main.1.1", "main.1.2"]


@pytest.mark.parametrize(("on_failed", "phase"), [("abort", "failed"), ("continue", "done")])
def test_what_follows_a_failure_is_declared(lab: MissionLab, on_failed: str, phase: str) -> None:
    more = f'done = {{ confirm = "Well?" }}\nfail_after_s = 0.5\non_failed = "{on_failed}"\n'
    text = ONE.format(more=more) + '[[steps]]\nname = "after"\ndone = { time_s = 0.1 }'
    assert lab.ask("start", text).ok
    lab.until(phase, 3.0)
    lab.run(0.5)
    assert lab.step("main", "go").phase == "failed"
    assert lab.step("main", "after").phase == ("done" if phase == "done" else "skipped")
    assert lab.swarm.behaviours() == ["", "", ""]


def test_a_robot_that_refuses_or_is_lost_fails_its_step_and_the_others_stop(lab: MissionLab) -> None:
    assert lab.ask("start", ONE.format(more='done = { confirm = "Well?" }')).ok
    lab.run(0.5)
    lab.swarm.robots["r1"].kill()
    lab.run(4.0)
    assert lab.status is not None
    assert lab.status.phase == "running"
    lab.until("paused", 4.0)
    assert "lost: r1" in lab.status.reason
    lab.run(0.5)
    assert lab.swarm.behaviours()[0] == ""
    lab.swarm.robots["r1"].start()
    lab.swarm.robots["r0"].refuse = "its wheels are off"
    lab.run(1.0)
    assert lab.ask("resume").ok
    lab.until("paused", 2.0)
    assert "its wheels are off" in lab.status.reason


# ---------------------------------------------------------------- operators
@pytest.mark.parametrize("robots", [(), ("r1",)])
def test_a_stop_pauses_the_mission_and_all_its_robots(lab: MissionLab, robots: tuple[str, ...]) -> None:
    assert lab.ask("start", ONE.format(more='done = { arrived = "all" }')).ok
    lab.run(0.5)
    for _ in range(5):
        lab.swarm.bus.publish(KEYS.stop, StopRequest(id="halt", robots=robots, source="bob"))
        lab.run(0.1)
    assert lab.phases == ["running", "paused"]
    assert lab.swarm.behaviours() == ["", "", ""]
    assert lab.ask("resume").ok
    lab.swarm.bus.publish(KEYS.stop, StopRequest(id="halt", robots=robots, source="bob"))  # a late copy
    lab.until("done")


def test_a_stop_of_other_robots_changes_nothing(lab: MissionLab) -> None:
    assert lab.ask("start", ONE.format(more='done = { arrived = "all" }')).ok
    lab.run(0.5)
    lab.swarm.bus.publish(KEYS.stop, StopRequest(id="halt", robots=("r2",), source="bob"))
    lab.until("done")
    assert lab.phases == ["running", "done"]


def test_an_estop_pauses_and_is_never_released_by_the_mission(lab: MissionLab) -> None:
    assert lab.ask("start", ONE.format(more='done = { arrived = "all" }')).ok
    lab.run(0.5)
    lab.swarm.bus.publish(KEYS.estop, EStop(id="e", engaged=True, robots=("r0",), source="bob"))
    lab.run(0.5)
    assert lab.phases == ["running", "paused"]
    assert lab.swarm.robots["r0"].estop
    lab.swarm.robots["r0"].refuse = "its e-stop is latched"
    assert lab.ask("resume").ok
    lab.run(1.0)
    assert lab.phases == ["running", "paused", "running", "paused"]
    assert not [each for each in lab.swarm.sent(EStop) if isinstance(each, EStop) and not each.engaged]


def test_another_operators_request_pauses_the_mission_and_keeps_its_robot(lab: MissionLab) -> None:
    assert lab.ask("start", ONE.format(more='done = { arrived = "all" }')).ok
    lab.run(0.5)
    lab.swarm.ask("mine", "flocking_bc", "r1")
    lab.run(1.0)
    assert lab.phases == ["running", "paused"]
    assert lab.swarm.behaviours() == ["", "flocking_bc", ""]


def test_leases_are_obeyed_and_taken_only_on_request(lab: MissionLab) -> None:
    def hold() -> None:
        lab.swarm.bus.publish(KEYS.lease_request, LeaseRequest(operator="bob", robots=("r1",), hold=True))

    hold()
    lab.run(0.1)
    text = ONE.format(more='done = { arrived = "all" }')
    refused = lab.ask("start", text)
    assert not refused.ok
    assert "held by bob" in refused.reason
    assert lab.ask("start", text, take=True).ok
    lab.run(0.5)
    assert lab.swarm.behaviours() == ["move_to_goal_bc", "move_to_goal_bc", ""]
    assert lab.ask("abort", operator="bob").ok  # stopping needs no lease
    lab.run(0.5)
    assert lab.swarm.behaviours() == ["", "", ""]
    assert lab.status is not None
    assert lab.status.reason == "by bob"


def test_a_resume_that_is_older_than_a_stop_is_refused(lab: MissionLab) -> None:
    assert lab.ask("start", ONE.format(more='done = { arrived = "all" }')).ok
    lab.run(0.3)
    sent_s = lab.swarm.runtime.now_s()
    lab.run(0.1)
    Operator(lab.swarm.bus, KEYS, lab.swarm.runtime, "bob", clock="lab").stop()
    lab.run(0.6)
    assert lab.phases[-1] == "paused"
    late = MissionRequest(id="late", op="resume", operator="carl", source="carl", clock="lab", stamp_s=sent_s)
    lab.swarm.bus.publish(KEYS.mission_request, late)
    lab.run(0.2)
    assert not next(each for each in lab.replies if each.id == "late").ok
    assert lab.phases[-1] == "paused"


# ---------------------------------------------------------------- checks
def test_all_that_does_not_fit_the_swarm_is_named_at_once(lab: MissionLab) -> None:
    text = """
[tracks.a]
[[tracks.a.steps]]
behaviour = "move_to_gaol_bc"
robots = ["r0"]
done = { arrived = "all" }
[[tracks.a.steps]]
behaviour = "move_to_goal_bc"
robots = ["r9"]
done = { metric = "coverage.fractoin > 1" }
[[tracks.b.steps]]
robots = ["r0"]
behaviour = "drive_bc"
done = { time_s = 1 }
"""
    reply = lab.ask("check", text)
    found = {(each.track, each.step, each.key) for each in reply.problems}
    assert found == {
        ("a", "step 1", "behaviour"), ("a", "step 2", "robots"), ("a", "step 2", "parameters"),
        ("a", "step 2", "done.metric"), ("b", "step 1", "robots"), ("b", "step 1", "behaviour"),
    }  # fmt: skip
    assert lab.missions.statuses() == ()


def test_two_missions_do_not_share_robots_and_old_ones_are_forgotten(lab: MissionLab) -> None:
    assert lab.ask("start", ONE.format(more='done = { confirm = "Well?" }')).ok
    assert "which has not ended" in lab.ask("start", ONE.format(more='done = { arrived = "all" }')).reason
    for number in range(20):
        text = f'robots = ["r2"]\n[[steps]]\nname = "{number}"\ndone = {{ time_s = 0 }}'
        assert lab.ask("start", text).ok
        lab.run(0.2)
    names = [each.tracks[0].steps[0].name for each in lab.missions.statuses()]
    assert names == ["go", *map(str, range(5, 20))]
    lab.kill_core()
    assert [each.tracks[0].steps[0].name for each in lab.missions.statuses()] == names


# ---------------------------------------------------------------- the core dies
def finish(lab: MissionLab) -> None:
    """Let the mission end, and check what must hold however often the core died."""
    lab.until("done", 40.0)
    lab.run(1.0)
    assert lab.status is not None
    assert all(step.phase == "done" for track in lab.status.tracks for step in track.steps)
    again = {pair: count for pair, count in Counter(lab.started()).items() if count > 1}
    assert not again, "a request that ran was sent anew"
    first = [name for name in order_of(lab) if name.startswith("west")]
    assert first == ["west.1.1", "west.2.1", "west.3.1"]
    assert {request_id.partition(".")[2] for _, request_id in lab.started()} == {*first, "east.2.1"}
    assert lab.swarm.behaviours() == ["", "", ""]


@pytest.mark.parametrize("tenths", range(1, 40, 3))
def test_a_core_killed_at_any_moment_goes_on_with_the_same_step(lab: MissionLab, tenths: int) -> None:
    assert lab.ask("start", FIVE).ok
    lab.run(tenths / 10.0 + 0.03)
    assert lab.status is not None
    before = {(track.name, step.name): step for track in lab.status.tracks for step in track.steps}
    lab.kill_core()
    after = {(track.name, step.name): step for track in lab.missions.statuses()[0].tracks for step in track.steps}
    assert {key: step.phase for key, step in before.items()} == {key: step.phase for key, step in after.items()}
    assert all(after[key].elapsed_s >= before[key].elapsed_s - 1.1 for key in after)
    finish(lab)


def test_a_core_killed_at_each_write_of_its_database_goes_on(tmp_path: Path) -> None:
    """The property: whatever was written last, the mission ends as if nothing had happened. All instants are tried."""
    for instant in itertools.count(1):
        path = tmp_path / f"{instant}.db"
        lab = MissionLab(path)
        writes = 0

        def dies(_: str, instant: int = instant) -> None:
            nonlocal writes
            writes += 1
            if writes == instant:
                raise Killed

        lab.kill_core(MortalStore(path, dies))
        writes = 0
        died = False
        try:
            lab.ask("start", FIVE, id="mission")
            lab.until("done", 40.0)
        except Killed:
            died = True
            lab.swarm.runtime.mailbox.drain()
            lab.kill_core()
            lab.ask("start", FIVE, id="mission")  # sent until it is answered
        finish(lab)
        lab.close()
        if not died:
            break
    assert instant > 20


def test_an_abort_that_the_core_did_not_survive_still_stops_the_robots(tmp_path: Path) -> None:
    path = tmp_path / "core.db"
    lab = MissionLab(path)
    assert lab.ask("start", ONE.format(more='done = { confirm = "Well?" }')).ok
    lab.run(0.5)
    armed = False

    def dies(moment: str) -> None:
        if armed and moment == "after":
            raise Killed

    lab.kill_core(MortalStore(path, dies))
    lab.run(0.5)
    assert lab.swarm.behaviours() == ["move_to_goal_bc", "move_to_goal_bc", ""]
    armed = True
    with pytest.raises(Killed):
        lab.ask("abort")
    armed = False
    lab.kill_core(Store(path))
    lab.run(1.0)
    assert lab.swarm.behaviours() == ["", "", ""]
    assert lab.missions.statuses()[0].phase == "aborted"
    lab.close()
