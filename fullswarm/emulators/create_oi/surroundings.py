"""Holds what an emulated Create's light, infrared and cliff sensors see, and returns their packets' values.

Source: Create 2 and Create Open Interface specifications, packets 8, 13, 15, 17, 27 to 31, 45 to 53. These give the
ranges of the signals but no thresholds; those here lie well above the noise that a free sensor shows.
"""

from __future__ import annotations

from dataclasses import dataclass

from fullswarm.drivers.create_oi.protocol import Generation

FLOOR_SIGNAL, NO_FLOOR_SIGNAL = 2600, 12
"""What a cliff sensor measures over a light floor, and over none; its range is 0 to 4095."""
WALL_NEAR, LIGHT_NEAR = 60, 150
"""From these signals on the wall and the light bumper bits are set."""
VIRTUAL_WALL_BYTE = 162
"""What a virtual wall (force field) sends to the infrared receivers."""
MAX_WALL, MAX_LIGHT = 1023, 4095
_CLIFFS = ("left", "front_left", "front_right", "right")
_LIGHTS = ("left", "front_left", "centre_left", "centre_right", "front_right", "right")


@dataclass(slots=True)
class Surroundings:
    """What is around the robot now."""

    wall_signal: int = 0  # 0 to 1023: reflection at its right-hand side
    light_signals: tuple[int, int, int, int, int, int] = (0, 0, 0, 0, 0, 0)  # 0 to 4095, left to right
    infrared: tuple[int, int, int] | None = None  # bytes at the omnidirectional, left, right receiver; None: none
    virtual_wall: bool = False
    dirt: int = 0  # 0 to 255

    def values(self, generation: Generation, cliffs: list[bool]) -> dict[str, int]:
        """Return the packets' values; `cliffs` tells where the floor is gone: left, front left, front right, right."""
        nothing = 0 if generation.m_per_count is not None else 255  # a Create 1 says 255 for no infrared byte
        omni, left, right = self.infrared or (nothing, nothing, nothing)
        if self.virtual_wall and self.infrared is None:
            omni = VIRTUAL_WALL_BYTE if generation.m_per_count is not None else omni
        signals = {f"light_{name}": value for name, value in zip(_LIGHTS, self.light_signals, strict=True)}
        return {
            "wall": int(self.wall_signal >= WALL_NEAR),
            "wall_signal": self.wall_signal,
            "virtual_wall": int(self.virtual_wall),
            "dirt": self.dirt,
            "ir_omni": omni,
            "ir_left": left,
            "ir_right": right,
            "light_bumper": sum(1 << bit for bit, each in enumerate(self.light_signals) if each >= LIGHT_NEAR),
            **signals,
            **{f"cliff_{name}": int(gone) for name, gone in zip(_CLIFFS, cliffs, strict=True)},
            **{
                f"cliff_{name}_signal": NO_FLOOR_SIGNAL if gone else FLOOR_SIGNAL
                for name, gone in zip(_CLIFFS, cliffs, strict=True)
            },
        }
