"""A scenario as an SDF 1.9 world for Gazebo: floor, light, boxes and walls, the goal, robots at their starts."""

from __future__ import annotations

import xml.etree.ElementTree as ET

from fullswarm.evaluate.scenarios.importers.sdf import EXPORTED_GOAL, EXPORTED_WALL
from fullswarm.evaluate.scenarios.model import Box, Scenario
from fullswarm.evaluate.scenarios.placement import boxes_for, spawn

BOX_HEIGHT_M = 0.5
WALL_M = 0.2
"""Thickness of a wall; its inner face lies on the scenario's bounds."""

ROBOT_HEIGHT_M = 0.1
ROBOT_MASS_KG = 3.6
RADIUS_M = 0.17
WHEEL_RADIUS_M = 0.036
WHEEL_BASE_M = 0.235
"""Of an iRobot Create 2 (Open Interface specification)."""

_GREY, _BLUE, _GREEN = "0.5 0.5 0.5 1", "0.1 0.3 0.8 1", "0.1 0.7 0.2 0.3"


def scenario_to_sdf(
    scenario: Scenario, seed: int, robots: int, *, radius_m: float = RADIUS_M, driven: bool = False
) -> str:
    """Return the world of a scenario's trial: boxes and robots stand where `seed` puts them.

    Parameters
    ----------
    radius_m
        Of the robots' bodies.
    driven
        Give each robot two wheels, a castor and Gazebo's DiffDrive, which listens on ``/model/robot_1/cmd_vel``.

    Raises
    ------
    ConfigError
        Boxes or robots do not fit.
    """
    root = ET.Element("sdf", version="1.9")
    world = ET.SubElement(root, "world", name=_name(scenario.name))
    _light(world)
    _floor(world, scenario)
    for number, box in enumerate(boxes_for(scenario, seed)):
        _box(world, f"box_{number}", box)
    if scenario.walls:
        for side, wall in _walls(scenario).items():
            _box(world, f"{EXPORTED_WALL}{side}", wall)
    _goal(world, scenario)
    for number, (x, y, heading) in enumerate(spawn(scenario, robots, seed, radius_m).tolist(), 1):
        _robot(world, f"robot_{number}", (x, y, heading), radius_m, driven)
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _name(text: str) -> str:
    """Return a name that XML can hold and Gazebo's topics can carry."""
    return "".join(each if each.isascii() and (each.isalnum() or each in "_-") else "_" for each in text)


def _light(world: ET.Element) -> None:
    light = ET.SubElement(world, "light", name="sun", type="directional")
    for tag, text in (
        ("cast_shadows", "true"),
        ("pose", "0 0 10 0 0 0"),
        ("diffuse", "0.8 0.8 0.8 1"),
        ("specular", "0.2 0.2 0.2 1"),
        ("direction", "-0.5 0.1 -0.9"),
    ):
        ET.SubElement(light, tag).text = text


def _floor(world: ET.Element, scenario: Scenario) -> None:
    x_min, y_min, x_max, y_max = scenario.bounds_m
    link = _model(world, "ground_plane", ((x_min + x_max) / 2, (y_min + y_max) / 2, 0.0, 0.0), static=True)
    for tag in ("collision", "visual"):
        plane = ET.SubElement(ET.SubElement(ET.SubElement(link, tag, name=tag), "geometry"), "plane")
        ET.SubElement(plane, "normal").text = "0 0 1"
        ET.SubElement(plane, "size").text = _numbers(2 * (x_max - x_min), 2 * (y_max - y_min))


def _walls(scenario: Scenario) -> dict[str, Box]:
    x_min, y_min, x_max, y_max = scenario.bounds_m
    x, y = (x_min + x_max) / 2, (y_min + y_max) / 2
    length = x_max - x_min + 2 * WALL_M
    return {
        "west": (x_min - WALL_M / 2, y, WALL_M, y_max - y_min, 0.0),
        "east": (x_max + WALL_M / 2, y, WALL_M, y_max - y_min, 0.0),
        "south": (x, y_min - WALL_M / 2, length, WALL_M, 0.0),
        "north": (x, y_max + WALL_M / 2, length, WALL_M, 0.0),
    }


def _box(world: ET.Element, name: str, box: Box) -> None:
    x, y, size_x, size_y, yaw = box
    link = _model(world, name, (x, y, BOX_HEIGHT_M / 2, yaw), static=True)
    _shape(link, "box", {"size": _numbers(size_x, size_y, BOX_HEIGHT_M)}, _GREY)


def _goal(world: ET.Element, scenario: Scenario) -> None:
    """Draw the goal as a flat disc that nothing collides with."""
    link = _model(world, EXPORTED_GOAL, (*scenario.goal.centre_m, 0.005, 0.0), static=True)
    size = {"radius": _numbers(scenario.goal.radius_m), "length": "0.01"}
    _shape(link, "cylinder", size, _GREEN, collides=False)


def _robot(world: ET.Element, name: str, pose: tuple[float, float, float], radius_m: float, driven: bool) -> None:
    x, y, heading = pose
    link = _model(world, name, (x, y, 0.0, heading), static=False)
    # With wheels the body must not drag over the floor.
    clear_m = 0.02 if driven else 0.0
    size = {"radius": _numbers(radius_m), "length": _numbers(ROBOT_HEIGHT_M - clear_m)}
    _shape(link, "cylinder", size, _BLUE, height_m=(ROBOT_HEIGHT_M + clear_m) / 2)
    _inertia(link, ROBOT_MASS_KG, radius_m, ROBOT_HEIGHT_M, ROBOT_HEIGHT_M / 2)
    if driven:
        model = world[-1]
        _castor(link, radius_m)
        for side, sign in (("left", 1.0), ("right", -1.0)):
            _wheel(model, side, sign * min(WHEEL_BASE_M / 2, 0.8 * radius_m))
        _diff_drive(model, 2 * min(WHEEL_BASE_M / 2, 0.8 * radius_m))


def _castor(link: ET.Element, radius_m: float) -> None:
    for place, sign in (("front", 1.0), ("back", -1.0)):
        collision = ET.SubElement(link, "collision", name=f"castor_{place}")
        ET.SubElement(collision, "pose").text = f"{_numbers(sign * 0.8 * radius_m)} 0 0.011 0 0 0"
        sphere = ET.SubElement(ET.SubElement(collision, "geometry"), "sphere")
        ET.SubElement(sphere, "radius").text = "0.01"
        ode = ET.SubElement(ET.SubElement(ET.SubElement(collision, "surface"), "friction"), "ode")
        ET.SubElement(ode, "mu").text = ET.SubElement(ode, "mu2").text = "0"


def _wheel(model: ET.Element, side: str, y_m: float) -> None:
    link = ET.SubElement(model, "link", name=f"{side}_wheel")
    ET.SubElement(link, "pose").text = f"0 {_numbers(y_m)} {WHEEL_RADIUS_M} -1.5707963267948966 0 0"
    _shape(link, "cylinder", {"radius": _numbers(WHEEL_RADIUS_M), "length": "0.02"}, "0.1 0.1 0.1 1")
    _inertia(link, 0.1, WHEEL_RADIUS_M, 0.02, 0.0)
    joint = ET.SubElement(model, "joint", name=f"{side}_wheel_joint", type="revolute")
    ET.SubElement(joint, "parent").text = "link"
    ET.SubElement(joint, "child").text = f"{side}_wheel"
    axis = ET.SubElement(joint, "axis")
    ET.SubElement(axis, "xyz").text = "0 0 1"
    limit = ET.SubElement(axis, "limit")
    ET.SubElement(limit, "lower").text, ET.SubElement(limit, "upper").text = "-1e16", "1e16"


def _diff_drive(model: ET.Element, base_m: float) -> None:
    plugin = ET.SubElement(model, "plugin", filename="gz-sim-diff-drive-system", name="gz::sim::systems::DiffDrive")
    for tag, text in (
        ("left_joint", "left_wheel_joint"),
        ("right_joint", "right_wheel_joint"),
        ("wheel_separation", _numbers(base_m)),
        ("wheel_radius", _numbers(WHEEL_RADIUS_M)),
        ("max_linear_velocity", "0.5"),
    ):
        ET.SubElement(plugin, tag).text = text


# ------------------------------------------------------------------------------------------------------- pieces
def _model(world: ET.Element, name: str, pose: tuple[float, float, float, float], *, static: bool) -> ET.Element:
    """Add a model of one link at x, y, z, yaw; return the link."""
    model = ET.SubElement(world, "model", name=name)
    x, y, z, yaw = pose
    ET.SubElement(model, "pose").text = f"{_numbers(x, y, z)} 0 0 {_numbers(yaw)}"
    ET.SubElement(model, "static").text = "true" if static else "false"
    return ET.SubElement(model, "link", name="link")


def _shape(
    link: ET.Element, kind: str, size: dict[str, str], colour: str, *, height_m: float = 0.0, collides: bool = True
) -> None:
    for tag in ("collision", "visual") if collides else ("visual",):
        element = ET.SubElement(link, tag, name=tag)
        if height_m:
            ET.SubElement(element, "pose").text = f"0 0 {_numbers(height_m)} 0 0 0"
        shape = ET.SubElement(ET.SubElement(element, "geometry"), kind)
        for key, text in size.items():
            ET.SubElement(shape, key).text = text
        if tag == "visual":
            material = ET.SubElement(element, "material")
            ET.SubElement(material, "ambient").text = ET.SubElement(material, "diffuse").text = colour


def _inertia(link: ET.Element, mass_kg: float, radius_m: float, length_m: float, height_m: float) -> None:
    """Add a solid cylinder's mass and moments."""
    inertial = ET.SubElement(link, "inertial")
    if height_m:
        ET.SubElement(inertial, "pose").text = f"0 0 {_numbers(height_m)} 0 0 0"
    ET.SubElement(inertial, "mass").text = _numbers(mass_kg)
    moments = ET.SubElement(inertial, "inertia")
    across = mass_kg * (3 * radius_m**2 + length_m**2) / 12
    for tag, value in (("ixx", across), ("iyy", across), ("izz", mass_kg * radius_m**2 / 2)):
        ET.SubElement(moments, tag).text = _numbers(value)


def _numbers(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)
