"""The emulated rover's parameters: real names and defaults, a part of the real 1278. Unknown names: silence."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.codec import dialect

NO_INDEX = 65535
INT8, INT16, INT32 = p.PARAM_INT8, 4, 6
RATES = ("RAW_SENS", "EXT_STAT", "RC_CHAN", "RAW_CTRL", "POSITION", "EXTRA1", "EXTRA2", "EXTRA3", "PARAMS")
DEFAULTS: dict[str, float] = {
    "SYSID_THISMAV": 1, "SYSID_MYGCS": 255, "SYSID_ENFORCE": 0, "FS_ACTION": 2, "FS_TIMEOUT": 1.5, "FS_THR_ENABLE": 1,
    "FS_GCS_ENABLE": 0, "FS_GCS_TIMEOUT": 5, "FS_CRASH_CHECK": 0, "FS_EKF_ACTION": 1, "FS_EKF_THRESH": 0.8,
    "INITIAL_MODE": 0, "ARMING_CHECK": 1, "RC_OVERRIDE_TIME": 3, "CRUISE_SPEED": 3, "CRUISE_THROTTLE": 75,
    "WP_SPEED": 3, "WP_RADIUS": 2, "ATC_ACCEL_MAX": 1, "ATC_DECEL_MAX": 0, "ATC_BRAKE": 1, "ATC_SPEED_P": 0.1,
    "ATC_SPEED_I": 0.2, "ATC_STOP_SPEED": 0.1, "ATC_STR_RAT_MAX": 120, "ATC_STR_ACC_MAX": 120, "ATC_STR_RAT_FF": 0.2,
    "ATC_STR_RAT_P": 0.2, "ATC_STR_RAT_I": 0.2, "ATC_TURN_MAX_G": 0.6, "MOT_SLEWRATE": 100, "SCHED_LOOP_RATE": 50,
    "SERIAL0_PROTOCOL": 2, "SERIAL1_PROTOCOL": 2, "SERIAL2_PROTOCOL": 2, "BATT_MONITOR": 4, "VISO_TYPE": 0,
    "EK3_ENABLE": 1, "EK3_SRC1_POSXY": 3, "EK3_SRC1_VELXY": 3, "EK3_SRC1_POSZ": 1, "EK3_SRC1_VELZ": 3,
    "EK3_SRC1_YAW": 1, "SIM_GPS_DISABLE": 0, **{f"SR{port}_{name}": 1.0 for port in (0, 1) for name in RATES},
}  # fmt: skip
KINDS = {
    "FS_ACTION": INT8, "FS_GCS_ENABLE": INT8, "FS_THR_ENABLE": INT8, "FS_CRASH_CHECK": INT8, "FS_EKF_ACTION": INT8,
    "INITIAL_MODE": INT8, "CRUISE_THROTTLE": INT8, "VISO_TYPE": INT8, "EK3_ENABLE": INT8, "EK3_SRC1_POSXY": INT8,
    "EK3_SRC1_VELXY": INT8, "EK3_SRC1_POSZ": INT8, "EK3_SRC1_VELZ": INT8, "EK3_SRC1_YAW": INT8, "BATT_MONITOR": INT8,
    "SYSID_THISMAV": INT16, "SYSID_MYGCS": INT16, "SYSID_ENFORCE": INT8, "MOT_SLEWRATE": INT16,
    "SCHED_LOOP_RATE": INT16, "SERIAL0_PROTOCOL": INT8, "SERIAL1_PROTOCOL": INT8, "SERIAL2_PROTOCOL": INT8,
    "ARMING_CHECK": INT32, "SIM_GPS_DISABLE": INT8,
}  # fmt: skip


def fresh() -> dict[str, float]:
    """Return a new vehicle's parameters."""
    return {name: float(value) for name, value in DEFAULTS.items()}


def answer(parameters: dict[str, float], message: Any) -> Any | None:
    """Return the answer to PARAM_REQUEST_READ, by name or by index; None: silence."""
    names = list(parameters)
    if message.param_index >= 0:
        known = message.param_index < len(names)
        return value_of(parameters, names[message.param_index], message.param_index) if known else None
    return value_of(parameters, message.param_id) if message.param_id in parameters else None


def store(parameters: dict[str, float], message: Any) -> Any | None:
    """Take PARAM_SET, whatever the value as long as it is a number; return the echo, None: silence."""
    if message.param_id not in parameters or not math.isfinite(message.param_value):
        return None
    parameters[message.param_id] = message.param_value
    return value_of(parameters, message.param_id)


def listing(parameters: dict[str, float]) -> Iterator[Any]:
    """Yield the answers to PARAM_REQUEST_LIST."""
    for index, name in enumerate(list(parameters)):
        yield value_of(parameters, name, index)


def value_of(parameters: dict[str, float], name: str, index: int = NO_INDEX) -> Any:
    """Return PARAM_VALUE: any type travels as a plain float."""
    kind = KINDS.get(name, p.PARAM_REAL32)
    return dialect().MAVLink_param_value_message(name.encode("ascii"), parameters[name], kind, len(parameters), index)
