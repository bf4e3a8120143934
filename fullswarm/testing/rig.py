"""What a check may do to a robot, and what came of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from fullswarm.clock import Clock
from fullswarm.drivers.base import Driver, Pose, Twist


@dataclass(frozen=True, kw_only=True)
class Rig:
    """One robot or emulator, and the hands that break it. What is None is not checked, and the report says so.

    Callables are called on the checking thread and may return anything, except where a type is given.
    """

    make: Callable[[], Driver]
    """Constructs a driver for this robot; each time a new one, the last of which is open."""
    make_on: Callable[[Clock], Driver] | None = None
    """The same with a clock of ours in place of the machine's."""
    pump: Callable[[], object] | None = None
    """Called at 50 Hz while the check waits, for an emulator without a thread of its own."""
    body_speed: Callable[[], Twist] | None = None
    """How the body truly moves now, whatever the driver says."""
    body_pose: Callable[[], Pose] | None = None
    """Where the body truly is, in the frame of ``Reading.pose``."""
    unplug: Callable[[], object] | None = None
    """Pull the cable, or break the link in both directions; the device keeps its power."""
    replug: Callable[[], object] | None = None
    """Put the cable back."""
    mute: Callable[[bool], object] | None = None
    """Let the device hear, but say nothing; with False speak again."""
    garbage: Callable[[bytes], object] | None = None
    """Bring these bytes (noise) to the driver, between what the device says."""
    cut: Callable[[], object] | None = None
    """Lose the second half of the next frame that the device sends; the frames after it are whole."""
    bump: Callable[[bool], object] | None = None
    """Press or release the bumper."""
    obstacle: Callable[[], object] | None = None
    """Put an obstacle within reach of the robot's senses, or do nothing if one is there."""
    motors_on: Callable[[], bool] | None = None
    """Whether the device itself would obey a set-point now: armed, in closed loop, in Safe mode."""
    other_process: bool = False
    """Whether another process may open the driver's URL: then one is started, paused and killed while it drives."""
    fault_s: float = 1.5
    """The driver's stated time: it is in FAULT so long after the device's last word."""
    ready_s: float = 2.0
    """It is READY so long after the link is whole again."""
    rest_m_s: float = 0.0
    """How fast the device creeps although told zero."""
    odometry_share: float = 0.06
    """By which share of the way its odometry may be wrong."""


@dataclass
class Report:
    """What was checked, and what was not; ``print`` it."""

    url: str
    checked: dict[str, str] = field(default_factory=dict)
    """Name → what was measured on the way."""
    skipped: dict[str, str] = field(default_factory=dict)
    """Name → why it was not checked: so that it is not taken for checked."""

    def add(self, name: str, measured: str = "") -> None:
        """Note what holds."""
        self.checked[name] = measured

    def skip(self, name: str, reason: str) -> None:
        """Note what was not looked at."""
        self.skipped[name] = reason

    def lacks(self, name: str, **callables: object) -> bool:
        """Tell whether one of the rig's `callables` is missing, and note that `name` is skipped for want of it."""
        missing = [each for each, value in callables.items() if value is None]
        if missing:
            self.skip(name, f"the rig has no {', no '.join(missing)}")
        return bool(missing)

    def __str__(self) -> str:
        """One line per check, those left out last."""
        width = max(map(len, [*self.checked, *self.skipped]), default=0)
        lines = [f"  checked  {name:{width}}  {measured}".rstrip() for name, measured in self.checked.items()]
        lines += [f"  skipped  {name:{width}}  {reason}" for name, reason in self.skipped.items()]
        return "\n".join([self.url, *lines])
