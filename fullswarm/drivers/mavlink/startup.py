"""From the first heartbeat to a vehicle that may be activated: version, message rates, failsafe, position."""

from __future__ import annotations

from functools import partial

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.codec import StationEncoder
from fullswarm.drivers.mavlink.requests import CommandQueue, EnsureParameter, ReadParameter
from fullswarm.drivers.mavlink.vehicle import Vehicle

STATION = 255
RATES_HZ: dict[int, float] = {
    p.MESSAGE_HEARTBEAT: 4.0,  # the armed bit comes with heartbeats only: 1 Hz would delay every confirmation
    p.MESSAGE_LOCAL_POSITION: 20.0,
    p.MESSAGE_ATTITUDE: 20.0,
    p.MESSAGE_EKF: 2.0,
    p.MESSAGE_BATTERY: 1.0,
}
WATCHED = {p.LocalPosition: p.MESSAGE_LOCAL_POSITION, p.Attitude: p.MESSAGE_ATTITUDE}
WATCH_S = 2.0
LOWEST_HZ = 5.0


class Startup:
    """Asks for what driving needs, sees whether it came, and asks again when it stops coming."""

    def __init__(self, encoder: StationEncoder, *, ekf_ignored: bool) -> None:
        self._encoder, self._ekf_ignored = encoder, ekf_ignored
        self.restart()

    def restart(self) -> None:
        """Begin anew: another boot knows nothing of what was asked before."""
        self._queue = CommandQueue()
        self._rates = dict(RATES_HZ)
        self._counts = dict.fromkeys(WATCHED.values(), 0)
        self._watch_s: float | None = None
        # Written for good into the vehicle's memory: without it a rover that loses us stays armed for ever.
        self._failsafe = EnsureParameter("FS_GCS_ENABLE", 1.0, frozenset((1.0, 2.0)), p.PARAM_INT8)
        self._station = ReadParameter("SYSID_MYGCS")
        self._top_speed = ReadParameter("WP_SPEED")

    @property
    def top_speed_m_s(self) -> float | None:
        """The vehicle's own speed limit, to which it clamps without a word; None if unknown."""
        value = self._top_speed.value
        return value if value is not None and value > 0.0 else None

    def receive(self, body: p.Body) -> None:
        """Take a message of the vehicle."""
        watched = WATCHED.get(type(body))
        if watched is not None:
            self._counts[watched] += 1
        elif isinstance(body, p.Ack):
            self._queue.on_ack(body)
        elif isinstance(body, p.Parameter):
            for each in (self._failsafe, self._station, self._top_speed):
                each.receive(body)

    def tick(self, now_s: float, vehicle: Vehicle) -> list[bytes]:
        """Return the frames that are due."""
        if self._watch_s is None:
            self._watch_s = now_s + WATCH_S
            for message in self._rates:
                self._ask_rate(message)
            self._ask_version()
        elif now_s >= self._watch_s:
            self._watch_rates(now_s, vehicle)
        frames = self._queue.tick(now_s)
        for each in (self._failsafe, self._station, self._top_speed):
            frames += each.tick(now_s, self._encoder)
        return frames

    def _watch_rates(self, now_s: float, vehicle: Vehicle) -> None:
        """Ask again for what does not come: the request was lost, or the vehicle forgot it in a restart."""
        located = vehicle.ekf is not None and vehicle.ekf.good
        for message, count in self._counts.items():
            expected = located or message != p.MESSAGE_LOCAL_POSITION  # no position is sent before there is one
            if expected and self._queue.idle and count < 0.5 * self._rates[message] * WATCH_S:
                self._ask_rate(message)
        if vehicle.version is None and self._queue.idle:
            self._ask_version()
        self._counts = dict.fromkeys(self._counts, 0)
        self._watch_s = now_s + WATCH_S

    def _ask_version(self) -> None:
        make = partial(self._encoder.request_message, p.MESSAGE_VERSION)
        self._queue.ask(p.COMMAND_REQUEST_MESSAGE, make, lambda _: None)

    def _ask_rate(self, message: int) -> None:
        def make(confirmation: int) -> bytes:
            return self._encoder.message_interval(message, self._rates[message], confirmation)

        def done(result: int | None) -> None:
            if result == p.Result.DENIED and self._rates[message] > LOWEST_HZ:  # a slower main loop than usual
                self._rates[message] = max(LOWEST_HZ, self._rates[message] / 2)
                self._ask_rate(message)

        self._queue.ask(p.COMMAND_MESSAGE_INTERVAL, make, done)

    def problem(self, now_s: float, vehicle: Vehicle) -> str:
        """Return what still keeps the vehicle from being READY; empty when nothing does."""
        heartbeat = vehicle.heartbeat
        if heartbeat is None:
            return "no heartbeat yet"
        if heartbeat.custom_mode == p.Mode.INITIALISING:
            return "the autopilot is starting"
        if heartbeat.status == p.STATUS_CRITICAL:
            return f"a failsafe of the autopilot is on{_quoted(vehicle.texts_since(now_s - 30.0))}"
        if not self._failsafe.confirmed:
            silent = self._failsafe.silent_tries > 3
            return "FS_GCS_ENABLE=1 is not confirmed" + (": the vehicle does not answer" if silent else "")
        if self._station.value not in (None, float(STATION)):
            return f"SYSID_MYGCS is {self._station.value:.0f}: its failsafe ignores us; set it to {STATION}"
        if not self._ekf_ignored and (vehicle.ekf is None or not vehicle.ekf.good):
            flags = "unknown" if vehicle.ekf is None else f"{vehicle.ekf.flags:#x}"
            return f"the autopilot does not know its position yet (EKF flags {flags})"
        if vehicle.telemetry_silent(now_s):
            return "no position or attitude is being sent"
        return ""


def _quoted(texts: list[str]) -> str:
    return f": {'; '.join(dict.fromkeys(texts))}" if texts else ""


def unsupported(heartbeat: p.Heartbeat) -> str:
    """Return why this vehicle must not be driven as an ArduPilot rover; empty if it may."""
    if heartbeat.autopilot != p.AUTOPILOT_ARDUPILOT:
        return f"autopilot {heartbeat.autopilot} is not ArduPilot (3); only ArduPilot Rover is supported"
    if heartbeat.vehicle_type not in p.ROVER_TYPES:
        return f"it says it is a vehicle of type {heartbeat.vehicle_type}, not a ground rover (10): not driven"
    return ""
