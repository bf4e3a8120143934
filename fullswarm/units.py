"""Units by the end of a name: ``speed_m_s`` is in m/s."""

from __future__ import annotations

UNITS = {
    "_m_s2": "m/s²",
    "_m_s": "m/s",
    "_rad_s2": "rad/s²",
    "_rad_s": "rad/s",
    "_per_s": "1/s",
    "_m2": "m²",
    "_m": "m",
    "_rad": "rad",
    "_s": "s",
    "_hz": "Hz",
    "_j": "J",
    "_wh": "Wh",
    "_kg": "kg",
}
"""The longer ends first."""


def unit_of(name: str) -> str:
    """Return the unit that a name ends with; empty: a count, a share or a text."""
    return next((unit for end, unit in UNITS.items() if name.endswith(end)), "")
