"""The Robotarium shim: names, values against ``rps`` or against computations of their own, and the testbed."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import minimize

import fullswarm.robotarium
from fullswarm.clock import MonotonicClock
from fullswarm.errors import ConfigError, MissingExtra
from fullswarm.robotarium import robotarium as ours_robotarium
from fullswarm.robotarium.robotarium import Robotarium
from fullswarm.robotarium.utilities import barrier_certificates, controllers, graph, misc, transformations
from fullswarm.robotarium.utilities.barrier_certificates2 import create_robust_barriers
from fullswarm.robotarium.utilities.programme import Constraints, nearest
from tests.unit.rps_modules import ALIAS, fresh_rps

mpl.use("Agg")

Array = NDArray[np.float64]
UTILITIES = ("transformations", "controllers", "barrier_certificates", "graph", "misc")
NAMES = ("robotarium", "robotarium_abc", *(f"utilities.{name}" for name in UTILITIES))
MATRIX = pytest.mark.filterwarnings("ignore:the matrix subclass:PendingDeprecationWarning")  # rps uses it
seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module")
def rps() -> Iterator[SimpleNamespace]:
    """The modules of the Robotarium's own simulator, by the last part of their names."""
    with fresh_rps():
        yield SimpleNamespace(**{name.rpartition(".")[2]: importlib.import_module(f"rps.{name}") for name in NAMES})


def ours(name: str) -> ModuleType:
    return importlib.import_module(f"fullswarm.robotarium.{name}")


def poses_of(seed: int, count: int = 5) -> Array:
    rng = np.random.default_rng(seed)
    return rng.uniform([[-1.6], [-1.0], [-4.0]], [[1.6], [1.0], [4.0]], (3, count))


def planar_of(seed: int, count: int = 5, size: float = 0.3) -> Array:
    return np.random.default_rng(seed + 1).uniform(-size, size, (2, count))


def apart(seed: int, count: int, least: float = 0.2) -> Array:
    """Return poses (3, count) whose positions are at least so far apart."""
    rng = np.random.default_rng(seed)
    while True:
        poses = rng.uniform([[-0.6], [-0.6], [-3.0]], [[0.6], [0.6], [3.0]], (3, count))
        first, second = np.triu_indices(count, 1)
        if (np.linalg.norm(poses[:2, first] - poses[:2, second], axis=0) > least).all():
            return poses


# ------------------------------------------------------------------ names
def parameters(function: Any) -> list[tuple[str, Any]]:
    return [(each.name, each.default) for each in inspect.signature(function).parameters.values()]


def same(theirs: list[tuple[str, Any]], found: list[tuple[str, Any]]) -> bool:
    """Tell whether `found` begins with the same names and defaults."""
    return len(found) >= len(theirs) and all(
        name == other and np.array_equal(default, other_default)
        for (name, default), (other, other_default) in zip(theirs, found, strict=False)
    )


@pytest.mark.parametrize("name", NAMES)
def test_every_public_name_of_rps_is_there_with_the_same_parameters(name: str, rps: SimpleNamespace) -> None:
    theirs, found = getattr(rps, name.rpartition(".")[2]), ours(name)
    public = {
        key: value
        for key, value in vars(theirs).items()
        if not key.startswith("_") and str(getattr(value, "__module__", "")).startswith("rps")
    }
    assert public
    for key, value in public.items():
        if key == "RobotariumABC" and name == "robotarium":
            continue  # there by its star import only
        assert hasattr(found, key), key
        assert key in found.__all__, f"'from {name} import *' does not give {key}"
        assert same(parameters(value), parameters(getattr(found, key))), key
        if inspect.isclass(value):
            for method, function in inspect.getmembers(value, inspect.isfunction):
                if not method.startswith("_"):
                    assert same(parameters(function), parameters(getattr(getattr(found, key), method))), method


def test_star_imports_bring_numpy_and_pyplot_as_those_of_rps(rps: SimpleNamespace) -> None:
    for name in NAMES[2:]:
        assert {"np"} <= set(vars(getattr(rps, name.rpartition(".")[2])))
        assert "np" in ours(name).__all__
    assert misc.plt is plt
    assert "plt" in misc.__all__


def test_the_module_of_rps_that_needs_quadprog_is_there_too() -> None:
    found = importlib.util.find_spec("rps.utilities.barrier_certificates2")
    assert found is not None
    tree = ast.parse(Path(str(found.origin)).read_text(encoding="utf-8"))
    (function,) = [each for each in tree.body if isinstance(each, ast.FunctionDef)]
    theirs = [
        (argument.arg, ast.literal_eval(default))
        for argument, default in zip(function.args.args, function.args.defaults, strict=True)
    ]
    assert function.name == "create_robust_barriers"
    assert theirs == parameters(create_robust_barriers)


@MATRIX
def test_what_the_creators_return_takes_the_same_parameters(rps: SimpleNamespace) -> None:
    for name in NAMES[2:5]:
        module = getattr(rps, name.rpartition(".")[2])
        for key in [each for each in vars(module) if each.startswith("create_")]:
            theirs, found = getattr(module, key)(), getattr(ours(name), key)()
            pairs = zip(theirs, found, strict=True) if isinstance(theirs, tuple) else [(theirs, found)]
            for function, other in pairs:
                names = [each for each, _ in parameters(function)]
                assert names == [each for each, _ in parameters(other)], key


def test_constants_of_the_testbed_are_those_of_rps(rps: SimpleNamespace) -> None:
    start = apart(3, 2)
    theirs = rps.robotarium.Robotarium(2, False, True, start.copy())
    found = Robotarium(2, False, True, start)
    for name in (
        "number_of_robots", "boundaries", "time_step", "robot_diameter", "robot_radius", "wheel_radius", "base_length",
        "max_linear_velocity", "max_angular_velocity", "max_wheel_velocity", "show_figure", "sim_in_real_time",
    ):  # fmt: skip
        assert getattr(found, name) == pytest.approx(getattr(theirs, name)), name
    np.testing.assert_array_equal(found.poses, theirs.poses)


# ------------------------------------------------------------------ values against rps
@given(seeds, st.floats(0.2, 3.0), st.floats(0.5, 4.0))
@settings(max_examples=30)
def test_maps_give_what_rps_gives(rps: SimpleNamespace, seed: int, gain: float, limit: float) -> None:
    theirs, poses, dxi = rps.transformations, poses_of(seed), planar_of(seed)
    np.testing.assert_allclose(
        transformations.create_si_to_uni_dynamics(gain, limit)(dxi, poses),
        theirs.create_si_to_uni_dynamics(gain, limit)(dxi, poses),
        atol=1e-12,
    )
    to_unicycle, to_points = transformations.create_si_to_uni_mapping(0.1 * gain, limit)
    their_unicycle, their_points = theirs.create_si_to_uni_mapping(0.1 * gain, limit)
    np.testing.assert_allclose(to_unicycle(dxi, poses), their_unicycle(dxi, poses), atol=1e-12)
    np.testing.assert_allclose(to_points(poses), their_points(poses), atol=1e-12)
    np.testing.assert_allclose(
        transformations.create_uni_to_si_dynamics(gain)(dxi, poses),
        theirs.create_uni_to_si_dynamics(gain)(dxi, poses),
        atol=1e-12,
    )


@given(seeds, st.floats(0.2, 3.0))
@settings(max_examples=30)
def test_controllers_give_what_rps_gives(rps: SimpleNamespace, seed: int, gain: float) -> None:
    theirs, states, goals = rps.controllers, poses_of(seed), poses_of(seed + 2)
    np.testing.assert_allclose(
        controllers.create_si_position_controller(gain, 1.5, 0.2)(states[:2], goals[:2]),
        theirs.create_si_position_controller(gain, 1.5, 0.2)(states[:2], goals[:2]),
        atol=1e-12,
    )
    np.testing.assert_allclose(
        controllers.create_clf_unicycle_position_controller(gain, 2.0)(states, goals[:2]),
        theirs.create_clf_unicycle_position_controller(gain, 2.0)(states, goals[:2]),
        atol=1e-12,
    )
    np.testing.assert_allclose(
        controllers.create_clf_unicycle_pose_controller(gain, 2.0, 0.7)(states, goals),
        theirs.create_clf_unicycle_pose_controller(gain, 2.0, 0.7)(states, goals),
        atol=1e-9,
    )


@given(seeds, st.integers(3, 9), st.integers(0, 40))
@settings(max_examples=30)
def test_graphs_and_random_starts_are_those_of_rps_after_the_same_seed(
    rps: SimpleNamespace, seed: int, count: int, more: int
) -> None:
    for name in ("cycle_GL", "lineGL", "completeGL"):
        np.testing.assert_array_equal(getattr(graph, name)(count), getattr(rps.graph, name)(count))
    poses = poses_of(seed, count)
    np.random.seed(seed)  # noqa: NPY002
    found = (
        graph.random_connectedGL(count, more), graph.randomGL(count, more), misc.generate_initial_conditions(count)
    )  # fmt: skip
    np.random.seed(seed)  # noqa: NPY002
    np.testing.assert_array_equal(found[0], rps.graph.random_connectedGL(count, more))
    np.testing.assert_array_equal(found[1], rps.graph.randomGL(count, more))
    np.testing.assert_array_equal(found[2], rps.misc.generate_initial_conditions(count))
    laplacian = graph.random_connectedGL(count, more)
    kept = laplacian.copy()
    for node in range(count):
        neighbours = graph.topological_neighbors(laplacian, node)
        np.testing.assert_array_equal(neighbours, rps.graph.topological_neighbors(kept.copy(), node))
        np.testing.assert_array_equal(
            graph.delta_disk_neighbors(poses, node, 0.8), rps.graph.delta_disk_neighbors(poses, node, 0.8)
        )
    np.testing.assert_array_equal(laplacian, kept)
    goals = poses + 0.08 * poses_of(seed + 1, count)
    np.testing.assert_array_equal(misc.at_pose(poses, goals), rps.misc.at_pose(poses, goals))


@pytest.fixture
def exact(rps: SimpleNamespace) -> Iterator[None]:
    """The solver of rps with small tolerances; its own are 0.01."""
    options = rps.barrier_certificates.options
    kept = dict(options)
    options.update(reltol=1e-10, abstol=1e-11, feastol=1e-11, maxiters=200)
    yield
    options.clear()
    options.update(kept)


@pytest.mark.parametrize("seed", range(5))
def test_certificates_give_what_rps_gives_with_small_tolerances(seed: int, rps: SimpleNamespace, exact: None) -> None:
    poses, dxi = apart(seed, 6), planar_of(seed, 6)
    dxu = planar_of(seed, 6) * [[1.0], [8.0]]
    for name in [each for each in vars(barrier_certificates) if "barrier_certificate" in each and each[:6] == "create"]:
        if name == "create_unicycle_differential_drive_barrier_certificate":
            continue  # rps's fails: its solver is not imported
        certificate, other = getattr(barrier_certificates, name)(), getattr(rps.barrier_certificates, name)()
        single = name.startswith("create_single")
        arguments = (dxi, poses[:2]) if single else (dxu, poses)
        found = certificate(*(each.copy() for each in arguments))
        np.testing.assert_allclose(found, other(*(each.copy() for each in arguments)), atol=2e-5, err_msg=name)
        assert np.abs(found - arguments[0]).max() > 1e-3, f"{name} had nothing to change"


def test_certificates_leave_a_safe_velocity_and_the_arrays_of_the_script_alone() -> None:
    points, dxi = np.array([[-1.0, 1.0], [0.0, 0.0]]), np.array([[0.05, 0.9], [0.1, 0.0]])
    kept = dxi.copy()
    found = barrier_certificates.create_single_integrator_barrier_certificate()(dxi, points)
    np.testing.assert_allclose(found, [[0.05, 0.2], [0.1, 0.0]])  # the second one shortened to the limit
    np.testing.assert_array_equal(dxi, kept)


# ------------------------------------------------------------------ values against computations of their own
@pytest.mark.parametrize("seed", range(4))
def test_the_robust_certificate_holds_for_every_disturbance_and_is_the_nearest(seed: int) -> None:
    """Wheels may turn 2 rad/s faster or slower; the motion of the points is differentiated numerically."""
    ahead, base, wheel, gain, radius, off, most = 0.05, 0.105, 0.016, 150.0, 0.17, 2.0, 12.5
    poses, dxu = apart(seed, 2, 0.35), planar_of(seed, 2) * [[0.6], [5.0]]
    dxu[0, 0] = 0.15
    bearing = poses[2, 0] + np.array([0.2, 2.0])
    obstacles = poses[:2, :1] + 0.27 * np.stack([np.cos(bearing), np.sin(bearing)])  # one in the way of a robot
    certificate = barrier_certificates.create_unicycle_differential_drive_barrier_certificate(
        disturbance=off, barrier_gain=gain, safety_radius=radius
    )

    def after(wheels: Array, dt: float) -> Array:
        """Return the points (2, N) after wheel speeds (2, N), left and right, for dt s."""
        speed, turn = wheel * wheels.sum(axis=0) / 2.0, wheel * (wheels[1] - wheels[0]) / base
        heading = poses[2] + dt * turn
        moved = poses[:2] + dt * speed * np.stack([np.cos(poses[2]), np.sin(poses[2])])
        found: Array = moved + ahead * np.stack([np.cos(heading), np.sin(heading)])
        return found

    def margins(points: Array) -> Array:
        """Return h of the pair, and of each robot to each obstacle."""
        to_obstacles = points[:, :, None] - obstacles[:, None, :]
        pair = points[:, 0] - points[:, 1]
        found: Array = np.r_[pair @ pair, (to_obstacles**2).sum(axis=0).ravel()] - radius**2
        return found

    def derivative(wheels: Array) -> Array:
        return (margins(after(wheels, 1e-6)) - margins(after(wheels, -1e-6))) / 2e-6

    # There is no drift, so the derivative is linear in the wheel speeds.
    slopes = np.stack([derivative(each.reshape(2, 2)) for each in np.identity(4)], axis=1)
    corners = np.array(np.meshgrid(*[[-off, off]] * 4)).reshape(4, -1)
    now = margins(after(np.zeros((2, 2)), 0.0))

    def worst(wheels: Array) -> Array:
        """Return the least ``dh/dt + gain h³`` of each constraint over the corners of the disturbances."""
        found: Array = (slopes @ (wheels[:, None] + corners)).min(axis=1) + gain * now**3
        return found

    def to_wheels(twist: Array) -> Array:
        found: Array = np.stack([twist[0] - 0.5 * base * twist[1], twist[0] + 0.5 * base * twist[1]]) / wheel
        return found.ravel()

    def cost(wheels: Array) -> float:
        left, right = (to_wheels(dxu) - wheels).reshape(2, 2)
        return float(((0.5 * wheel * (left + right)) ** 2 + (ahead * wheel / base * (right - left)) ** 2).sum())

    wheels = to_wheels(certificate(dxu, poses, obstacles))
    assert worst(wheels).min() > -1e-5
    assert np.abs(wheels).max() < most + 1e-5
    best = minimize(
        lambda each: 1e3 * cost(each), np.zeros(4), method="SLSQP", bounds=[(-most, most)] * 4,
        constraints={"type": "ineq", "fun": worst}, options={"ftol": 1e-10},
    )  # fmt: skip
    assert best.success
    assert worst(best.x).min() > -1e-6
    assert cost(wheels) == pytest.approx(best.fun / 1e3, abs=1e-6)
    assert cost(wheels) > 1e-4  # there was something to change


def test_the_programme_answers_with_the_least_violation_where_nothing_satisfies_all() -> None:
    impossible = Constraints(np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]]), np.array([-1.0, -0.5, 0.2]))
    found = nearest(np.array([[5.0], [0.7]]), impossible)
    np.testing.assert_allclose(found, [[-0.25], [0.2]], atol=2e-3)  # halfway between x <= -1 and x >= 0.5


@given(seeds)
@settings(max_examples=30)
def test_the_map_with_backwards_motion_turns_the_shorter_way(seed: int) -> None:
    poses, dxi = poses_of(seed), planar_of(seed)
    found = transformations.create_si_to_uni_dynamics_with_backwards_motion(1.0, 2.0)(dxi, poses)
    assert (np.abs(found[1]) <= 2.0 + 1e-12).all()
    axis = np.exp(1j * poses[2])
    velocity = dxi[0] + 1j * dxi[1]
    np.testing.assert_allclose(found[0], (velocity / axis).real, atol=1e-12)
    # A small turn in this sense brings the wheels' axis nearer to the velocity, whichever end leads.
    along = np.abs((velocity / axis).real)
    turned = np.abs((velocity / (axis * np.exp(1e-6j * np.sign(found[1])))).real)
    assert (turned >= along).all()


@pytest.mark.parametrize("seed", range(3))
def test_controllers_bring_unicycles_to_their_poses(seed: int) -> None:
    goals = poses_of(seed + 10, 4)
    for controller in (
        controllers.create_clf_unicycle_pose_controller(),
        controllers.create_hybrid_unicycle_pose_controller(),
    ):
        states = poses_of(seed, 4)
        for _ in range(3000):
            if misc.at_pose(states, goals, 0.05, 0.06)[0].size == 4:
                break
            speed, turn = controller(states, goals)
            turn = np.clip(turn, -3.6, 3.6)
            states = states + 0.02 * np.stack([speed * np.cos(states[2]), speed * np.sin(states[2]), turn])
        assert misc.at_pose(states, goals, 0.05, 0.06)[0].size == 4


def test_the_clf_controller_stands_on_its_goal() -> None:
    pose = np.array([[0.3], [0.2], [1.0]])
    np.testing.assert_array_equal(controllers.create_clf_unicycle_pose_controller()(pose, pose), [[0.0], [0.0]])


def test_the_hybrid_controller_does_not_alternate_between_driving_and_turning() -> None:
    controller = controllers.create_hybrid_unicycle_pose_controller()
    goal = np.array([[0.0], [0.0], [2.0]])

    def speed_at(distance: float, **state: Array) -> float:
        return abs(float(controller(np.array([[-distance], [0.0], [0.0]]), goal, **state)[0, 0]))

    assert speed_at(0.04) > 0.0  # it drives to 0.03 m
    assert speed_at(0.029) == 0.0
    assert speed_at(0.04) == 0.0  # within 0.05 m it goes on turning
    assert speed_at(0.06) > 0.0
    assert speed_at(0.04, input_approach_state=np.zeros((1, 1))) == 0.0


@pytest.mark.parametrize("name", ["cycle_GL", "lineGL", "completeGL"])
@pytest.mark.parametrize("count", range(1, 7))
def test_laplacians_are_laplacians_and_connected(name: str, count: int) -> None:
    found = getattr(graph, name)(count)
    np.testing.assert_array_equal(found, found.T)
    np.testing.assert_array_equal(found.sum(axis=1), 0.0)
    assert np.sum(np.linalg.eigvalsh(found) < 1e-9) == 1  # as many zeros as components


def test_arrival_at_points() -> None:
    states = np.array([[0.0, 1.0, 2.0], [0.0, 0.0, 0.0], [0.0, 1.0, 2.0]])
    (there,) = misc.at_position(states, states[:2] + np.array([[0.0, 0.03, 0.01], [0.01, 0.0, 0.0]]))
    assert there.tolist() == [0, 2]


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: transformations.create_si_to_uni_dynamics(0.0), "linear_velocity_gain: is 0.0, expected more than 0"),
        (lambda: transformations.create_si_to_uni_dynamics()(np.zeros((2, 3)), np.zeros((3, 2))), "dxi: has shape"),
        (lambda: controllers.create_si_position_controller()(np.zeros(2), np.zeros((2, 1))), "xi: has shape (2,)"),
        (
            lambda: controllers.create_si_position_controller()(np.array("here"), np.zeros((2, 1))),
            "xi: is not an array",
        ),
        (lambda: barrier_certificates.create_unicycle_barrier_certificate(safety_radius=0.1), "at least 0.12 m"),
        (
            lambda: barrier_certificates.create_single_integrator_barrier_certificate(magnitude_limit=0.3),
            "magnitude_limit: is 0.3",
        ),
        (
            lambda: barrier_certificates.create_single_integrator_barrier_certificate_with_boundary(
                boundary_points=np.zeros(3)
            ),
            "x_min, x_max",
        ),
        (
            lambda: create_robust_barriers(max_num_robots=1)(np.zeros((2, 2)), poses_of(1, 2), np.empty(0)),
            "max_num_robots",
        ),
        (lambda: graph.lineGL(0), "N: is 0"),
        (lambda: graph.topological_neighbors(np.zeros((2, 3)), 0), "L: has shape"),
        (lambda: graph.topological_neighbors(graph.lineGL(3), 3), "agent: is 3, expected 0 to 2"),
        (lambda: misc.generate_initial_conditions(80), "do not fit"),
        (lambda: misc.determine_marker_size(SimpleNamespace(show_figure=False), 0.1), "show_figure"),
    ],
)
def test_wrong_arguments_are_named(call: Any, says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        call()
    assert says in str(caught.value)


# ------------------------------------------------------------------ the testbed
START = np.array([[-0.5, 0.0, 0.5], [0.0, 0.2, -0.2], [0.0, 1.0, 2.0]])


def made(**changes: Any) -> Robotarium:
    return Robotarium(**{"number_of_robots": 3, "show_figure": False, "initial_conditions": START, **changes})


def test_poses_are_read_once_per_step() -> None:
    r = made()
    with pytest.raises(ConfigError, match="call get_poses"):
        r.step()
    np.testing.assert_array_equal(r.get_poses(), START)
    with pytest.raises(ConfigError, match="call step"):
        r.get_poses()
    r.step()
    with pytest.raises(ConfigError, match="call get_poses"):
        r.step()
    r.get_poses()
    assert r.lab.time_s == pytest.approx(0.033)


def test_commands_stay_and_are_cut_off_at_the_limits() -> None:
    r = made(filtered=False)
    dxu = np.array([[0.5, 0.1], [0.0, -9.0]])
    kept = dxu.copy()
    r.get_poses()
    r.set_velocities([2, 0], dxu)
    np.testing.assert_array_equal(dxu, kept)
    limit = 2 * 0.2 / 0.11
    np.testing.assert_allclose(r.velocities, [[0.1, 0.0, 0.2], [-limit, 0.0, 0.0]])
    for _ in range(20):
        r.step()
        r.get_poses()
    moved = r.poses - START
    np.testing.assert_array_equal(moved[:, 1], 0.0)
    assert np.hypot(*moved[:2, 2]) == pytest.approx(20 * 0.033 * 0.2, abs=0.012)  # it gathers speed first
    assert moved[2, 0] % (2 * np.pi) == pytest.approx(-20 * 0.033 * limit % (2 * np.pi), abs=0.15)
    assert r.report().over_wheel_limit == 20


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"number_of_robots": 0}, "number_of_robots: is 0, expected 1 to 50"),
        ({"number_of_robots": 51}, "1 to 50"),
        ({"initial_conditions": START[:, :2]}, "has shape (3, 2), expected (3, 3)"),
        ({"initial_conditions": START * [[0.1], [0.1], [1.0]]}, "start"),
        ({"initial_conditions": START * [[5.0], [1.0], [1.0]]}, "start"),
    ],
)
def test_wrong_starts_are_refused(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        made(**changes)
    assert says in str(caught.value)


def test_wrong_commands_are_refused() -> None:
    r = made()
    wrong: tuple[tuple[Any, Array, str], ...] = (
        ([0, 3], np.zeros((2, 2)), "0 to 2"),
        ([0.5], np.zeros((2, 1)), "0 to 2"),
        (np.arange(3), np.zeros((2, 2)), "expected (2, 3)"),
        ([0], np.full((2, 1), np.nan), "not finite"),
    )
    for ids, velocities, says in wrong:
        with pytest.raises(ConfigError) as caught:
            r.set_velocities(ids, velocities)
        assert says in str(caught.value)


def test_the_filter_keeps_centres_within_the_boundaries_and_lets_them_reach_those() -> None:
    r = made(number_of_robots=1, initial_conditions=np.array([[1.4], [0.0], [0.0]]))
    for _ in range(150):
        r.get_poses()
        r.set_velocities(0, np.array([[0.2], [0.0]]))
        r.step()
    assert 1.59 < r.poses[0, 0] <= 1.6
    assert r.report().outside == 0


def test_a_figure_shows_the_robots_in_real_time() -> None:
    r = made(show_figure=True)
    clock = MonotonicClock()
    began_s = clock.now_s()
    for _ in range(6):
        r.get_poses()
        r.set_velocities(range(3), np.full((2, 3), 0.2))
        r.step()
    assert clock.now_s() - began_s >= 5 * 0.033
    np.testing.assert_allclose(np.array([each.center for each in r.chassis_patches]).T, r.poses[:2])
    r.axes.scatter([0.8], [0.8], s=misc.determine_marker_size(r, 0.2), color="#0000ff", linewidths=0.0)
    r.figure.canvas.draw()
    seen = np.asarray(r.figure.canvas.buffer_rgba())
    blue = (seen[:, :, 2] > 200) & (seen[:, :, 0] < 50)
    (left, _), (right, _) = r.axes.transData.transform([[0.7, 0.0], [0.9, 0.0]])
    assert blue.any(axis=0).sum() == pytest.approx(right - left, abs=2.0)
    letter = r.axes.text(0.0, 0.0, "|", fontsize=misc.determine_font_size(r, 0.2))
    high = r.axes.transData.inverted().transform(letter.get_window_extent().size) - (
        r.axes.transData.inverted().transform((0.0, 0.0))
    )
    assert 0.15 < high[1] < 0.3
    plt.close(r.figure)
    r.get_poses()
    r.step()  # a closed window ends nothing


def test_the_end_of_a_script_prints_what_the_robotarium_would_refuse(capsys: pytest.CaptureFixture[str]) -> None:
    r = made()
    r.get_poses()
    r.set_velocities(range(3), np.tile([[0.2], [2.0]], (1, 3)))
    r.step()
    r.call_at_scripts_end()
    printed = capsys.readouterr().out
    assert "1 steps, 1 s on the testbed" in printed
    assert "1 steps with a wheel commanded more than 12.5 rad/s" in printed


def test_a_missing_package_is_named_with_the_extra_that_brings_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "osqp" else name)
    with pytest.raises(MissingExtra) as caught:
        importlib.reload(fullswarm.robotarium)
    assert str(caught.value) == "scripts of the Robotarium need osqp (pip install 'fullswarm[lab]')"


def test_the_alias_refuses_to_come_after_rps() -> None:
    with fresh_rps():
        importlib.import_module("rps.robotarium")
        with pytest.raises(ConfigError, match="imported already"):
            importlib.import_module(ALIAS)
    with fresh_rps():
        importlib.import_module(ALIAS)
        assert importlib.import_module("rps.robotarium") is ours_robotarium
