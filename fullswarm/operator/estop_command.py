"""The command ``estop``: presses until every robot has confirmed, and reports at every moment which have not."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec

from fullswarm import output
from fullswarm.errors import FullswarmError, SafetyStop, Unreachable
from fullswarm.messages import EStopReceipt, RequestStatus
from fullswarm.operator import session
from fullswarm.operator.estop import REPEAT_S, EStopOrder
from fullswarm.operator.orders import robot_ids
from fullswarm.operator.session import Session, Target
from fullswarm.operator.view import FleetView

COMPLAIN_S = 0.5
"""An e-stop that is not confirmed by then names the missing robots."""
REMIND_S = 5.0
CLEAR_TIMEOUT_S = 5.0
"""A forgotten terminal must not release a robot that comes back tomorrow; an e-stop is pressed without end."""
NOBODY_S = 5.0
"""With no robot known by then there is no robot to press for: most likely the wrong swarm."""

STANDING_ALONE = "robots without a hub stand by themselves, but they are not latched"


@dataclass(frozen=True, slots=True)
class Press:
    """What is asked for; no `timeout_s` is the default of the act."""

    robots: tuple[str, ...]
    engaged: bool
    reason: str = ""
    timeout_s: float | None = None
    fleet: frozenset[str] = frozenset()  # of the fleet file: they must confirm even if they were never received

    @property
    def patience_s(self) -> float:
        """How long it goes on."""
        if self.timeout_s is not None:
            return self.timeout_s
        return math.inf if self.engaged else CLEAR_TIMEOUT_S


def estop(
    target: Target,
    robots: Sequence[str],
    *,
    engaged: bool,
    reason: str,
    timeout_s: float | None,
    fleet: Path | None,
    as_json: bool,
) -> int:
    """Engage or release the e-stop, print every receipt, name those that did not confirm.

    Raises
    ------
    SafetyStop
        A robot did not confirm before the time was up or Ctrl-C; names them.
    Unreachable
        No robot was received, or no hub answered in time.
    """
    press = Press(robot_ids(robots), engaged, reason, timeout_s)
    target, press = _with_fleet(target, press, fleet)
    with ExitStack() as stack:
        line = _connect(stack, target, press)
        pressing = Pressing(line, press, as_json)
        line.on_interrupt = line.finish
        line.run()
        pressing.order.close()
        return pressing.result()


def _with_fleet(target: Target, press: Press, fleet: Path | None) -> tuple[Target, Press]:
    """Take names, hub and swarm from the fleet file; what is wrong with that must not prevent a stop."""
    if fleet is None:
        return target, press
    from fullswarm.config import load_swarm

    try:
        config = load_swarm(fleet)
    except FullswarmError as error:
        output.progress(f"going on without the fleet file: {error}")
        return target, press
    swarm = config.swarm if target.swarm == Target().swarm else target.swarm
    return (
        replace(target, hub=target.hub or config.hub.endpoint, swarm=swarm),
        replace(press, fleet=frozenset(config.robots)),
    )


def _connect(stack: ExitStack, target: Target, press: Press) -> Session:
    """Reach the hub, however long it takes: robots whose hub comes back drive on unless they receive the order."""
    waited_s, within_s = 0.0, COMPLAIN_S if press.engaged else session.CONNECT_S
    while True:
        try:
            return stack.enter_context(session.connect(target, within_s))
        except Unreachable as error:
            if waited_s == 0.0 and press.engaged:
                output.progress(f"{error.where}: {error.what}: {STANDING_ALONE}; trying on")
            waited_s += within_s
            within_s = min(session.CONNECT_S, press.patience_s - waited_s)
            if not press.engaged or within_s <= 0.0:
                raise Unreachable(error.what, where=error.where, hint=f"{STANDING_ALONE}; {error.hint}") from error


@dataclass(slots=True)
class Pressing:
    """One order on its way, and what is said about it."""

    line: Session
    press: Press
    as_json: bool
    order: EStopOrder = field(init=False)
    _view: FleetView = field(init=False)
    _from_core: set[str] = field(init=False, default_factory=set)
    _connected: bool = field(init=False, default=True)

    def __post_init__(self) -> None:
        line, press = self.line, self.press
        self._view = FleetView(line.bus, line.keys, line.runtime)
        line.bus.subscribe(line.keys.behaviour_status, RequestStatus, self._core_said)
        self.order = line.operator.estop(
            press.engaged,
            press.robots,
            press.reason,
            known=self._known,
            deadline_s=press.patience_s,
            on_receipt=self._receipt,
            on_done=lambda _: line.finish(),
        )
        line.runtime.every(REMIND_S, self._complain, first_s=COMPLAIN_S)
        line.runtime.every(REPEAT_S, self._watch_hub)
        line.runtime.after(NOBODY_S, self._nobody)

    def result(self) -> int:
        """Print the outcome and return 0, or raise what is wrong."""
        order = self.order
        if self.as_json:
            output.data_json(self._as_dict())
        if order.overruled_by:
            raise SafetyStop(
                f"{order.overruled_by} was latched again after this release",
                hint="another operator pressed the e-stop meanwhile: it holds",
            )
        if not order.concerned():
            raise Unreachable("no robot was heard", where=self.line.hub, hint="are agents running in this swarm?")
        if order.unconfirmed():
            hint = "go there: they may still move" if order.message.engaged else "they stay stopped; try again"
            raise SafetyStop(f"after {order.elapsed_s:.3g} s {'; '.join(self._missing())}", hint=hint)
        return 0

    def _known(self) -> Iterable[str]:
        return {*self._view.robots(), *self.press.fleet, *self._from_core}

    def _core_said(self, status: RequestStatus) -> None:
        """Take the names of the whole fleet from the core, if one lives: it answers an e-stop with all it knows."""
        if status.request_id == self.order.message.id:
            self._from_core.update(status.robots)

    def _missing(self) -> list[str]:
        """Return the robots that have not confirmed, by what is known of them."""
        order, heard = self.order, {*self._view.robots()}
        never = [robot for robot in order.silent() if robot not in heard]
        mute = [robot for robot in order.silent() if robot in heard]
        state = "latched, but not seen standing" if order.message.engaged else "not released"
        return [
            f"{what} {', '.join(names)}"
            for what, names in (
                ("no answer from", mute),
                ("nothing heard from", never),
                (f"{state}:", order.rolling()),
            )
            if names
        ]

    def _receipt(self, receipt: EStopReceipt) -> None:
        if not self.as_json:
            output.data(receipt_line(receipt))

    def _complain(self) -> None:
        if not self.order.done and self.order.unconfirmed():
            output.progress(f"after {self.order.elapsed_s:.1f} s {'; '.join(self._missing())}; trying on")

    def _nobody(self) -> None:
        if not self.order.concerned() and self.press.timeout_s is None:
            self.line.finish()

    def _watch_hub(self) -> None:
        connected = self.line.bus.connected()
        if connected != self._connected:
            self._connected = connected
            said = "the hub is back" if connected else f"the hub is lost: {STANDING_ALONE}; trying on"
            output.progress(said)

    def _as_dict(self) -> dict[str, object]:
        order = self.order
        return {
            "id": order.message.id,
            "engaged": order.message.engaged,
            "receipts": [msgspec.to_builtins(order.receipts[robot]) for robot in sorted(order.receipts)],
            "answered_s": {robot: round(order.answered_s[robot], 4) for robot in sorted(order.answered_s)},
            "confirmed_s": {robot: round(order.confirmed_s[robot], 4) for robot in sorted(order.confirmed_s)},
            "unconfirmed": list(order.unconfirmed()),
            "silent": list(order.silent()),
        }


def receipt_line(receipt: EStopReceipt) -> str:
    """Return a receipt in words."""
    if not receipt.engaged:
        return f"{receipt.robot}: released"
    if receipt.standing:
        return f"{receipt.robot}: stands, rolled {receipt.rolled_m:.3f} m"
    return f"{receipt.robot}: stopping"
