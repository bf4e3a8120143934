"""Shows pads and the pilot's status in a terminal."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from fullswarm.operator.joystick.pilot import PilotStatus
from fullswarm.operator.joystick.state import PadState

_BAR = 10


class Screen:
    """A changing status on stderr: in place on a terminal, as a line per change anywhere else."""

    def __init__(self) -> None:
        self._console = Console(stderr=True, highlight=False)
        self._live = Live(console=self._console, auto_refresh=False, transient=True) if self.in_place else None
        self._last = ""
        if self._live is not None:
            self._live.start()

    @property
    def in_place(self) -> bool:
        """Whether stderr is a terminal."""
        return self._console.is_terminal

    def show(self, what: Table | str, line: str) -> None:
        """Show `what` on a terminal; elsewhere `line`, if it has changed."""
        if self._live is not None:
            self._live.update(what, refresh=True)
        elif line != self._last:
            self._console.print(escape(line), soft_wrap=True)
        self._last = line

    def close(self) -> None:
        """Restore the terminal."""
        if self._live is not None:
            self._live.stop()


def status_text(status: PilotStatus) -> str:
    """Return the pilot's status, with rich's markup."""
    hold = "[bold green]DEAD-MAN HELD[/]" if status.dead_man else "[dim]dead-man up[/]"
    count = f" ({status.robots})" if status.robots > 1 else ""
    sticks = "  ".join(f"{name} {_bar(value)} {value:+.2f}" for name, value in status.values.items())
    what = f"[bold]{escape(status.behaviour)}[/]  {sticks}" if status.behaviour else "[dim]nothing[/]"
    turbo = "  [bold yellow]TURBO[/]" if status.turbo else ""
    lines = [
        f"{escape(status.pad or 'no gamepad: plug one in')}  |  {escape(status.selection)}{count}  |  {hold}{turbo}",
        f"requests {what}",
    ]
    return "\n".join([*lines, f"[bold]{escape(status.note)}[/]"] if status.note else lines)


def status_line(status: PilotStatus) -> str:
    """Return the same for a file, without the values that change twenty times a second."""
    pad = status.pad or "no gamepad"
    parts = [pad, status.selection, status.behaviour, status.note]
    return " | ".join(part for part in parts if part)


def pad_table(pads: tuple[PadState, ...], meanings: Mapping[str, str]) -> Table:
    """Return axes and buttons of all pads, and what they would request."""
    table = Table("pad", "control", "value", "requests", title="nothing is sent; Ctrl-C ends")
    for pad in pads:
        if not pad.known:
            table.add_row(escape(pad.name), "unknown to SDL", "", "map it with `fullswarm joystick map`")
        for name, value in pad.axes.items():
            table.add_row(escape(pad.name), name, f"{_bar(value)} {value:+.2f}", escape(meanings.get(name, "")))
        for name in sorted({*meanings, *pad.buttons}.difference(pad.axes)) if pad.known else ():
            down = "[bold green]down[/]" if name in pad.buttons else "-"
            table.add_row(escape(pad.name), name, down, escape(meanings.get(name, "")))
    return table


def pad_line(pads: tuple[PadState, ...], meanings: Mapping[str, str]) -> str:
    """Return the pressed buttons and pushed sticks in one line."""
    if not pads:
        return "no gamepad"
    parts = []
    for pad in pads:
        pushed = [_with_meaning(f"{name} {value:+.1f}", name, meanings) for name, value in pad.axes.items() if
                  abs(value) >= 0.1]  # fmt: skip
        pressed = [_with_meaning(name, name, meanings) for name in sorted(pad.buttons)]
        quiet = "at rest" if pad.known else "unknown to SDL: map it with `fullswarm joystick map`"
        parts.append(f"{pad.name}: {', '.join(pushed + pressed) or quiet}")
    return "; ".join(parts)


def _with_meaning(text: str, name: str, meanings: Mapping[str, str]) -> str:
    return f"{text} = {meanings[name]}" if name in meanings else text


def _bar(value: float) -> str:
    """Return a bar with its zero in the middle."""
    at = round(max(-1.0, min(1.0, value)) * _BAR / 2)
    left, right = max(0, -at), max(0, at)
    return " " * (_BAR // 2 - left) + "█" * left + "│" + "█" * right + " " * (_BAR // 2 - right)
