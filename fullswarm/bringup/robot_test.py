"""`fullswarm robots test URL`: drives one robot a short way, slowly, and reports whether it follows the driver.

Each step gives a verdict. Whatever ends the test, Ctrl-C and a closed terminal included, the wheels are commanded zero
first; should this process be killed, the robot's watchdog stops them, or the guardian of one that has none.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import asdict

from rich.markup import escape
from rich.table import Table

from fullswarm import output, registry
from fullswarm.bringup.bench import Bench
from fullswarm.bringup.robot_test_steps import Step, steps
from fullswarm.clock import MonotonicClock
from fullswarm.drivers.base import STAND, Description, Driver, Lifecycle
from fullswarm.drivers.guardian import guarded
from fullswarm.errors import ConfigError
from fullswarm.launch.typed import Typed
from fullswarm.runtime import Runtime

ON_THE_FLOOR = """Put the robot on the floor with 0.5 m of free room on all sides, away from edges, off its charger.
(In the air its wheel-drop and cliff sensors would not let it drive.)"""
NO_WATCHDOG = "Should this computer die or the cable come off, the robot drives on: keep a hand at its switch."
IN_THE_AIR = """Jack the robot up so that no wheel touches the ground, and keep hands and cables away."""


def run(url: str, *, speed_m_s: float, confirmed: bool, ready_s: float, as_json: bool) -> int:
    """Test the robot at `url`; return 0 when nothing failed, else 1.

    Parameters
    ----------
    confirmed
        Skip the confirmation prompt: it is safe to drive.
    ready_s
        How long it may take to be READY.

    Raises
    ------
    ConfigError
        The URL is wrong, the speed is beyond the robot's, or no confirmation.
    DriverError
        The port cannot be had.
    """
    driver: Driver = guarded(registry.driver_class(url)(url))
    description = driver.description
    if speed_m_s > description.limits.speed_m_s:
        hint = f"its limit is {description.limits.speed_m_s:.2f} m/s"
        raise ConfigError(f"{speed_m_s} m/s is too fast for this robot", where="--speed", hint=hint)
    clock = MonotonicClock()
    runtime = Runtime(clock)
    runtime.stop_on_signals()
    bench = Bench(driver, runtime, None if confirmed else Typed())
    output.progress(_explain(description, speed_m_s))
    if not confirmed and not _agreed(bench):
        output.progress("nothing was opened, nothing moved")
        return 1
    done: list[Step] = []
    hertz: list[float] = []
    with _stopped_at_the_end(driver):
        driver.open()
        for step in steps(bench, clock, speed_m_s, ready_s, hertz):
            done.append(step)
            output.progress(f"{step.verdict:8} {step.name}: {step.what}")
        firmware, battery = driver.firmware, bench.newest.battery if bench.newest else None
        description = driver.description  # a rover reports its autopilot only now
    done.append(_closed(driver))
    passed = all(each.verdict != "failed" for each in done)
    if as_json:
        output.data_json(
            {
                "url": url,
                "make": description.make,
                "model": description.model,
                "firmware": firmware,
                "battery": battery,
                "readings_hz": hertz[0] if hertz else None,
                "passed": passed,
                "steps": [asdict(each) for each in done],
            }
        )
    else:
        output.data_table(_table(done))
        output.data(f"{description.make} {description.model}: {'passed' if passed else 'FAILED'}")
    return 0 if passed else 1


@contextlib.contextmanager
def _stopped_at_the_end(driver: Driver) -> Iterator[None]:
    """Stop the wheels first, then leave the robot in its safe state, whatever ends the test."""
    with contextlib.ExitStack() as end:  # from the last to the first, and each even if another fails
        end.callback(driver.close)
        end.callback(driver.deactivate)
        end.callback(driver.command, STAND)
        try:
            yield
        except KeyboardInterrupt:
            driver.command(STAND)
            output.progress("stopping the wheels, then closing")
            raise


def _explain(description: Description, speed_m_s: float) -> str:
    limits = description.limits
    watchdog = "none" if description.watchdog_s is None else f"{description.watchdog_s:g} s"
    alone = "" if description.watchdog_s else f"{NO_WATCHDOG}\n"
    place = ON_THE_FLOOR if description.senses_bumps else IN_THE_AIR
    return (
        f"{description.make} {description.model}: up to {limits.speed_m_s:.2f} m/s, {limits.turn_rad_s:.2f} rad/s; "
        f"its own watchdog: {watchdog}\n"
        f"It will drive forwards, backwards, left and right, a second or two each, its wheels at {speed_m_s:g} m/s.\n"
        f"{alone}{place}\nCtrl-C stops the wheels at any time."
    )


def _agreed(bench: Bench) -> bool:
    agreed = bench.answers("Is it safe to drive?")
    if agreed is None:
        raise ConfigError("not confirmed that it is safe to drive", hint="answer y, or skip the prompt with --yes")
    return agreed


def _closed(driver: Driver) -> Step:
    closed = driver.state is Lifecycle.CLOSED
    return Step("close", "passed" if closed else "failed", str(driver.state))


def _table(steps: list[Step]) -> Table:
    table = Table("step", "verdict", "what", box=None, padding=(0, 2, 0, 0), header_style="bold")
    for each in steps:
        verdict = f"[bold red]{each.verdict}[/]" if each.verdict == "failed" else each.verdict
        table.add_row(escape(each.name), verdict, escape(each.what))
    return table
