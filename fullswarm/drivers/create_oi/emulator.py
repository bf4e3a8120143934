"""A Create on a pseudo-terminal: :class:`.firmware.Firmware` behind a real port, over a body.

The port's path is a link that outlives an unplugging, as ``/dev/serial/by-id`` does. The emulator reads the rate
that the other side has set: at a wrong one it hears nothing and sends garbage.
"""

from __future__ import annotations

import fcntl
import math
import os
import select
import struct
import tempfile
import termios
import threading
import tty
from pathlib import Path
from types import TracebackType

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import Pose
from fullswarm.drivers.create_oi.firmware import Body, Firmware, Quirks
from fullswarm.drivers.create_oi.protocol import CREATE2, Generation, Mode
from fullswarm.geometry import wrap

__all__ = ["Body", "CreateEmulator", "FreeBody", "Quirks"]

STEP_S = 0.005
LATE_BYTES = 4096
"""A reader who lets more than this pile up loses what follows, as with a real port's buffer."""

_NOISE = bytes((each * 149 + 71) & 0xFF for each in range(256))


class FreeBody:
    """A body alone on an endless floor: the wheels do at once what they are told. Thread-safe."""

    def __init__(self, wheel_base_m: float = CREATE2.wheel_base_m, clock: Clock | None = None) -> None:
        self._base_m = wheel_base_m
        self._clock = clock or MonotonicClock()
        self._lock = threading.Lock()
        self._stamp_s = self._clock.now_s()
        self._speeds = (0.0, 0.0)
        self._rolled = (0.0, 0.0)
        self._x_m = self._y_m = self._heading_rad = 0.0
        self._bumps = (False, False)

    @property
    def wheels(self) -> tuple[float, float]:
        """Left and right wheel now, m/s."""
        with self._lock:
            return self._speeds

    @property
    def pose(self) -> Pose:
        """Where the body truly is; starts at (0, 0, 0)."""
        with self._lock:
            self._go_on()
            return Pose(self._x_m, self._y_m, wrap(self._heading_rad))

    def set_wheels(self, left_m_s: float, right_m_s: float) -> None:
        """Turn the wheels from now on."""
        with self._lock:
            self._go_on()
            self._speeds = (left_m_s, right_m_s)

    def travelled(self) -> tuple[float, float]:
        """Return how far the wheels have rolled, metres."""
        with self._lock:
            self._go_on()
            return self._rolled

    def bumped(self) -> tuple[bool, bool]:
        """Tell which halves of the bumper are pressed."""
        with self._lock:
            return self._bumps

    def press(self, left: bool, right: bool) -> None:
        """Press or release the bumper; nothing stops the body, there is nothing in its way."""
        with self._lock:
            self._bumps = (left, right)

    def push(self, left_m: float, right_m: float) -> None:
        """Roll the wheels by hand."""
        with self._lock:
            self._go_on()
            self._roll(left_m, right_m)

    def _go_on(self) -> None:
        now_s = self._clock.now_s()
        passed_s, self._stamp_s = now_s - self._stamp_s, now_s
        self._roll(self._speeds[0] * passed_s, self._speeds[1] * passed_s)

    def _roll(self, left_m: float, right_m: float) -> None:
        forward, turn = (left_m + right_m) / 2.0, (right_m - left_m) / self._base_m
        middle = self._heading_rad + turn / 2.0
        self._x_m += forward * math.cos(middle)
        self._y_m += forward * math.sin(middle)
        self._heading_rad += turn
        self._rolled = (self._rolled[0] + left_m, self._rolled[1] + right_m)


class CreateEmulator:
    """A robot to plug a driver into. A context manager; `url` opens it.

    Parameters
    ----------
    generation, body
        Which robot, and what it stands on; a :class:`FreeBody` by default.
    quirks, encoders
        See :class:`~.firmware.Firmware`.
    """

    def __init__(
        self,
        generation: Generation = CREATE2,
        body: Body | None = None,
        *,
        quirks: Quirks | None = None,
        encoders: tuple[int, int] = (0, 0),
        clock: Clock | None = None,
    ) -> None:
        self.generation = generation
        self._clock = clock or MonotonicClock()
        self.body = body or FreeBody(generation.wheel_base_m, self._clock)
        self._firmware = Firmware(generation, self.body, quirks=quirks, encoders=encoders)
        self._folder = tempfile.TemporaryDirectory(prefix="create-")
        self.port = str(Path(self._folder.name) / "port")
        self._lock = threading.Lock()  # guards the firmware, the pty and the switches
        self._master: int | None = None
        self._slave: int | None = None
        self._stuck = self._closed = False
        self._wake_r, self._wake_w = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self.replug()
        self._thread = threading.Thread(target=self._run, name=f"emulator {self.port}", daemon=True)
        self._thread.start()

    def __enter__(self) -> CreateEmulator:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def url(self) -> str:
        """What the driver is opened with."""
        return f"create://{self.port}?model={self.generation.name}"

    @property
    def mode(self) -> Mode:
        """The mode that the robot is in."""
        with self._lock:
            return self._firmware.mode

    def set_cliff(
        self, left: bool = False, front_left: bool = False, front_right: bool = False, right: bool = False
    ) -> None:
        """Take the floor away under these sensors, give it back to the others."""
        with self._lock:
            self._firmware.cliffs = [left, front_left, front_right, right]

    def set_wheel_drop(self, left: bool = False, right: bool = False) -> None:
        """Let wheels hang."""
        with self._lock:
            self._firmware.drops = [left, right]

    def set_charger(self, plugged: bool) -> None:
        """Plug the charger in or out."""
        with self._lock:
            self._firmware.charger = plugged

    def set_overcurrent(self, left: bool = False, right: bool = False) -> None:
        """Let wheel motors draw too much."""
        with self._lock:
            self._firmware.overcurrents = right << 3 | left << 4

    def set_charge(self, fraction: float) -> None:
        """Fill the battery to this part of its capacity."""
        with self._lock:
            self._firmware.charge_mah = round(fraction * self._firmware.capacity_mah)

    def set_stuck(self, stuck: bool) -> None:
        """Let the robot hear, but say nothing; it goes on driving."""
        with self._lock:
            self._stuck = stuck

    def unplug(self) -> None:
        """Pull the cable. The robot keeps its power, its mode and its speed, as a real one does."""
        with self._lock:
            self._hang_up()

    def replug(self) -> None:
        """Put the cable back; the port has its old path."""
        with self._lock:
            if self._master is not None:
                return
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)  # or the terminal echoes the robot's words back to it
            os.set_blocking(self._master, False)
            Path(self.port).symlink_to(os.ttyname(self._slave))
        self._wake()

    def close(self) -> None:
        """Switch the robot off and remove its port. Closing twice is fine."""
        if self._closed:
            return
        self._closed = True
        self._wake()
        self._thread.join()
        self.unplug()
        self.body.set_wheels(0.0, 0.0)
        os.close(self._wake_r)
        os.close(self._wake_w)
        self._folder.cleanup()

    # ------------------------------------------------------------ the robot's thread
    def _run(self) -> None:
        while not self._closed:
            master = self._master
            ears = [self._wake_r] if master is None else [self._wake_r, master]
            try:
                ready, _, _ = select.select(ears, [], [], STEP_S)
            except (OSError, ValueError):
                continue  # unplugged between the two lines
            if self._wake_r in ready:
                os.read(self._wake_r, 4096)
            with self._lock:
                self._turn()

    def _turn(self) -> None:
        now_s = self._clock.now_s()
        baud = self._baud()
        heard = self._hear()
        if baud == self.generation.baud:
            said = self._firmware.receive(heard, now_s) + self._firmware.step(now_s, self.generation.budget(baud))
        else:  # bits of another length: each side hears noise, which a robot ignores
            said = (heard + self._firmware.step(now_s)).translate(_NOISE)
        if said and not self._stuck:
            self._say(said)

    def _baud(self) -> int:
        if self._master is None:
            return self.generation.baud
        speed = termios.tcgetattr(self._master)[5]
        return next((rate for rate in (19200, 57600, 115200) if getattr(termios, f"B{rate}") == speed), 0)

    def _hear(self) -> bytes:
        if self._master is None:
            return b""
        try:
            return os.read(self._master, 4096)
        except BlockingIOError:
            return b""

    def _say(self, data: bytes) -> None:
        if self._master is None or self._slave is None:
            return
        (waiting,) = struct.unpack("i", fcntl.ioctl(self._slave, termios.FIONREAD, b"\0" * 4))
        if waiting > LATE_BYTES:
            return
        try:
            os.write(self._master, data)
        except BlockingIOError:
            return

    def _hang_up(self) -> None:
        if self._master is None or self._slave is None:
            return
        Path(self.port).unlink()
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = None

    def _wake(self) -> None:
        try:
            os.write(self._wake_w, b"\0")
        except BlockingIOError:
            return
