"""What the numbers in an ODrive's heartbeat mean: axis states and error bits, which differ between 0.5 and 0.6."""

from __future__ import annotations

import enum

from fullswarm.drivers.can.odrive import Firmware


class AxisState(enum.IntEnum):
    """What an axis does."""

    UNDEFINED = 0
    IDLE = 1
    STARTUP_SEQUENCE = 2
    FULL_CALIBRATION = 3
    MOTOR_CALIBRATION = 4
    ENCODER_INDEX_SEARCH = 6
    ENCODER_OFFSET_CALIBRATION = 7
    CLOSED_LOOP = 8
    LOCKIN_SPIN = 9
    ENCODER_DIR_FIND = 10
    HOMING = 11


_STATE_NAMES = {int(state): state.name for state in AxisState}

ERRORS: dict[Firmware, dict[int, str]] = {
    "0.5": {
        0x1: "INVALID_STATE",
        0x2: "DC_BUS_UNDER_VOLTAGE",
        0x4: "DC_BUS_OVER_VOLTAGE",
        0x8: "CURRENT_MEASUREMENT_TIMEOUT",
        0x10: "BRAKE_RESISTOR_DISARMED",
        0x20: "MOTOR_DISARMED",
        0x40: "MOTOR_FAILED",
        0x80: "SENSORLESS_ESTIMATOR_FAILED",
        0x100: "ENCODER_FAILED",
        0x200: "CONTROLLER_FAILED",
        0x800: "WATCHDOG_TIMER_EXPIRED",
        0x1000: "MIN_ENDSTOP_PRESSED",
        0x2000: "MAX_ENDSTOP_PRESSED",
        0x4000: "ESTOP_REQUESTED",
        0x20000: "HOMING_WITHOUT_ENDSTOP",
        0x40000: "OVER_TEMP",
        0x80000: "UNKNOWN_POSITION",
    },
    "0.6": {
        0x1: "INITIALIZING",
        0x2: "SYSTEM_LEVEL",
        0x4: "TIMING_ERROR",
        0x8: "MISSING_ESTIMATE",
        0x10: "BAD_CONFIG",
        0x20: "DRV_FAULT",
        0x40: "MISSING_INPUT",
        0x100: "DC_BUS_OVER_VOLTAGE",
        0x200: "DC_BUS_UNDER_VOLTAGE",
        0x400: "DC_BUS_OVER_CURRENT",
        0x800: "DC_BUS_OVER_REGEN_CURRENT",
        0x1000: "CURRENT_LIMIT_VIOLATION",
        0x2000: "MOTOR_OVER_TEMP",
        0x4000: "INVERTER_OVER_TEMP",
        0x8000: "VELOCITY_LIMIT_VIOLATION",
        0x10000: "POSITION_LIMIT_VIOLATION",
        0x1000000: "WATCHDOG_TIMER_EXPIRED",
        0x2000000: "ESTOP_REQUESTED",
        0x4000000: "SPINOUT_DETECTED",
        0x8000000: "BRAKE_RESISTOR_DISARMED",
        0x10000000: "THERMISTOR_DISCONNECTED",
        0x40000000: "CALIBRATION_ERROR",
    },
}


def error_names(bits: int, firmware: Firmware) -> str:
    """Return the names of the error bits, an unknown bit as its number; empty for none."""
    known = ERRORS[firmware]
    set_bits = (1 << shift for shift in range(32) if bits >> shift & 1)
    return ", ".join(known.get(bit, f"error bit {bit:#x}") for bit in set_bits)


def error_bit(name: str, firmware: Firmware) -> int:
    """Return the bit of a named error; ``KeyError`` for an unknown name."""
    return {text: bit for bit, text in ERRORS[firmware].items()}[name]


def state_name(state: int) -> str:
    """Return the name of an axis state, an unknown one as its number."""
    return _STATE_NAMES.get(state, f"state {state}")
