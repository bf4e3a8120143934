"""The commands about leases: list the holders, and hold robots. Each returns its exit code."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec
from rich.markup import escape
from rich.table import Table

from fullswarm import output
from fullswarm.errors import ConfigError, RequestRefused
from fullswarm.messages import Lease, Leases
from fullswarm.operator import session
from fullswarm.operator.leases import SETTLE_S, LeaseHolder
from fullswarm.operator.orders import robot_ids
from fullswarm.operator.session import Session, Target

PATIENCE_S = 3.0
"""The core reports the leases each second."""


def show(target: Target, *, as_json: bool, timeout_s: float = PATIENCE_S) -> int:
    """Print which operator holds which robots, as the core reports it each second."""
    heard: Leases | None = None
    with session.connect(target) as line:

        def receive(message: Leases) -> None:
            nonlocal heard
            heard = message
            line.finish()

        line.bus.subscribe(line.keys.leases, Leases, receive)
        line.run(timeout_s)
        if heard is None:
            raise line.no_core(timeout_s)
    leases = sorted(heard.leases, key=lambda lease: lease.robot)
    if as_json:
        output.data_json(msgspec.to_builtins(leases))
    elif leases:
        output.data_table(_table(leases))
    else:
        output.progress("no robot is held: each obeys every operator")
    return 0


def _table(leases: Iterable[Lease]) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    for name in ("robot", "held by", "for", "taken from"):
        table.add_column(name, overflow="fold")
    for lease in leases:
        table.add_row(*map(escape, (lease.robot, lease.operator, duration(lease.age_s), lease.taken_from or "-")))
    return table


def duration(seconds: float) -> str:
    """Return a time as people say it: ``12 s``, ``3 min 05 s``, ``2 h 07 min``."""
    whole = int(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02} min"


def hold(target: Target, robots: Iterable[str], *, take: bool, timeout_s: float = PATIENCE_S) -> int:
    """Hold robots until Ctrl-C (exit code 0), or until none is left because others took them over (1).

    Raises
    ------
    RequestRefused
        Others hold all of them, and they were not to be taken over; or the core knows none of them.
    Unreachable
        The core said nothing for `timeout_s`.
    """
    ids = robot_ids(robots, groups=True)
    if not ids:
        raise ConfigError("which robots?", where="leases hold", hint="e.g. fullswarm leases hold r1 r2")
    with session.connect(target) as line:
        return _Holding(line, ids, take, timeout_s).run()


class _Holding:
    """`leases hold` from its first word to Ctrl-C."""

    def __init__(self, line: Session, ids: tuple[str, ...], take: bool, timeout_s: float) -> None:
        self._line, self._ids, self._timeout_s = line, ids, timeout_s
        self._holder = LeaseHolder(
            line.bus,
            line.keys,
            line.runtime,
            line.operator.name,
            on_change=lambda _: self._tell(),
            on_lost=self._lost,
            on_refused=self._refused,
        )
        self._told: tuple[str, ...] = ()
        self._ever = False
        self._refusals: list[str] = []
        line.on_interrupt = line.finish
        self._holder.hold(ids, take=take)
        # The core's word after `SETTLE_S` is its answer, and it speaks each second.
        line.runtime.after(max(timeout_s, SETTLE_S + 1.0), self._judge)

    def run(self) -> int:
        name = self._line.operator.name
        self._line.run()
        heard, held = self._holder.heard, self._holder.held()
        self._holder.close()
        if not heard:
            raise self._line.no_core(self._timeout_s)
        if not self._ever and self._refusals:
            hint = "--take takes them over, `fullswarm leases` shows who holds what"
            raise RequestRefused("; ".join(self._refusals), where="leases hold", hint=hint)
        if not self._ever:
            known = "`fullswarm robots` shows which there are"
            raise RequestRefused(f"the core knows no {', '.join(self._ids)}", where="leases hold", hint=known)
        if held:
            output.progress(f"{name} gave back {', '.join(held)}")
        return 0 if held else 1

    def _tell(self) -> None:
        held = self._holder.held()
        if held != self._told:
            self._told = held
            self._ever |= bool(held)
            if held:
                output.progress(f"{self._line.operator.name} holds {', '.join(held)}; Ctrl-C gives back")

    def _lost(self, robots: tuple[str, ...], operator: str) -> None:
        output.progress(f"{', '.join(robots)}: taken over by {operator}")
        self._end_without_any()

    def _refused(self, robots: tuple[str, ...], operator: str) -> None:
        text = f"{', '.join(robots)} held by {operator}"
        self._refusals.append(text)
        output.progress(f"refused: {text}")
        self._end_without_any()

    def _judge(self) -> None:
        if not self._holder.heard or not (self._ever or self._refusals):
            self._line.finish()

    def _end_without_any(self) -> None:
        if not self._holder.held() and not self._holder.wanted():
            self._line.finish()
