"""A scenario as an SDF 1.9 world for Gazebo: floor, light, boxes and walls, the goal, robots at their starts."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from types import MappingProxyType

from fullswarm.drivers.create_oi.protocol import CREATE2, GENERATIONS, TOP_MM_S, Generation
from fullswarm.drivers.create_oi.settings import ACCEL_M_S2
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.evaluate.scenarios.importers.sdf import EXPORTED_GOAL, EXPORTED_WALL
from fullswarm.evaluate.scenarios.model import Box, Scenario
from fullswarm.evaluate.scenarios.placement import boxes_for, spawn

BOX_HEIGHT_M = 0.5
WALL_M = 0.2
"""Thickness of a wall; its inner face lies on the scenario's bounds."""

START_RADIUS_M = 0.17
"""Of the robots of a trial, whose starts are exported whatever the exported body's size."""

MODELS: Mapping[str, Generation] = MappingProxyType(GENERATIONS)
"""The robots that can be exported; radius and distance of the wheels are the driver's record of them."""

ROBOT_HEIGHT_M = 0.092
ROBOT_MASS_KG = 3.6
WHEEL_RADIUS_M = 0.036
WHEEL_MASS_KG = 0.1
"""What the driver has no need to know: an iRobot Create 2, as its maker states and as it is weighed."""

SUN = """<light name="sun" type="directional">
    <cast_shadows>true</cast_shadows><pose>0 0 10 0 0 0</pose>
    <diffuse>0.8 0.8 0.8 1</diffuse><specular>0.2 0.2 0.2 1</specular><direction>-0.5 0.1 -0.9</direction>
</light>"""

_GREY, _BLUE, _GREEN = "0.5 0.5 0.5 1", "0.1 0.3 0.8 1", "0.1 0.7 0.2 0.3"


def scenario_to_sdf(
    scenario: Scenario, seed: int, robots: int, *, model: str = CREATE2.name, driven: bool = False
) -> str:
    """Return the world of a scenario's trial: boxes and robots stand where `seed` puts them.

    Parameters
    ----------
    model
        Which robot: one of `MODELS`.
    driven
        Give each robot two wheels, a castor and Gazebo's DiffDrive, which listens on ``/model/robot_1/cmd_vel``.

    Raises
    ------
    ConfigError
        Boxes or robots do not fit, or there is no such model.
    """
    if model not in MODELS:
        raise ConfigError(f"there is no model '{model}'", where="--model", hint=did_you_mean(model, MODELS))
    root = ET.Element("sdf", version="1.9")
    world = ET.SubElement(root, "world", name=_name(scenario.name))
    _add(world, SUN)
    _floor(world, scenario)
    for number, box in enumerate(boxes_for(scenario, seed)):
        _box(world, f"box_{number}", box)
    if scenario.walls:
        for side, wall in _walls(scenario).items():
            _box(world, f"{EXPORTED_WALL}{side}", wall)
    _goal(world, scenario)
    for number, (x, y, heading) in enumerate(spawn(scenario, robots, seed, START_RADIUS_M).tolist(), 1):
        _robot(world, f"robot_{number}", (x, y, heading), MODELS[model], driven)
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _name(text: str) -> str:
    """Return a name that XML can hold and Gazebo's topics can carry."""
    return "".join(each if each.isascii() and (each.isalnum() or each in "_-") else "_" for each in text)


def _add(parent: ET.Element, text: str) -> None:
    parent.append(ET.fromstring(text))  # noqa: S314  (our own text)


def _floor(world: ET.Element, scenario: Scenario) -> None:
    x_min, y_min, x_max, y_max = scenario.bounds_m
    size = _numbers(2 * (x_max - x_min), 2 * (y_max - y_min))
    plane = f"<geometry><plane><normal>0 0 1</normal><size>{size}</size></plane></geometry>"
    parts = "".join(f'<{tag} name="{tag}">{plane}</{tag}>' for tag in ("collision", "visual"))
    _add(world, _model("ground_plane", ((x_min + x_max) / 2, (y_min + y_max) / 2, 0.0, 0.0), parts))


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
    shape = _shape("box", {"size": _numbers(size_x, size_y, BOX_HEIGHT_M)}, _GREY)
    _add(world, _model(name, (x, y, BOX_HEIGHT_M / 2, yaw), shape))


def _goal(world: ET.Element, scenario: Scenario) -> None:
    """Draw the goal as a flat disc that nothing collides with."""
    size = {"radius": _numbers(scenario.goal.radius_m), "length": "0.01"}
    shape = _shape("cylinder", size, _GREEN, collides=False)
    _add(world, _model(EXPORTED_GOAL, (*scenario.goal.centre_m, 0.005, 0.0), shape))


def _robot(world: ET.Element, name: str, pose: tuple[float, float, float], record: Generation, driven: bool) -> None:
    x, y, heading = pose
    radius_m = record.radius_m
    # With wheels the body must not drag over the floor.
    clear_m = 0.02 if driven else 0.0
    body_kg = ROBOT_MASS_KG - (2 * WHEEL_MASS_KG if driven else 0.0)
    size = {"radius": _numbers(radius_m), "length": _numbers(ROBOT_HEIGHT_M - clear_m)}
    parts = _shape("cylinder", size, _BLUE, height_m=(ROBOT_HEIGHT_M + clear_m) / 2)
    parts += _inertia(body_kg, radius_m, ROBOT_HEIGHT_M, ROBOT_HEIGHT_M / 2)
    drive, half_base_m = "", record.wheel_base_m / 2
    if driven:
        parts += "".join(_castor(place, sign * 0.8 * radius_m) for place, sign in (("front", 1.0), ("back", -1.0)))
        drive = _wheel("left", half_base_m) + _wheel("right", -half_base_m) + _diff_drive(2 * half_base_m)
    _add(world, _model(name, (x, y, 0.0, heading), parts, static=False, beside=drive))


def _castor(place: str, x_m: float) -> str:
    return f"""<collision name="castor_{place}">
        <pose>{_numbers(x_m)} 0 0.011 0 0 0</pose>
        <geometry><sphere><radius>0.01</radius></sphere></geometry>
        <surface><friction><ode><mu>0</mu><mu2>0</mu2></ode></friction></surface>
    </collision>"""


def _wheel(side: str, y_m: float) -> str:
    shape = _shape("cylinder", {"radius": _numbers(WHEEL_RADIUS_M), "length": "0.02"}, "0.1 0.1 0.1 1")
    return f"""<link name="{side}_wheel">
        <pose>0 {_numbers(y_m)} {WHEEL_RADIUS_M} -1.5707963267948966 0 0</pose>
        {shape}{_inertia(WHEEL_MASS_KG, WHEEL_RADIUS_M, 0.02, 0.0)}
    </link>
    <joint name="{side}_wheel_joint" type="revolute">
        <parent>link</parent><child>{side}_wheel</child>
        <axis><xyz>0 0 1</xyz><limit><lower>-1e16</lower><upper>1e16</upper></limit></axis>
    </joint>"""


def _diff_drive(base_m: float) -> str:
    top, ramp = TOP_MM_S / 1000.0, ACCEL_M_S2
    return f"""<plugin filename="gz-sim-diff-drive-system" name="gz::sim::systems::DiffDrive">
        <left_joint>left_wheel_joint</left_joint><right_joint>right_wheel_joint</right_joint>
        <wheel_separation>{_numbers(base_m)}</wheel_separation><wheel_radius>{_numbers(WHEEL_RADIUS_M)}</wheel_radius>
        <min_linear_velocity>{-top}</min_linear_velocity><max_linear_velocity>{top}</max_linear_velocity>
        <min_linear_acceleration>{-ramp}</min_linear_acceleration>
        <max_linear_acceleration>{ramp}</max_linear_acceleration>
    </plugin>"""


# ------------------------------------------------------------------------------------------------------- pieces
def _model(
    name: str, pose: tuple[float, float, float, float], parts: str, *, static: bool = True, beside: str = ""
) -> str:
    """Return a model at x, y, z, yaw with a link of `parts`, and what stands beside the link."""
    x, y, z, yaw = pose
    return f"""<model name="{name}">
        <pose>{_numbers(x, y, z)} 0 0 {_numbers(yaw)}</pose>
        <static>{"true" if static else "false"}</static>
        <link name="link">{parts}</link>{beside}
    </model>"""


def _shape(kind: str, size: dict[str, str], colour: str, *, height_m: float = 0.0, collides: bool = True) -> str:
    pose = f"<pose>0 0 {_numbers(height_m)} 0 0 0</pose>" if height_m else ""
    sizes = "".join(f"<{key}>{text}</{key}>" for key, text in size.items())
    inside = f"{pose}<geometry><{kind}>{sizes}</{kind}></geometry>"
    material = f"<material><ambient>{colour}</ambient><diffuse>{colour}</diffuse></material>"
    collision = f'<collision name="collision">{inside}</collision>' if collides else ""
    return f'{collision}<visual name="visual">{inside}{material}</visual>'


def _inertia(mass_kg: float, radius_m: float, length_m: float, height_m: float) -> str:
    """Return a solid cylinder's mass and moments."""
    pose = f"<pose>0 0 {_numbers(height_m)} 0 0 0</pose>" if height_m else ""
    across, along = mass_kg * (3 * radius_m**2 + length_m**2) / 12, mass_kg * radius_m**2 / 2
    moments = f"<ixx>{_numbers(across)}</ixx><iyy>{_numbers(across)}</iyy><izz>{_numbers(along)}</izz>"
    return f"<inertial>{pose}<mass>{_numbers(mass_kg)}</mass><inertia>{moments}</inertia></inertial>"


def _numbers(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)
