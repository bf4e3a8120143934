"""The conversation with one ROS base as a state machine: time and bytes in, time and bytes out.

The base counts as there while its odometry arrives, newly measured: its stamps, where it has any, must go on and must
not fall behind. A silent base, or one whose odometry arrives ever later, is a FAULT, and zero is sent to it until it is
back. In READY nothing is sent, so that another program may drive the robot.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from fullswarm.drivers.base import STAND, Description, Hazard, Lifecycle, Pose, RangeScan, Reading, Twist
from fullswarm.drivers.guardian import LONG_WATCHDOG_S, StopPlan
from fullswarm.drivers.guardian import SILENCE_S as GUARDIAN_S
from fullswarm.drivers.linked import LinkSession, Odometer
from fullswarm.drivers.ros.models import MIDDLE
from fullswarm.drivers.ros.protocol import Battery, EStop, Hazards, LaserScan, Odometry, Report
from fullswarm.drivers.ros.settings import SCAN_SILENCE_S
from fullswarm.errors import LinkLost, MessageError
from fullswarm.geometry import wrap
from fullswarm.reasons import Reason, given

SILENCE_S = 0.5
"""Without odometry for so long the base is lost."""
LATE_S = 0.3
"""Odometry that arrives so much later than the fastest did is not believed."""
WINDOW_S = 30.0
"""The fastest of this time and the time before it: clocks drift apart."""
RELINK_S, LONGEST_RELINK_S = 0.6, 8.0
"""A stream in which nothing was understood for so long is begun anew; each time it waits longer, up to the second."""
PERIOD_S = 0.05
"""Between two commands. Bases that stop by themselves do so after 0.3 s or more."""
ZEROS = 4
"""Zero is sent so often when the robot shall stand; then nothing more."""
ZERO_S = 0.2
"""Between two zeros while the base is lost."""
JUMP_SHARE, JUMP_M, JUMP_RAD = 1.5, 0.05, 0.3
"""Odometry moves at most by this share of its limits, and so much, between two messages; else it has begun anew."""
ANEW_M = 1e-6
"""Counting from zero again looks like this."""
LOW = 0.1
SCAN_SIGMA_M = 0.02
"""Standard deviation of a distance: LDS-01 and RPLIDAR A1 at 2 m, by their data sheets."""


def patience_s(description: Description) -> float:
    """Return after which silence of the driver's process the robot is stopped: by itself if it does so soon."""
    watchdog_s = description.watchdog_s
    return watchdog_s if watchdog_s is not None and watchdog_s <= LONG_WATCHDOG_S else GUARDIAN_S


class Wire(Protocol):
    """How a transport carries a base's messages."""

    trouble: str
    streams: bool
    """Bytes of a stream, in which nothing may be understood any more after a cut frame."""

    def linked(self) -> None:
        """Begin anew: the link is open."""
        ...

    def received(self, chunk: bytes) -> Sequence[Report]:
        """Return the reports that are whole now; ``MessageError``: one is wrong; ``LinkLost``: the link is."""
        ...

    def outgoing(self) -> Sequence[bytes]:
        """Return what the link itself has to send."""
        ...

    def drive(self, twist: Twist, stamp_s: float | None) -> bytes:
        """Return a command; empty: it cannot be sent yet."""
        ...

    def farewell(self) -> Sequence[bytes]:
        """Return what ends the link."""
        ...


class Lag:
    """Judges by stamps of the robot's own clock whether its messages fall behind."""

    def __init__(self) -> None:
        self._fastest: deque[tuple[float, float]] = deque(maxlen=2)  # (begin of a window, smallest offset in it)
        self.offset_s: float | None = None
        """From the robot's clock to ours, with the shortest delay seen."""

    def late_s(self, stamp_s: float, now_s: float) -> float:
        """Return by how much a message is later than the fastest."""
        offset_s = now_s - stamp_s
        if not self._fastest or now_s - self._fastest[-1][0] > WINDOW_S:
            self._fastest.append((now_s, offset_s))
        elif offset_s < self._fastest[-1][1]:
            self._fastest[-1] = self._fastest[-1][0], offset_s
        self.offset_s = min(each for _, each in self._fastest)
        return offset_s - self.offset_s


class Session(LinkSession[bytes]):
    """One ROS base.

    Parameters
    ----------
    estop
        An e-stop's state is part of what must be known before it drives.
    plan
        What a guardian sends, for a transport where one can.
    scan_at
        Where on the robot its lidar is.
    """

    firmware = ""

    def __init__(
        self, description: Description, wire: Wire, *, stamped: bool, estop: bool, plan: StopPlan[bytes] | None = None,
        scan_at: Pose = MIDDLE,
    ) -> None:  # fmt: skip
        self._patience_s = patience_s(description)
        self._limits, self._wire, self._stamped, self._plan = description.limits, wire, stamped, plan
        self._odometer, self._breaks = Odometer(), 0
        self._lag, self._newest = Lag(), Odometry(-math.inf, Pose(0.0, 0.0, 0.0), STAND)
        self._odometry_s: float | None = None  # when it last arrived, and was believed
        self._ticked_s, self._linked_s, self._sent_s = -math.inf, -math.inf, -math.inf
        self._battery: float | None = None
        self._scan_at, self._scan_max_m = scan_at, description.ranges_max_m
        self._ranges: tuple[RangeScan, ...] = ()
        self._scanned_s = -math.inf
        self._hazards = Hazard.NONE
        self._engaged: bool | None = None if estop else False
        self._unread = Hazard.NONE  # since the last read()
        self._target, self._zeros = STAND, 0
        self._refused = ""
        self._relink_s = RELINK_S

    # ------------------------------------------------------------ the link
    def linked(self, now_s: float) -> None:
        """Begin anew: the link is open."""
        self._wire.linked()
        self._lag, self._linked_s, self._zeros, self._refused = Lag(), now_s, ZEROS, ""

    def lost(self, reason: str, now_s: float) -> None:
        """Note that there is no link, or no base at its other end."""
        super().lost(reason, now_s)
        self._stand()

    def received(self, chunk: bytes, now_s: float) -> None:
        """Take bytes."""
        self._notice_pause(now_s)
        try:
            for report in self._wire.received(chunk):
                self._take(report, now_s)
        except MessageError as error:
            self._refused = error.what  # shown if nothing better comes

    def tick(self, now_s: float) -> list[bytes]:
        """Judge the silence; return what is to be sent."""
        self._notice_pause(now_s)
        self._judge(now_s)
        self._relink(now_s)
        out = list(self._wire.outgoing())
        if self.state is Lifecycle.ACTIVE:
            due = now_s - self._sent_s >= PERIOD_S
        elif self._zeros:
            due = now_s - self._sent_s >= (ZERO_S if self.state is Lifecycle.FAULT else PERIOD_S)
        else:
            due = False
        command = self._wire.drive(self._target, self._stamp_s(now_s)) if due else b""
        if command:
            self._sent_s = now_s
            if self.state is not Lifecycle.FAULT:  # in a FAULT until it is over
                self._zeros = max(0, self._zeros - 1)
            out.append(command)
        return out

    def next_due_s(self, now_s: float) -> float:
        """Return when there is something to send next: a stop at once."""
        if self.state is Lifecycle.ACTIVE or self._zeros:
            return max(now_s, min(self._sent_s + PERIOD_S, super().next_due_s(now_s)))
        return super().next_due_s(now_s)

    def greeting(self) -> list[bytes]:
        """Return what the link itself has to send, and no command: for a probe."""
        return list(self._wire.outgoing())

    # ------------------------------------------------------------ the agent
    def read(self) -> Reading | None:
        """Return the newest reading; its hazards are those since the last call."""
        found, self._unread = self._unread, Hazard.NONE
        return self.reading if self.reading is None else replace(self.reading, hazards=self.reading.hazards | found)

    def activate(self, now_s: float) -> None:
        """READY → ACTIVE."""
        super().activate(now_s)
        self._sent_s = -math.inf

    def deactivate(self, now_s: float) -> None:
        """ACTIVE → READY with the wheels at zero."""
        del now_s
        if self.state is Lifecycle.ACTIVE:
            self.state = Lifecycle.READY
            self._stand()

    def command(self, twist: Twist, now_s: float) -> Twist:
        """Take a set-point; return it held within the limits."""
        del now_s
        applied = self._limits.clip(twist)
        if applied == STAND != self._target:
            self._sent_s = -math.inf
        self._target = applied
        return applied

    def final_stop(self) -> list[bytes]:
        """Return zero, and the end of the link."""
        zero = self._wire.drive(STAND, 0.0 if self._stamped else None)
        return [each for each in (zero, *self._wire.farewell()) if each]

    def stop_plan(self, now_s: float) -> StopPlan[bytes] | None:
        """Return what a guardian sends while the robot is driven."""
        del now_s
        return self._plan if self.state is Lifecycle.ACTIVE else None

    def trouble(self, now_s: float) -> Reason:
        """Return why it is in FAULT, or what it waits for."""
        return given(self.fault or self.why(now_s))

    def why(self, now_s: float) -> str:
        """Return what it waits for while it is OPEN, once that takes long."""
        return self._missing() if self.state is Lifecycle.OPEN and now_s - self._linked_s > SILENCE_S else ""

    # ------------------------------------------------------------ within
    def _notice_pause(self, now_s: float) -> None:
        """Stop when this process did not run, or its clock has jumped, and forget how fast messages were."""
        if now_s - self._ticked_s > self._patience_s:
            self._lag = Lag()
            if self.state is Lifecycle.ACTIVE:
                self.lost("this process did not run for a while: its commands were too late", now_s)
        self._ticked_s = now_s

    def _relink(self, now_s: float) -> None:
        """Begin a stream anew in which nothing is understood; raises ``LinkLost``."""
        since_s = max(self._linked_s, self._odometry_s or -math.inf)
        if self._wire.streams and now_s - since_s > self._relink_s:
            self._relink_s = min(2.0 * self._relink_s, LONGEST_RELINK_S)
            raise LinkLost(self._missing())

    def _judge(self, now_s: float) -> None:
        if self.state in (Lifecycle.READY, Lifecycle.ACTIVE):
            if self._odometry_s is None or now_s - self._odometry_s > SILENCE_S:
                self.lost(self._missing(), now_s)
            elif self.unguarded:
                self.lost(self.unguarded, now_s)
            elif self._blind(now_s):
                self.lost(self._missing(), now_s)
        elif self.state is Lifecycle.OPEN and now_s - self._linked_s > 4.0 * SILENCE_S > 0.0:
            self.lost(self._missing(), now_s)

    def _blind(self, now_s: float) -> bool:
        """Tell whether the lidar that the URL names is silent."""
        return self._scan_max_m > 0.0 and now_s - self._scanned_s > SCAN_SILENCE_S

    def _missing(self) -> str:
        detail = self._wire.trouble or self._refused
        if self._odometry_s is None or self._ticked_s - self._odometry_s > SILENCE_S:
            what = (
                f"no new odometry for {SILENCE_S:g} s: is its bring-up running, and are topic, namespace and rmw right?"
            )
        elif self._engaged is None:
            what = "nothing was received yet on the topic of its emergency stop: is it published there?"
        else:
            what = f"no scan for {SCAN_SILENCE_S:g} s: does its lidar turn, and is the topic of scan= right?"
        return f"{what} ({detail})" if detail else what

    def _take(self, report: Report, now_s: float) -> None:
        if isinstance(report, Odometry):
            self._take_odometry(report, now_s)
        elif isinstance(report, Battery):
            self._battery = report.charge
        elif isinstance(report, Hazards):
            self._hazards = report.hazards
            self._unread |= report.hazards
        elif isinstance(report, EStop):
            self._take_estop(report, now_s)
        else:
            self._take_scan(report, now_s)

    def _take_scan(self, report: LaserScan, now_s: float) -> None:
        """Keep the newest scan for the next reading; its stamp becomes one of our clock, never later than now."""
        ended_s, offset_s = now_s, self._lag.offset_s
        if report.stamp_s > 0.0 and offset_s is not None:
            ended_s = report.stamp_s + offset_s + report.duration_s
            if now_s - ended_s > LATE_S:
                self._refused = f"its scans arrive {now_s - ended_s:.1f} s late: the network is overloaded"
                return
        self._scanned_s = now_s
        most_m = min(report.max_m, self._scan_max_m)
        distances_m = np.where(report.distances_m > most_m, math.inf, report.distances_m)
        self._ranges = (
            RangeScan(
                min(ended_s, now_s), report.angles_rad, distances_m, most_m, self._scan_at,
                duration_s=report.duration_s, sigma_m=SCAN_SIGMA_M,
            ),
        )  # fmt: skip

    def _take_estop(self, report: EStop, now_s: float) -> None:
        self._engaged = report.engaged
        if report.engaged:
            self._unread |= Hazard.ESTOP_BUTTON
            self.lost("its emergency stop is engaged: release it on the robot", now_s)

    def _take_odometry(self, report: Odometry, now_s: float) -> None:
        previous = self._newest
        if report.stamp_s > 0.0:
            if report.stamp_s == previous.stamp_s:
                return  # repeated, not measured
            if report.stamp_s < previous.stamp_s:
                self._lag = Lag()  # its clock was set, or it has restarted
            late_s = self._lag.late_s(report.stamp_s, now_s)
            if late_s > LATE_S:
                self._refused = f"its odometry arrives {late_s:.1f} s late: the network is overloaded"
                return
        if self._odometry_s is not None and self._began_anew(previous, report, now_s - self._odometry_s):
            self._odometer.rebase()
            self._breaks += 1
        self._newest, self._odometry_s, self._refused, self._relink_s = report, now_s, "", RELINK_S
        self.reading = Reading(
            stamp_s=now_s,
            odometry=self._odometer.update(report.pose),
            twist=report.twist,
            odometry_breaks=self._breaks,
            hazards=self._present_hazards(),
            contacts=int(Hazard.BUMP in self._hazards),
            battery=self._battery,
            ranges=self._ranges,
        )
        well = not self.unguarded and self._engaged is False and not self._blind(now_s)
        if self.state in (Lifecycle.OPEN, Lifecycle.FAULT) and well:
            self.state, self.fault = Lifecycle.READY, ""
            self._zeros = ZEROS  # its last driver may have been killed while it drove

    def _began_anew(self, before: Odometry, after: Odometry, passed_s: float) -> bool:
        """Tell whether the odometry counts from another place now: the base has restarted, or was reset."""
        if after.stamp_s < before.stamp_s:
            return True
        limits = self._limits
        moved_m = math.hypot(after.pose.x_m - before.pose.x_m, after.pose.y_m - before.pose.y_m)
        turned_rad = abs(wrap(after.pose.heading_rad - before.pose.heading_rad))
        zero = max(abs(after.pose.x_m), abs(after.pose.y_m), abs(after.pose.heading_rad)) < ANEW_M
        passed_s = min(passed_s, SILENCE_S)  # beyond that it was lost, and stood
        return (
            (zero and max(moved_m, turned_rad) > 0.01)
            or moved_m > JUMP_SHARE * limits.speed_m_s * passed_s + JUMP_M
            or turned_rad > JUMP_SHARE * limits.turn_rad_s * passed_s + JUMP_RAD
        )

    def _present_hazards(self) -> Hazard:
        found = self._hazards
        if self._battery is not None and self._battery < LOW:
            found |= Hazard.BATTERY_LOW
        return found | Hazard.ESTOP_BUTTON if self._engaged else found

    def _stamp_s(self, now_s: float) -> float | None:
        """Return a command's stamp: now on the robot's clock, so that a base that looks at it drops late ones."""
        if not self._stamped:
            return None
        offset_s = self._lag.offset_s
        return 0.0 if offset_s is None else max(0.0, now_s - offset_s)

    def _stand(self) -> None:
        self._target, self._zeros, self._sent_s = STAND, ZEROS, -math.inf
