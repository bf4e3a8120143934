"""ArduPilot Rover 4.6 as its wire shows it, measured on the real firmware. No I/O, no clock of its own.

Faithful where drivers get hurt: early ACKs that prove nothing, an armed bit that comes with the next heartbeat,
set-points stored while disarmed, frames and masks silently ignored, a rate cap, silence for unknown parameters,
a 3 s set-point timeout, a ground-station failsafe that is off by default and latches HOLD, a pilot
whose throttle overrides set-points.

Its map begins where it was switched on.
Left out: missions, fences, FILE_TRANSFER_PROTOCOL, tuning of its controllers; LOITER stands still, and SMART_RTL goes
straight home as RTL does: to where it was armed.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.codec import dialect
from fullswarm.emulators.mavlink import driving, parameters, requests
from fullswarm.emulators.mavlink.driving import FULL_M_S, STAND, Limits, Motors, Sticks, Target
from fullswarm.emulators.mavlink.position import FAILSAFE_S, LOST_S, Chart, FilterNoise, Position
from fullswarm.emulators.mavlink.requests import SetpointRecord
from fullswarm.emulators.mavlink.telemetry import LOOP_HZ, Channel, KeyRing, Streams
from fullswarm.simulation.bodies import Body, BodyState

LOOP_S = 1.0 / LOOP_HZ
REAL_BOOT_S = 42.4
TALKS_S, TALKS_AGAIN_S, REBOOT_S = 1.03, 0.57, 0.66  # to the first heartbeat; from the command to the links' end
SETPOINT_TIMEOUT_S = 3.0
TIMESYNC_S = 10.0
LONGEST_GAP_S = 0.5  # a process that was held up does not catch up more than this
RECORDS = 20_000
CONSOLE = b"Init Gyro**\n\nAP_Logger_File: buffer size=204800\n"
BOOT = (
    (2.4, "ArduPilot Ready"), (19.9, "EKF3 IMU0 origin set"), (41.9, "EKF3 IMU0 is using GPS"),
    (41.9, "AHRS: EKF3 active"),
)  # fmt: skip
ORIGIN_S, LOCATES_S = 19.9, 41.9
ARM_PROBLEMS = (
    (2.4, "System not initialised"), (8.0, "Accels inconsistent"), (19.9, "AHRS: waiting for home"),
    (25.0, "Gyros inconsistent"), (REAL_BOOT_S, "AHRS: not using configured AHRS type"),
)  # fmt: skip
NEED_POSITION = frozenset({p.Mode.GUIDED, p.Mode.LOITER, p.Mode.RTL, p.Mode.SMART_RTL, p.Mode.CIRCLE})
HOMING = NOT_ARMABLE = frozenset({p.Mode.RTL, p.Mode.SMART_RTL})
FAILSAFE_MODES = {1: p.Mode.RTL, 2: p.Mode.HOLD, 3: p.Mode.SMART_RTL, 4: p.Mode.SMART_RTL, 6: p.Mode.LOITER}
TERMINATE = 5
BY_HAND = frozenset({p.Mode.MANUAL, p.Mode.ACRO, p.Mode.STEERING, p.Mode.SIMPLE})


@dataclass(slots=True)
class Firmware:
    """One rover's autopilot.

    Parameters
    ----------
    body
        What it drives.
    system
        Its system id.
    boot_s
        Power-on to armable; the real one needs 42.4 s (position filter), everything before scales with it.
    refuse_arm
        Text with which arming is refused; empty: it is not.
    ports
        How many ports it has; the first one (SERIAL0) accepts unsigned frames even if signing is set up.
    traps_floats
        End by numbers that are none, as the firmware's simulator does by default and boards do not.
    seed
        Of its position filter's noise; rovers of one world have different ones.
    creep_m_s
        Speed that comes on top of what its motors do: a slope, or a zero that is badly set.
    """

    body: Body
    system: int = 1
    boot_s: float = REAL_BOOT_S
    refuse_arm: str = ""
    loop_hz: float = LOOP_HZ
    ports: int = 1
    traps_floats: bool = False
    seed: int = 0
    creep_m_s: float = 0.0
    parameters: dict[str, float] = field(default_factory=parameters.fresh)
    setpoints: deque[SetpointRecord] = field(default_factory=lambda: deque(maxlen=RECORDS))
    located: bool = True  # False: the position estimate is gone, at once; see also set_gps
    charge: float = 0.87
    safety: bool = False  # the motor safety switch is pressed
    mode: int = p.Mode.INITIALISING
    armed: bool = False
    failsafe: bool = False
    aborted: bool = False
    target: Target | None = None
    home_m: tuple[float, float] | None = None
    reboot_due_s: float = math.inf
    sticks: Sticks = field(default_factory=Sticks)
    motors: Motors = field(default_factory=Motors)
    keys: KeyRing = field(default_factory=KeyRing)
    chart: Chart = field(default_factory=Chart)
    channels: list[Channel] = field(init=False)
    position: Position = field(init=False)
    noise: FilterNoise = field(init=False)
    _booted_s: float = 0.0
    _talks_s: float = TALKS_S
    _stepped_s: float = 0.0
    _target_s: float = -math.inf
    _station_s: float | None = None
    _stuck: BodyState | None = None
    _announced: int = 0
    _refusal_s: float = math.inf
    _timesync_s: float = 0.0

    def __post_init__(self) -> None:
        self.channels = [Channel(number, self.system, self.keys) for number in range(self.ports)]
        self.parameters["SYSID_THISMAV"] = float(self.system)
        self.position = Position(self.parameters)
        self.noise = FilterNoise(self.seed)

    # ------------------------------------------------------------ power and time
    def power_on(self, now_s: float, *, again: bool = False) -> None:
        """Start from nothing: intervals, mode, arming and set-points are forgotten, parameters and key are kept."""
        self._booted_s = self._stepped_s = now_s
        self._talks_s = TALKS_AGAIN_S if again else TALKS_S
        self.mode, self.armed, self.failsafe, self.aborted = p.Mode.INITIALISING, False, False, False
        self.target, self.home_m, self._target_s = None, None, -math.inf
        self._station_s, self.reboot_due_s, self._announced, self._refusal_s = None, math.inf, 0, math.inf
        self.sticks, self.motors = Sticks(), Motors()
        self.position.restart(now_s)
        self.chart.origin = None
        self._timesync_s = now_s + TIMESYNC_S
        for channel in self.channels:
            channel.clear()
            channel.streams = Streams(self, now_s + self._scaled(self._talks_s), self.loop_hz)
        self.channels[0].print(CONSOLE)
        self.body.drive(*STAND)

    def _scaled(self, real_s: float) -> float:
        return real_s * self.boot_s / REAL_BOOT_S

    def _up_s(self, now_s: float) -> float:
        """Return the time since power-on in seconds of the real, slow boot."""
        return (now_s - self._booted_s) * REAL_BOOT_S / max(self.boot_s, 1e-3)

    @property
    def next_due_s(self) -> float:
        """When :meth:`tick` has something to do."""
        return self._stepped_s + LOOP_S

    def restarts(self, now_s: float) -> bool:
        """Return whether the connections end now: it restarts, or its process has ended."""
        return self.aborted or now_s >= self.reboot_due_s

    def tick(self, now_s: float) -> list[bytes]:
        """Run the main loop up to `now_s`; return what goes out on the first port (others: :meth:`take`)."""
        if now_s >= self.reboot_due_s:
            self.power_on(now_s, again=True)
        self._stepped_s = max(self._stepped_s, now_s - LONGEST_GAP_S)
        while self._stepped_s + LOOP_S <= now_s + 1e-9 and not self.aborted:
            self._stepped_s += LOOP_S
            self._step(self._stepped_s)
        return self.take(0)

    def take(self, port: int) -> list[bytes]:
        """Return the frames that go out on a port, and forget them."""
        return self.channels[port].take()

    def _step(self, now_s: float) -> None:
        self._announce(now_s)
        self.position.step(now_s)
        up_s, by_satellites = now_s - self._booted_s, self.position.by_gps
        self.noise.step(up_s, self.unaided_s(now_s), LOOP_S, by_satellites=by_satellites)
        self._begin_map(now_s)
        self._watch_position(now_s)
        self._watch_station(now_s)
        self.sticks.step(now_s, self.parameters.get("RC_OVERRIDE_TIME", 3.0))
        self._drive(now_s)
        if self._up_s(now_s) < self._talks_s:
            return
        for channel in self.channels:
            for message in channel.streams.due(now_s) if channel.streams else []:
                channel.send(message, now_s)
        if now_s >= self._timesync_s:
            self._timesync_s += TIMESYNC_S
            self.broadcast(dialect().MAVLink_timesync_message(0, self.boot_ms(now_s) * 1_000_000))

    def _announce(self, now_s: float) -> None:
        while self._announced < len(BOOT) and self._up_s(now_s) >= BOOT[self._announced][0]:
            self.text(BOOT[self._announced][1], severity=6)
            if self._announced == 0:
                self._set_mode(int(self.parameters.get("INITIAL_MODE", 0.0)))
            self._announced += 1
        if now_s >= self._refusal_s:
            self._refusal_s = math.inf
            self.text("Flight mode change failed")

    def _begin_map(self, now_s: float) -> None:
        """Set the map's origin where the rover stands, once the receiver's fix is good, and send it on all ports."""
        if not self.position.by_gps:
            self.chart.origin = None  # poses from outside are places on the map
        located = self.position.by_gps and self.position.gps and self._up_s(now_s) >= ORIGIN_S
        if self.chart.origin is None and located:
            truth = self.body.state()
            self.chart.begin(truth.x_m, truth.y_m)
            for channel in self.channels:
                for message in channel.streams.make(p.MESSAGE_ORIGIN, now_s) if channel.streams else []:
                    channel.send(message, now_s)

    @property
    def map_origin(self) -> tuple[float, float]:
        """Latitude and longitude of where its map begins; of the world's (0, 0) before that is known."""
        return self.chart.origin or self.position.given or self.chart.world

    # ------------------------------------------------------------ driving
    @property
    def limits(self) -> Limits:
        """What bounds a set-point now."""
        return Limits(self.parameters["WP_SPEED"], math.radians(self.parameters["ATC_STR_RAT_MAX"]))

    def _drive(self, now_s: float) -> None:
        motors, limits = self.motors, self.limits
        guided = self.mode == p.Mode.GUIDED or self.mode in HOMING
        if self.armed == (self.home_m is None):
            state = self.state()
            self.home_m = (state.x_m, state.y_m) if self.armed else None
        desired = self._guided(now_s, limits) if guided else STAND
        if not self.armed or self.safety:
            motors.cut(LOOP_S)
        elif guided:
            accel, turn_accel = (self.parameters[each] for each in ("ATC_ACCEL_MAX", "ATC_STR_ACC_MAX"))
            # 0 and below: no limit.
            motors.follow(
                desired, accel if accel > 0 else 1e3, math.radians(turn_accel if turn_accel > 0 else 1e5), LOOP_S
            )
        elif self.mode in BY_HAND:
            sticks = self.sticks
            motors.push(sticks.throttle * FULL_M_S, -sticks.steering * limits.turn_rad_s, LOOP_S)
        else:
            motors.push(0.0, 0.0, LOOP_S)
        self.body.drive(motors.speed_m_s + self.creep_m_s, motors.turn_rad_s)

    def _guided(self, now_s: float, limits: Limits) -> tuple[float, float]:
        target = self.target
        if target is None:
            return STAND
        if target.place_m is None and now_s - self._target_s > SETPOINT_TIMEOUT_S:
            self.target = None
            self.text("target not received last 3secs, stopping")
            return STAND
        desired = driving.steer(target, self.state(), limits)
        if desired is None:
            self.target = None
            self.broadcast(dialect().MAVLink_mission_item_reached_message(0))
            return STAND
        cruise, throttle = self.parameters["CRUISE_SPEED"], self.parameters["CRUISE_THROTTLE"] / 100.0
        return self.sticks.nudge(desired[0], cruise, throttle), desired[1]

    def aim(self, target: Target, now_s: float) -> None:
        """Take a target."""
        self.target, self._target_s = target, now_s
        if target.odd:
            self.text("Internal Errors 0x400", severity=2)

    # ------------------------------------------------------------ failsafes
    def _watch_station(self, now_s: float) -> None:
        if not self.parameters.get("FS_GCS_ENABLE") or self._station_s is None or self.failsafe:
            return
        if now_s - self._station_s > self.parameters["FS_GCS_TIMEOUT"] + self.parameters["FS_TIMEOUT"]:
            self.failsafe = True
            self.text("Radio Failsafe")  # sic: the real firmware names the wrong one
            if self.armed:
                self._act(int(self.parameters["FS_ACTION"]), now_s)

    def _act(self, action: int, now_s: float) -> None:
        """Perform FS_ACTION: nothing, a mode (HOLD if that one cannot be), or disarm."""
        if action == TERMINATE:
            self.armed = False
        elif action in FAILSAFE_MODES:
            mode = FAILSAFE_MODES[action]
            self._set_mode(mode if mode == p.Mode.HOLD or self.positioned(now_s) else p.Mode.HOLD)

    def _watch_position(self, now_s: float) -> None:
        before_s, after_s = (self.position.silent_s(each) for each in (now_s - LOOP_S, now_s))
        if before_s < LOST_S <= after_s < math.inf:
            self.text("AHRS: DCM active")
        if before_s < FAILSAFE_S <= after_s < math.inf:
            self.text("EKF variance", severity=2)
            self.text("EKF failsafe", severity=2)
            if self.armed and self.mode in NEED_POSITION:
                self._set_mode(p.Mode.HOLD)

    # ------------------------------------------------------------ what people do to it
    def _set_mode(self, mode: int) -> None:
        if mode != self.mode:
            self.target = Target(place_m=self.home_m) if mode in HOMING and self.home_m is not None else None
        self.mode = mode
        for channel in self.channels:
            if channel.streams:
                channel.streams.heartbeat_now()

    def pilot_mode(self, mode: int) -> None:
        """Turn the pilot's mode switch."""
        self._set_mode(mode)

    def request_mode(self, mode: int, now_s: float) -> p.Result:
        """Change the mode as a station requests, if it can be."""
        if self.mode == p.Mode.INITIALISING:
            self._refusal_s = now_s + self._scaled(0.55)
            return p.Result.ACCEPTED  # an early ACCEPTED proves nothing
        if p.mode_name(mode).startswith("mode "):
            self.text(f"No such mode {mode}")
            return p.Result.FAILED
        blind = mode in NEED_POSITION and self.armed and not self.positioned(now_s)
        if blind or mode in (p.Mode.AUTO, p.Mode.INITIALISING):
            self.text("Flight mode change failed")
            return p.Result.FAILED
        self._set_mode(mode)
        return p.Result.ACCEPTED

    def arm_problem(self, now_s: float) -> str:
        """Return why arming is refused; empty: it is not."""
        if self.mode in NOT_ARMABLE:
            return "Mode not armable"
        up_s = self._up_s(now_s)
        early = next((problem for until_s, problem in ARM_PROBLEMS if up_s < until_s), "")
        return early or ("Hardware safety switch" if self.safety else self.refuse_arm)

    def reboot_soon(self, now_s: float) -> None:
        """Restart when the links have had time to send the answer."""
        self.reboot_due_s = now_s + self._scaled(REBOOT_S)

    def abort(self) -> None:
        """End by a floating-point exception, if the trap is on: the process is gone until it is started again."""
        self.aborted = self.aborted or self.traps_floats
        if self.aborted:
            self.body.drive(*STAND)
            for channel in self.channels:
                channel.clear()

    def set_gps(self, on: bool) -> None:
        """Switch the GPS; without it the position is lost 7 s later, and 8.2 s later the mode is HOLD."""
        self.position.gps = on

    def cover_antenna(self, on: bool) -> None:
        """Cover the GPS antenna: the receiver works and reports no fix."""
        self.position.covered = on

    def stick_sensors(self, on: bool) -> None:
        """Repeat the present measurements with new time stamps; or stop that."""
        self._stuck = self.state() if on else None

    def set_interval(self, message: int, interval_us: float, now_s: float, port: int = 0) -> str:
        """Set a message's rate on a port as SET_MESSAGE_INTERVAL does; return why not, empty if it is done."""
        streams = self.channels[port].streams
        return streams.set_interval(message, interval_us, now_s) if streams else "it is off"

    # ------------------------------------------------------------ what arrives
    def receive(self, message: Any, now_s: float, port: int = 0) -> None:
        """Take one of the dialect's messages; those for other systems or from our own id are dropped."""
        source = message.get_srcSystem(), message.get_srcComponent()
        if self.aborted or source == (self.system, 1) or self._up_s(now_s) < self._talks_s:
            return
        if getattr(message, "target_system", getattr(message, "target", 0)) not in (0, self.system):
            return
        enforced = self.parameters.get("SYSID_ENFORCE") == 1.0
        if enforced and source[0] not in (self.system, int(self.parameters["SYSID_MYGCS"])):
            return
        channel = self.channels[port]
        if channel.accepts(message, now_s):
            requests.take(self, message, channel, now_s)

    def station_alive(self, now_s: float) -> None:
        """Note a heartbeat of the controlling station: only those feed the failsafe."""
        self._station_s = now_s
        if self.failsafe:
            self.failsafe = False
            self.text("GCS Failsafe Cleared")  # the mode stays what the failsafe made it

    # ------------------------------------------------------------ what goes out
    def text(self, text: str, severity: int = 4) -> None:
        """Send a line of text on all ports, in chunks if it is long."""
        data = text.encode("ascii", "replace")
        chunks = [data[at : at + p.TEXT_CHUNK] for at in range(0, len(data), p.TEXT_CHUNK)]
        text_id = 0 if len(chunks) == 1 else 1 + len(data)
        for index, chunk in enumerate(chunks):
            self.broadcast(dialect().MAVLink_statustext_message(severity, chunk, text_id, index))

    def broadcast(self, message: Any) -> None:
        """Send a message on all ports."""
        for channel in self.channels:
            channel.send(message, self._stepped_s)

    def fix(self, now_s: float) -> tuple[int, int]:
        """Return the type of the satellite fix, and when the last one was: milliseconds since power-on."""
        position = self.position
        stamp_ms = self.boot_ms(position.fix_s) if math.isfinite(position.fix_s) else 0
        return position.fix_type(now_s), stamp_ms

    def unaided_s(self, now_s: float) -> float:
        """Return for how long nothing has measured the position."""
        return self.position.silent_s(now_s)

    def truth(self) -> BodyState:
        """Return where the body is."""
        return self.body.state()

    def state(self) -> BodyState:
        """Return the state that the filter estimates."""
        return self._stuck or self.noise.seen(self.position.measured(self.body.state()))

    def boot_ms(self, now_s: float) -> int:
        """Return milliseconds since power-on."""
        return round((now_s - self._booted_s) * 1000)

    def positioned(self, now_s: float) -> bool:
        """Whether the position filter has a position: late in the boot, and not while it is lost."""
        return self.located and self._up_s(now_s) >= LOCATES_S and self.position.known(now_s)
