"""What is known of one wheel's controller."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fullswarm.drivers.can.kinematics import WheelTrack
from fullswarm.drivers.can.protocol import Beat, Mode, WheelCodec

SILENT_S = 1.0
"""Without a heartbeat for that long a wheel counts as lost."""
BLIND_S = 0.5
"""Without a word on its motion for that long too: an agent does not drive on older readings."""
STUCK_S = 0.5
"""For so long a wheel may tell a speed without counting."""

SILENCE = Beat(Mode.UNKNOWN)


@dataclass(slots=True)
class Axis:
    """One wheel and the newest that its controller has told."""

    side: str
    codec: WheelCodec
    track: WheelTrack
    beat_s: float = -math.inf
    motion_s: float = -math.inf
    beat: Beat = SILENCE
    firmware: str = ""
    volts: float | None = None

    @property
    def name(self) -> str:
        """Return how messages call it."""
        return f"{self.side} wheel (node {self.codec.node})"

    def forget(self) -> None:
        """Begin to listen anew."""
        self.beat_s = self.motion_s = -math.inf

    def complaint(self, now_s: float) -> str:
        """Return what this wheel fails to tell; empty when it is alive."""
        blind = now_s - self.motion_s > BLIND_S
        if now_s - self.beat_s > (BLIND_S / 2.0 if blind else SILENT_S):
            return f"no heartbeat from the {self.name}: check its power, node number and the bus' bitrate"
        if blind:
            return (
                f"no motion from the {self.name}: switch its cyclic messages on "
                "(ODrive: encoder estimates, VESC: CAN status 1 and 5)"
            )
        if self.track.stuck_for(now_s) > STUCK_S:
            return f"the encoder of the {self.name} is stuck: it tells a speed, but its position stays"
        return ""

    def well(self, started_s: float, now_s: float) -> bool:
        """Tell whether it has answered a start sequence in good health."""
        return self.beat_s > started_s and not (self.complaint(now_s) or self.unwell())

    def unwell(self) -> str:
        """Return what keeps it from driving although it is alive; empty: nothing."""
        if self.beat.error:
            return f"{self.name} reports {self.beat.error}"
        return f"{self.name} is busy: {self.beat.state}" if self.beat.mode is Mode.BUSY else ""
