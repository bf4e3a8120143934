"""A Scout to try the driver on: its firmware and a TCP port, over a body. `fullswarm emulate acme` runs one."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from typing import Self
from urllib.parse import urlsplit

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import STAND, Pose, Twist
from fullswarm.emulators.faults import BadLink, LinkFaults
from fullswarm.simulation.bodies import Body, FreeBody

from fullswarm_acme.protocol import WATCHDOG_S, LineParser, State, line, parse_drive, state
from fullswarm_acme.session import LIMITS

STEP_S = 0.02


class Firmware:
    """What the robot's own computer does: obey lines, ramp, stop by itself after 1 s without DRIVE."""

    def __init__(self, body: Body, boot: int = 1) -> None:
        self.body, self.battery, self.estop = body, 1.0, False
        self.enabled = self.greeted = False
        self._boot, self._start = boot, body.state()
        self._target, self._target_s = STAND, 0.0
        self._speed_m_s = self._turn_rad_s = 0.0

    def obey(self, text: str, now_s: float) -> str:
        """Do what a line says; return the answer, empty if there is none."""
        wished = parse_drive(text)
        if wished is not None:
            self._target, self._target_s = wished, now_s
        elif text == "HELLO":
            self.greeted = True
            return f"ROBOT Scout 2.3 {self._boot}"
        elif text == "ENABLE" and not self.estop:
            self.enabled, self._target = True, STAND
        elif text == "DISABLE":
            self.enabled = False
        return ""

    def step(self, now_s: float) -> str:
        """Turn the motors for one step; return the state."""
        if now_s - self._target_s > WATCHDOG_S or not self.enabled or self.estop:
            self._target = STAND
        wished_m_s = max(0.0, min(self._target.linear_m_s, LIMITS.speed_m_s))  # nothing looks backwards
        self._speed_m_s = _ramp(self._speed_m_s, wished_m_s, LIMITS.accel_m_s2 * STEP_S)
        self._turn_rad_s = _ramp(self._turn_rad_s, self._target.angular_rad_s, LIMITS.turn_accel_rad_s2 * STEP_S)
        self.body.drive(self._speed_m_s, self._turn_rad_s)
        mode = "ESTOP" if self.estop else "ON" if self.enabled else "IDLE"
        now, start = self.body.state(), self._start
        pose = Pose(now.x_m - start.x_m, now.y_m - start.y_m, now.heading_rad)
        return state(State(mode, pose, Twist(now.speed_m_s, now.turn_rad_s), any(now.bumps), self.battery))


def _ramp(now: float, wished: float, step: float) -> float:
    return now + max(-step, min(step, wished - now))


class AcmeEmulator:
    """A Scout behind a TCP port of this machine; a context manager. `url` opens it.

    Parameters
    ----------
    port
        0 takes a free one.
    body
        What the robot drives; alone on an endless floor by default.
    """

    def __init__(self, port: int = 0, body: Body | None = None, clock: Clock | None = None) -> None:
        self._clock = clock or MonotonicClock()
        self.body = body or FreeBody(clock=self._clock)
        self.faults = LinkFaults()
        self._ears, self._mouth = BadLink(self.faults, 1), BadLink(self.faults, 2)
        self._lock = threading.RLock()  # guards all below
        self._boots = 1
        self._firmware, self._parser = Firmware(self.body), LineParser()
        self._muted = self._cut = False
        self._client: socket.socket | None = None
        self._listener: socket.socket | None = _listen(port)
        self._port: int = self._listener.getsockname()[1]
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"emulator {self.url}", daemon=True)

    @property
    def url(self) -> str:
        """What the driver is opened with."""
        return f"acme://127.0.0.1:{self._port}"

    @property
    def motors_on(self) -> bool:
        """Whether it is enabled: it obeys set-points."""
        with self._lock:
            return self._firmware.enabled

    def start(self) -> Self:
        """Switch the robot on."""
        self._thread.start()
        return self

    def close(self) -> None:
        """Switch it off. Closing twice is fine."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self.unplug()
        self.body.drive(0.0, 0.0)

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    # ------------------------------------------------------------ hands
    def unplug(self) -> None:
        """Take it out of the network; it keeps its power."""
        with self._lock:
            self._hang_up()
            if self._listener is not None:
                self._listener.close()
                self._listener = None

    def replug(self) -> None:
        """Put it back, at its old address."""
        with self._lock:
            if self._listener is None:
                self._listener = _listen(self._port)

    def reboot(self) -> None:
        """Restart its computer: motors off, connection gone, counting from zero."""
        with self._lock:
            self._hang_up()
            self._boots += 1
            self._firmware = Firmware(self.body, self._boots)

    def mute(self, on: bool) -> None:
        """Let it hear, but say nothing."""
        with self._lock:
            self._muted = on

    def garbage(self, data: bytes) -> None:
        """Let it say noise."""
        with self._lock:
            self._say(data)

    def cut(self) -> None:
        """Lose the second half of its next line."""
        with self._lock:
            self._cut = True

    def set_battery(self, fraction: float) -> None:
        """Fill its battery to this part."""
        with self._lock:
            self._firmware.battery = fraction

    def press_estop(self, on: bool) -> None:
        """Press or release its red button."""
        with self._lock:
            self._firmware.estop = on
            self._firmware.enabled = False

    # ------------------------------------------------------------ the robot's thread
    def _run(self) -> None:
        next_s = self._clock.now_s()
        while not self._closing.is_set():
            with self._lock:
                ears = [each for each in (self._client, self._listener) if each is not None]
            with contextlib.suppress(OSError, ValueError):  # unplugged between the two lines
                select.select(ears, [], [], max(0.0, min(STEP_S, next_s - self._clock.now_s())))
            with self._lock:
                now_s = self._clock.now_s()
                self._hear(now_s)
                if now_s >= next_s:
                    next_s = max(next_s + STEP_S, now_s)
                    self._speak(self._firmware.step(now_s), now_s)

    def _hear(self, now_s: float) -> None:
        with contextlib.suppress(BlockingIOError):
            if self._client is None and self._listener is not None:
                self._client, _ = self._listener.accept()
                self._client.setblocking(False)
                self._parser, self._firmware.greeted = LineParser(), False
        if self._client is not None:
            try:
                data = self._client.recv(4096)
            except BlockingIOError:
                data = None
            except OSError:
                data = b""
            if data == b"":
                self._hang_up()
            elif data:
                self._ears.put(data, now_s)
        for chunk in self._ears.due(now_s):
            for text in self._parser.feed(chunk):
                answer = self._firmware.obey(text, now_s)
                if answer:
                    self._mouth.put(line(answer), now_s)

    def _speak(self, text: str, now_s: float) -> None:
        said = line(text)
        if self._cut:
            self._cut, said = False, said[: len(said) // 2]
        if self._firmware.greeted:
            self._mouth.put(said, now_s)
        for chunk in self._mouth.due(now_s):
            if not self._muted:
                self._say(chunk)

    def _say(self, data: bytes) -> None:
        if self._client is not None:
            with contextlib.suppress(OSError):
                self._client.send(data)

    def _hang_up(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
        self._ears.clear()
        self._mouth.clear()


def _listen(port: int) -> socket.socket:
    listener = socket.create_server(("127.0.0.1", port))
    listener.setblocking(False)
    return listener


def start(url: str, body: Body) -> AcmeEmulator:
    """Switch on the Scout at the other end of a driver's URL."""
    return AcmeEmulator(urlsplit(url).port or 7700, body).start()
