"""Presses a standing robot's e-stop for a moment and releases it again: whether it gets there, and how soon.

Nothing moves by this, and no other operator's e-stop is cleared: a robot that is latched already is left alone, and
one that another operator latches meanwhile stays latched.
"""

from __future__ import annotations

from collections.abc import Callable

from fullswarm import output
from fullswarm.bringup.checks import Check, took
from fullswarm.messages import EStop
from fullswarm.operator.estop import EStopOrder
from fullswarm.operator.session import Session
from fullswarm.operator.view import FleetView

NAME = "e-stop"
PRESS_S = RELEASE_S = 3.0
LATE_S, TOO_LATE_S = 0.2, 1.0
FRESH_S = 1.0
"""Health reports come at 2 Hz and on change: an older one may not know of a latch or a behaviour."""
ROLLED_M = 0.02
CROSSING_S = 0.3
"""Time within which another operator's order may cross ours."""

Agree = Callable[[str], bool | None]
"""Asks the operator; None: no terminal."""


def check(line: Session, view: FleetView, robot: str, agree: Agree) -> Check:
    """Press and release if the robot is at standstill, is free and the operator agrees."""
    others = _Others(line, robot)
    try:
        line.run(FRESH_S)  # older messages may be minutes old: the operator may have taken so long to answer
        if reason := _unfit(view, robot, line.operator.name):
            return Check(NAME, "warning", f"not pressed: {reason}", f"then again: fullswarm doctor --robot {robot}")
        agreed = agree(f"Press the e-stop of {robot} for a moment and release it again? It stands; nothing moves.")
        if agreed is None:
            return Check(
                NAME,
                "warning",
                "not pressed: no terminal to ask for confirmation",
                "--yes skips the confirmation prompt",
            )
        if not agreed:
            return Check(NAME, "ok", "not pressed: not wanted")
        line.run(FRESH_S)
        if others.pressed or (reason := _unfit(view, robot, line.operator.name)):
            what = f"not pressed: {reason or 'another operator has just pressed it'}"
            return Check(NAME, "warning", what, f"then again: fullswarm doctor --robot {robot}")
        return _press(line, robot, others)
    finally:
        others.close()


class _Others:
    """Watches whether another operator presses this robot's e-stop."""

    def __init__(self, line: Session, robot: str) -> None:
        self.pressed = ""
        self._robot, self._source = robot, line.source
        self._subscription = line.bus.subscribe(line.keys.estop, EStop, self._hear)

    def _hear(self, order: EStop) -> None:
        if order.engaged and order.source != self._source and (not order.robots or self._robot in order.robots):
            self.pressed = order.source or "another operator"

    def close(self) -> None:
        self._subscription.close()


def _unfit(view: FleetView, robot: str, name: str) -> str:
    """Return why it must not be pressed now; empty if it may."""
    seen = view.snapshot()
    row = next((each for each in seen.robots if each.robot == robot), None)
    if row is None or row.health is None or row.silent:
        return f"{robot} is not received"
    health, holder = row.health, seen.holders.get(robot, "")
    if health.estop:
        return "it is latched already, and stays so"
    if health.moving:
        return "it moves"
    if health.behaviour:
        return f"it runs {health.behaviour}, which this would end"
    if holder and holder != name:
        return f"{holder} holds it"
    if health.lifecycle not in ("READY", "ACTIVE"):
        return f"its driver is {health.lifecycle}: its standstill could not be verified"
    return ""


def _press(line: Session, robot: str, others: _Others) -> Check:
    interrupted = False

    def interrupt() -> None:
        nonlocal interrupted
        interrupted = True
        line.runtime.pause()

    released: EStopOrder | None = None
    line.on_interrupt = interrupt  # Ctrl-C now means: release it first
    try:
        pressed = _order(line, robot, engaged=True, within_s=PRESS_S)
    finally:
        line.on_interrupt = None
        if not others.pressed:
            released = _release(line, robot)
    if interrupted:
        raise KeyboardInterrupt
    if released is not None and not released.overruled_by:
        line.run(CROSSING_S)
        if others.pressed:  # on its way while we released: that must not have undone it
            _order(line, robot, engaged=True, within_s=PRESS_S)
            released = None
    return _judge(robot, pressed, released, others.pressed)


def _order(line: Session, robot: str, *, engaged: bool, within_s: float) -> EStopOrder:
    order = line.operator.estop(
        engaged,
        (robot,),
        "preflight: is released again at once" if engaged else "preflight",
        deadline_s=within_s,
        on_done=lambda _: line.runtime.pause(),
    )
    line.run(within_s + 0.5)
    order.close()
    return order


def _release(line: Session, robot: str) -> EStopOrder:
    try:
        return _order(line, robot, engaged=False, within_s=RELEASE_S)
    except BaseException:
        output.progress(f"{robot} may still be latched: fullswarm estop --clear {robot}")
        raise


def _judge(robot: str, pressed: EStopOrder, released: EStopOrder | None, other: str) -> Check:
    clear = f"fullswarm estop --clear {robot}"
    if released is None:
        return Check(NAME, "warning", f"{other} pressed it meanwhile: it stays latched", f"when that is over: {clear}")
    if released.overruled_by:
        return Check(NAME, "warning", "another operator pressed it during the release: it stays latched", clear)
    if released.unconfirmed():
        return Check(NAME, "failure", "pressed, but its release was not confirmed: it may still be latched", clear)
    if pressed.silent():
        what = f"not confirmed within {took(pressed.elapsed_s)}"
        return Check(NAME, "failure", what, "do not drive it before this works: look at the network")
    if pressed.unconfirmed():
        what = "latched, but its agent does not see it standing"
        return Check(NAME, "failure", what, f"look at the driver: fullswarm logs {robot}")
    answered_s, stood_s = pressed.answered_s[robot], pressed.confirmed_s[robot]
    what = f"receipt after {took(answered_s)}, seen standing after {took(stood_s)}, released again"
    if pressed.receipts[robot].rolled_m > ROLLED_M:
        what = f"{what}; it rolled {pressed.receipts[robot].rolled_m:.3f} m"
        return Check(NAME, "failure", what, "it was reported at standstill: check its wheels and its encoders")
    if answered_s > LATE_S:
        mend = "look at the network before it drives"
        return Check(NAME, "failure" if answered_s > TOO_LATE_S else "warning", what, mend)
    return Check(NAME, "ok", what)
