"""One VESC as a wheel's codec."""

from __future__ import annotations

from dataclasses import dataclass

from fullswarm.drivers.can import vesc
from fullswarm.drivers.can.protocol import Beat, Frame, Mode, Motion, Power, Report, Want, Wheel

_PONG = 18
_HEARD = frozenset({9, _PONG, 27})  # statuses 1 and 5
_WRAP = 1 << 32


@dataclass(slots=True)
class VescCodec:
    """One controller as a :class:`~fullswarm.drivers.can.protocol.WheelCodec`.

    The protocol has no states and its status messages no faults: life is shown by answering a ping, and a
    controller in fault only by a wheel that does not turn. Status messages 1 and 5 are off as delivered and its
    timeout (1 s, then the motor coasts) is set in VESC Tool only; just SET commands feed it. A set-point inside
    the dead band is sent as a brake current, because the regulator would let the wheel roll.
    """

    node: int
    wheel: Wheel
    host: int = 253  # our own address, for pongs
    min_erpm: float = 900.0  # s_pid_min_erpm
    brake_a: float = 5.0
    malformed: int = 0
    _tachometer: int = 0  # as told last …
    _counts: int = 0  # … and without its wraps

    @property
    def max_speed_m_s(self) -> float:
        """Return ``inf``: the controller's own limit is not to be had on the bus."""
        return float("inf")

    @property
    def generic_firmware(self) -> str:
        """Return what is known: plain frames do not carry its version."""
        return "VESC"

    def quantised(self, speed_m_s: float) -> float:
        """Return the speed of the nearest whole ERPM, zero below the firmware's minimum."""
        return self.wheel.speed_of_erpm(self._erpm(speed_m_s))

    def _erpm(self, speed_m_s: float) -> int:
        erpm = round(max(-vesc.MAX_ERPM, min(vesc.MAX_ERPM, self.wheel.erpm(speed_m_s))))
        return erpm if abs(erpm) >= self.min_erpm else 0

    def start(self) -> tuple[Frame, ...]:
        """Nothing to clear and no mode to choose: let the motor go."""
        return self.release()

    def engage(self) -> tuple[Frame, ...]:
        """Hold the wheel."""
        return self.drive(0.0)

    def drive(self, speed_m_s: float) -> tuple[Frame, ...]:
        """Regulate the speed, or brake when it is zero or too slow to be regulated."""
        erpm = self._erpm(speed_m_s)
        order = vesc.SetErpm(erpm) if erpm else vesc.SetBrake(self.brake_a)
        return (vesc.encode(self.node, order),)

    def release(self) -> tuple[Frame, ...]:
        """Current zero: the wheel coasts."""
        return (vesc.encode(self.node, vesc.SetCurrent(0.0)),)

    def keep_alive(self) -> tuple[Frame, ...]:
        """Nothing: an idle controller that times out stays idle."""
        return ()

    def poll(self, wants: Want) -> tuple[Frame, ...]:
        """Ping; status messages cannot be asked for."""
        return (vesc.encode(self.node, vesc.Ping(self.host)),) if Want.BEAT in wants else ()

    def decode(self, frame: Frame) -> Report | None:
        """Return what the controller tells: pong, speed, tachometer and voltage."""
        if not frame.extended or frame.remote:
            return None
        command, address = frame.id >> 8, frame.id & 0xFF
        if command not in _HEARD or address != (self.host if command == _PONG else self.node):
            return None
        message = vesc.decode(frame)
        match message:
            case vesc.Pong(node=node):
                return Beat(Mode.UNKNOWN) if node == self.node else None
            case vesc.Status1(erpm=erpm) if abs(erpm) <= vesc.MAX_ERPM:
                return Motion(self.wheel.speed_of_erpm(erpm), None)
            case vesc.Status5(tachometer=tachometer, volts=volts):
                distance_m = self.wheel.metres(self._unwrapped(tachometer) / self._counts_per_turn)
                return Motion(None, distance_m, Power(volts) if volts >= 0.0 else None)
        self.malformed += 1
        return None

    @property
    def _counts_per_turn(self) -> int:
        return vesc.TACHO_PER_TURN * self.wheel.pole_pairs

    def _unwrapped(self, tachometer: int) -> int:
        step = (tachometer - self._tachometer + _WRAP // 2) % _WRAP - _WRAP // 2
        self._tachometer = tachometer
        self._counts += step
        return self._counts
