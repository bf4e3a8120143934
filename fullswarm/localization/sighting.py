"""What a source has seen, in its own axes and in metres and ENU, and the conventions of a sender. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fullswarm.errors import ConfigError, did_you_mean

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
UNSEEN_RAD = math.pi
"""Standard deviation of a heading that was not seen."""
FAR_M = 1.0e5


class Refused(Exception):
    """What a sender says is invalid. `kind` has no numbers in it: each kind is logged once."""

    def __init__(self, kind: str, what: str = "") -> None:
        super().__init__(f"{kind}: {what}" if what else kind)
        self.kind = kind


@dataclass(frozen=True, slots=True)
class Sighting:
    """Where a source has seen one body. World frame, ENU.

    Parameters
    ----------
    name : of the body in the source's own language: a rigid body, or a robot
    position_sigma_m : standard deviation along the worse axis
    heading_sigma_rad : from `UNSEEN_RAD` on the heading was not seen
    time_s : on the sender's clock, when it was exposed or measured; None: it states no time
    contacts : bodies that it is seen to touch
    tracked : the source sees it now; else the rest says nothing
    covariance_m2 : (xx, xy, yy); None: `position_sigma_m` along both axes
    quality : of the detection, 0 to 1, as the source judges it
    marker : by what it was recognised, such as "tag 3"
    """

    name: str
    x_m: float
    y_m: float
    heading_rad: float
    position_sigma_m: float
    heading_sigma_rad: float
    time_s: float | None = None
    contacts: int = 0
    tracked: bool = True
    covariance_m2: tuple[float, float, float] | None = None
    quality: float = 1.0
    marker: str = ""


@dataclass(frozen=True, slots=True)
class Ranging:
    """How far a robot is from an anchor, measured by radio.

    Parameters
    ----------
    robot : the robot, or the tag's name in the source's own language
    anchor : name of the anchor
    distance_m, sigma_m : distance and its standard deviation; 0: the source states none
    time_s : on the sender's clock; None: it states no time
    """

    robot: str
    anchor: str
    distance_m: float
    sigma_m: float = 0.0
    time_s: float | None = None


@dataclass(frozen=True, slots=True)
class Body:
    """A rigid body as a capture system reports it: its axes, its unit of length.

    Parameters
    ----------
    quaternion : x, y, z, w; None: no orientation
    tracked : the cameras see it now; else the numbers say nothing
    error : how far its markers are off on average, in the system's unit; 0: not stated
    """

    name: str
    x: float
    y: float
    z: float
    quaternion: tuple[float, float, float, float] | None = None
    tracked: bool = True
    error: float = 0.0


@dataclass(frozen=True, slots=True)
class Frame:
    """What a capture system saw at one time.

    Parameters
    ----------
    time_s : of the exposure, on the system's clock; None: it states none that counts on
    """

    bodies: tuple[Body, ...]
    time_s: float | None = None


@dataclass(frozen=True, slots=True)
class Convention:
    """The conventions of a sender.

    Parameters
    ----------
    unit_m : length of the source's unit of x, y and z
    y_up : the source's floor is x and -z, as in Motive, and a heading turns about y; else x and y, about z
    sigma_m, sigma_rad : standard deviations where the source gives none
    """

    unit_m: float = 1.0
    y_up: bool = False
    sigma_m: float = 0.005
    sigma_rad: float = 0.02

    def floor(self, x: float, across: float) -> tuple[float, float]:
        """Return x and y on the floor in metres; `across` is -z if y is up, else y.

        Raises
        ------
        Refused
            No place on a floor.
        """
        x_m, y_m = x * self.unit_m, across * self.unit_m
        if not (abs(x_m) <= FAR_M and abs(y_m) <= FAR_M):  # nor if one is NaN
            raise Refused("no place on a floor", f"({x_m:g}, {y_m:g}) m; is --unit right?")
        return x_m, y_m

    def yaw(self, x: float, y: float, z: float, w: float) -> float:
        """Return the direction on the floor, rad, of the body's x axis.

        Raises
        ------
        Refused
            The quaternion is none, or the axis points up or down.
        """
        if not abs(math.hypot(x, y, z, w) - 1.0) <= 0.01:
            raise Refused("a quaternion has length 1", f"not {[x, y, z, w]!r:.80}")
        ahead = 1.0 - 2.0 * (y * y + z * z)
        left = 2.0 * (w * y - x * z) if self.y_up else 2.0 * (w * z + x * y)
        if math.hypot(ahead, left) < 0.1:
            raise Refused("the body's x axis points up or down", "turn the rigid body so that x points ahead")
        return math.atan2(left, ahead)

    def sighting(self, body: Body, time_s: float | None) -> Sighting:
        """Return a body of a capture system as a sighting.

        Raises
        ------
        Refused
            Its numbers are no place on a floor, or no orientation.
        """
        if not body.tracked:
            return Sighting(body.name, 0.0, 0.0, 0.0, 0.0, 0.0, tracked=False)
        x_m, y_m = self.floor(body.x, -body.z if self.y_up else body.y)
        error_m = body.error * self.unit_m
        sigma_m = max(self.sigma_m, error_m if math.isfinite(error_m) else 0.0)
        heading_rad, sigma_rad = 0.0, UNSEEN_RAD
        if body.quaternion is not None:
            heading_rad, sigma_rad = self.yaw(*body.quaternion), self.sigma_rad
        return Sighting(body.name, x_m, y_m, heading_rad, sigma_m, sigma_rad, time_s, marker=body.name)


def unit_of(word: str) -> float:
    """Return the length in metres of a unit: m, cm or mm.

    Raises
    ------
    ConfigError
        None of these.
    """
    if word not in UNITS:
        raise ConfigError(f"'{word}' is not a unit", where="--unit", hint=did_you_mean(word, UNITS))
    return UNITS[word]
