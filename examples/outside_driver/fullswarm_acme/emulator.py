"""Emulates a Scout: its firmware behind a real TCP port. `fullswarm emulate acme` runs one."""

from typing import Literal
from urllib.parse import urlsplit

from fullswarm.clock import Clock
from fullswarm.drivers.base import STAND
from fullswarm.emulators.base import Emulator, body_and_clock
from fullswarm.emulators.ports import TcpPort
from fullswarm.geometry import clamp
from fullswarm.simulation.bodies import Body

from fullswarm_acme.protocol import WATCHDOG_S, Drive, Enable, Hello, LineParser, Robot, State, line
from fullswarm_acme.session import LIMITS

STEP_S = 0.02


class Firmware:
    """What the robot's own computer does: execute messages, ramp speeds, stop after 1 s without a set-point."""

    def __init__(self, body: Body) -> None:
        self.body, self.battery, self.estop = body, 1.0, False
        self.boots, self.next_due_s, self._start = 0, 0.0, body.state()
        self.reboot()

    def reboot(self) -> None:
        """Start anew, with the motors off."""
        self.boots += 1
        self.enabled = False
        self._target, self._target_s = STAND, 0.0
        self._speed_m_s = self._turn_rad_s = 0.0
        self.hung_up()

    def hung_up(self, _port: int = 0) -> None:
        """Wait for the next client to say hello."""
        self._greeted, self._parser, self._out = False, LineParser(), list[bytes]()

    def receive(self, data: bytes, now_s: float, _port: int) -> None:
        """Execute messages."""
        for message in self._parser.feed(data):
            if isinstance(message, Hello):
                self._greeted = True
                self._out.append(line(Robot("Scout", "2.3", self.boots)))
            elif isinstance(message, Enable):
                self.enabled, self._target = message.on and not self.estop, STAND
            elif isinstance(message, Drive):
                self._target, self._target_s = message.twist, now_s

    def step(self, now_s: float) -> bool:
        """Turn the motors, and send the state."""
        if now_s >= self.next_due_s:
            self.next_due_s = max(self.next_due_s + STEP_S, now_s)
            if now_s - self._target_s > WATCHDOG_S or not self.enabled or self.estop:
                self._target = STAND
            target_m_s = clamp(self._target.linear_m_s, 0.0, LIMITS.speed_m_s)  # nothing looks backwards
            faster, turning = LIMITS.accel_m_s2 * STEP_S, LIMITS.turn_accel_rad_s2 * STEP_S
            self._speed_m_s += clamp(target_m_s - self._speed_m_s, -faster, faster)
            self._turn_rad_s += clamp(self._target.angular_rad_s - self._turn_rad_s, -turning, turning)
            self.body.drive(self._speed_m_s, self._turn_rad_s)
            if self._greeted:
                self._out.append(line(self._state()))
        return False

    def _state(self) -> State:
        now, start = self.body.state(), self._start
        values = (now.speed_m_s, now.turn_rad_s, now.x_m - start.x_m, now.y_m - start.y_m, now.heading_rad)
        v, w, x, y, heading = (round(value * 1e3) for value in values)
        mode: Literal["IDLE", "ON", "ESTOP"] = "ESTOP" if self.estop else "ON" if self.enabled else "IDLE"
        return State(v, w, x, y, heading, mode, any(now.bumps), round(self.battery * 100))

    def take(self, _port: int) -> list[bytes]:
        """Return the lines to send."""
        out, self._out = self._out, []
        return out


class AcmeEmulator(Emulator):
    """A Scout behind a TCP port of this machine; port 0 takes a free one."""

    def __init__(self, port: int = 0, body: Body | None = None, clock: Clock | None = None) -> None:
        body, clock = body_and_clock(body, clock)
        self.firmware, tcp = Firmware(body), TcpPort("127.0.0.1", port)
        super().__init__(self.firmware, [tcp], body, clock, seeds=(1, 2))
        self.url = f"acme://{tcp.address}"

    @property
    def motors_on(self) -> bool:
        """Whether it is enabled: it obeys set-points."""
        return self.firmware.enabled

    def reboot(self) -> None:
        """Restart its computer: motors off, connection gone."""
        self.do(lambda: (self.drop(), self.firmware.reboot()))

    def set_battery(self, fraction: float) -> None:
        """Fill its battery to this part."""
        self.firmware.battery = fraction

    def press_estop(self, on: bool) -> None:
        """Press or release its red button."""
        self.firmware.estop, self.firmware.enabled = on, False


def start(url: str, body: Body) -> AcmeEmulator:
    """Switch on the Scout at the other end of a driver's URL."""
    return AcmeEmulator(urlsplit(url).port or 7700, body).start()
