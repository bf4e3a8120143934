"""Somebody else's client on the emulated ODrive: PyPI's odrive-can, over the emulated serial adapter."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import can
import pytest
from odrive_can.odrive import CanMsg, DriveError, ODriveCAN

from fullswarm.emulators.can.emulator import EmulatedBase

OPTIONS = "interface=slcan&left=1&right=2&wheel_radius=0.05&base=0.3"


async def until(condition: Callable[[], bool], limit_s: float = 2.0) -> None:
    async with asyncio.timeout(limit_s):
        while not condition():
            await asyncio.sleep(0.005)


async def drive(bus: can.BusABC, robot: EmulatedBase) -> None:
    """As the package's own example of velocity control does."""
    axis = ODriveCAN(1, bus)
    told: list[CanMsg] = []
    axis.feedback_callback = lambda message, _: told.append(message)
    await asyncio.wait_for(axis.start(), 2.0)
    try:
        await axis.wait_for_heartbeat()
        axis.check_alive()
        axis.check_errors()
        assert axis.axis_state == "IDLE"
        axis.clear_errors()  # type: ignore[no-untyped-call]  # not annotated there
        axis.set_controller_mode("VELOCITY_CONTROL", "PASSTHROUGH")
        await axis.set_axis_state("CLOSED_LOOP_CONTROL")
        axis.set_input_vel(1.0)
        await until(lambda: bool(told) and told[-1].data["Vel_Estimate"] > 0.99)
        await until(lambda: told[-1].data["Pos_Estimate"] > 0.2)
        assert robot.body.state().turn_rad_s == pytest.approx(-0.1 * 3.14159 / 0.3, rel=0.05)  # one wheel turns
        assert (await axis.get_bus_voltage_current())["Bus_Voltage"] == pytest.approx(29.4)
        assert set(await axis.get_iq()) == {"Iq_Setpoint", "Iq_Measured"}
        # Last, because estimates also come by themselves: the client may keep one for its next answer.
        assert (await axis.get_encoder_estimates())["Vel_Estimate"] == pytest.approx(1.0, rel=0.02)
        robot.press_estop(True)
        await until(lambda: axis.axis_state == "IDLE")
        with pytest.raises(DriveError, match="ESTOP"):
            axis.check_errors()
    finally:
        axis.stop()
        del axis._bus  # its __del__ would shut the bus down, whenever that is


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_odrive_can_drives_the_emulated_base(tmp_path: Path) -> None:
    path = tmp_path / "robot.can"
    with (
        EmulatedBase(f"can+odrive://{path}?{OPTIONS}") as robot,
        can.Bus(interface="slcan", channel=str(path), bitrate=250_000, sleep_after_open=0.0, ignore_config=True) as bus,
    ):
        asyncio.run(drive(bus, robot))
