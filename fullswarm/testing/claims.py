"""What a description claims, held against what the robot does."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from fullswarm.drivers.base import STAND, Hazard, Reading, Twist
from fullswarm.geometry import wrap
from fullswarm.testing.trial import DRIFT_RAD, NEXT_S, PACE, Trial

CLAIMS = (
    "speed told and true",
    "odometry against the truth",
    "slow driving",
    "can_reverse",
    "senses_bumps",
    "senses_pose",
    "senses_obstacles",
)
TRUE = 0.25
"""Share by which the true speed may differ from the measured one."""
WAY_S, WAYS = 1.5, 3
"""How long the odometry is compared with the truth, and how often before it counts as wrong."""
SLOW = (Twist(0.05, 0.0), Twist(0.0, 0.1))
SLOW_S, SLOW_SHARE = 1.0, 0.4
"""How long a slow robot is watched, and by which share it may be slower or faster than applied."""
POSE_M = 0.1
BACK_S = 0.4


def check_claims(trial: Trial) -> None:
    """Hold the description against the robot; begins and ends with an open driver, standing."""
    rig, report, description = trial.rig, trial.report, trial.driver.description
    if not report.lacks("speed told and true", body_speed=rig.body_speed):
        report.add("speed told and true", _check_truth(trial))
    if not report.lacks("odometry against the truth", body_speed=rig.body_speed):
        report.add("odometry against the truth", _check_odometry(trial))
    report.add("slow driving", _check_slow(trial))
    report.add("can_reverse", _check_reverse(trial))
    if not description.senses_bumps:
        report.add("senses_bumps", "not claimed, and never told")
    elif rig.bump is None:
        report.lacks("senses_bumps", bump=None)
    else:
        report.add("senses_bumps", _check_bumps(trial, rig.bump))
    if not description.senses_pose:
        report.add("senses_pose", "not claimed, and never told")
    elif not report.lacks("senses_pose", body_pose=rig.body_pose):
        report.add("senses_pose", _check_pose(trial))
    if not description.senses_obstacles:
        report.add("senses_obstacles", "not claimed, and never told")
    elif not report.lacks("senses_obstacles", obstacle=rig.obstacle):
        report.add("senses_obstacles", _check_obstacles(trial))


def _check_truth(trial: Trial) -> str:
    """The readings tell how the body moves: a scale that is wrong both ways would pass otherwise."""
    worst = 0.0
    trial.go()
    for wished in (Twist(trial.pace.linear_m_s, 0.0), Twist(0.0, trial.pace.angular_rad_s)):
        applied = trial.drive(wished, share=0.9)
        agrees = trial.wait(partial(_agrees, trial, applied), trial.settle_s, partial(trial.command, wished))
        trial.demand(
            agrees,
            f"under {applied} the body moves with {trial.motion}, but the reading says "
            f"{trial.newest and trial.newest.twist}; check wheel radius, base and units",
        )
        worst = max(worst, _error(trial, applied))
    trial.halt("a zero command", each=lambda: trial.command(STAND))
    return f"within {worst:.1%}"


def _agrees(trial: Trial, applied: Twist) -> bool:
    return _error(trial, applied) <= TRUE


def _error(trial: Trial, applied: Twist) -> float:
    """Return by which share of the truth the newest reading is wrong, in the component that is driven."""
    told, true = trial.newest.twist if trial.newest is not None else STAND, trial.motion or STAND
    if applied.linear_m_s:
        return abs(told.linear_m_s - true.linear_m_s) / max(abs(true.linear_m_s), 1e-6)
    return abs(told.angular_rad_s - true.angular_rad_s) / max(abs(true.angular_rad_s), 1e-6)


@dataclass
class _Way:
    """Adds up how far the odometry goes and how far the body truly goes, along its heading or round."""

    trial: Trial
    turning: bool
    before: Reading
    told: float = 0.0  # m or rad
    true_rate: float = 0.0  # m/s or rad/s, added up …
    looks: int = 0  # … over so many looks

    def look(self) -> None:
        """Take the newest reading, and the body's motion now."""
        reading = self.trial.newest
        if reading is not None and reading.stamp_s > self.before.stamp_s:
            a, b = self.before.odometry, reading.odometry
            turned = wrap(b.heading_rad - a.heading_rad)
            halfway = a.heading_rad + turned / 2.0
            along = math.cos(halfway) * (b.x_m - a.x_m) + math.sin(halfway) * (b.y_m - a.y_m)
            self.told += turned if self.turning else along
            self.before = reading
        motion = self.trial.motion or STAND
        self.true_rate += motion.angular_rad_s if self.turning else motion.linear_m_s
        self.looks += 1


def _measure_way(trial: Trial, wished: Twist, duration_s: float) -> tuple[float, float]:
    """Drive for a while; return the mean speed by the odometry, and as it truly was (m/s or rad/s)."""
    way = _Way(trial, wished.angular_rad_s != 0.0, trial.fresh())
    began_s = way.before.stamp_s

    def each() -> None:
        trial.command(wished)
        way.look()

    trial.wait(lambda: False, duration_s, each)
    return way.told / max(way.before.stamp_s - began_s, 1e-6), way.true_rate / max(way.looks, 1)


def _check_odometry(trial: Trial) -> str:
    """The way that the odometry counts is the body's: a wheel radius or base that is 10 % wrong shows here."""
    worst, most = 0.0, trial.rig.odometry_share
    for wished in (Twist(trial.pace.linear_m_s, 0.0), Twist(0.0, trial.pace.angular_rad_s)):
        off, told, true = math.inf, 0.0, 0.0
        for _ in range(WAYS):  # the body may have been bumped, or this machine busy
            trial.go()
            trial.drive(wished, share=0.9)
            told, true = _measure_way(trial, wished, WAY_S)
            off = abs(told - true) / max(abs(true), 1e-6)
            if off <= most:
                break
        what = "wheel radius" if wished.linear_m_s else "wheel base"
        trial.demand(
            off <= most,
            f"under {wished} the odometry counts {told:.3f} a second, the body goes {true:.3f}: {off:.0%} apart, more "
            f"than {most:.0%}; check {what} and counts per turn",
        )
        worst = max(worst, off)
    trial.halt("a zero command", each=lambda: trial.command(STAND))
    return f"within {worst:.1%}"


def _check_slow(trial: Trial) -> str:
    """What is said to be applied moves the robot, however slow it is: a dead band is told by applying zero."""
    found = []
    for wished in SLOW:
        trial.go()
        trial.halt("a zero command", each=lambda: trial.command(STAND))
        applied = trial.command(wished)
        rate = applied.linear_m_s or applied.angular_rad_s
        unit = "m/s" if wished.linear_m_s else "rad/s"
        if rate == 0.0:
            found.append(f"{wished.linear_m_s or wished.angular_rad_s:g} {unit}: applies zero, and says so")
            continue
        trial.spend(min(trial.settle_s, SLOW_S), wished)
        told, true = _measure_way(trial, wished, SLOW_S)
        moves = true if trial.rig.body_speed is not None else told
        rest = trial.rig.rest_m_s if wished.linear_m_s else 0.0
        trial.demand(
            abs(moves - rate) <= SLOW_SHARE * abs(rate) + rest,
            f"command({wished}) says that it applies {rate:.3f} {unit}, but the robot moves with {moves:.3f} {unit}; "
            "where the device has a dead band, return what it really does: zero",
        )
        found.append(f"{moves:.3f} of {rate:.3f} {unit}")
    trial.halt("a zero command", each=lambda: trial.command(STAND))
    return ", ".join(found)


def _check_reverse(trial: Trial) -> str:
    """Half speed backwards: applied if it can, clipped to zero if it cannot, in the wheels as well as in words."""
    limits = trial.driver.description.limits
    back = Twist(-PACE * limits.speed_m_s, 0.0)
    if limits.can_reverse:
        return "claimed, and driven backwards"  # by the check of the signs
    trial.go()
    trial.halt("a zero command", each=lambda: trial.command(STAND))
    begin = trial.fresh().odometry
    trial.spend(BACK_S, back)
    end = trial.fresh().odometry
    c, s = math.cos(begin.heading_rad), math.sin(begin.heading_rad)
    gone_m = c * (end.x_m - begin.x_m) + s * (end.y_m - begin.y_m)
    true = trial.motion or STAND
    trial.demand(
        gone_m >= -0.1 * limits.speed_m_s * BACK_S and true.linear_m_s >= -0.1 * limits.speed_m_s,
        f"its description says that it cannot reverse, but under {back} it goes {gone_m:.3f} m ({true}); clip it",
    )
    return "denied, and clipped"


def _check_bumps(trial: Trial, bump: Callable[[bool], object]) -> str:
    began_s = trial.clock.now_s()
    bump(True)
    try:
        seen = trial.wait(lambda: _bumped(trial), NEXT_S)
        took_s = trial.clock.now_s() - began_s
        trial.demand(seen, f"its description says senses_bumps, but a bump is not told within {NEXT_S} s")
    finally:
        bump(False)
    gone = trial.wait(lambda: not _bumped(trial), NEXT_S)
    trial.demand(gone, f"it still tells a bump {NEXT_S} s after the bumper was released")
    return f"told after {took_s:.2f} s"


def _bumped(trial: Trial) -> bool:
    return trial.newest is not None and Hazard.BUMP in trial.newest.hazards


def _check_pose(trial: Trial) -> str:
    where = trial.rig.body_pose
    if where is None:
        return ""
    trial.wait(trial.rests, trial.settle_s)
    told, true = trial.fresh().pose, where()
    if told is None:
        raise AssertionError(f"{trial.driver.url}: its description says senses_pose, but it tells none")
    off_m = math.hypot(told.x_m - true.x_m, told.y_m - true.y_m)
    off_rad = abs(wrap(told.heading_rad - true.heading_rad))
    trial.demand(
        off_m <= POSE_M and off_rad <= 2.0 * DRIFT_RAD,
        f"it tells the pose {told}, the body is at {true}; x is east, y north, heading 0 along x, counter-clockwise",
    )
    return f"{off_m * 1e3:.0f} mm, {math.degrees(off_rad):.1f} deg beside the truth"


def _check_obstacles(trial: Trial) -> str:
    put = trial.rig.obstacle
    if put is None:
        return ""
    put()
    seen = trial.wait(lambda: trial.newest is not None and len(trial.newest.obstacles) > 0, NEXT_S)
    trial.demand(seen, f"its description says senses_obstacles, but an obstacle is not told within {NEXT_S} s")
    return "told"
