"""The schema of a fleet file, with its defaults and the ranges that other checks share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, PositiveFloat

from fullswarm.bus.endpoint import DEFAULT_HUB, is_loopback
from fullswarm.bus.network_faults import parse_network
from fullswarm.errors import ConfigError
from fullswarm.keys import ROBOT_ID, TRUTH

DEFAULT_WORLD = "127.0.0.1:7450"
ALL_TO_ALL_ROBOTS = 16
STEEPEST_DEG = 89.0
"""At the poles north is no direction."""

# Ranges that fleet files, the core's database, requests and robots share: (least, greatest).
SAFETY_MARGIN_M = (0.0, 1.0)
BARRIER_GAIN_PER_S = (0.01, 20.0)
BARRIERS = ("braking", "linear")
SPEED_LIMIT_M_S = (0.01, 10.0)
TURN_LIMIT_RAD_S = (0.01, 20.0)
HEARING_M = (0.0, 1000.0)
EXPIRES_S = (0.0, 60.0)
LARGEST_TAG = 586
"""Number of the last tag of the family AprilTag 36h11."""


def _robot_id(text: str) -> str:
    if text == TRUTH:
        raise ValueError(f"'{TRUTH}' cannot name a robot: it is the name of the process that measures the true poses")
    return _name(text, "robot")


def _swarm_name(text: str) -> str:
    return _name(text, "swarm")


def _group_name(text: str) -> str:
    return _name(text, "group")


def _dock_name(text: str) -> str:
    return _name(text, "dock")


def _name(text: str, owner: str) -> str:
    if not ROBOT_ID.match(text):
        raise ValueError(f"'{text}' cannot name a {owner}: use letters, digits, '-' and '_', 64 at most")
    return text


def _bounds(bounds: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    x_min, y_min, x_max, y_max = bounds
    if not (x_min < x_max and y_min < y_max):
        raise ValueError(
            f"[{x_min:g}, {y_min:g}, {x_max:g}, {y_max:g}] is not an arena: write [x_min, y_min, x_max, y_max]"
        )
    return bounds


def _on_earth(origin: tuple[float, float]) -> tuple[float, float]:
    latitude, longitude = origin
    if not (abs(latitude) <= STEEPEST_DEG and abs(longitude) <= 180.0):
        raise ValueError(
            f"{latitude:g}, {longitude:g} is not a place on earth: latitude (-{STEEPEST_DEG:g} to {STEEPEST_DEG:g}), "
            "then longitude (-180 to 180), in degrees"
        )
    return origin


def _conditions(text: str) -> str:
    try:
        parse_network(text, where="")
    except ConfigError as error:
        raise ValueError(str(error)) from None
    return text


def _ability(text: str) -> str:
    return _name(text, "capability")


RobotId = Annotated[str, AfterValidator(_robot_id)]
Ability = Annotated[str, AfterValidator(_ability)]
DockName = Annotated[str, AfterValidator(_dock_name), Field(max_length=48)]
GroupName = Annotated[str, AfterValidator(_group_name)]
SwarmName = Annotated[str, AfterValidator(_swarm_name)]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]  # m
Size = Annotated[float, Field(le=1e6)]
Bounds = Annotated[tuple[Coordinate, Coordinate, Coordinate, Coordinate], AfterValidator(_bounds)]
Box = tuple[Coordinate, Coordinate, Size, Size, float]
Conditions = Annotated[str, AfterValidator(_conditions)]
Point = tuple[float, float]
Origin = Annotated[tuple[float, float], AfterValidator(_on_earth)]


def _tables(found: object) -> object:
    """Take one table for a list of one."""
    return (found,) if isinstance(found, dict) else tuple(found) if isinstance(found, list) else found


class Section(BaseModel):
    """A table of a TOML file: unknown keys are errors, values cannot change afterwards."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class HubConfig(Section):
    """Where the hub listens (a zenoh endpoint)."""

    endpoint: str = DEFAULT_HUB


class CoreConfig(Section):
    """The base station's core."""

    store: Path | None = None  # SQLite file of the local database; None: in memory, `up` keeps one until it ends
    schedule_interval_s: float = Field(0.05, ge=0.0, le=10.0)  # rapid requests are spread over this
    heartbeat_hz: float = Field(10.0, ge=0.5, le=1000.0)
    audit: Path | None = None  # folder of the audit log; None: beside `store`, else in the user's state folder
    results: Path | None = None  # where the performance node writes JSON; None: nowhere


class AgentConfig(Section):
    """What every agent runs with."""

    control_rate_hz: float = Field(50.0, ge=5.0, le=500.0)
    state_rate_hz: float = Field(20.0, ge=1.0, le=500.0)
    health_rate_hz: float = Field(2.0, ge=0.2, le=50.0)
    measurement_rate_hz: float = Field(2.0, ge=0.2, le=50.0)
    state_delay_s: float = Field(0.05, ge=0.0, le=2.0)  # of a neighbour's state on the network, where none is measured
    sensing_radius_m: float = Field(3.0, gt=0.0, le=1000.0)
    # what moves and is no robot of the fleet (people, carts): assumed limits, and whether robots step aside
    object_speed_m_s: float = Field(2.0, ge=0.0, le=100.0)
    object_accel_m_s2: float = Field(2.0, ge=0.0, le=100.0)
    evade: bool = True
    # robots with range sensors find their place on the map: [world] boxes and map
    locate_on_map: bool = False
    grid_cell_m: float = Field(0.05, ge=0.01, le=1.0)  # of the occupancy grid that range sensors fill
    state_cell_m: float | None = Field(None, ge=0.0, le=1e4)  # cells of the states, 0: all on one key; see below
    neighbour_timeout_s: float = Field(1.0, gt=0.0, le=60.0)
    command_ttl_s: float = Field(0.3, gt=0.0, le=2.0)
    core_silence_s: float = Field(1.0, gt=0.0, le=10.0)
    reading_timeout_s: float = Field(0.3, gt=0.0, le=10.0)  # the driver's last reading is older: stop
    battery_low: float = Field(0.1, ge=0.0, le=1.0)  # share at which a robot stands; only driving by hand moves it
    battery_rise: float = Field(0.05, ge=0.0, le=1.0)  # and how much more it takes to go on
    fence_margin_m: float = Field(0.0, ge=-1000.0, le=1000.0)  # how far outside the arena a robot's centre may be
    fence_delay_s: float = Field(0.15, ge=0.0, le=5.0)  # from a decision to brakes that act, for the fence
    speed_limit_m_s: float | None = Field(None, ge=SPEED_LIMIT_M_S[0], le=SPEED_LIMIT_M_S[1])  # below the driver's own
    turn_limit_rad_s: float | None = Field(None, ge=TURN_LIMIT_RAD_S[0], le=TURN_LIMIT_RAD_S[1])
    speed_gain: float = Field(1.0, gt=0.0, le=100.0)  # K_v of the paper
    turn_gain_per_s: float = Field(3.0, gt=0.0, le=100.0)  # K_w of the paper
    safety_margin_m: float = Field(0.03, ge=SAFETY_MARGIN_M[0], le=SAFETY_MARGIN_M[1])
    # γ of the linear barrier: share of the gap that may be closed per second
    # what limits the approach: the distance in which the robot can brake, or γ of the gap per second as in the paper
    barrier: Literal["braking", "linear"] = "braking"
    coordination: bool = True  # robots with a goal, behind the filter, avoid one another in advance
    barrier_gain_per_s: float = Field(2.0, ge=BARRIER_GAIN_PER_S[0], le=BARRIER_GAIN_PER_S[1])
    bounds_m: Bounds | None = None  # arena for real robots; None: the world's, or none
    # auto: ekf (fuse odometry with noisy poses or with fixes) unless the driver senses a pose that is filtered already
    estimator: Literal["auto", "direct", "ekf"] = "auto"
    pose_confidence_sigma: float = Field(3.0, ge=0.0, le=10.0)  # standard deviations of a pose that the filter counts
    # sources of fixes, the preferred one first, by how the name of their sensor begins ("mocap", "camera"): it counts
    # where two contradict each other; else the robot stands until they agree
    fix_order: tuple[str, ...] = ()
    # no usable pose fix for so long: odometry alone, and another source may move the pose
    fix_timeout_s: float = Field(0.5, gt=0.0, le=60.0)
    fix_max_delay_s: float = Field(0.3, ge=0.0, le=2.0)  # a fix later than the fastest ones by more is refused
    fix_latency_s: float = Field(0.0, ge=0.0, le=1.0)  # what even the fastest fix takes from the camera to the agent
    fix_gate_sigma: float = Field(4.0, ge=1.0, le=1000.0)  # a fix further off, in standard deviations, is an outlier
    # so many of the first fixes must agree, unless they fit the start pose of this file
    fix_first_count: int = Field(3, ge=1, le=10_000)
    fix_reanchor_count: int = Field(5, ge=2, le=10_000)  # so many outliers that agree, one after the other,
    fix_reanchor_s: float = Field(0.5, ge=0.0, le=60.0)  # over so long: the robot was carried, the pose jumps to them
    start_sigma_m: float = Field(0.05, gt=0.0, le=100.0)  # how well a robot is put on the start pose of this file
    start_sigma_rad: float = Field(0.05, gt=0.0, le=100.0)
    # standard deviation of odometry after 1 m; it grows with the root
    odometry_sigma_m: float = Field(0.02, gt=0.0, le=100.0)
    odometry_sigma_rad: float = Field(0.03, gt=0.0, le=100.0)  # of its heading after 1 m or a turn of 1 rad


class NoiseConfig(Section):
    """What the simulated sensors add; zero is perfect sensing."""

    position_m: float = Field(0.0, ge=0.0, le=100.0)  # standard deviation
    heading_rad: float = Field(0.0, ge=0.0, le=10.0)
    odometry: float = Field(0.0, ge=0.0, le=0.5)  # standard deviation of each robot's scale error: way, and turning


class SightConfig(Section):
    """How simulated robots see other bodies, robots and movers alike, within the sensing radius and line of sight."""

    bodies: bool = True  # False: they see none
    pose: bool = True  # False: robots sense no pose, only their odometry
    noise_m: float = Field(0.0, ge=0.0, le=10.0)  # standard deviation of a seen body's place, per axis
    dropout: float = Field(0.0, ge=0.0, le=1.0)  # share of the looks in which a body is missed


class RangesConfig(Section):
    """A simulated range sensor. Robots that have one sense obstacles and bodies by it alone."""

    count: int = Field(360, ge=1, le=4096)  # rays of a scan
    max_m: float = Field(6.0, gt=0.0, le=100.0)
    sigma_m: float = Field(0.01, ge=0.0, le=10.0)  # standard deviation of a distance
    dropout: float = Field(0.01, ge=0.0, le=1.0)  # share of the rays that measure nothing
    rate_hz: float = Field(10.0, gt=0.0, le=200.0)  # scans per second
    fov_rad: float = Field(6.283185307179586, gt=0.0, le=6.283185307179587)  # field of view, centred on its x axis
    cone_rad: float = Field(0.0, ge=0.0, le=1.5)  # each ray measures the nearest thing in a cone of this angle
    x_m: float = Field(0.0, ge=-10.0, le=10.0)  # where it is on the body
    y_m: float = Field(0.0, ge=-10.0, le=10.0)
    yaw_rad: float = Field(0.0, ge=-6.3, le=6.3)


class MoverConfig(Section):
    """A body of the simulated world that no agent commands: a person, a cart, a robot without a filter."""

    waypoints: Annotated[tuple[Point, ...], Field(min_length=1)]  # m; it starts at the first one
    speed_m_s: float = Field(1.0, ge=0.0, le=10.0)
    accel_m_s2: float = Field(2.0, gt=0.0, le=1e4)  # from standstill at each waypoint, and to it
    radius_m: float = Field(0.25, gt=0.0, le=50.0)
    start_s: float = Field(0.0, ge=0.0, le=1e6)  # simulated time at which it leaves
    repeat: Literal["back", "loop", "once"] = "back"  # at the last waypoint: return the same way, go to the first, stay


class DrivetrainConfig(Section):
    """How motors, wheels and brakes of the engine "drivetrain" differ from the ideal unicycle."""

    dead_time_s: float = Field(0.1, ge=0.0, le=1.0)  # from a command to the first effect on the motors
    lag_s: float = Field(0.05, ge=0.0, le=1.0)  # time constant of the motors, first order
    slip: float = Field(0.03, ge=0.0, lt=1.0)  # greatest share of a wheel's speed that is lost; varies with time
    unequal_wheels: float = Field(0.02, ge=0.0, le=0.5)  # greatest difference of the wheels' radii, as a share
    brakes: float = Field(1.0, gt=0.0, le=1.0)  # share of `accel_limit_m_s2` with which a robot decelerates
    declared: bool = True  # the robots' `Limits` state all this; false: they claim the ideal unicycle


class BatteryConfig(Section):
    """Batteries of the simulated bodies; without this table bodies have none. A flat one moves its body no more."""

    start: float = Field(1.0, ge=0.0, le=1.0)  # charge at first, as a share of the capacity
    start_spread: float = Field(0.0, ge=0.0, le=1.0)  # each body's is lower than `start` by up to so much
    rest_per_h: float = Field(0.1, ge=0.0, le=100.0)  # share of the capacity that computer and sensors draw
    drive_per_m: float = Field(0.00014, ge=0.0, le=1.0)  # and what each metre and
    turn_per_rad: float = Field(0.00002, ge=0.0, le=1.0)  # each radian of the wheels' motion takes beyond that
    charge_per_h: float = Field(0.55, gt=0.0, le=1000.0)  # share that a dock puts into it, rest included
    spread: float = Field(0.0, ge=0.0, lt=1.0)  # greatest deviation of each body's draw and charge, as a share
    contact_m: float = Field(0.05, gt=0.0, le=1.0)  # a body so near a dock's pose has its contacts


class BodyConfig(Section):
    """What one robot's body has instead of the world's; None: as the world."""

    speed_limit_m_s: float | None = Field(None, ge=SPEED_LIMIT_M_S[0], le=SPEED_LIMIT_M_S[1])
    turn_limit_rad_s: float | None = Field(None, ge=TURN_LIMIT_RAD_S[0], le=TURN_LIMIT_RAD_S[1])
    accel_limit_m_s2: float | None = Field(None, gt=0.0, le=1000.0)
    turn_accel_limit_rad_s2: float | None = Field(None, gt=0.0, le=10_000.0)
    radius_m: float | None = Field(None, ge=0.005, le=50.0)
    declared_radius_m: float | None = Field(None, ge=0.005, le=50.0)
    mass_kg: float | None = Field(None, gt=0.0, le=10_000.0)
    drivetrain: DrivetrainConfig | None = None
    ranges: RangesConfig | None = None


EngineName = Literal["pybullet", "pybullet-wheels", "kinematic", "drivetrain"]
"""The physics engines; `fullswarm.simulation.engine.ENGINES` has the class of each."""


class WorldConfig(Section):
    """The simulated world; a table with nothing but `origin` is none."""

    origin: Origin | None = None  # latitude, longitude (degrees): where on earth the swarm's (0, 0) is
    engine: EngineName = "pybullet"
    address: str = DEFAULT_WORLD  # UDP host:port of the world process
    bounds_m: Bounds = (0.0, 0.0, 20.0, 20.0)  # x_min, y_min, x_max, y_max
    walls: bool = True
    boxes: tuple[Box, ...] = ()  # centre x, y, size x, y (m), yaw (rad)
    rate_hz: float = Field(50.0, ge=1.0, le=1000.0)
    substeps: int = Field(5, ge=1, le=100)  # physics steps per world step
    speed_limit_m_s: float = Field(0.5, ge=SPEED_LIMIT_M_S[0], le=SPEED_LIMIT_M_S[1])
    turn_limit_rad_s: float = Field(4.25, ge=TURN_LIMIT_RAD_S[0], le=TURN_LIMIT_RAD_S[1])
    accel_limit_m_s2: float = Field(2.0, gt=0.0, le=1000.0)
    turn_accel_limit_rad_s2: float = Field(20.0, gt=0.0, le=10_000.0)
    radius_m: float = Field(0.17, ge=0.005, le=50.0)  # Create footprint
    declared_radius_m: float | None = Field(None, ge=0.005, le=50.0)  # what robots state; None: `radius_m`
    mass_kg: float = Field(3.6, gt=0.0, le=10_000.0)
    watchdog_s: float = Field(0.3, gt=0.0, le=60.0)  # a body whose driver is silent stops
    drivetrain: DrivetrainConfig = DrivetrainConfig()  # of the engine "drivetrain"
    bodies: dict[RobotId, BodyConfig] = {}  # [world.bodies.<robot>]: what differs from the above
    noise: NoiseConfig = NoiseConfig()
    sight: SightConfig = SightConfig()
    ranges: RangesConfig | None = None  # of each robot; in place of `sight` and of sensed obstacles
    battery: BatteryConfig | None = None
    movers: tuple[MoverConfig, ...] = ()
    seed: int = 0

    def of_body(self, robot: str) -> WorldConfig:
        """Return the world as one robot's body has it: with the limits, sizes and drivetrain of that body."""
        body = self.bodies.get(robot)
        if body is None:
            return self
        return self.model_copy(update={name: value for name, value in body if value is not None})


class PerformanceConfig(Section):
    """Calculators, summarizers and when a trial is over."""

    coverage_cell_m: float = Field(0.1, ge=0.001, le=1000.0)
    arrive_radius_m: PositiveFloat | None = None  # a robot so near its goal has arrived; None: the request's, or 0.1
    max_execution_s: PositiveFloat | None = None
    coverage_at_least: float | None = Field(None, gt=0.0, le=1.0)
    stop_on_collision: bool = False
    all_arrived: bool = False  # every robot of the fleet file is at its goal
    stalled_s: PositiveFloat | None = None  # no robot with a task has moved by more than its radius for so long


class NetworkConfig(Section):
    """Injected faults of the network between the processes: what ``--network`` sets."""

    conditions: Conditions | None = None  # loss=20%,delay=100ms±50,partition=r1+r2|*@5s-10s; None: no faults
    seed: int = 0
    since_s: float | None = None  # monotonic clock from which a partition's times count; None: each process's start


class DockConfig(Section):
    """A place where robots charge."""

    id: DockName
    pose: tuple[Coordinate, Coordinate, float]  # of a docked robot: x, y (m), heading (rad)
    approach_m: float = Field(0.6, ge=0.1, le=50.0)  # so far before it robots line up, and to there they back out
    slots: int = Field(1, ge=1, le=64)  # robots side by side
    spacing_m: float = Field(0.6, gt=0.0, le=50.0)  # from slot to slot, to the left of a docked robot
    robots: tuple[RobotId, ...] = ()  # that may use it; these and `makes` empty: all
    makes: tuple[str, ...] = ()  # makes or models that may use it: "iRobot", "Create 2"
    means: Literal["pose", "own"] = "pose"  # own: by the robot's own means, as a Create by its infrared beams


class RobotChargingConfig(Section):
    """What one robot has instead of the fleet's thresholds; None: as the fleet. Shares of a full battery."""

    go_at: float | None = Field(None, gt=0.0, lt=1.0)
    leave_at: float | None = Field(None, gt=0.0, le=1.0)
    reserve: float | None = Field(None, ge=0.0, lt=1.0)


class ChargingConfig(Section):
    """When robots go to charge; without a dock none does. Charges are shares of a full battery."""

    go_at: float = Field(0.35, gt=0.0, lt=1.0)  # below it a robot leaves its task for a dock that is free
    early_at: float = Field(0.75, gt=0.0, le=1.0)  # and below this, where docks would be short if it waited
    leave_at: float = Field(0.95, gt=0.0, le=1.0)  # charged so far it returns to its task
    reserve: float = Field(0.15, ge=0.0, lt=1.0)  # what a robot shall have left at its dock; above `battery_low`
    idle_robots: bool = False  # robots without a task charge too: also those that an operator has stopped
    draw_per_h: float = Field(0.3, gt=0.0, le=100.0)  # first guesses, until it is learnt from each robot:
    draw_per_m: float = Field(0.0003, gt=0.0, le=1.0)
    charge_per_h: float = Field(0.5, gt=0.0, le=1000.0)
    way_factor: float = Field(1.5, ge=1.0, le=10.0)  # way to a dock, as a multiple of the straight line
    dock_s: float = Field(60.0, ge=5.0, le=3600.0)  # a robot that has not docked within this tries another dock
    no_current_s: float = Field(20.0, ge=1.0, le=3600.0)  # and one that is docked, and is not charged within this
    retry_s: float = Field(900.0, ge=10.0, le=86_400.0)  # after so long a dock that failed is tried again
    speed_m_s: float = Field(0.1, ge=0.01, le=1.0)  # on the straight way into a dock and out of it


class FixesConfig(Section):
    """A source of poses that `up` starts: motion capture, a receiver or anchors at the base station."""

    source: Annotated[str, Field(min_length=1, max_length=500)]  # URL: natnet://192.168.1.5, vicon://..., json://...
    axes: Literal["z-up", "y-up"] | None = None  # of the capture system; None: what systems of its kind have
    unit: Literal["m", "cm", "mm"] | None = None
    sigma_m: float | None = Field(None, ge=1e-4, le=100.0)  # standard deviation where the source gives none
    sigma_rad: float | None = Field(None, ge=1e-4, le=3.0)
    map: dict[str, RobotId] = {}  # robot by its name in the capture system; other names are robot ids
    objects: dict[str, Annotated[float, Field(gt=0.0, le=100.0)]] = {}  # radius (m) by the name of what is no robot
    robot: str = ""  # the robot that the source measures, where it names none (GNSS, a radio tag)
    insecure_network: bool = False  # a source that listens may do so beyond this machine


TagNumber = Annotated[int, Field(ge=0, le=LARGEST_TAG)]
FloorPlace = tuple[TagNumber, Coordinate, Coordinate, float]


class TagsConfig(Section):
    """The tags that cameras see (AprilTag 36h11); `fullswarm track sheets` prints them."""

    size_m: float = Field(0.12, ge=0.01, le=10.0)  # side of the black square, on robots
    height_m: float = Field(0.1, ge=0.0, le=10.0)  # of the robots' tags above the floor
    floor_size_m: float = Field(0.14, ge=0.01, le=10.0)
    floor: tuple[FloorPlace, ...] = ()  # number, x, y (m), direction of the upper edge (rad)


class CameraConfig(Section):
    """A camera that sees the robots' tags; `up` starts a process for it."""

    name: RobotId
    source: Annotated[
        str, Field(min_length=1, max_length=500)
    ]  # v4l2:///dev/video0, rtsp://…, http://…, file, world://
    calibration: Path | None = None  # what `fullswarm track calibrate` has written; None: camera-<name>.toml
    rate_hz: float = Field(20.0, ge=1.0, le=200.0)  # pictures that are looked at
    latency_s: float = Field(0.0, ge=0.0, le=2.0)  # from the exposure to the arrival, where the source states no time
    show: Annotated[str, Field(max_length=100)] = ""  # HOST:PORT of the live picture; empty: none


class RobotConfig(Section):
    """One robot of the fleet."""

    id: RobotId
    driver: str = ""  # URL; empty: sim://<id>
    emulate: Annotated[str, Field(min_length=1, max_length=64)] | None = (
        None  # the world gives it a body and a port; its real driver talks to that
    )
    pose: tuple[Coordinate, Coordinate, float] | None = None  # start: x, y (m), heading (rad)
    charging: RobotChargingConfig = RobotChargingConfig()
    fixes: Annotated[str, Field(max_length=500)] = ""  # URL of a sensor on board that its agent reads: gnss:///dev/tty…
    ranges: Annotated[str, Field(max_length=500)] = ""  # URL of range sensors on board: ld19://…, vl53l1x://…
    capabilities: tuple[Ability, ...] = Field((), max_length=32)  # beside those of its make: "carry", "camera"
    tag: TagNumber | None = None  # that cameras see; None: its number in the file, from 1
    tag_size_m: float | None = Field(None, ge=0.01, le=10.0)  # None: as in [tags]
    tag_height_m: float | None = Field(None, ge=0.0, le=10.0)
    tag_offset_m: tuple[Coordinate, Coordinate, float] = (0.0, 0.0, 0.0)  # x, y, turn (rad) of the tag on the robot
    host: str = ""  # its companion computer, for `fullswarm deploy`; empty: <id>.local
    ssh_user: str = "fullswarm-admin"
    ssh_port: int = Field(22, ge=1, le=65535)

    @property
    def url(self) -> str:
        """The driver's URL."""
        return self.driver or f"sim://{self.id}"

    @property
    def elsewhere(self) -> bool:
        """Its agent runs on a computer of its own, where `fullswarm deploy` puts it."""
        return bool(self.host) and not is_loopback(self.host) and not self.simulated

    @property
    def simulated(self) -> bool:
        """It lives in the simulated world, behind an emulated port or without one."""
        return self.emulate is not None or self.url.startswith("sim:")


class SwarmConfig(Section):
    """A fleet file."""

    swarm: SwarmName = "swarm"
    origin: Origin | None = None  # as in [world]; where a [world] with nothing but an origin ends up
    hub: HubConfig = HubConfig()
    core: CoreConfig = CoreConfig()
    agent: AgentConfig = AgentConfig()
    world: WorldConfig | None = None
    performance: PerformanceConfig = PerformanceConfig()
    network: NetworkConfig = NetworkConfig()
    fixes: Annotated[tuple[FixesConfig, ...], BeforeValidator(_tables)] = ()  # one table, or several
    anchors: dict[str, tuple[Coordinate, Coordinate, Coordinate]] = {}  # x, y, z (m) of radio anchors
    radio_height_m: float = Field(0.0, ge=-10.0, le=100.0)  # of the robots' radios above the ground
    tags: TagsConfig = TagsConfig()
    camera: tuple[CameraConfig, ...] = ()
    robot: tuple[RobotConfig, ...] = ()
    dock: tuple[DockConfig, ...] = Field((), max_length=256)
    charging: ChargingConfig = ChargingConfig()
    groups: dict[GroupName, tuple[RobotId, ...]] = {}  # @name names these robots wherever robots are named

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """The arena: x_min, y_min, x_max, y_max in metres; 100 m wide around the origin by default."""
        if self.agent.bounds_m is not None:
            return self.agent.bounds_m
        return self.world.bounds_m if self.world else (-50.0, -50.0, 50.0, 50.0)

    @property
    def state_cell_m(self) -> float:
        """Size of the cells by which states are published; when the file is silent, cells from 17 robots on.

        All-to-all is cheapest for a few robots; for many, what each receives must not grow with the swarm.
        """
        if self.agent.state_cell_m is not None:
            return self.agent.state_cell_m
        return self.agent.sensing_radius_m if len(self.robot) > ALL_TO_ALL_ROBOTS else 0.0

    @property
    def origin_deg(self) -> tuple[float, float] | None:
        """Latitude and longitude of the swarm's (0, 0); None: not given."""
        return self.origin or (self.world.origin if self.world else None)

    @property
    def world_or_default(self) -> WorldConfig:
        """The simulated world; an empty one when the file has none."""
        return self.world or WorldConfig()

    @property
    def robots(self) -> tuple[str, ...]:
        """Ids in the order of the file."""
        return tuple(each.id for each in self.robot)
