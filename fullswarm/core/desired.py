"""The desired state of one robot: its order, what it confirmed, the control request in flight.

A state machine without I/O: events in, at most one control request out. The rules:

* an active behaviour is disabled, and that acknowledged, before another one is enabled (paper II.C.2);
* the same behaviour with new parameters is an update and needs no disabling;
* what is not acknowledged is sent again with the same sequence number, so that it is carried out once;
* the validity of an intent counts from its request, however late it arrives;
* what is sent names the stops that the core knows: a robot ignores what was sent before the core knew its newest one;
* the robot's report of itself is authoritative: after a restart of either side the two are compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec

from fullswarm.messages import ControlAck, ControlRequest, Needs, Result, RobotHealth, Value
from fullswarm.reasons import NONE, Code, Reason, given, reason
from fullswarm.recent import Recent

RESEND_S = 0.1
RESEND_MAX_S = 0.5
BEHIND_S = 0.5
"""What a robot runs for another core, although it has acknowledged this one, is overdue after this time."""
UNSEEN_S = 2.0
"""The report of a robot that names no request of this core counts for this time as older than its acknowledgement: on a
loaded computer a report waits for longer than an acknowledgement does."""

KNOWN_HALTS = 4
"""So many stops are sent with a request: the robot's newest is among them unless several crossed it."""

IDLE = ("", "stop")
"""Behaviours that mean: nothing is enabled."""

NO_TASK = "it reports neither the task that it had confirmed nor a reason; see its agent's log"


class Order(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What one robot must run; also the form stored in the local database."""

    request_id: str
    behaviour: str
    parameters: dict[str, Value] = {}
    law: str = ""
    team: int = 0
    peers: tuple[str, ...] = ()
    members: tuple[str, ...] = ()
    roles: tuple[str, ...] = ()
    needs: Needs | None = None
    stays: bool = False
    filtered: bool = False
    centralised: bool = False
    survives_core: bool = False
    expires_s: float = 0.0
    adopted: bool = False  # found on the robot after a restart of the core: parameters unknown
    operator: str = ""  # with `clock` and `stamp_s` as in the request
    clock: str = ""
    stamp_s: float = 0.0

    @property
    def intent(self) -> bool:
        """It expires unless repeated."""
        return self.expires_s > 0.0

    @property
    def enables_nothing(self) -> bool:
        """Nothing shall be enabled."""
        return self.behaviour in IDLE or not (self.law or self.centralised or self.adopted)


@dataclass(slots=True)
class Desired:
    """State of one robot. `order` is the present one; None: nothing is requested of it."""

    robot: str
    core: str
    present: bool = False
    order: Order | None = None
    waiting: Order | None = None  # until the schedule interval is over
    ordered_s: float = -math.inf  # when this core got the newest order; one that it has restored is older than any stop
    switched_s: float = -math.inf
    expires_at_s: float = math.inf
    settled: bool = False  # the robot confirmed `order`
    refused: Reason = NONE  # why the robot refused `order`
    active: str = ""  # the behaviour that it last reported
    in_flight: ControlRequest | None = None  # sent, not acknowledged
    tries: int = 0
    resend_s: float = math.inf
    acked_sequence: int = 0  # highest sequence acknowledged
    acked_s: float = -math.inf
    halts: Recent[str, None] = field(default_factory=lambda: Recent(KNOWN_HALTS))  # of this robot, by their ids
    _maybe_active: str = field(default="", repr=False)  # an enable in flight when the order changed
    _enabled: ControlRequest | None = field(default=None, repr=False)  # by which the robot runs `order`

    def set_order(self, order: Order | None, now_s: float) -> None:
        """Replace the order."""
        if self.in_flight is not None and self.in_flight.enable:
            self._maybe_active = self.in_flight.behaviour
        self.order, self.settled, self.refused, self._enabled = order, False, NONE, None
        self.expires_at_s = now_s + order.expires_s if order is not None and order.intent else math.inf
        if self.in_flight is not None and (order is None or self.in_flight.enable):
            self._clear_in_flight()

    def next(self, sequence: Callable[[], int]) -> ControlRequest | None:
        """Return the control request to send now, with a `sequence` of its own, if any."""
        order = self.order
        if order is None or self.settled or self.refused or not self.present:
            return None
        blocking = self.active or self._maybe_active
        if blocking and (order.enables_nothing or blocking != order.behaviour):
            if self.in_flight is not None and not self.in_flight.enable:
                return None
            return self._new_request(order, blocking, enable=False, sequence=sequence())
        if order.enables_nothing:
            self.settled = True
            self._clear_in_flight()
            return None
        if self.in_flight is not None or order.adopted:
            return None
        return self._new_request(order, order.behaviour, enable=True, sequence=sequence())

    def _new_request(self, order: Order, behaviour: str, *, enable: bool, sequence: int) -> ControlRequest:
        filled = order if enable else Order(request_id=order.request_id, behaviour=behaviour)
        self.in_flight = ControlRequest(
            request_id=order.request_id,
            robot=self.robot,
            behaviour=behaviour,
            enable=enable,
            parameters=filled.parameters,
            filtered=filled.filtered,
            law=filled.law,
            team=filled.team,
            peers=filled.peers,
            members=filled.members,
            roles=filled.roles,
            needs=filled.needs,
            stays=filled.stays,
            centralised=filled.centralised,
            survives_core=filled.survives_core,
            expires_s=filled.expires_s,
            core=self.core,
            sequence=sequence,
        )
        self.tries = 0
        return self.in_flight

    def due(self, now_s: float) -> ControlRequest | None:
        """Return the request in flight as it is to be sent now; None without one, or when it is an expired intent."""
        flight = self.in_flight
        if flight is None:
            return None
        left_s = self.expires_at_s - now_s if flight.enable and flight.expires_s > 0.0 else math.inf
        if left_s <= 0.0:
            return None
        # Within rounding it is as requested.
        expires_s = left_s if left_s < flight.expires_s - 1e-6 else flight.expires_s
        return msgspec.structs.replace(flight, stamp_s=now_s, expires_s=expires_s, halts=tuple(self.halts))

    def sent(self, now_s: float) -> None:
        """Note that the request was sent: the next try follows after 0.1 s, later ones up to 0.5 s apart."""
        self.resend_s = now_s + min(RESEND_S * 2.0**self.tries, RESEND_MAX_S)
        self.tries = min(self.tries + 1, 8)

    def acknowledge(self, ack: ControlAck, now_s: float) -> bool:
        """Process an acknowledgement; False when it answers a request that is no longer in flight."""
        flight = self.in_flight
        if ack.core != self.core:
            return False
        if ack.accepted:
            self.acked_sequence, self.acked_s = max(self.acked_sequence, ack.sequence), now_s
        if flight is None or ack.sequence != flight.sequence:
            return False
        self._clear_in_flight()
        if not flight.enable:
            self.active = self._maybe_active = ""
        elif ack.accepted:
            self.active, self._maybe_active = flight.behaviour, ""
            self.settled, self._enabled = True, flight
        else:
            self.refused = given(ack.reason or "no reason given", ack.code, ack.parameters)
        return True

    def compare(self, health: RobotHealth, restarted: bool, now_s: float) -> Reason:
        """Compare with what the robot reports.

        Returns
        -------
        Reason
            Empty, or why the robot itself has ended the order: then the order is to be dropped.
        """
        if restarted:
            self._send_again(now_s)
            self.acked_sequence = 0
            self._maybe_active = ""
        result = health.result
        if result is not None and self.order is not None and result.request_id == self.order.request_id:
            self._clear_in_flight()
            self.active = self._maybe_active = ""
            return result_reason(result, self.order.behaviour)
        if self._foreign(health) and not restarted:
            overdue = now_s - self.acked_s >= BEHIND_S and self.order is not None
            return reason(Code.OTHER_CORE) if overdue else NONE  # two cores must not alternate
        if self._stale(health, restarted, now_s):
            return NONE
        order, running = self.order, health.behaviour
        if order is None:
            self._observe(running)
            return NONE
        same = running != "" and (running, health.request_id) == (order.behaviour, order.request_id)
        # Commands are numbered per core: a centralised order of an earlier core must be enabled again.
        if same and not (order.centralised and health.core != self.core):
            self._confirm(health)
            return NONE
        if not running and not order.enables_nothing and (order.adopted or self.settled):
            if not restarted:
                why = given(health.stop_reason, health.stop_code, health.stop_parameters)
                return why or given(health.fault, health.fault_code) or reason(Code.DRIVER_STOPPED, cause=NO_TASK)
            if order.adopted:
                return given("the robot was restarted, and the core has lost the parameters by its own restart")
        self._observe(running)
        return NONE

    def _foreign(self, health: RobotHealth) -> bool:
        """Tell whether the robot runs what another core asked for, although it has acknowledged this one."""
        return self.acked_sequence > 0 and health.behaviour != "" and health.core != self.core

    def _stale(self, health: RobotHealth, restarted: bool, now_s: float) -> bool:
        """Tell whether the report was written before the robot acknowledged the newest request."""
        if restarted or not self.acked_sequence:
            return False
        if health.core == self.core:
            return health.sequence < self.acked_sequence
        # It has received nothing of this core yet, or what another one asked since.
        return now_s - self.acked_s < UNSEEN_S

    def _confirm(self, health: RobotHealth) -> None:
        """Use a report in place of a lost acknowledgement."""
        flight = self.in_flight
        if flight is not None and flight.enable and (health.core != self.core or health.sequence >= flight.sequence):
            self._enabled = flight
            self._clear_in_flight()
        if self.in_flight is None and not self.refused:
            self.active, self._maybe_active, self.settled = health.behaviour, "", True
            if health.core == self.core:
                self.acked_sequence = max(self.acked_sequence, health.sequence)

    def _observe(self, running: str) -> None:
        """Record what the robot runs when that is not its order."""
        idle = running in IDLE
        self.active = "" if idle else running
        self.settled = self.settled and idle and self.order is not None and self.order.enables_nothing

    def _send_again(self, now_s: float) -> None:
        """Have a new process of the agent get what the one before it was sent.

        Under the same number: its first report may come after its answer, and then it would start it a second time.
        """
        flight = self.in_flight if self.in_flight is not None and self.in_flight.enable else self._enabled
        self._clear_in_flight()
        if flight is not None:
            self.in_flight, self.tries, self.resend_s, self.settled = flight, 0, now_s, False

    def _clear_in_flight(self) -> None:
        self.in_flight, self.resend_s = None, math.inf


def result_reason(result: Result, behaviour: str) -> Reason:
    """Return the result of a behaviour that has ended itself as a reason."""
    code = Code.ARRIVED if result.outcome == "arrived" else Code.FAILED
    return reason(code, behaviour=behaviour, text=result.text or "no more is said")
