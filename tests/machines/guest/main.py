"""Try each device and say the facts, one JSON document a line, on the second serial port."""

from __future__ import annotations

import json
import subprocess
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.machines.guest import can_bus, joystick, serial_robot

MODULES = {
    "joystick": ("uinput", "evdev", "joydev"),
    "can_bus": ("vcan", "can_raw"),
    "serial_robot": ("dummy_hcd", "cdc_acm", "usb_f_acm", "g_serial"),
}
PARTS: dict[str, Callable[[], dict[str, Any]]] = {
    "joystick": joystick.facts,
    "can_bus": can_bus.facts,
    "serial_robot": serial_robot.facts,
}


def main() -> None:
    """Try all, whatever becomes of one."""
    with Path("/dev/ttyS1").open("w") as out:
        for name, part in PARTS.items():
            began_s = time.monotonic()
            try:
                for module in MODULES[name]:
                    subprocess.run(["modprobe", module], check=True)
                said: dict[str, Any] = {"facts": part()}
            except Exception:  # the test shows it
                said = {"error": traceback.format_exc()}
            took_s = round(time.monotonic() - began_s, 1)
            out.write(json.dumps({"part": name, "took_s": took_s, "uptime_s": round(_uptime_s(), 1), **said}) + "\n")
            out.flush()


def _uptime_s() -> float:
    return float(Path("/proc/uptime").read_text().split()[0])


if __name__ == "__main__":
    main()
