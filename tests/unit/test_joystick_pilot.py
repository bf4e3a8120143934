from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.operator.joystick.bindings import parse_bindings
from fullswarm.operator.joystick.state import AXES
from tests.unit.joystick_bench import LB, ME, RB, STREAMED, Bench, fresh, sticks

bench = pytest.fixture(fresh)


def test_a_stick_without_the_dead_man_asks_for_nothing(bench: Bench) -> None:
    bench.push(leftx=-1.0, righty=1.0)
    bench.run(2.0)
    assert bench.requests == []


def test_left_stick_with_the_dead_man_requests_move_left_of_the_whole_swarm(bench: Bench) -> None:
    bench.press(LB)
    bench.push(leftx=-1.0)
    request = bench.newest()
    assert (request.behaviour, request.robots, request.operator) == ("move_left_bc", (), ME)
    assert request.parameters == {"magnitude": 0.5}
    bench.press(RB)
    bench.run(0.03)
    assert bench.newest().parameters == {"magnitude": 1.0}


@pytest.mark.parametrize(
    ("axes", "behaviour"),
    [
        ({"leftx": 0.8}, "move_right_bc"),
        ({"leftx": -0.8, "lefty": 0.2}, "move_left_bc"),
        ({"lefty": -0.8}, "move_forward_bc"),
        ({"lefty": 0.8, "leftx": 0.5}, "move_backward_bc"),
    ],
)
def test_the_axis_further_out_decides(bench: Bench, axes: dict[str, float], behaviour: str) -> None:
    bench.press(LB)
    bench.push(**axes)
    assert bench.newest().behaviour == behaviour


def test_a_diagonal_does_not_flutter_between_two_behaviours(bench: Bench) -> None:
    bench.press(LB)
    bench.push(leftx=0.72, lefty=-0.70)
    began_s = bench.time_s
    for step in range(20):
        bench.push(leftx=0.70 + 0.02 * (step % 2), lefty=-0.71)
    assert {each.behaviour for each in bench.sent_since(began_s)} == {"move_right_bc"}
    bench.push(leftx=0.5, lefty=-0.8)
    assert bench.newest().behaviour == "move_forward_bc"


def test_it_streams_at_20_hz_and_sends_a_moved_stick_at_once(bench: Bench) -> None:
    bench.press(LB)
    bench.push(lefty=-0.6)
    began_s = bench.time_s
    bench.run(1.0)
    assert len(bench.sent_since(began_s)) == pytest.approx(20, abs=1)


@pytest.mark.parametrize("after_s", [0.005, 0.01, 0.015, 0.02, 0.03, 0.045])
def test_a_moved_stick_is_sent_within_20_ms_and_a_poll_whenever_the_last_frame_was(
    bench: Bench, after_s: float
) -> None:
    bench.press(LB)
    bench.push(lefty=-0.6)
    frames = len(bench.requests)
    while len(bench.requests) == frames:
        bench.run(0.001)
    bench.run(after_s)
    moved_s = bench.time_s
    bench.pads.set(bench.pad, lefty=-0.9)
    bench.run(0.1)
    changed = [at_s for at_s, each in bench.requests if sticks(each)[0] > 0.4]
    assert changed[0] - moved_s <= 0.0251


def test_inside_the_dead_zone_is_nothing_and_just_outside_is_little(bench: Bench) -> None:
    bench.press(LB)
    bench.push(leftx=0.14)
    assert bench.requests == []
    bench.push(leftx=0.16)
    assert 0.0 < sticks(bench.newest())[0] < 0.02


def test_letting_the_dead_man_go_is_zero_at_the_next_look_and_ends_the_stream(bench: Bench) -> None:
    bench.press(LB)
    bench.push(lefty=-1.0)
    bench.run(0.5)
    let_go_s = bench.time_s
    bench.pads.set(bench.pad, buttons=frozenset())
    bench.run(1.0)
    after = [(at_s, sticks(each)) for at_s, each in bench.requests if at_s > let_go_s]
    zeros = [at_s for at_s, values in after if not any(values)]
    assert zeros[0] - let_go_s <= 0.0051
    assert len(zeros) == 3
    assert all(at_s < zeros[0] for at_s, values in after if any(values))
    assert bench.holders == {}


def test_a_dead_man_that_is_down_when_the_pad_comes_moves_nothing_until_pressed_again() -> None:
    bench = Bench()
    bench.unplug()
    bench.run(0.2)
    bench.pad = bench.pads.plug(LB)
    bench.run(0.2)
    bench.push(leftx=1.0)
    bench.run(0.5)
    assert bench.requests == []
    bench.release(LB)
    bench.press(LB)
    bench.run(0.05)
    assert bench.newest().behaviour == "move_right_bc"


def test_unplugging_while_driving_is_zero_and_a_stop_of_those_robots(bench: Bench) -> None:
    bench.tap("dpright")
    bench.press(LB)
    bench.push(lefty=-1.0)
    gone_s = bench.time_s
    bench.unplug()
    bench.run(0.6)
    assert not any(sticks(bench.newest()))
    assert bench.stops[0][0] - gone_s <= 0.0051
    assert {stop.robots for _, stop in bench.stops} == {("r1",)}
    assert bench.note() == "pad 1 is gone: r1 stopped"
    count = len(bench.requests)
    bench.pad = bench.pads.plug(LB)
    bench.run(0.2)
    bench.push(lefty=-1.0)
    bench.run(0.5)
    assert len(bench.requests) == count


def test_unplugging_a_pad_that_does_not_drive_stops_no_robot(bench: Bench) -> None:
    bench.press(LB)
    bench.unplug()
    bench.run(0.5)
    assert bench.stops == []
    assert bench.holders == {}


def test_an_error_of_the_pads_counts_as_unplugged(bench: Bench) -> None:
    bench.press(LB)
    bench.push(lefty=-1.0)
    bench.pads.error = OSError("USB bus error")
    bench.run(0.5)
    assert not any(sticks(bench.newest()))
    assert len(bench.stops) == 5
    assert "USB bus error" in bench.note()
    bench.pads.error = None
    count = len(bench.requests)
    bench.run(0.5)
    assert len(bench.requests) == count  # the dead-man is still down


def test_right_stick_drives_one_robot_only(bench: Bench) -> None:
    bench.press(LB)
    bench.push(righty=-1.0)
    assert bench.requests == []
    assert "one robot, not whole swarm" in bench.note()
    bench.push(righty=0.0)
    bench.release(LB)
    bench.tap("dpright")
    bench.press(LB)
    bench.push(righty=-1.0)
    request = bench.newest()
    assert (request.behaviour, request.robots) == ("drive_bc", ("r1",))
    assert request.parameters == {"linear": 0.5, "angular": 0.0}
    bench.push(righty=0.0, rightx=1.0)
    assert bench.newest().parameters == {"linear": 0.0, "angular": -0.5}


def test_the_cross_steps_through_robots_groups_and_makes(bench: Bench) -> None:
    seen = []
    for _ in range(5):
        bench.tap("dpright")
        seen.append(bench.pilot.status().selection)
    bench.tap("dpleft")
    assert [*seen, bench.pilot.status().selection] == ["r1", "r2", "r3", "r4", "r1", "r4"]
    labels = []
    for _ in range(5):
        bench.tap("dpup")
        labels.append(bench.pilot.status().selection)
    assert labels == ["whole swarm", "group scouts", "all Create", "all Rover", "whole swarm"]
    bench.tap("dpup")
    bench.press(LB)
    bench.push(leftx=1.0)
    assert bench.newest().robots == ("r1", "r3")
    assert set(bench.holders) == {"r1", "r3"}


def test_a_group_that_is_gone_is_empty_and_not_the_whole_swarm(bench: Bench) -> None:
    bench.tap("dpup")
    bench.groups = {}
    bench.pilot._roster._groups.clear()
    bench.press(LB)
    bench.push(leftx=1.0)
    assert bench.requests == []
    assert "no robot of it" in bench.note()


def test_choosing_another_robot_zeroes_the_first_and_waits_for_the_stick_to_be_centred(bench: Bench) -> None:
    bench.tap("dpright")
    bench.press(LB)
    bench.push(lefty=-1.0)
    bench.tap("dpright")
    bench.run(0.3)
    assert not any(sticks([each for _, each in bench.requests if each.robots == ("r1",)][-1]))
    assert all(each.robots == ("r1",) for _, each in bench.requests)
    assert bench.holders == {"r2": ME}
    bench.push(lefty=0.0)
    bench.push(lefty=-1.0)
    assert (bench.newest().robots, sticks(bench.newest())) == (("r2",), [0.5])


def test_a_button_starts_a_behaviour_only_with_the_dead_man(bench: Bench) -> None:
    bench.tap("x")
    assert bench.requests == []
    bench.press(LB)
    bench.tap("x")
    assert (bench.newest().behaviour, bench.newest().robots) == ("rendezvous_bc", ())
    bench.release(LB)
    bench.run(1.0)
    assert len(bench.requests) == 1


def test_a_behaviour_asked_for_while_driving_comes_after_the_zeros_and_stays(bench: Bench) -> None:
    bench.press(LB)
    bench.push(leftx=1.0)
    bench.tap("y")
    bench.run(1.0)
    assert bench.newest().behaviour == "flocking_bc"
    assert not any(sticks([each for _, each in bench.requests if each.behaviour in STREAMED][-1]))
    bench.push(leftx=0.0)
    bench.push(leftx=1.0)
    assert bench.newest().behaviour == "move_right_bc"


def test_a_behaviour_that_the_core_never_had_is_called_off_with_the_dead_man(bench: Bench) -> None:
    bench.press(LB)
    bench.core = False
    bench.tap("x")
    bench.release(LB)
    bench.run(0.3)
    count = len(bench.requests)
    bench.core = True
    bench.run(2.0)
    assert len(bench.requests) == count


def test_interventions_at_driven_robots_are_felt_three_times_a_second_at_most(bench: Bench) -> None:
    bench.tap("dpright")
    bench.intervene("r1")
    assert bench.pads.rumbles == []
    bench.press(LB)
    bench.push(leftx=1.0)
    for _ in range(10):
        bench.intervene("r1")
        bench.intervene("r2")
        bench.run(0.1)
    assert 3 <= len(bench.pads.rumbles) <= 4
    assert "filter: r1: keeps clear of r9" in bench.note()
    bench.push(leftx=0.0)
    felt = len(bench.pads.rumbles)
    bench.intervene("r2")
    bench.intervene("r1")
    bench.run(0.5)
    assert len(bench.pads.rumbles) == felt


def test_a_robot_that_joins_the_whole_swarm_is_held_too(bench: Bench) -> None:
    bench.press(LB)
    bench.push(leftx=1.0)
    bench.robots["r5"] = "Create"
    bench.run(1.0)
    assert bench.holders["r5"] == ME


def test_only_the_robots_that_were_named_are_driven() -> None:
    bench = Bench(only=("r2", "@scouts"))
    bench.press(LB)
    bench.push(leftx=1.0)
    assert bench.newest().robots == ("r1", "r2", "r3")


def test_the_note_of_an_unknown_pad_names_the_command_that_maps_it(bench: Bench) -> None:
    bench.pads.plug(known=False)
    bench.run(0.1)
    assert "joystick map" in bench.note()


def test_closing_is_zero_then_everything_is_given_back(bench: Bench) -> None:
    ended: list[float] = []
    bench.press(LB)
    bench.push(leftx=1.0)
    bench.pilot.close(lambda: ended.append(bench.time_s))
    bench.run(1.0)
    assert ended
    assert not any(sticks(bench.newest()))
    assert bench.holders == {}
    count = len(bench.requests)
    bench.run(1.0)
    assert len(bench.requests) == count


def test_triggers_and_fixed_parameters_can_be_bound() -> None:
    text = """
        [motion]
        share_without_turbo = 1.0
        dead_zone = 0.0
        [[sticks]]
        behaviour = "drive"
        axes = { linear = "righttrigger" }
        parameters = { speed_m_s = 0.2 }
    """
    bench = Bench(bindings=parse_bindings(text))
    bench.press(LB)
    bench.push(righttrigger=0.25)
    assert bench.newest().parameters == {"linear": 0.25, "speed_m_s": 0.2}


AXIS = st.one_of(st.just(0.0), st.floats(-1.0, 1.0), st.sampled_from([math.nan, math.inf, -1.0, 1.0]))
STEP = st.fixed_dictionaries(
    {
        "buttons": st.frozensets(st.sampled_from([LB, LB, LB, RB, *"abx", "back", "dpright", "dpup"]), max_size=4),
        "axes": st.dictionaries(st.sampled_from(AXES), AXIS, max_size=3),
        "world": st.sampled_from(["", "", "", "", "", "unplug", "no hub", "no core", "taken", "refused"]),
        "seconds": st.sampled_from([0.005, 0.02, 0.1, 0.5]),
    }
)


@settings(max_examples=30, deadline=None)
@given(st.lists(STEP, min_size=1, max_size=15))
def test_nothing_moves_without_the_dead_man_and_the_last_word_is_zero(steps: list[dict[str, object]]) -> None:
    bench = Bench()
    held: list[tuple[float, float]] = []
    for step in steps:
        world = step["world"]
        bench.bus.hub, bench.core = world != "no hub", world != "no core"
        bench.refuse = "no" if world == "refused" else ""
        bench.holders = {"r1": "ben@lab"} if world == "taken" else bench.holders
        bench.tell_leases()
        if world == "unplug":
            bench.unplug()
            bench.run(0.02)
            bench.pad = bench.pads.plug()
        buttons, axes, seconds = step["buttons"], step["axes"], step["seconds"]
        assert isinstance(buttons, frozenset)
        assert isinstance(axes, dict)
        assert isinstance(seconds, float)
        if LB in buttons:
            held.append((bench.time_s, bench.time_s + seconds + 0.0051))
        bench.pads.set(bench.pad, buttons=buttons, **axes)
        bench.run(seconds)
    bench.pads.set(bench.pad, buttons=frozenset())
    bench.run(1.0)
    streamed = [(at_s, each) for at_s, each in bench.requests if each.behaviour in STREAMED]
    for at_s, request in streamed:
        assert all(-1.0 <= value <= 1.0 for value in sticks(request))
        assert request.parameters.get("magnitude", 0.0) >= 0.0  # type: ignore[operator]
        if any(sticks(request)):
            assert any(begin <= at_s <= end for begin, end in held)
    if streamed:
        assert not any(sticks(streamed[-1][1]))
    assert ME not in bench.holders.values()
