"""Measures the fault matrix on live processes and writes docs/safety.md: ``python -m benchmarks.fault_matrix``.

Two minutes. `--check` prints the table and writes nothing.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.system.fault_matrix import BACKENDS, BATTERY_S, DEVICE_S, FAULTS, Fault, Result, full_rounds
from tests.system.fault_rounds import Matrix

DOCS = Path(__file__).parent.parent / "docs" / "safety.md"
SILENCE_S = 0.32
SILENCES = ("command time-to-live", "hub lost", "estimator silent", "clock jump", "frozen simulation clock")
REFLEXES = ("bump", "cliff", "wheel drop", "low battery", "geofence")

HEAD = """# Safety: the fault matrix, measured

This page is written by `python -m benchmarks.fault_matrix`; do not edit it. `make test-all` measures the same and
judges it (`tests/system/test_reflexes.py`). What each reflex is and why: [how a robot comes to
stand](explanation-safety-stops.md). The process that watches over an agent: [decision 14](decisions/0014-guardian.md).

Five robots drive at 0.35 m/s in one kinematic world: real agents, real drivers, real ports, emulated firmware. Then a
process is killed, a cable pulled, a sensor pressed. Each cell: **time until the device's own set-point is zero** · time
until the body stands (below 0.02 m/s) · metres that it went meanwhile. Command time-to-live 0.3 s, core heartbeat 1 s,
control period 0.02 s; `reading_timeout_s = 0.3`. The world is looked at each 5 ms.

"""

FOOT = """
## What cannot be had

- **Create, cable pulled**: it has no watchdog and no command reaches it. It moves on until the cable is back
  (then its first words are zero). Only its own bumper, cliff and wheel-drop reflexes stop it before.
- **Create, computer without power, or agent and guardian killed together**: the same. One of them alone is covered;
  a guardian that is killed is replaced within about half a second, which the robot drives on.
- **Cable pulled, computer without power, or agent and guardian killed together, other makes**: only the device's own
  time-out is left ({devices}). No software on board makes that shorter.
- **A rover whose agent is killed** receives HOLD: its motors are off, and it coasts to a standstill.
- **A rover** brakes by its firmware's own acceleration limit, so it stands late although its set-point is zero.
- **A low battery** is detected when the robot reports it: {battery}.
- Sensors that a make does not have (—) trigger nothing.
- A **core heartbeat** that is silent counts as lost after `core_silence_s`, 1 s as configured.
- An **e-stop** takes the bus's way, not a period.

These are emulators. Measure your robot on a stand before you trust a figure.
"""


def _number(value: float, unit: str) -> str:
    return "never" if math.isinf(value) else f"{value:.2f} {unit}"


def cell(fault: Fault, robot: str, results: dict[tuple[str, str], Result]) -> str:
    """Return one cell of the table."""
    result = results.get((fault.name, BACKENDS[robot]))
    if result is None:
        return "—" if robot not in fault.robots else "not measured"
    if math.isinf(result.zero_s):
        return "**never**, rolls on"
    return f"**{result.zero_s:.2f} s** · {_number(result.rest_s, 's')} · {result.distance_m:.2f} m"


def table(measured: Sequence[Result]) -> str:
    """Return the table in Markdown, and what follows from it."""
    results = {(each.fault, each.backend): each for each in measured}
    lines = [f"| fault | {' | '.join(BACKENDS.values())} |", f"|---|{'---|' * len(BACKENDS)}"]
    lines += [
        f"| {fault.name} | {' | '.join(cell(fault, robot, results) for robot in BACKENDS)} |"
        for fault in FAULTS.values()
    ]
    lines += ["", "Which means, worst cell over all makes:", ""]
    for title, names, bound in (
        ("every silence (command, hub, readings, clock)", SILENCES, f"{SILENCE_S} s"),
        ("core heartbeat", ("core heartbeat",), "1.02 s"),
        ("reflexes", REFLEXES, "one sensor period + 0.02 s"),
        ("agent SIGKILL and SIGSTOP of robots with a guardian, and a simulated one", ("agent SIGKILL", "agent SIGSTOP"),
         "0.36 s"),
    ):  # fmt: skip
        own = ("sim", "create2", "rover", "vesc") if names[0].startswith("agent") else tuple(BACKENDS.values())
        worst_s = max((each.zero_s for each in measured if each.fault in names and each.backend in own), default=0.0)
        lines.append(f"- {title}: zero after {worst_s:.3f} s (bound: {bound})")
    lines.append(f"- nearest to its own bound: {nearest(measured)}")
    lines += ["", "Remarks:", ""]
    for fault in FAULTS.values():
        remarks = dict.fromkeys(fault.notes.values())
        lines += [f"- {fault.name}: {_who(fault, text)}{text}" for text in remarks]
        lines += [f"- {fault.name}, —: {fault.lacking}"] if fault.lacking else []
    return "\n".join(lines) + "\n"


def nearest(measured: Sequence[Result]) -> str:
    """Say which cell has the least to spare; one below zero missed its bound."""
    cell = min((each for each in measured if math.isfinite(each.zero_s)), key=lambda each: each.bound_s - each.zero_s)
    return f"{cell.fault}, {cell.backend}, zero after {cell.zero_s:.3f} s (bound: {cell.bound_s:.3f} s)"


def _who(fault: Fault, text: str) -> str:
    robots = [BACKENDS[robot] for robot, note in fault.notes.items() if note == text]
    return "" if len(robots) == len(BACKENDS) else f"{', '.join(robots)}: "


def measure() -> list[Result]:
    """Run all rounds."""
    matrix, results = Matrix(), list[Result]()
    try:
        for happens in full_rounds():
            results += matrix.run(happens)
            sys.stderr.write(f"{next(iter(happens.values()))}: done\n")
    finally:
        matrix.close()
    return results


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, write; 1 if a bound is missed by more than the 0.05 s that a busy machine may take."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing")
    write = not parser.parse_args(arguments).check
    measured = measure()
    text = table(measured)
    devices = ", ".join(f"{BACKENDS[robot]} {wait_s:g} s" for robot, wait_s in DEVICE_S.items() if wait_s < math.inf)
    reported = ", ".join(f"{BACKENDS[robot]} each {period_s:g} s" for robot, period_s in BATTERY_S.items())
    sys.stdout.write(text)
    if write:
        DOCS.write_text(f"{HEAD}{text}{FOOT.format(devices=devices, battery=reported)}", encoding="utf-8")
    missed = [each for each in measured if each.zero_s > each.bound_s + 0.05]
    sys.stderr.writelines(f"missed: {each}\n" for each in missed)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
