"""One robot as the request handler sees it: what is wanted, what it confirmed, what is on the way to it.

Pure bookkeeping: events in, at most one control request out. The rules:

* an active behaviour is disabled, and that acknowledged, before another one is enabled (paper II.C.2);
* the same behaviour with new parameters is an update and needs no disabling;
* what is not acknowledged is sent again, with the same sequence number, so that it happens once;
* an intent lives from when it was asked for, however late it gets through;
* what the robot reports of itself is the truth: after a restart of either side the two are compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec

from fullswarm.messages import ControlAck, ControlRequest, RobotHealth, Value
from fullswarm.reasons import NONE, Code, Reason, given, reason

RESEND_S = 0.1
RESEND_MAX_S = 0.5
BEHIND_S = 0.5
"""A report that contradicts an acknowledgement is taken for older than it during this time, then for the truth."""

IDLE = ("", "stop")
"""Behaviours that mean: nothing is enabled."""


class Order(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What one robot shall run; also the form in which it is kept in the local database."""

    request_id: str
    behaviour: str
    parameters: dict[str, Value] = {}
    law: str = ""
    team: int = 0
    filtered: bool = False
    centralised: bool = False
    survives_core: bool = False
    expires_s: float = 0.0
    adopted: bool = False  # read off the robot after a restart of the core: parameters unknown
    operator: str = ""  # who asked for it; with `clock` and `stamp_s` as in the request
    clock: str = ""
    stamp_s: float = 0.0

    @property
    def intent(self) -> bool:
        """It lapses unless repeated."""
        return self.expires_s > 0.0

    @property
    def stands(self) -> bool:
        """Nothing shall be enabled."""
        return self.behaviour in IDLE or not (self.law or self.centralised or self.adopted)


@dataclass(slots=True)
class Desired:
    """State of one robot. `order` is what is wanted now; None: leave it alone."""

    robot: str
    core: str
    present: bool = False
    order: Order | None = None
    waiting: Order | None = None  # until the schedule interval is over
    switched_s: float = -math.inf
    lapses_s: float = math.inf
    settled: bool = False  # the robot confirmed `order`
    refused: Reason = NONE  # why it said no to `order`
    active: str = ""  # the behaviour it last said it runs
    flight: ControlRequest | None = None  # sent, not acknowledged
    tries: int = 0
    resend_s: float = math.inf
    obeyed: int = 0  # highest sequence acknowledged
    acked_s: float = -math.inf
    _maybe: str = field(default="", repr=False)  # an enable on the way when the order changed

    def want(self, order: Order | None, now_s: float) -> None:
        """Change what is wanted."""
        if self.flight is not None and self.flight.enable:
            self._maybe = self.flight.behaviour
        self.order, self.settled, self.refused = order, False, NONE
        self.lapses_s = now_s + order.expires_s if order is not None and order.intent else math.inf
        if self.flight is not None and (order is None or self.flight.enable):
            self._land()

    def next(self, sequence: Callable[[], int]) -> ControlRequest | None:
        """Return the control request to send now, with a `sequence` of its own, if any."""
        order = self.order
        if order is None or self.settled or self.refused or not self.present:
            return None
        blocking = self.active or self._maybe
        if blocking and (order.stands or blocking != order.behaviour):
            if self.flight is not None and not self.flight.enable:
                return None
            return self._launch(order, blocking, enable=False, sequence=sequence())
        if order.stands:
            self.settled = True
            self._land()
            return None
        if self.flight is not None or order.adopted:
            return None
        return self._launch(order, order.behaviour, enable=True, sequence=sequence())

    def _launch(self, order: Order, behaviour: str, *, enable: bool, sequence: int) -> ControlRequest:
        filled = order if enable else Order(request_id=order.request_id, behaviour=behaviour)
        self.flight = ControlRequest(
            request_id=order.request_id,
            robot=self.robot,
            behaviour=behaviour,
            enable=enable,
            parameters=filled.parameters,
            filtered=filled.filtered,
            law=filled.law,
            team=filled.team,
            centralised=filled.centralised,
            survives_core=filled.survives_core,
            expires_s=filled.expires_s,
            core=self.core,
            sequence=sequence,
        )
        self.tries = 0
        return self.flight

    def due(self, now_s: float) -> ControlRequest | None:
        """Return `flight` as it is to be sent now; None when there is none, or it is an intent that has lapsed."""
        flight = self.flight
        if flight is None:
            return None
        left_s = self.lapses_s - now_s if flight.enable and flight.expires_s > 0.0 else math.inf
        if left_s <= 0.0:
            return None
        # Within rounding it is as it was asked for.
        expires_s = left_s if left_s < flight.expires_s - 1e-6 else flight.expires_s
        return msgspec.structs.replace(flight, stamp_s=now_s, expires_s=expires_s)

    def sent(self, now_s: float) -> None:
        """Note that `flight` went out: the next try comes after 0.1 s, later ones up to 0.5 s apart."""
        self.resend_s = now_s + min(RESEND_S * 2.0**self.tries, RESEND_MAX_S)
        self.tries = min(self.tries + 1, 8)

    def acknowledge(self, ack: ControlAck, now_s: float) -> bool:
        """Take a robot's answer; False when it answers something that is no longer asked."""
        flight = self.flight
        if ack.core != self.core:
            return False
        if ack.accepted:
            self.obeyed, self.acked_s = max(self.obeyed, ack.sequence), now_s
        if flight is None or ack.sequence != flight.sequence:
            return False
        self._land()
        if not flight.enable:
            self.active = self._maybe = ""
        elif ack.accepted:
            self.active, self._maybe = flight.behaviour, ""
            self.settled = True
        else:
            self.refused = given(ack.reason or "no reason given", ack.code, ack.parameters)
        return True

    def compare(self, health: RobotHealth, restarted: bool, now_s: float) -> Reason:
        """Compare with what the robot reports.

        Returns
        -------
        Reason
            False, or why the robot itself has given up what was wanted: then nothing is wanted any more.
        """
        if restarted:
            self._land()
            self.obeyed = 0
            self._maybe = ""
        if self._foreign(health) and not restarted:
            overdue = now_s - self.acked_s >= BEHIND_S and self.order is not None
            return reason(Code.OTHER_CORE) if overdue else NONE  # do not fight over it
        if self._stale(health, restarted, now_s):
            return NONE
        order, running = self.order, health.behaviour
        if order is None:
            self._observe(running)
            return NONE
        same = running != "" and (running, health.request_id) == (order.behaviour, order.request_id)
        # Commands are numbered per core: a centralised order of an earlier one must be enabled anew.
        if same and not (order.centralised and health.core != self.core):
            self._confirm(health)
            return NONE
        if not running and not order.stands and (order.adopted or self.settled):
            if not restarted:
                told = given(health.stop_reason, health.stop_code, health.stop_parameters)
                return told or reason(Code.DRIVER_STOPPED)
            if order.adopted:
                return given("the robot was started again, and the core lost the parameters when it was itself")
        self._observe(running)
        return NONE

    def _foreign(self, health: RobotHealth) -> bool:
        """Tell whether the robot runs what another core asked for, although it has obeyed this one."""
        return self.obeyed > 0 and health.behaviour != "" and health.core != self.core

    def _stale(self, health: RobotHealth, restarted: bool, now_s: float) -> bool:
        """Tell whether the report was written before the robot obeyed our newest request."""
        if restarted or not self.obeyed:
            return False
        # An idle robot does not tell a sequence.
        return health.sequence < self.obeyed and now_s - self.acked_s < BEHIND_S

    def _confirm(self, health: RobotHealth) -> None:
        """Take a report for the acknowledgement that was lost."""
        flight = self.flight
        if flight is not None and flight.enable and (health.core != self.core or health.sequence >= flight.sequence):
            self._land()
        if self.flight is None and not self.refused:
            self.active, self._maybe, self.settled = health.behaviour, "", True
            if health.core == self.core:
                self.obeyed = max(self.obeyed, health.sequence)

    def _observe(self, running: str) -> None:
        """Take note of what the robot runs when that is not what is wanted."""
        idle = running in IDLE
        self.active = "" if idle else running
        self.settled = self.settled and idle and self.order is not None and self.order.stands

    def _land(self) -> None:
        self.flight, self.resend_s = None, math.inf
