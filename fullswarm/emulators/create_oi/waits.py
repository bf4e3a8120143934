"""The Create 1's waits and scripts: it hears nothing, and says nothing, until something has happened."""

from __future__ import annotations

from collections.abc import Mapping

from fullswarm.drivers.create_oi.protocol import Command, Mode, Op

WAITS = (Op.WAIT_TIME, Op.WAIT_DISTANCE, Op.WAIT_ANGLE, Op.WAIT_EVENT)

# Event number to (packet, bits) that mean it; 22 is the mode. Source: Create Open Interface, command 158.
_EVENTS: dict[int, tuple[str, int]] = {
    1: ("bumps_drops", 0b11100), 2: ("bumps_drops", 0b10000), 3: ("bumps_drops", 0b01000), 4: ("bumps_drops", 0b00100),
    5: ("bumps_drops", 0b11), 6: ("bumps_drops", 0b10), 7: ("bumps_drops", 0b01), 8: ("virtual_wall", 1),
    9: ("wall", 1), 11: ("cliff_left", 1), 12: ("cliff_front_left", 1), 13: ("cliff_front_right", 1),
    14: ("cliff_right", 1), 15: ("chargers", 0b10), 16: ("buttons", 0b100), 17: ("buttons", 0b001),
    18: ("digital_inputs", 0b0001), 19: ("digital_inputs", 0b0010), 20: ("digital_inputs", 0b0100),
    21: ("digital_inputs", 0b1000),
}  # fmt: skip
_CLIFFS = ("cliff_left", "cliff_front_left", "cliff_front_right", "cliff_right")


def happens(event: int, values: Mapping[str, int]) -> bool:
    """Tell whether an event of command 158 is there; 256 - n is the opposite of n. An unknown one always is."""
    if event > 128:
        return not happens(256 - event, values)
    if event == 10:
        return any(values.get(each, 0) for each in _CLIFFS)
    if event == 22:
        return values.get("mode", 0) == Mode.PASSIVE
    packet, bits = _EVENTS.get(event, ("", 0))
    return not packet or bool(values.get(packet, 0) & bits)


class Wait:
    """One wait that is under way.

    Parameters
    ----------
    way_mm, angle_deg
        What the robot had driven and turned in all when the wait began.
    """

    def __init__(self, command: Command, now_s: float, way_mm: float, angle_deg: float) -> None:
        self._op, self._began_s = command.op, now_s
        self._way_mm, self._angle_deg = way_mm, angle_deg
        self._amount = int.from_bytes(command.data, "big", signed=command.op in (Op.WAIT_DISTANCE, Op.WAIT_ANGLE))

    def over(self, now_s: float, way_mm: float, angle_deg: float, values: Mapping[str, int]) -> bool:
        """Tell whether it has happened."""
        if self._op is Op.WAIT_TIME:
            return now_s - self._began_s >= self._amount / 10.0
        if self._op is Op.WAIT_EVENT:
            return happens(self._amount, values)
        gone = way_mm - self._way_mm if self._op is Op.WAIT_DISTANCE else angle_deg - self._angle_deg
        return gone >= self._amount if self._amount >= 0 else gone <= self._amount
