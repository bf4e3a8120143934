"""`fullswarm estop`: repeats the order until every robot has confirmed it, and reports which have not."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm import output
from fullswarm.cli.options import Json, RobotArguments, robot_ids, shell_command
from fullswarm.errors import FullswarmError, SafetyStop, Unreachable

if TYPE_CHECKING:
    from fullswarm.cli.options import Target
    from fullswarm.messages import EStopReceipt, RequestStatus
    from fullswarm.operator.estop import EStopOrder
    from fullswarm.operator.session import Session
    from fullswarm.operator.view import FleetView

REPORT_S = 0.5
"""An e-stop that is not confirmed by then names the missing robots."""
REPORT_AGAIN_S = 5.0
CLEAR_TIMEOUT_S = 5.0
"""A forgotten terminal must not release a robot that comes back tomorrow; an e-stop is repeated without end."""
NO_ROBOT_S = 5.0
"""With no robot known by then there is none to stop: most likely the wrong swarm."""

WITHOUT_HUB = "robots without a hub stop by themselves, but they are not latched"


@dataclass(frozen=True, slots=True)
class EStopOptions:
    """The order; no `timeout_s` means the default: without end, and 5 s for a release."""

    robots: tuple[str, ...]
    engaged: bool
    reason: str = ""
    timeout_s: float | None = None
    fleet: frozenset[str] = frozenset()  # of the fleet file: they must confirm even if they were never received
    as_json: bool = False

    @property
    def patience_s(self) -> float:
        """How long the order is repeated."""
        if self.timeout_s is not None:
            return self.timeout_s
        return math.inf if self.engaged else CLEAR_TIMEOUT_S


@shell_command()
def estop(
    target: Target,
    robots: RobotArguments = None,
    clear: Annotated[bool, typer.Option("--clear", help="Release the latched e-stop instead.")] = False,
    reason: Annotated[str, typer.Option(help="The reason, for the robots' logs and reports.")] = "",
    timeout: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS", min=0.1, max=86400, help="Give up then (default: on Ctrl-C; with --clear 5 s)."
        ),
    ] = None,
    fleet: Annotated[
        Path | None,
        typer.Option(
            envvar="FULLSWARM_FLEET", metavar="FILE", help="Require confirmation from all robots of this fleet file."
        ),
    ] = None,
    as_json: Json = False,
) -> int:
    """Engage the emergency stop, latched until --clear; repeat it until all robots confirm.

    Exit code 4 when a robot did not confirm, 3 when no robot was received or no hub answers.
    """
    options = EStopOptions(robot_ids(robots), not clear, reason, timeout, as_json=as_json)
    target, options = _with_fleet(target, options, fleet)
    with ExitStack() as stack:
        connection, at_once = _connect(stack, target, options)
        report = EStopReport(connection, options)
        if not at_once:
            report.order.hub_returned()
        connection.on_interrupt = connection.finish
        connection.run()
        report.order.close()
        return report.result()


def _with_fleet(target: Target, options: EStopOptions, fleet: Path | None) -> tuple[Target, EStopOptions]:
    """Take robots, hub and swarm from the fleet file; an error in that file must not prevent a stop."""
    if fleet is None:
        return target, options
    from fullswarm.config import load_swarm

    try:
        config = load_swarm(fleet)
    except FullswarmError as error:
        output.progress(f"continuing without the fleet file: {error}")
        return target, options
    swarm = config.swarm if target.swarm == type(target)().swarm else target.swarm
    return (
        replace(target, hub=target.hub or config.hub.endpoint, swarm=swarm),
        replace(options, fleet=frozenset(config.robots)),
    )


def _connect(stack: ExitStack, target: Target, options: EStopOptions) -> tuple[Session, bool]:
    """Reach the hub, however long it takes: robots whose hub comes back drive on unless they receive the order.

    Returns
    -------
    tuple
        The session, and whether the hub answered at once.
    """
    from fullswarm.operator import session

    waited_s, within_s = 0.0, REPORT_S if options.engaged else session.CONNECT_S
    while True:
        try:
            return stack.enter_context(session.connect(target, within_s)), waited_s == 0.0
        except Unreachable as error:
            if waited_s == 0.0 and options.engaged:
                output.progress(f"{error.where}: {error.what}: {WITHOUT_HUB}; still trying")
            waited_s += within_s
            within_s = min(session.CONNECT_S, options.patience_s - waited_s)
            if not options.engaged or within_s <= 0.0:
                raise Unreachable(error.what, where=error.where, hint=f"{WITHOUT_HUB}; {error.hint}") from error


@dataclass(slots=True)
class EStopReport:
    """Sends one order and prints which robots have confirmed it and which have not."""

    connection: Session
    options: EStopOptions
    order: EStopOrder = field(init=False)
    _view: FleetView = field(init=False)
    _from_core: set[str] = field(init=False, default_factory=set)
    _connected: bool = field(init=False, default=True)

    def __post_init__(self) -> None:
        from fullswarm.messages import RequestStatus
        from fullswarm.operator.estop import REPEAT_S
        from fullswarm.operator.view import FleetView

        connection, options = self.connection, self.options
        self._view = FleetView(connection.bus, connection.keys, connection.runtime)
        connection.bus.subscribe(connection.keys.behaviour_status, RequestStatus, self._on_status)
        self.order = connection.operator.estop(
            options.engaged,
            options.robots,
            options.reason,
            known=self._known,
            deadline_s=options.patience_s,
            on_receipt=self._on_receipt,
            on_done=lambda _: connection.finish(),
        )
        connection.runtime.every(REPORT_AGAIN_S, self._report_missing, first_s=REPORT_S)
        connection.runtime.every(REPEAT_S, self._watch_hub)
        connection.runtime.after(NO_ROBOT_S, self._end_without_robots)

    def result(self) -> int:
        """Print the outcome and return 0, or raise what is wrong."""
        order = self.order
        if self.options.as_json:
            output.data_json(self._as_dict())
        if order.overruled_by:
            raise SafetyStop(
                f"{order.overruled_by} was latched again after this release",
                hint="another operator engaged the e-stop meanwhile; it stays engaged",
            )
        if not order.concerned():
            raise Unreachable(
                "no robot was received", where=self.connection.hub, hint="are agents running in this swarm?"
            )
        if order.unconfirmed():
            hint = "go there: they may still move" if order.message.engaged else "they stay stopped; try again"
            raise SafetyStop(f"after {order.elapsed_s:.3g} s {'; '.join(self._missing())}", hint=hint)
        return 0

    def _known(self) -> Iterable[str]:
        return {*self._view.robots(), *self.options.fleet, *self._from_core}

    def _on_status(self, status: RequestStatus) -> None:
        """Take the names of the whole fleet from the core, if one runs: it answers an e-stop with all it knows."""
        if status.request_id == self.order.message.id:
            self._from_core.update(status.robots)

    def _missing(self) -> list[str]:
        """Return the robots that have not confirmed, by what is known of them."""
        order, received = self.order, {*self._view.robots()}
        never = [robot for robot in order.silent() if robot not in received]
        mute = [robot for robot in order.silent() if robot in received]
        state = "latched, but standstill not confirmed" if order.message.engaged else "not released"
        return [
            f"{what} {', '.join(names)}"
            for what, names in (
                ("no answer from", mute),
                ("nothing ever received from", never),
                (f"{state}:", order.decelerating()),
            )
            if names
        ]

    def _on_receipt(self, receipt: EStopReceipt) -> None:
        if not self.options.as_json:
            output.data(receipt_line(receipt))

    def _report_missing(self) -> None:
        if not self.order.done and self.order.unconfirmed():
            output.progress(f"after {self.order.elapsed_s:.1f} s {'; '.join(self._missing())}; still trying")

    def _end_without_robots(self) -> None:
        if not self.order.concerned() and self.options.timeout_s is None:
            self.connection.finish()

    def _watch_hub(self) -> None:
        connected = self.connection.bus.connected()
        if connected != self._connected:
            self._connected = connected
            if connected:
                self.order.hub_returned()
            output.progress("the hub is back" if connected else f"the hub is lost: {WITHOUT_HUB}; still trying")

    def _as_dict(self) -> dict[str, object]:
        import msgspec

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
    """Return a receipt as text."""
    if not receipt.engaged:
        return f"{receipt.robot}: released"
    if receipt.standing:
        return f"{receipt.robot}: at standstill after {receipt.rolled_m:.3f} m"
    return f"{receipt.robot}: decelerating"
