"""Encoders of both ends, what one frame says, and numbers for it."""

from __future__ import annotations

import math
from typing import Any

from hypothesis import strategies as st

from fullswarm.drivers.mavlink.codec import Encoder, StationEncoder, StreamParser, decode

number = st.floats(-1e4, 1e4, width=32)
angle = st.floats(-math.pi, math.pi)


def station() -> StationEncoder:
    return StationEncoder(255, 190, 1)


def rover() -> Encoder:
    return Encoder(1, 1)


def only(data: bytes) -> Any:
    (message,) = StreamParser().feed(data)
    return message


def body(data: bytes) -> Any:
    received = decode(only(data))
    assert received is not None
    assert (received.system, received.component) == (1, 1)
    return received.body
