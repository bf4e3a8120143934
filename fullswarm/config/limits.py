"""Ranges that fleet files, the core's database, requests and robots hold to alike: (least, greatest)."""

from __future__ import annotations

SAFETY_MARGIN_M = (0.0, 1.0)
BARRIER_GAIN_PER_S = (0.01, 20.0)
SPEED_LIMIT_M_S = (0.01, 10.0)
TURN_LIMIT_RAD_S = (0.01, 20.0)
HEARING_M = (0.0, 1000.0)
EXPIRES_S = (0.0, 60.0)
