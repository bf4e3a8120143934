"""The conversation of one simulated robot with its world as a state machine: datagrams and time in, datagrams out."""

from __future__ import annotations

import contextlib
import math
import secrets
from dataclasses import replace

import numpy as np

from fullswarm.drivers.actuators import ActuatorValue
from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Pose, RangeScan, Reading, Twist
from fullswarm.drivers.linked import LONGEST_WAIT_S, LinkSession, Odometer
from fullswarm.drivers.sim import protocol
from fullswarm.drivers.sim.settings import SimUrl
from fullswarm.errors import DriverError, LinkLost, MessageError

SILENCE_S = 0.5
PAUSED_S = 0.2
"""When this session was not ticked for so long, this process stood still: the world was not silent meanwhile."""


class Session(LinkSession[bytes]):
    """One robot. A world that restarts is found again; the robot is READY then, never ACTIVE."""

    firmware = ""

    def __init__(self, url: SimUrl, now_s: float) -> None:
        self._url, self._where, self._id = url, f"{url.host}:{url.port}", secrets.token_hex(8)
        self._limits = url.description.limits
        self._out: list[protocol.Datagram] = []
        self._hello_s = now_s  # when the next is due
        self._sequence, self._driven = 0, STAND
        self._world = ""  # the run of a world that has welcomed it
        self._odometer = Odometer()
        self._actuators: dict[str, str] = {}
        self._scan = -1  # number of the newest scan
        self._ranges: tuple[RangeScan, ...] = ()
        self._unread = False
        self._time_s = -math.inf  # of the world, in the newest reading
        self._received_s = self._ticked_s = now_s

    # ------------------------------------------------------------ the link
    def received(self, chunk: bytes, now_s: float) -> None:
        """Take a datagram of the world."""
        with contextlib.suppress(MessageError):  # not the world's bytes: its silence is what counts
            self._receive(protocol.decode(chunk), now_s)

    def _receive(self, datagram: protocol.Datagram, now_s: float) -> None:
        if datagram.robot != self._url.robot or datagram.session != self._id:
            return
        if isinstance(datagram, protocol.Refusal):
            self._received_s, self.state = now_s, Lifecycle.FAULT
            self.fault = str(DriverError(datagram.reason, where=self._where, hint=datagram.hint))
        elif isinstance(datagram, protocol.Welcome):
            self._welcome(datagram)
        elif isinstance(datagram, protocol.BodyReading) and datagram.time_s > self._time_s:
            self._judge(now_s)  # a silence that was not noticed yet must not leave the robot ACTIVE
            self._take(datagram, now_s)

    def tick(self, now_s: float) -> list[bytes]:
        """Return what is to be sent."""
        self._judge(now_s)
        if now_s >= self._hello_s:
            self._hello_s = now_s + protocol.HELLO_PERIOD_S
            hello = protocol.Hello(
                robot=self._url.robot, session=self._id, sensing_m=self._url.sensing_m, actuators=self._actuators
            )
            self._out.append(hello)
        out, self._out = self._out, []
        return [protocol.encode(each) for each in out]

    def next_due_s(self, now_s: float) -> float:
        """Return the time of the next greeting: at once if there is something to send."""
        return now_s if self._out else min(self._hello_s, now_s + LONGEST_WAIT_S)

    # ------------------------------------------------------------ the agent
    def read(self) -> Reading | None:
        """Return the newest reading; its contacts and hazards are those since the last call."""
        self._unread = False
        return self.reading

    def deactivate(self, now_s: float) -> None:
        """ACTIVE → READY with the wheels at zero."""
        super().deactivate(now_s)
        self._drive(STAND)

    def command(self, twist: Twist, now_s: float) -> Twist:
        """Send a set-point in one datagram; return it held within the limits."""
        del now_s
        return self._drive(self._limits.clip(twist))

    def halt(self, why: str, now_s: float) -> None:
        """Stand, whatever the world's own watchdog allows."""
        del why, now_s
        if self._driven != STAND:
            self._drive(STAND)

    def final_stop(self) -> list[bytes]:
        """Return zero, and that the robot is free for another driver."""
        self._drive(STAND)
        self._out.append(protocol.Bye(robot=self._url.robot, session=self._id))
        return [protocol.encode(each) for each in self._out]

    def actuate(self, name: str, value: ActuatorValue, now_s: float) -> None:
        """Send it at once, and again with each greeting."""
        if self._actuators.get(name) != value:
            self._actuators = {**self._actuators, name: str(value)}
            self._hello_s = now_s

    # ------------------------------------------------------------ within
    def _judge(self, now_s: float) -> None:
        """Go to FAULT once the world has been silent for too long.

        A pause of this process is no silence of the world: it ends the motion (for want of commands, and by the world's
        own watchdog), not what the robot was asked for.
        """
        paused_s, self._ticked_s = now_s - self._ticked_s, now_s
        if paused_s > PAUSED_S:
            self._received_s += paused_s
        if now_s - self._received_s > SILENCE_S:
            what, hint = f"no reading for {SILENCE_S} s", "is the world running there, with this robot in it?"
            self.state, self.fault = Lifecycle.FAULT, str(LinkLost(what, where=self._where, hint=hint))

    def _welcome(self, welcome: protocol.Welcome) -> None:
        promised, (speed_m_s, turn_rad_s, *_) = self._url.description.limits, welcome.limits
        self.firmware = welcome.firmware
        self._limits = replace(
            promised,
            speed_m_s=min(speed_m_s, promised.speed_m_s),
            turn_rad_s=min(turn_rad_s, promised.turn_rad_s),
        )
        if welcome.world != self._world:
            # Another run of the world: its clock and its odometry start anew, and nothing drives on.
            self._world, self._time_s, self._odometer = welcome.world, -math.inf, Odometer()
            self._scan = -1
            if self.state is Lifecycle.ACTIVE:
                self.state = Lifecycle.READY

    def _look(self, scan: protocol.Scan, now_s: float) -> None:
        """Take a scan that is new."""
        if scan.number <= self._scan:
            return
        distances_m = protocol.unpack_rows(scan.distances, 1)[:, 0].astype(np.float64)
        angles_rad = scan.first_rad + scan.step_rad * np.arange(len(distances_m), dtype=np.float64)
        self._scan = scan.number
        self._ranges = (
            RangeScan(
                now_s, angles_rad, distances_m, scan.max_m, Pose(*scan.mount), sigma_m=scan.sigma_m,
                cone_rad=scan.cone_rad,
            ),
        )  # fmt: skip

    def _take(self, body: protocol.BodyReading, now_s: float) -> None:
        if body.scan is not None:
            self._look(body.scan, now_s)
        reading = Reading(
            stamp_s=now_s,
            odometry=self._odometer.update(Pose(*body.odometry)),
            twist=Twist(*body.twist),
            pose=Pose(*body.pose) if body.senses_pose else None,
            hazards=Hazard(body.hazards),
            contacts=body.contacts,
            obstacles=protocol.unpack_rows(body.obstacles, 6),
            bodies=None if body.bodies is None else protocol.unpack_rows(body.bodies, 3),
            ranges=self._ranges,
            battery=body.battery,
            charging=body.charging,
        )
        if self._unread and self.reading is not None:  # a contact must not be over before it has been read
            contacts = max(reading.contacts, self.reading.contacts)
            reading = replace(reading, contacts=contacts, hazards=reading.hazards | self.reading.hazards)
        self._time_s, self._received_s, self.reading, self._unread = body.time_s, now_s, reading, True
        if self.state in (Lifecycle.OPEN, Lifecycle.FAULT) and self._world:
            self.state, self.fault = Lifecycle.READY, ""

    def _drive(self, twist: Twist) -> Twist:
        self._sequence += 1
        self._driven = twist
        self._out.append(
            protocol.Drive(
                robot=self._url.robot,
                session=self._id,
                sequence=self._sequence,
                linear_m_s=twist.linear_m_s,
                angular_rad_s=twist.angular_rad_s,
                active=self.state is Lifecycle.ACTIVE,
            )
        )
        return twist
