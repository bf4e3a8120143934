"""From the first heartbeat to a vehicle that may be activated: version, message rates, failsafe, position."""

from __future__ import annotations

from functools import partial

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.autopilot import Autopilot
from fullswarm.drivers.mavlink.codec import StationEncoder
from fullswarm.drivers.mavlink.requests import CommandQueue, EnsureParameter, ReadParameter
from fullswarm.drivers.mavlink.vehicle import Vehicle
from fullswarm.reasons import NONE, Code, Reason, given

RATES_HZ: dict[int, float] = {
    p.MESSAGE_HEARTBEAT: 4.0,  # the armed bit comes with heartbeats only: 1 Hz would delay every confirmation
    p.MESSAGE_LOCAL_POSITION: 20.0,
    p.MESSAGE_ATTITUDE: 20.0,
    p.MESSAGE_BATTERY: 1.0,
    p.MESSAGE_SYS_STATUS: 4.0,  # the safety switch
    p.MESSAGE_GPS: 10.0,  # receivers fix at 5 Hz: a lost fix is seen 0.1 s later at most
}
ESTIMATOR_HZ = 5.0
WATCHED = {
    p.LocalPosition: p.MESSAGE_LOCAL_POSITION, p.Attitude: p.MESSAGE_ATTITUDE, p.SatelliteFix: p.MESSAGE_GPS,
}  # fmt: skip
WATCH_S = 2.0
LOWEST_HZ = 5.0


class Startup:
    """Asks for what driving needs, sees whether it came, and asks again when it stops coming.

    Parameters
    ----------
    external
        Whether the vehicle is to be located from outside; its parameters are then checked.
    """

    def __init__(
        self, encoder: StationEncoder, autopilot: Autopilot, *, ekf_ignored: bool, external: bool = False
    ) -> None:
        self._encoder, self._autopilot = encoder, autopilot
        self._ekf_ignored = ekf_ignored
        self._checks = autopilot.pose_checks if external else ()
        self.restart()

    def restart(self) -> None:
        """Begin anew: another boot knows nothing of what was asked before."""
        autopilot = self._autopilot
        self._queue = CommandQueue()
        self._rates = RATES_HZ | {autopilot.estimator: ESTIMATOR_HZ}
        self._counts = dict.fromkeys(WATCHED.values(), 0)
        self._watch_s: float | None = None
        self._guards = [
            EnsureParameter(
                each.name,
                each.wanted,
                each.accepted,
                each.kind,
                bytewise=autopilot.bytewise,
                writes=each.unfit is None,
            )
            for each in autopilot.guards
        ]
        self._reads = {
            name: ReadParameter(name) for name in (*autopilot.reads, *(check.name for check in self._checks))
        }
        self.known: dict[str, float] = {}
        self.answered = False

    def receive(self, body: p.Body) -> None:
        """Take a message of the vehicle."""
        self.answered = self.answered or isinstance(body, (p.Ack, p.Parameter))
        watched = WATCHED.get(type(body))
        if watched is not None:
            self._counts[watched] += 1
        elif isinstance(body, p.Ack):
            self._queue.on_ack(body)
        elif isinstance(body, p.Parameter):
            for guard in self._guards:
                guard.receive(body)
            if body.name in self._reads:
                self._reads[body.name].receive(body)
                self.known[body.name] = body.value

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
        for guard in self._guards:
            frames += guard.tick(now_s, self._encoder)
            if not guard.confirmed:
                break  # the next one would set free what this one forbids
        for read in self._reads.values():
            frames += read.tick(now_s, self._encoder)
        return frames

    def _watch_rates(self, now_s: float, vehicle: Vehicle) -> None:
        """Ask again for what does not come: the request was lost, or the vehicle forgot it in a restart."""
        located = vehicle.ekf is not None and vehicle.ekf.good
        for message, count in self._counts.items():
            # No position is sent before there is one, and nothing of a receiver by a vehicle that has none.
            needs = {p.MESSAGE_LOCAL_POSITION: located, p.MESSAGE_GPS: vehicle.aiding.has_receiver}
            expected = needs.get(message, True)
            if expected and self._queue.idle and count < 0.5 * self._rates[message] * WATCH_S:
                self._ask_rate(message)
        if vehicle.ekf is None and self._queue.idle:
            self._ask_rate(self._autopilot.estimator)
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

    def problem(self, now_s: float, vehicle: Vehicle) -> Reason:
        """Return what still keeps the vehicle from being READY; false when nothing does."""
        heartbeat = vehicle.heartbeat
        if heartbeat is None:
            return given("no heartbeat yet")
        if self._autopilot.starting(heartbeat):
            return given("the autopilot is starting")
        if heartbeat.status == p.STATUS_CRITICAL:
            return given(f"a failsafe of the autopilot is on{_quoted(vehicle.texts_since(now_s - 30.0))}")
        setting = self._setting_problem()
        if setting:
            return given(setting)
        if not self._ekf_ignored and (vehicle.ekf is None or not vehicle.ekf.good):
            flags = "unknown" if vehicle.ekf is None else f"{vehicle.ekf.flags:#x}"
            return given(f"the autopilot does not know its position yet (EKF flags {flags})", Code.POSITION)
        if vehicle.telemetry_silent(now_s):
            return given("no position or attitude is being sent")
        return NONE

    @property
    def unfit(self) -> str:
        """Which parameter has a value that forbids driving until a person changes it; empty if none is known to."""
        for guard, ensure in zip(self._autopilot.guards, self._guards, strict=True):
            if guard.unfit is not None and ensure.found is not None and not ensure.confirmed:
                return guard.unfit(ensure.found)
        return self._autopilot.problem(self.known)

    def _setting_problem(self) -> str:
        if self.unfit:
            return self.unfit
        for guard, ensure in zip(self._autopilot.guards, self._guards, strict=True):
            if not ensure.confirmed:
                silent = ensure.silent_tries > 3
                return f"{guard.name}={guard.wanted:g} is not confirmed" + (
                    ": the vehicle does not answer" if silent else ""
                )
        return next(iter(self._unfit(needed=True)), "")

    @property
    def warnings(self) -> list[str]:
        """What is odd about the vehicle's parameters but does not keep it from driving."""
        return self._unfit(needed=False)

    def _unfit(self, *, needed: bool) -> list[str]:
        found = []
        for check in self._checks:
            read = self._reads[check.name]
            if check.needed is needed and read.settled:
                text = check.unfit(read.value)
                if text:
                    found.append(text if read.value is not None else f"{text} (the vehicle does not have it)")
            elif check.needed and needed:
                found.append(f"{check.name} is not known yet")
        return found


def _quoted(texts: list[str]) -> str:
    return f": {'; '.join(dict.fromkeys(texts))}" if texts else ""
