"""Lab: a swarm in a program. Requests, functions as behaviours, commanded velocities, records, several at once."""

from __future__ import annotations

import itertools
import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fullswarm import Lab
from fullswarm.errors import BehaviourFailed, ConfigError, RequestRefused

Array = NDArray[np.float64]
STARTS = [[1.0, 1.0, 0.0], [1.0, 3.0, 0.0], [1.0, 5.0, 0.0]]
BOUNDS = (0.0, 0.0, 8.0, 8.0)


def made(**changes: Any) -> Lab:
    return Lab(**{"starts": STARTS, "bounds": BOUNDS, "seed": 7, **changes})


@pytest.fixture
def lab() -> Iterator[Lab]:
    with made() as found:
        yield found


def east(view: Any, params: Any) -> Array:
    return np.tile([0.2, 0.0], (len(view.position), 1))


# ------------------------------------------------------------------ what there is
def test_it_has_robots_poses_and_time(lab: Lab) -> None:
    assert lab.robots == ("r1", "r2", "r3")
    assert lab.time_s == 0.0
    np.testing.assert_allclose(lab.poses, STARTS)
    lab.step()
    assert lab.time_s == pytest.approx(lab.period_s)
    lab.run(1.0)
    assert lab.time_s == pytest.approx(1.0 + lab.period_s)


def test_it_opens_a_fleet_file(tmp_path: Path) -> None:
    file = tmp_path / "two.toml"
    file.write_text('[world]\nengine = "kinematic"\n[[robot]]\nid = "a"\n[[robot]]\nid = "b"\n')
    with Lab(file, seed=3, settings={"agent.sensing_radius_m": 1.5}) as lab:
        assert lab.robots == ("a", "b")
        assert lab._lockstep.config.agent.sensing_radius_m == 1.5


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({}, "how many robots"),
        ({"robots": 0}, "robots = 0"),
        ({"robots": "r1"}, r"\['r1'\]"),
        ({"robots": 2, "starts": STARTS}, "3 start poses for 2 robots"),
        ({"starts": [[1.0]]}, "not a start pose"),
        ({"starts": [[1.0, 1.0], [1.1, 1.0]]}, "overlap"),
        ({"robots": 1, "bounds": (5, 0, 1, 1)}, "arena"),
        ({"robots": 1, "obstacles": [[1, 1]]}, "not an obstacle"),
        ({"robots": 1, "engine": "kinematics"}, "kinematic"),
        ({"robots": 1, "settings": {"agent.sensing_radius": 2}}, "sensing_radius"),
        ({"fleet": "nowhere.toml"}, "nowhere.toml"),
        ({"fleet": "nowhere.toml", "robots": 2}, "fleet file and robots"),
    ],
)
def test_a_wrong_argument_is_named_in_a_sentence(arguments: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        Lab(**arguments)


# ------------------------------------------------------------------ requests
def test_a_behaviour_is_requested_by_name_and_carried_out(lab: Lab) -> None:
    request = lab.request("move_to_goal_bc", goal=np.array([3.0, 3.0]), arrive_radius_m=1.0, robots=["r1", "r3"])
    lab.run(10.0)
    assert request.phase == "running"
    assert (np.hypot(*(lab.poses[[0, 2], :2] - [3.0, 3.0]).T) < 1.1).all()
    np.testing.assert_allclose(lab.poses[1], STARTS[1])
    assert lab.metrics["collisions.events"] == 0.0
    assert lab.metrics["work.max_m"] > 1.5


def test_mistakes_are_refused_with_a_hint(lab: Lab) -> None:
    with pytest.raises(RequestRefused, match="did you mean 'move_to_goal"):
        lab.request("move_to_gaol", goal=[1, 2])
    with pytest.raises(RequestRefused, match="did you mean 'goal'"):
        lab.request("move_to_goal", goul=[1, 2])
    with pytest.raises(ConfigError, match="did you mean 'r1'"):
        lab.request("flocking", robots=["r11"])
    with pytest.raises(ConfigError, match="_bc"):
        lab.request("flocking", filtered=True)


def test_cancel_stops_those_that_still_run_it_and_no_others(lab: Lab) -> None:
    first = lab.request(east)
    lab.run(1.0)
    second = lab.request(east, robots="r3")
    lab.run(0.5)
    first.cancel()
    lab.run(1.0)
    assert second.phase == "running"
    np.testing.assert_allclose(lab.twists[:, 0], [0.0, 0.0, 0.2], atol=1e-6)


def test_a_behaviour_that_ends_itself_has_a_result(lab: Lab) -> None:
    def until_three(view: Any, *, text: Any = "there") -> Array:
        view.finish((view.position[:, 0] > 1.3) & (view.id == "r2"), "arrived", text)
        view.finish(view.id == "r3", "failed", "no map")
        return east(view, None)

    request = lab.request(until_three)
    assert request.result == {}
    lab.run(4.0)
    assert {robot: (each.outcome, each.text) for robot, each in request.result.items()} == {
        "r2": ("arrived", "there"),
        "r3": ("failed", "no map"),
    }
    assert request.running
    np.testing.assert_allclose(lab.twists[:, 0], [0.2, 0.0, 0.0], atol=1e-6)


# ------------------------------------------------------------------ functions as behaviours
def test_a_function_with_its_own_parameters_is_a_behaviour(lab: Lab) -> None:
    def drift(view: Any, *, speed_m_s: Any = 0.1, towards: Any = (1.0, 0.0)) -> Any:
        return speed_m_s * np.broadcast_to(towards, (len(view.position), 2))

    lab.request(drift, speed_m_s=0.2, robots=["r1"])
    lab.request(drift, robots=["r2"])
    lab.run(3.0)
    assert lab.twists[0, 0] == pytest.approx(0.2)
    assert lab.twists[1, 0] == pytest.approx(0.1)
    assert lab.twists[2, 0] == 0.0
    with pytest.raises(RequestRefused, match="speed_m_s"):
        lab.request(drift, speed_m_s="fast")


def test_a_function_may_return_twists(lab: Lab) -> None:
    lab.request(lambda view: np.tile([0.1, 0.5], (len(view.position), 1)), twist=True)
    lab.run(2.0)
    np.testing.assert_allclose(lab.twists, np.tile([0.1, 0.5], (3, 1)), atol=1e-6)


def test_a_function_that_fails_stops_its_robots_and_is_named(lab: Lab) -> None:
    def shape(view: Any, params: Any) -> Array:
        return np.zeros(3)

    lab.request(shape)
    with pytest.raises(BehaviourFailed, match=r"shape returned \(3,\), not an array of shape \(3, 2\)"):
        lab.run(1.0)

    def fails(view: Any, params: Any) -> Array:
        return np.full((len(view.position), 2), 1 / 0)

    lab.request(fails)
    with pytest.raises(BehaviourFailed, match="division by zero") as failed:
        lab.run(1.0)
    assert isinstance(failed.value.__cause__, ZeroDivisionError)  # its traceback shows the function's line
    lab.request(east)
    lab.run(1.0)
    assert (lab.twists[:, 0] > 0.1).all()


def test_the_filter_keeps_what_a_function_wants_from_a_contact() -> None:
    def ahead(view: Any, params: Any) -> Array:
        return np.where(view.position[:, :1] < 3.0, [[0.4, 0.0]], [[-0.4, 0.0]])

    starts = [[1.0, 3.0, 0.0], [5.0, 3.0, math.pi]]
    contacts = {}
    for filtered in (True, False):
        with Lab(starts=starts, bounds=BOUNDS) as lab:
            lab.request(ahead, filtered=filtered)
            lab.run(10.0)
            contacts[filtered] = lab.metrics["collisions.events"]
    assert contacts[True] == 0.0
    assert contacts[False] > 0.0  # the test can fail


def test_a_file_is_a_behaviour_with_the_record_beside_it(lab: Lab, tmp_path: Path) -> None:
    file = tmp_path / "drift.py"
    file.write_text(
        "from __future__ import annotations\nimport numpy as np\n\n"
        "def velocity(view, params):\n    return params.speed_m_s * np.ones((len(view.position), 1)) * [[1.0, 0.0]]\n"
    )
    file.with_suffix(".toml").write_text(
        '[drift]\nsummary = "Drift"\nlaw = "drift"\n[drift.parameters]\n'
        'speed_m_s = { type = "number", default = 0.15, min = 0.0, max = 0.3 }\n'
    )
    lab.request(file)
    lab.run(2.0)
    np.testing.assert_allclose(lab.twists[:, 0], 0.15, atol=1e-6)
    with pytest.raises(RequestRefused, match="speed_m_s = 1"):
        lab.request(str(file), speed_m_s=1.0)
    file.write_text("def velocity(view, params):\n    return 1 +\n")
    with pytest.raises(ConfigError, match=r"drift\.py:2"):
        lab.request(file)


# ------------------------------------------------------------------ commanded velocities
def test_commanded_velocities_are_driven_until_overwritten(lab: Lab) -> None:
    lab.set_velocities(["r2"], [[0.2, 0.4]])
    lab.run(1.0)
    assert lab.twists == pytest.approx(np.array([[0, 0], [0.2, 0.4], [0, 0]]), abs=1e-6)
    lab.set_velocities(None, [[0.1, 0.0], [0.0, 0.0], [0.1, 0.1]])
    lab.run(1.0)
    assert lab.twists == pytest.approx(np.array([[0.1, 0], [0, 0], [0.1, 0.1]]), abs=1e-6)
    lab.set_velocities("r1", [[0.0, 0.2]], planar=True)
    lab.run(3.0)
    assert lab.poses[0, 2] == pytest.approx(math.pi / 2, abs=0.05)
    with pytest.raises(ConfigError, match=r"expected \(3, 2\)"):
        lab.set_velocities(None, np.array([0.1, 0.0]))
    with pytest.raises(ConfigError, match="not finite"):
        lab.set_velocities("r1", [[math.nan, 0.0]])


def test_commands_pass_the_filter_unless_it_is_off() -> None:
    events = {}
    for filtered, planar in itertools.product((True, False), repeat=2):
        with Lab(starts=[[1.0, 3.0, 0.0], [5.0, 3.0, math.pi]], bounds=BOUNDS) as lab:
            ahead = [[0.4, 0.0], [-0.4, 0.0]] if planar else [[0.4, 0.0], [0.4, 0.0]]
            lab.set_velocities(None, ahead, filtered=filtered, planar=planar)
            lab.run(5.0)
            events[filtered, planar] = lab.metrics["collisions.events"] > 0.0, lab.interventions.max() > 0.01
            lab.set_velocities(None, [[0.0, 0.0]] * 2, filtered=not filtered)
            lab.run(0.5)
            np.testing.assert_allclose(lab.twists, 0.0, atol=1e-6)
    assert events == {
        (True, True): (False, True), (True, False): (False, True),
        (False, True): (True, False), (False, False): (True, False),
    }  # fmt: skip


@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 2**16))
def test_commands_behind_the_filter_never_touch(seed: int) -> None:
    rng = np.random.default_rng(seed)
    with Lab(robots=5, bounds=(0.0, 0.0, 3.0, 3.0), seed=seed) as lab:
        for _ in range(12):
            lab.set_velocities(None, rng.uniform([-0.5, -2.0], [0.5, 2.0], (5, 2)))
            lab.run(0.5)
        assert lab.metrics["collisions.events"] == 0.0


# ------------------------------------------------------------------ records
def test_the_record_is_a_table_and_a_picture(lab: Lab, tmp_path: Path) -> None:
    lab.request(east)
    lab.run(2.0)
    table = lab.to_dataframe()
    assert list(table.columns) == [
        "time_s", "robot", "x_m", "y_m", "heading_rad", "speed_m_s", "turn_rad_s", "contact", "behaviour",
    ]  # fmt: skip
    assert len(table) == 21 * 3
    last = table[table.robot == "r2"].iloc[-1]
    assert last.x_m == pytest.approx(lab.poses[1, 0], abs=1e-6)
    assert last.behaviour == "east"
    assert lab.plot("east").save(tmp_path / "east.png").stat().st_size > 5000
    assert lab.plot()._repr_png_().startswith(b"\x89PNG")
    assert "data:image/gif;base64," in lab.animate(width_px=320, fps=2.0)._repr_html_()
    assert [repr(lab.plot()), repr(lab.animate())] == ["<Picture of 3 robots>", "<Animation of 3 robots>"]
    lab.close()
    assert lab.animate(width_px=320, fps=2.0).save(tmp_path / "east.gif").read_bytes().startswith(b"GIF")
    with pytest.raises(ConfigError, match="closed"):
        lab.step()


# ------------------------------------------------------------------ several, and the same again
def test_several_laboratories_do_not_disturb_each_other_and_repeat() -> None:
    def way(lab: Lab, parts: int) -> Array:
        for _ in range(parts):
            lab.run(3.0 / parts)
        return lab.poses

    def start() -> Lab:
        lab = Lab(robots=4, bounds=BOUNDS, seed=5, settings={"world.noise.position_m": 0.01})
        lab.request("rendezvous_bc")
        return lab

    with start() as alone:
        expected = way(alone, 1)
    with start() as one, start() as other:
        one.request(east, robots="r1")
        other_poses, one_poses = way(other, 3), way(one, 2)
    np.testing.assert_array_equal(other_poses, expected)
    assert not np.array_equal(one_poses, expected)


def test_import_of_the_package_imports_no_laboratory() -> None:
    code = "import sys, fullswarm; assert 'numpy' not in sys.modules; assert 'Lab' in dir(fullswarm)"
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="has no attribute 'Laboratory'"):
        __import__("fullswarm").Laboratory  # noqa: B018  (the access is the test)
