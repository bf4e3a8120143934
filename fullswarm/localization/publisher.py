"""Publishes what a source of poses sees: pose fixes of robots, places of other objects, and a report of the source.

Every source goes through here: motion capture, cameras, positioning outdoors. It owns which name is which robot, what
is logged of invalid data, and what operators learn of bodies that are not seen.
"""

from __future__ import annotations

import math
import uuid
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import structlog

from fullswarm.bus.base import Bus
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.keys import ROBOT_ID, Keys
from fullswarm.localization.sighting import Ranging, Refused, Sighting
from fullswarm.messages import FixSourceReport, HealthReport, ObjectFix, PoseFix, RangeFix
from fullswarm.runtime import Scheduler

log = structlog.get_logger()

LOG_S = 10.0
REPORT_S = 1.0
KNOWN_S = 5.0
"""By then every robot has reported its health twice."""
LARGEST_M = 100.0
KINDS = 50
"""Most kinds of errors that are logged, so that no sender can fill the log."""
REPORTED = 1000
"""Most bodies in a report."""


@dataclass(frozen=True, slots=True)
class Names:
    """What the names of a source stand for; others are robot ids.

    Parameters
    ----------
    robots : robot id by name
    objects : radius in m by the name of what is no robot
    """

    robots: dict[str, str] = field(default_factory=dict)
    objects: dict[str, float] = field(default_factory=dict)


def parse_objects(words: Iterable[str]) -> dict[str, float]:
    """Read ``NAME=RADIUS_M`` words.

    Raises
    ------
    ConfigError
        Not of that form, or a name comes twice.
    """
    found: dict[str, float] = {}
    for word in words:
        name, equals, text = word.rpartition("=")
        try:
            radius_m = float(text) if equals and name else math.nan
        except ValueError:
            radius_m = math.nan
        if not 0.0 < radius_m <= LARGEST_M:
            raise ConfigError("expected NAME=RADIUS_M", where=f"--object {word}", hint="like --object 'Person 1=0.3'")
        if name in found:
            raise ConfigError("the name is given twice", where=f"--object {word}")
        found[name] = radius_m
    return found


def parse_map(words: Iterable[str]) -> dict[str, str]:
    """Read ``NAME=ROBOT`` words.

    Raises
    ------
    ConfigError
        Not of that form, or a name or a robot comes twice.
    """
    found: dict[str, str] = {}
    for word in words:
        name, equals, robot = word.rpartition("=")
        if not equals or not name or not ROBOT_ID.match(robot):
            raise ConfigError("expected NAME=ROBOT", where=f"--map {word}", hint="like --map 'Rigid Body 1=r1'")
        if name in found or robot in found.values():
            raise ConfigError("the name or the robot is mapped already", where=f"--map {word}")
        found[name] = robot
    return found


class FixPublisher:
    """Publishes sightings, and logs one error for each kind of invalid ones.

    Parameters
    ----------
    sensor : what it is, for operators: "mocap", "camera ceiling"; at most 64 characters
    process : unique name of the source; made up where it is empty

    Attributes
    ----------
    sent : fixes published
    bad : objects refused, by kind
    """

    def __init__(
        self, bus: Bus, scheduler: Scheduler, keys: Keys, names: Names, *, sensor: str, process: str = ""
    ) -> None:
        self._bus, self._keys, self._scheduler, self._names = bus, keys, scheduler, names
        self._sensor = sensor
        self.process = process or f"fixes-{uuid.uuid4().hex[:8]}"
        self.sent = 0
        self.bad: Counter[str] = Counter()
        self._problem = ""
        self._seen_s: dict[str, tuple[str, float]] = {}  # by robot: marker, when it was seen last
        self._logged = (0, 0)
        self._known: set[str] = set()
        self._strange: set[str] = set()
        self._began_s = scheduler.now_s()
        self._subscription = bus.subscribe(keys.health(), HealthReport, self._on_health, latest=True)
        self._timers = [scheduler.every(LOG_S, self._log), scheduler.every(REPORT_S, self._report)]

    def expect(self, robot: str, marker: str) -> None:
        """State by what a robot is recognised, so that its absence is reported before it was ever seen."""
        self._seen_s.setdefault(robot, (marker, -math.inf))

    def problem(self, text: str) -> None:
        """State why the source gives nothing or less than it should; empty: it is well. Shown to operators."""
        if text != self._problem:
            self._problem = text
            self._report()
            if text:
                log.warning(text, sensor=self._sensor)
            else:
                log.info("the source of fixes is well again", sensor=self._sensor)

    def publish(self, seen: Sighting, arrival_s: float, sender: str = "") -> None:
        """Publish a sighting; its time is `arrival_s` on this machine's clock unless it states one of its own."""
        if not seen.tracked:
            return
        radius_m = self._names.objects.get(seen.name)
        if radius_m is not None:
            self._publish_object(seen, radius_m, arrival_s)
            return
        robot = self._robot(seen.name, seen.marker or seen.name, sender)
        if not robot:
            return
        fix = PoseFix(
            robot=robot,
            x_m=seen.x_m,
            y_m=seen.y_m,
            heading_rad=seen.heading_rad,
            position_sigma_m=seen.position_sigma_m,
            heading_sigma_rad=seen.heading_sigma_rad,
            source=self._clock_of(seen.time_s, sender),
            stamp_s=arrival_s if seen.time_s is None else seen.time_s,
            contacts=seen.contacts,
            covariance_m2=seen.covariance_m2,
            quality=seen.quality,
            sensor=self._sensor,
            marker=seen.marker[:64],
        )
        self._bus.publish(self._keys.pose_fix(robot), fix)

    def publish_range(
        self, seen: Ranging, above_m: tuple[float, float, float], sigma_m: float, arrival_s: float, sender: str = ""
    ) -> None:
        """Publish a distance to an anchor at `above_m`: x, y, and its height above the robot's radio."""
        robot = self._robot(seen.robot, f"radio, {seen.anchor}", sender)
        if not robot:
            return
        x_m, y_m, up_m = above_m
        fix = RangeFix(
            robot=robot,
            anchor=seen.anchor[:64],
            x_m=x_m,
            y_m=y_m,
            up_m=up_m,
            distance_m=seen.distance_m,
            sigma_m=sigma_m,
            source=self._clock_of(seen.time_s, sender),
            stamp_s=arrival_s if seen.time_s is None else seen.time_s,
            sensor=self._sensor,
        )
        self._bus.publish(self._keys.range_fix(robot), fix)

    def _robot(self, name: str, marker: str, sender: str) -> str:
        """Return the robot that a name stands for, noted as seen; empty: none, and refused."""
        robot = self._names.robots.get(name, name)
        if not ROBOT_ID.match(robot):
            hint = f"{name!r:.60}: say --map NAME=ROBOT which one it is"
            self.refuse(Refused("no robot can be called so", hint), sender)
            return ""
        self._look_for(robot)
        self.sent += 1
        if robot in self._seen_s or len(self._seen_s) < REPORTED:
            self._seen_s[robot] = marker, self._scheduler.now_s()
        return robot

    def _clock_of(self, time_s: float | None, sender: str) -> str:
        """Return the name of a clock: that of the sender's machine if it states its time, else this one's."""
        return f"{self.process}/{sender}" if time_s is not None and sender else self.process

    def _publish_object(self, seen: Sighting, radius_m: float, arrival_s: float) -> None:
        """Tell the robots where something is that is no robot of the fleet."""
        self.sent += 1
        number = list(self._names.objects).index(seen.name)
        fix = ObjectFix(
            object=seen.name, x_m=seen.x_m, y_m=seen.y_m, radius_m=radius_m, source=self.process, stamp_s=arrival_s
        )  # fmt: skip
        self._bus.publish(self._keys.object_fix(f"o{number}"), fix)  # its name may not fit into a key

    def refuse(self, refused: Refused, sender: str = "") -> None:
        """Count what is invalid; log it if it is the first of its kind."""
        first = refused.kind not in self.bad
        if first and len(self.bad) >= KINDS:
            self.bad["other"] += 1
            return
        self.bad[refused.kind] += 1
        if first:
            log.warning("a datagram was refused", why=str(refused), sender=sender)

    def _on_health(self, report: HealthReport) -> None:
        self._known.update(each.robot for each in report.robots)

    def _look_for(self, robot: str) -> None:
        """Log once that a robot is unknown: a wrong name looks like a robot that is switched off."""
        if robot in self._known or robot in self._strange or self._scheduler.now_s() - self._began_s < KNOWN_S:
            return
        if len(self._strange) < KINDS:
            self._strange.add(robot)
            log.warning("fixes for a robot that is not here", robot=robot, hint=did_you_mean(robot, self._known))

    def _report(self) -> None:
        """Publish what is seen and what is not."""
        now_s = self._scheduler.now_s()
        rows = [(robot, marker[:64], now_s - seen_s) for robot, (marker, seen_s) in self._seen_s.items()]
        report = FixSourceReport(
            source=self.process,
            sensor=self._sensor,
            problem=self._problem[:500],
            robots=tuple(robot for robot, _, _ in rows),
            markers=tuple(marker for _, marker, _ in rows),
            unseen_s=tuple(-1.0 if math.isinf(unseen_s) else unseen_s for _, _, unseen_s in rows),
            stamp_s=now_s,
        )
        self._bus.publish(self._keys.fix_source(self.process), report)

    def _log(self) -> None:
        now = (self.sent, self.bad.total())
        if now != self._logged:
            log.info("fixes", sent=now[0], refused=now[1], **({"why": dict(self.bad)} if self.bad else {}))
            self._logged = now

    def close(self) -> None:
        """Log the result, and stop."""
        for timer in self._timers:
            timer.cancel()
        self._subscription.close()
        self._log()
