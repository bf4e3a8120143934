"""The conversation with one rover as a state machine: bytes and time in, frames and state out.

No I/O, no thread, no clock: it can be replayed, and tested in lockstep.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from fullswarm.drivers.base import STAND, Description, Hazard, Lifecycle, Pose, Reading, Twist
from fullswarm.drivers.guardian import SILENCE_S, StopPlan
from fullswarm.drivers.linked import LinkSession
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.arming import SETPOINT_S, Activation, Controls, StandDown, left_armed, stop_plan
from fullswarm.drivers.mavlink.autopilot import STATION, ArduPilot, Autopilot, unsupported
from fullswarm.drivers.mavlink.codec import StationEncoder, StreamParser, decode, decoded_ids
from fullswarm.drivers.mavlink.external import ExternalPose
from fullswarm.drivers.mavlink.frame import SwarmFrame
from fullswarm.drivers.mavlink.px4 import AUTOPILOTS
from fullswarm.drivers.mavlink.requests import RESEND_S
from fullswarm.drivers.mavlink.settings import Options as Options
from fullswarm.drivers.mavlink.signing import Signing
from fullswarm.drivers.mavlink.startup import Startup
from fullswarm.drivers.mavlink.vehicle import LINK_SILENCE_S, Vehicle
from fullswarm.errors import DriverError
from fullswarm.reasons import Code, Reason, given

STATION_COMPONENT, AUTOPILOT_COMPONENT = 190, 1
HEARTBEAT_S = 1.0
FAULT_DWELL_S = 0.5  # long enough for an agent's loop to see it
RETRY_S = 1.0  # between two attempts to arm
STAND_DOWN_S = 5.0
RESIGN_S = 5.0
"""The guardian's frames are signed anew: a vehicle accepts a new link for a minute after the signature."""


class Session(LinkSession[bytes]):
    """One rover, from silence to driving and back.

    Parameters
    ----------
    signing
        Signs what is sent and checks what is received; closed with the session. None: nothing is signed.
    describe
        Returns what is known of a rover with an autopilot.
    """

    closing_s = 4.0

    def __init__(
        self,
        options: Options,
        now_s: float,
        signing: Signing | None = None,
        describe: Callable[[Autopilot], Description] | None = None,
    ) -> None:
        self._options, self.signing, self._describe = options, signing, describe
        self._parser: StreamParser | None = None  # from the first connection on
        signer = None if signing is None else signing.signer()
        self._encoder = StationEncoder(STATION, STATION_COMPONENT, options.system, signer)
        guardian = None if signing is None else signing.signer(guardian=True)
        self._guardian_encoder = StationEncoder(STATION, STATION_COMPONENT, options.system, guardian)
        self._plan: StopPlan[bytes] | None = None
        self._plan_kind: tuple[str, bool] | None = None
        self._resign_s = now_s
        self._vehicle = Vehicle(receiver=not options.external, filtered=not options.ekf_ignored)
        self._fly_by(options.autopilot or ArduPilot())
        self._activation: Activation | None = None
        self._stand_down: StandDown | None = None
        self.why = f"no heartbeat from system {options.system} yet"
        self._opened_s = now_s
        self._fault_s = -math.inf
        self._heartbeat_due_s = now_s
        self._setpoint_due_s = self._stop_due_s = now_s
        self._activating = self._taken_over = self._armed_by_us = False
        self._asked_s = self._retry_s = -math.inf
        self._command = STAND
        self._moving_sent_s = -math.inf
        self._confirm = False

    def _fly_by(self, autopilot: Autopilot) -> None:
        options = self._options
        self.autopilot = autopilot
        if self._describe is not None:
            self.description = self._describe(autopilot)
        self._startup = Startup(self._encoder, autopilot, ekf_ignored=options.ekf_ignored, external=options.external)
        blank = autopilot.blank_velocity
        self._external = (
            ExternalPose(self._encoder, options.limits, options.origin, blank) if options.external else None
        )
        own = None if options.external else options.origin  # fixes from outside are in the swarm's frame already
        self._frame = None if own is None else SwarmFrame(self._encoder, autopilot.chart, own)
        self._vehicle.frame = self._frame

    # ------------------------------------------------------------ for the agent
    @property
    def firmware(self) -> str:
        """The firmware's name and version, e.g. ``ArduRover 4.6.3``; empty until known."""
        return f"{self.autopilot.firmware} {self._vehicle.version}" if self._vehicle.version else ""

    @property
    def unfit(self) -> str:
        """What keeps an OPEN vehicle from READY and does not pass by itself, or not soon; empty if nothing."""
        unfit = (self._startup.unfit or self.unguarded) if self.state is Lifecycle.OPEN else ""
        return f"{self._options.where}: {unfit}" if unfit else ""

    def trouble(self, now_s: float) -> Reason:
        """Return why it is in FAULT or not ACTIVE, what a person must set, or what aid is lost."""
        return given(self.fault or self.unfit or self.unaided(now_s))

    def unaided(self, now_s: float) -> str:
        """Return what is lost of a vehicle whose position is dead reckoning by now; empty while it is measured."""
        if self.state not in (Lifecycle.READY, Lifecycle.ACTIVE):
            return ""
        problem = self._vehicle.aiding.problem(now_s)
        return f"{self._options.where}: {problem}" if problem else ""

    def texts(self, now_s: float, age_s: float = 30.0) -> list[str]:
        """Return the warnings of the last `age_s`: the vehicle's own texts, then what is odd about its settings."""
        odd = self._startup.warnings + ([] if self._external is None else self._external.warnings)
        return self._vehicle.texts_since(now_s - age_s) + odd

    def locate(self, pose: Pose, position_sigma_m: float, heading_sigma_rad: float, now_s: float) -> bool:
        """Take a pose measured from outside; return whether it is of use (``pose=external``)."""
        if self._external is None:
            return False
        self._external.locate(pose, position_sigma_m, heading_sigma_rad, now_s)
        return True

    @property
    def standing_down(self) -> bool:
        """Whether the vehicle may still be moving or armed because of us."""
        return self._stand_down is not None or self._activation is not None or self.state is Lifecycle.ACTIVE

    def read(self) -> Reading | None:
        """Return the newest reading; a pilot's take-over and the safety switch are the emergency-stop hazard."""
        reading = self._vehicle.reading
        pressed = self.autopilot.tells_safety and self._vehicle.motors_off
        if reading is not None and (self._taken_over or pressed):
            switch = Hazard.MOTORS_OFF if pressed else Hazard.NONE
            return replace(reading, hazards=reading.hazards | Hazard.ESTOP_BUTTON | switch)
        return reading

    def activate(self, now_s: float) -> None:
        """Begin to drive. Calls less than a second apart are one request, which a pilot's take-over ends."""
        same_request = now_s - self._asked_s < RETRY_S
        self._asked_s = now_s
        if self.state is not Lifecycle.READY or (self._taken_over and same_request):
            return
        if self._activation is not None:
            return
        self._taken_over = False
        self._activating = True

    def deactivate(self, now_s: float) -> None:
        """Stand down: zero set-point, HOLD, disarm; ends an activation. A pilot who has taken over stays in charge."""
        self._activating, self._command = False, STAND
        pending = self.state is Lifecycle.ACTIVE or self._activation is not None
        if pending and self._stand_down is None:  # asked again and again, it must not begin anew each time
            self._begin_stand_down(now_s)

    def command(self, twist: Twist, now_s: float) -> Twist:
        """Take a set-point; return what will be sent of it."""
        if self._stand_down is not None:
            return STAND
        applied = self.autopilot.applied(twist, self._options.limits, self._startup.known)
        if applied == STAND and self._command != STAND:
            self._setpoint_due_s = now_s  # a stop does not wait for its turn
        self._command = applied
        return applied

    def halt(self, why: str, now_s: float) -> None:
        """Stand, at once."""
        del why
        if self._command != STAND:
            self._command, self._setpoint_due_s = STAND, now_s

    def closing(self, now_s: float) -> None:
        """Stand down before the port is closed."""
        self.deactivate(now_s)

    @property
    def at_rest(self) -> bool:
        """Whether the vehicle stands, held and disarmed, as far as it was driven from here."""
        return not self.standing_down

    def closed(self) -> None:
        """Keep the signing clock for the next time."""
        if self.signing is not None:
            with contextlib.suppress(DriverError):
                self.signing.close()

    # ------------------------------------------------------------ for the link thread
    def linked(self, now_s: float) -> None:
        """Begin a new stream of bytes."""
        del now_s
        self._parser = StreamParser(decoded_ids(), None if self.signing is None else self.signing.accept)

    def accepts(self, datagram: bytes) -> bool:
        """Return whether a listening port shall take the sender of a datagram for the vehicle."""
        if self._vehicle.heartbeat is not None:
            return False
        authentic = None if self.signing is None else self.signing.authentic
        return any(map(self._is_heartbeat, StreamParser(decoded_ids(), authentic).feed(datagram)))

    def _is_heartbeat(self, message: Any) -> bool:
        received = decode(message)
        return received is not None and self._is_ours(received) and isinstance(received.body, p.Heartbeat)

    def _is_ours(self, received: p.Received) -> bool:
        # The autopilot itself, not a gimbal or a receiver beside it: some identify as ArduPilot too.
        ours = received.system == self._options.system and received.component == AUTOPILOT_COMPONENT
        return ours and not (isinstance(received.body, p.Heartbeat) and not received.body.is_vehicle)

    def received(self, chunk: bytes, now_s: float) -> None:
        """Take bytes from the port."""
        for message in () if self._parser is None else self._parser.feed(chunk):
            self.receive(message, now_s)

    def receive(self, message: Any, now_s: float) -> None:
        """Take one of the dialect's messages; those of other systems are ignored."""
        received = decode(message)
        if received is None or not self._is_ours(received):
            return
        body = received.body
        if isinstance(body, p.Heartbeat):
            self._recognise(body)
            self._watch_hand_back(body)
            self._vehicle.signs = bool(message.get_header().incompat_flags & 1)
        elif isinstance(body, p.Parameter):
            body = replace(body, value=body.bytewise) if self.autopilot.bytewise else body
            if not math.isfinite(body.value):
                return
        if isinstance(body, p.Ack) and body.target_system not in (0, STATION):
            return  # the answer to another station
        if isinstance(body, p.Ack) and body.command in (p.COMMAND_SET_MODE, p.COMMAND_ARM):
            self._confirm = self.autopilot.slow_heartbeat
        self._vehicle.receive(body, now_s)
        self._startup.receive(body)
        if self._external is not None:
            self._external.receive(body)
        if self._frame is not None:
            self._frame.receive(body)
        if self._activation is not None:
            self._activation.receive(body, now_s)
        driving = self.state is Lifecycle.ACTIVE and self._stand_down is None
        if isinstance(body, p.Heartbeat) and driving and not self._unsupported(body):
            self._watch_mode(body, now_s)

    def _recognise(self, heartbeat: p.Heartbeat) -> None:
        """Take the autopilot of the heartbeat, unless the URL names one, or while it is driven from here."""
        found = AUTOPILOTS.get(heartbeat.autopilot)
        settled = self._options.autopilot is not None or self.standing_down
        if found is not None and not settled and found.number != self.autopilot.number:
            self._fly_by(found)

    def _unsupported(self, heartbeat: p.Heartbeat) -> str:
        driven = self.autopilot if self.standing_down else None
        return unsupported(heartbeat, AUTOPILOTS, self._options.autopilot, driven)

    def next_due_s(self, now_s: float) -> float:
        """Return when :meth:`tick` has something to send at the latest."""
        due_s = self._heartbeat_due_s
        if self.state is Lifecycle.ACTIVE and self._stand_down is None:
            due_s = min(due_s, self._setpoint_due_s)
        if self._activation is not None:
            due_s = min(due_s, self._activation.next_due_s)
        if self._external is not None:
            due_s = min(due_s, self._external.next_due_s(now_s))
        return due_s

    def lost(self, reason: str, now_s: float) -> None:
        """Note that the port is gone; the driver opens it again."""
        self._fail(reason, now_s)
        self._forget()

    def stop_plan(self, now_s: float) -> StopPlan[bytes] | None:
        """Return what stops a vehicle that is driven from here; None: it is not."""
        kind = (self.autopilot.key, self.state is Lifecycle.ACTIVE) if self.standing_down else None
        if kind != self._plan_kind or (self._plan is not None and self.signing is not None and now_s >= self._resign_s):
            self._plan_kind, self._resign_s = kind, now_s + RESIGN_S
            controls = Controls(self.autopilot, self._guardian_encoder, self._startup.known)
            self._plan = None if kind is None else stop_plan(controls, drives=kind[1])
        return self._plan

    def stopped_by_guardian(self, now_s: float) -> None:
        """Note that the guardian, and not a pilot, has stopped the vehicle."""
        if self.standing_down:
            self._fail(f"its guardian stopped it: this process stood still for more than {SILENCE_S:g} s", now_s)
            if self._stand_down is None:
                self._begin_stand_down(now_s)

    def final_stop(self) -> list[bytes]:
        """Return what stops a vehicle that is still driven from here."""
        if not self.standing_down:
            return []
        stop = self._controls.stop()
        return stop if self.state is Lifecycle.ACTIVE else stop[1:]

    @property
    def _controls(self) -> Controls:
        return Controls(self.autopilot, self._encoder, self._startup.known)

    def tick(self, now_s: float) -> list[bytes]:
        """Return the frames that are due now."""
        frames: list[bytes] = []
        if now_s >= self._heartbeat_due_s:
            self._heartbeat_due_s = now_s + HEARTBEAT_S
            frames.append(self._encoder.heartbeat())
        if self._confirm:
            self._confirm = False
            frames.append(self._encoder.request_message(p.MESSAGE_HEARTBEAT))
        vehicle = self._vehicle
        if vehicle.rebooted:
            self._fail("the autopilot restarted", now_s)
            self._forget()
        if vehicle.heartbeat is None or vehicle.silent(now_s):
            if self.state is Lifecycle.ACTIVE:
                frames.append(self._controls.stand())  # it may still receive
            self._watch_silence(now_s)
            return frames
        problem = self._unsupported(vehicle.heartbeat)
        if problem:
            return frames + self._give_up(problem, now_s)
        frames += self._startup.tick(now_s, vehicle)
        if self._external is not None:
            frames += self._external.tick(now_s, vehicle.heading_rad)
        if self._frame is not None:
            frames += self._frame.tick(now_s)
        self._watch_problem(now_s)
        if self._stand_down is not None:
            frames += self._continue_stand_down(self._stand_down, now_s)
        elif self.state is Lifecycle.ACTIVE:
            frames += self._setpoint(now_s)
        elif self.state is Lifecycle.READY:
            frames += self._pursue_activation(now_s)
        return frames

    # ------------------------------------------------------------ transitions
    def _fail(self, reason: str, now_s: float) -> None:
        self.state, self.fault, self._fault_s = Lifecycle.FAULT, f"{self._options.where}: {reason}", now_s
        self._activating, self._command = False, STAND

    def _give_up(self, problem: str, now_s: float) -> list[bytes]:
        """Stop a vehicle that turns out not to be ours to drive, for a while, and then leave it alone."""
        if self.state is not Lifecycle.FAULT:
            driven, self._stop_due_s = self.standing_down, now_s
            self._fail(problem, now_s)
            if driven and self._stand_down is None:
                self._begin_stand_down(now_s)
        if self._stand_down is not None and now_s - self._stand_down.start_s > STAND_DOWN_S:
            self._stand_down = None
        if self._stand_down is None or now_s < self._stop_due_s:
            return []
        self._stop_due_s = now_s + RESEND_S
        return self._controls.stop()

    def _forget(self) -> None:
        self._vehicle.forget()
        self._startup.restart()
        if self._external is not None:
            self._external.restart()
        if self._frame is not None:
            self._frame.restart()
        self._activation = self._stand_down = None
        self._taken_over = False

    def _watch_silence(self, now_s: float) -> None:
        system = self._options.system
        if self._vehicle.heartbeat is not None:
            doubt = "" if self.signing is None else self.signing.doubt(system)
            what = f"it is received, but {doubt}" if doubt else f"no heartbeat from system {system}"
            self._fail(f"link lost: {what} for {LINK_SILENCE_S:g} s", now_s)
            self._forget()
        elif self.state is Lifecycle.OPEN and now_s - self._opened_s > LINK_SILENCE_S:
            doubt = "" if self.signing is None else self.signing.doubt(system)
            hint = f"it is received, but {doubt}" if doubt else "check power, cable, baud rate and ?sysid="
            self._fail(f"no heartbeat from system {system} ({hint})", now_s)

    def _watch_problem(self, now_s: float) -> None:
        """Move between OPEN, READY and FAULT as the vehicle's condition changes."""
        self.why = self._problem(now_s)
        settled = self._stand_down is None
        if self.state is Lifecycle.ACTIVE and settled and self.why:
            self._fail(self.why, now_s)
            self._begin_stand_down(now_s)
        elif self.state is Lifecycle.READY and self.why:
            self.state, self._activating = Lifecycle.OPEN, False
            if self._activation is not None:
                self._begin_stand_down(now_s)
        elif self.state is Lifecycle.FAULT and settled and now_s - self._fault_s > FAULT_DWELL_S:
            self.state, self.fault, self._opened_s = Lifecycle.OPEN, "", now_s
        elif self.state is Lifecycle.OPEN and settled:
            if left_armed(self._vehicle, self.autopilot, by_us=self._armed_by_us):
                self._begin_stand_down(now_s)
            elif not self.why and self._vehicle.aiding.unheard(now_s):
                self.why = "its satellite receiver has not reported again yet"  # the vehicle was silent as a whole
            elif not self.why:
                self.state = Lifecycle.READY

    def _problem(self, now_s: float) -> str:
        found = self._startup.problem(now_s, self._vehicle)
        why = found.text or self.unguarded
        lost = "" if self._external is None else self._external.problem(now_s)
        if lost and found.code == Code.POSITION:
            why = f"{why}: {lost}"
        if not why and self._frame is not None:
            why = self._frame.problem(now_s)
        if why and self.signing is None and self._vehicle.signs and not self._startup.answered:
            why += " (it signs its messages: give its key with ?sign_key=)"
        return why

    def _watch_mode(self, heartbeat: p.Heartbeat, now_s: float) -> None:
        """While ACTIVE: a pilot or another station took the vehicle; report it and stop commanding."""
        autopilot = self.autopilot
        guided = heartbeat.custom_mode == autopilot.drive_mode
        if heartbeat.status == p.STATUS_CRITICAL or autopilot.starting(heartbeat):
            return  # a failsafe or a restart, not a person: _watch_problem deals with it
        if guided and heartbeat.armed:
            return
        what = "it was disarmed" if guided else f"the mode was changed to {autopilot.mode_name(heartbeat.custom_mode)}"
        texts = "; ".join(dict.fromkeys(self._vehicle.texts_since(now_s - 2.0)))
        self.fault = (
            f"{self._options.where}: {what} by the pilot, another station or the autopilot"
            f"{f' ({texts})' if texts else ''}: ask for a behaviour again to take it back to "
            f"{autopilot.mode_name(autopilot.drive_mode)}"
        )
        self.state, self._command, self._asked_s = Lifecycle.READY, STAND, now_s
        self._taken_over, self._armed_by_us, self._activating = True, False, False

    def _watch_hand_back(self, heartbeat: p.Heartbeat) -> None:
        drive_mode = self.autopilot.drive_mode
        if self._vehicle.mode != drive_mode and heartbeat.custom_mode == drive_mode:
            self._taken_over = False

    def _begin_stand_down(self, now_s: float) -> None:
        pending = self._activation is not None and self._activation.arm_may_take_effect
        self._stand_down = StandDown(self._controls, self._vehicle, now_s, arm_pending=pending)
        self._activation, self._activating, self._command = None, False, STAND

    def _continue_stand_down(self, stand_down: StandDown, now_s: float) -> list[bytes]:
        frames = stand_down.tick(now_s)
        if stand_down.done:
            self._stand_down, self._armed_by_us = None, False
            if self.state is Lifecycle.ACTIVE:
                self.state = Lifecycle.READY
        elif now_s - stand_down.start_s > STAND_DOWN_S and self.state is not Lifecycle.FAULT:
            self._fail("the vehicle does not confirm hold and disarm; still trying", now_s)
        return frames

    def _setpoint(self, now_s: float) -> list[bytes]:
        if now_s < self._setpoint_due_s:
            return []
        self._setpoint_due_s = now_s + SETPOINT_S
        if self._command != STAND:
            self._moving_sent_s = now_s
        return [self.autopilot.setpoint(self._encoder, self._command, self._startup.known)]

    def _pursue_activation(self, now_s: float) -> list[bytes]:
        if self._activation is None:
            autopilot = self.autopilot
            stored = self._vehicle.mode == autopilot.drive_mode and now_s - self._moving_sent_s < autopilot.stores_s
            if not self._activating or now_s < self._retry_s or stored:
                return []
            self._activating = False
            self._activation = Activation(self._controls, self._vehicle, now_s)
        attempt = self._activation
        frames = attempt.tick(now_s)
        self._armed_by_us = self._armed_by_us or attempt.arm_may_take_effect
        if attempt.refusal:
            self.fault, self._retry_s = f"{self._options.where}: {attempt.refusal}", now_s + RETRY_S
            self._taken_over, self._asked_s = attempt.taken_over, now_s
            self._begin_stand_down(now_s)
        elif attempt.armed:
            self._activation, self.state, self.fault = None, Lifecycle.ACTIVE, ""
            self._command = STAND
            self._setpoint_due_s = now_s
            frames += self._setpoint(now_s)
        return frames
