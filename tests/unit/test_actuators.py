"""Actuators: what values they take, a Create's panel on its wire, simulated lamps in the world."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from structlog.testing import capture_logs

from fullswarm.agent.view import Params, View
from fullswarm.config import WorldConfig
from fullswarm.drivers.actuators import Actuator, checked, flag, number, pairs, text, word
from fullswarm.drivers.base import STAND, Lifecycle, Twist
from fullswarm.drivers.create_oi import protocol
from fullswarm.drivers.create_oi.panel import GAP_S, Panel
from fullswarm.drivers.create_oi.protocol import CREATE1, CREATE2, Generation
from fullswarm.drivers.create_oi.settings import describe
from fullswarm.drivers.fleet import OneRobot
from fullswarm.drivers.null.driver import NullDriver
from fullswarm.drivers.sim import protocol as sim_protocol
from fullswarm.drivers.sim.session import Session as SimSession
from fullswarm.drivers.sim.settings import parse_url
from fullswarm.errors import DriverError
from fullswarm.kernels import Array
from fullswarm.messages import ActuatorReport
from fullswarm.operator.console.fleet import fleet as fleet_frame
from fullswarm.operator.render import footer_lines
from fullswarm.operator.view import FleetView
from fullswarm.simulation.fleet import SimFleet
from fullswarm.simulation.world import World
from fullswarm.testing.actuators import bad_values, good_values
from tests.unit.agent_bench import Bench
from tests.unit.create_bench import Bench as CreateBench
from tests.unit.laws import install

EVERY = (
    flag("lamp"),
    number("arm", -1.0, 2.0, "rad"),
    word("gripper", ("open", "closed")),
    text("display", 4),
    pairs("song", ((0, 127), (0, 4)), ("MIDI note", "s"), 16),
)
LONGEST_COMMAND = 37  # a song of 16 notes, and to play it


# ---------------------------------------------------------------- values
@pytest.mark.parametrize("actuator", EVERY, ids=lambda each: each.name)
def test_values_of_other_types_and_ranges_are_refused_with_what_is_taken(actuator: Actuator) -> None:
    for good in good_values(actuator):
        checked(EVERY, actuator.name, good)
    for bad in bad_values(actuator):
        with pytest.raises(ValueError, match=f"actuator '{actuator.name}' takes"):
            checked(EVERY, actuator.name, bad)


@given(st.floats())
def test_a_number_is_taken_exactly_where_it_is_finite_and_in_range(value: float) -> None:
    arm = EVERY[1]
    if -1.0 <= value <= 2.0:
        assert arm.check(value) == arm.check(np.float64(value)) == value
    else:
        with pytest.raises(ValueError, match="-1 to 2 rad"):
            arm.check(value)


def test_values_come_out_in_one_type_also_from_arrays() -> None:
    assert EVERY[0].check(np.bool_(True)) is True
    assert EVERY[4].check(np.array([[60.0, 0.5]]).tolist()) == ((60.0, 0.5),)
    assert EVERY[2].expected() == "open | closed"
    with pytest.raises(ValueError, match="did you mean 'lamp'"):
        checked(EVERY, "lmap", True)
    with pytest.raises(ValueError, match="it has none"):
        checked((), "lamp", True)


# ---------------------------------------------------------------- a Create
def active(generation: Generation = CREATE2) -> CreateBench:
    bench = CreateBench(generation)
    bench.run(1.0)
    bench.session.activate(bench.clock.now_s())
    bench.run(0.5, STAND)
    assert bench.session.state is Lifecycle.ACTIVE
    return bench


def put(bench: CreateBench, name: str, value: Any) -> None:
    bench.session.actuate(name, checked(describe(CREATE2).actuators, name, value), bench.clock.now_s())


def serve(bench: CreateBench, duration_s: float, twist: Twist = STAND) -> list[tuple[float, bytes]]:
    """Run the bench as a driver would: what may wait goes behind everything else. Return what went, and when."""
    sent = []
    for _ in range(round(duration_s / 0.005)):
        bench.run(0.005, twist)
        chunk = bench.session.deferred(bench.clock.now_s())
        if chunk is not None:
            sent.append((bench.clock.now_s(), chunk))
            bench.carry(chunk)
    return sent


def test_lamps_display_and_songs_arrive_at_the_robot() -> None:
    bench = active()
    for name, value in (("led_dock", True), ("led_check", True), ("power_colour", 1.0), ("power_light", 0.5)):
        put(bench, name, value)
    put(bench, "display", "hi")
    put(bench, "song", [(60, 0.25), (0, 0.25), (67, 0.5)])
    sent = serve(bench, 0.3)
    panel = bench.robot.panel
    assert (panel.led_bits, panel.power_colour, panel.power_intensity) == (0b1100, 255, 128)
    assert panel.digits == "HI  "
    assert panel.songs[0] == bytes([60, 16, 0, 16, 67, 32])
    assert panel.played == [0]
    assert len(sent) == 3  # the four lamps are one command
    put(bench, "led_dock", True)
    put(bench, "song", [(60, 0.25), (0, 0.25), (67, 0.5)])
    assert serve(bench, 0.3) == []  # as it is already
    put(bench, "song", [])
    put(bench, "song", [(72, 0.25)])
    assert serve(bench, 0.3) == []  # the robot would ignore it while the first one plays
    serve(bench, 1.0)
    assert panel.played == [0, 0]
    assert panel.songs[0] == bytes([72, 16])


def test_a_robot_that_left_safe_mode_begins_dark_and_is_told_again() -> None:
    bench = active()
    put(bench, "led_dock", True)
    put(bench, "led_spot", True)
    bench.session.deactivate(bench.clock.now_s())
    with pytest.raises(DriverError, match="cannot set 'led_dock' while READY"):
        put(bench, "led_dock", True)
    assert serve(bench, 1.0) == []
    bench.session.activate(bench.clock.now_s())
    serve(bench, 0.5)
    assert bench.robot.panel.led_bits == 0
    put(bench, "led_dock", True)
    serve(bench, 0.2)
    assert bench.robot.panel.led_bits == 0b100


def test_notes_that_no_robot_has_are_refused() -> None:
    with pytest.raises(ValueError, match="note"):
        put(active(), "song", [(5, 0.5)])


def test_a_create_1_has_other_lamps_and_no_display() -> None:
    names = {each.name for each in describe(CREATE1).actuators}
    assert {"led_play", "led_advance", "song"} <= names
    assert not {"display", "led_dock"} & names


@given(st.lists(st.tuples(st.integers(0, 60), st.sampled_from(["lamp", "display", "song"])), max_size=60))
def test_whatever_is_asked_for_one_command_at_a_time_goes_out(asked: list[tuple[int, str]]) -> None:
    panel, sent, due = Panel(), [], sorted(asked)
    for step in range(80):
        while due and due[0][0] <= step:
            count, kind = len(due), due.pop(0)[1]
            if kind == "lamp":
                panel.put("power_light", (count % 5) / 4.0)
            elif kind == "display":
                panel.put("display", str(count))
            else:
                panel.put("song", ((31.0 + count, 0.1),) * 16)
        chunk = panel.next(0.005 * step)
        if chunk is not None:
            sent.append((0.005 * step, chunk))
    for (before_s, _), (after_s, chunk) in itertools.pairwise(sent):
        assert after_s - before_s >= GAP_S - 1e-9
        assert len(chunk) <= LONGEST_COMMAND


def test_nothing_of_the_panel_goes_out_between_a_stop_and_its_confirmation() -> None:
    bench = active()
    bench.run(0.5, Twist(0.3, 0.0))
    bench.sent.clear()
    now_s = bench.clock.now_s()
    put(bench, "song", [(60, 0.5)] * 16)
    put(bench, "led_dock", True)
    bench.gate.command(STAND, now_s)
    assert bench.session.deferred(now_s) is None  # zero has not even left
    sent = serve(bench, 0.3)
    zero = bytes(bench.sent).find(protocol.drive_direct(0, 0))
    first = min(bytes(bench.sent).find(chunk) for _, chunk in sent)
    assert 0 <= zero < first
    assert bench.wheels == (0.0, 0.0)


# ---------------------------------------------------------------- simulated robots
def test_simulated_robots_keep_their_lamps_and_grippers_in_the_world() -> None:
    world = World(WorldConfig(engine="kinematic"), ("r1", "r2"))
    fleet, second = SimFleet(world, lambda: 0.0), SimFleet(world, lambda: 0.0, row=1)
    fleet.actuate(0, "lamp", "red")
    second.actuate(0, "gripper", "closed")
    assert world.actuators == ({"lamp": "red", "gripper": "open"}, {"lamp": "off", "gripper": "closed"})
    with pytest.raises(ValueError, match=r"off \| white"):
        fleet.actuate(1, "lamp", "pink")


def test_a_simulated_robots_driver_repeats_what_was_asked_for() -> None:
    session = SimSession(parse_url("sim://r1"), 0.0)

    def greeting(now_s: float) -> dict[str, str]:
        found = [sim_protocol.decode(each) for each in session.tick(now_s)]
        return next((each.actuators for each in found if isinstance(each, sim_protocol.Hello)), {})

    assert greeting(0.0) == {}
    session.actuate("lamp", "red", 0.01)
    assert session.next_due_s(0.01) <= 0.01
    assert greeting(0.01) == {"lamp": "red"}
    session.actuate("gripper", "closed", 0.02)
    session.actuate("lamp", "red", 0.02)
    assert greeting(0.02) == {"lamp": "red", "gripper": "closed"}
    assert greeting(0.23) == {"lamp": "red", "gripper": "closed"}  # the datagram before may be lost


def test_a_robot_without_actuators_refuses_them_all() -> None:
    fleet = OneRobot("r1", NullDriver("null://r1"))
    with pytest.raises(ValueError, match="no actuator 'lamp'"):
        fleet.actuate(0, "lamp", math.nan)


# ---------------------------------------------------------------- what a control law asks for
def test_a_law_sets_actuators_of_its_robots_while_they_may_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    def signalling(view: View, params: Params) -> Array:
        east = view.position[:, 0] > 3.0
        view.actuate(east, "lamp", "red")
        view.actuate(np.flatnonzero(~east), "lamp", "green")
        return np.zeros((len(view.position), 2))

    install(monkeypatch, signalling=signalling)
    bench = Bench([(1.0, 1.0, 0.0), (5.0, 1.0, 0.0), (5.0, 4.0, 0.0)])
    bench.run(0.2)
    for robot in ("r2", "r3"):  # not all: rows of a view are not those of the agent
        bench.enable("signalling", robot=robot)
    bench.run(0.1)
    assert [each["lamp"] for each in bench.simulated.actuators] == ["off", "red", "red"]
    bench.estop(True, "e1")
    bench.run(0.1)
    for each in bench.simulated.actuators:
        each["lamp"] = "off"
    bench.run(0.2)
    assert [each["lamp"] for each in bench.simulated.actuators] == ["off", "off", "off"]


def test_what_a_robot_does_not_have_is_logged_once_with_the_reason_and_it_drives_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def mistaken(view: View, params: Params) -> Array:
        view.actuate(0, "lmap", "red")
        view.actuate(0, "lamp", 7)
        view.actuate(0, "gripper", "closed")
        return np.tile([0.3, 0.0], (len(view.position), 1))

    install(monkeypatch, mistaken=mistaken)
    bench = Bench([(1.0, 1.0, 0.0)])
    bench.run(0.2)
    with capture_logs() as logs:
        bench.enable("mistaken", robot="r1")
        bench.run(1.0)
    told = [each for each in logs if each["event"] == "an actuator is not set"]
    assert [(each["robot"], each["code"]) for each in told] == [("r1", "actuator")] * 2
    assert "the robot has no actuator 'lmap' (did you mean 'lamp'?)" in told[0]["reason"]
    assert "takes off | white" in told[1]["reason"]
    assert bench.simulated.actuators[0] == {"lamp": "off", "gripper": "closed"}
    assert bench.commanded[0, 0] > 0.25


# ---------------------------------------------------------------- what operators see of it
@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("lamp", True, "on"),
        ("lamp", np.False_, "off"),
        ("arm", 0.5, "0.5 rad"),
        ("gripper", "closed", "closed"),
        ("display", "   ", "blank"),
        ("song", [], "silent"),
        ("song", [(60, 1.0)], "1 pair"),
        ("song", [(60, 1.0), (62, 1.0)], "2 pairs"),
    ],
)
def test_a_value_in_words(name: str, value: object, words: str) -> None:
    (actuator,) = (each for each in EVERY if each.name == name)
    assert actuator.shown(value) == words


def test_operators_see_what_was_asked_last_and_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    lamp = ["red"]

    def signalling(view: View, params: Params) -> Array:
        view.actuate(view.id == "r2", "lamp", lamp[0])
        view.actuate(view.id == "r2", "gripper", "welded")  # is refused
        return np.zeros((len(view.position), 2))

    install(monkeypatch, signalling=signalling)
    bench, sent = Bench([(1.0, 1.0, 0.0), (5.0, 1.0, 0.0)]), list[ActuatorReport]()
    bench.bus.subscribe(bench.keys.actuators(), ActuatorReport, sent.append)
    view = FleetView(bench.bus, bench.keys, bench.runtime)
    bench.run(2.1)
    assert sent == []  # nothing until something is asked
    bench.enable("signalling")
    bench.run(1.1)
    assert [(each.robot, each.values) for each in sent[-1].robots] == [("r2", {"lamp": "red"})]
    seen = view.snapshot()
    assert [dict(row.actuators) for row in seen.robots] == [{}, {"lamp": "red"}]
    robots: Any = seen.as_dict()["robots"]
    assert robots[1]["actuators"] == {"lamp": "red"}
    assert fleet_frame(seen, 0.0)["robots"][1]["actuators"] == {"lamp": "red"}
    assert "r2: lamp red" in footer_lines(seen)
    lamp[0] = "green"
    bench.run(1.1)
    assert view.snapshot().robots[1].actuators == {"lamp": "green"}
    bench.stop("s")
    bench.run(4.0)
    assert view.snapshot().robots[1].actuators == {"lamp": "green"}  # a value holds until another is asked
    before = len(sent)
    bench.estop(True, "e1")
    lamp[0] = "blue"
    bench.run(1.1)
    assert len(sent) == before + 1
    assert sent[-1].robots[0].values == {"lamp": "green"}  # a robot that may not drive gets none
