"""Teaches SDL an unknown pad: asks for each control in turn and notes which axis, button or hat answers."""

from __future__ import annotations

from dataclasses import dataclass

from fullswarm.operator.joystick.state import RawState

CONTROLS = (
    ("leftx", "push the left stick to the right"),
    ("lefty", "pull the left stick towards you"),
    ("rightx", "push the right stick to the right"),
    ("righty", "pull the right stick towards you"),
    ("leftshoulder", "press the upper left shoulder button (LB): it will be the dead-man"),
    ("rightshoulder", "press the upper right shoulder button (RB)"),
    ("lefttrigger", "pull the left trigger all the way"),
    ("righttrigger", "pull the right trigger all the way"),
    ("a", "press the lowest of the four buttons on the right (A)"),
    ("b", "press the right one of them (B): it will be the e-stop"),
    ("x", "press the left one of them (X)"),
    ("y", "press the upper one of them (Y)"),
    ("dpup", "press the cross up"),
    ("dpdown", "press the cross down"),
    ("dpleft", "press the cross to the left"),
    ("dpright", "press the cross to the right"),
    ("back", "press Back, Select or View"),
    ("start", "press Start or Menu"),
    ("leftstick", "press the left stick down"),
    ("rightstick", "press the right stick down"),
)
NEEDED = ("leftx", "lefty", "leftshoulder", "a", "b")
"""Without them the default bindings can neither drive nor stop."""
STICKS = ("leftx", "lefty", "rightx", "righty")
TRIGGERS = ("lefttrigger", "righttrigger")
MOVED = 0.6
AT_REST = 0.3
REST_S = 0.3
HELD_S = 0.1


@dataclass(frozen=True, slots=True)
class Moved:
    """What answers: ``a3`` and the way it went, ``b7``, ``h0.4``."""

    source: str
    change: float = 0.0
    rest: float = 0.0


class Wizard:
    """Call `look` with what the pad says, again and again, until `done`.

    Attributes
    ----------
    controls
        Control → SDL's name of what answers it, such as ``leftx`` → ``a0``.
    note
        What was wrong with the last answer.
    """

    def __init__(self) -> None:
        self.controls: dict[str, str] = {}
        self.note = ""
        self._at = 0
        self._rest: RawState | None = None
        self._resting = False
        self._seen: RawState | None = None
        self._since_s = 0.0
        self._moved: Moved | None = None

    @property
    def done(self) -> bool:
        """Whether all has been asked."""
        return self._at >= len(CONTROLS)

    @property
    def asking(self) -> bool:
        """Whether it waits for a control, not for the pad to come to rest."""
        return self._resting and not self.done

    @property
    def prompt(self) -> str:
        """What to do now."""
        if self.done:
            return "done"
        return CONTROLS[self._at][1] if self.asking else "let everything go"

    @property
    def missing(self) -> tuple[str, ...]:
        """What the default bindings need and was skipped."""
        return tuple(each for each in NEEDED if each not in self.controls)

    def skip(self) -> None:
        """Leave this control out: the pad has none."""
        if not self.done:
            self._next()

    def look(self, now_s: float, raw: RawState) -> None:
        """Take in what the pad says at `now_s`."""
        if self.done:
            return
        if not self._resting:
            self._wait_for_rest(now_s, raw)
            return
        moved = self._what_moved(raw)
        same = moved is not None and self._moved is not None and moved.source == self._moved.source
        if moved is None or not same:
            self._since_s = now_s
        elif now_s - self._since_s >= HELD_S:
            self._answer(moved)
            return
        self._moved = moved

    def _wait_for_rest(self, now_s: float, raw: RawState) -> None:
        quiet = not raw.buttons and not any(raw.hats)
        if self._rest is not None:
            quiet = quiet and self._what_moved(raw, AT_REST) is None
        elif self._seen is not None:  # no rest is known yet: whatever stays where it is
            quiet = quiet and all(abs(a - b) < AT_REST for a, b in zip(raw.axes, self._seen.axes, strict=False))
        if not quiet or self._seen is None:
            self._seen, self._since_s = raw, now_s
        elif now_s - self._since_s >= REST_S:
            self._rest = self._rest or raw
            self._resting, self._moved = True, None

    def _what_moved(self, raw: RawState, least: float = MOVED) -> Moved | None:
        if raw.buttons:
            return Moved(f"b{min(raw.buttons)}")
        for number, hat in enumerate(raw.hats):
            if hat in (1, 2, 4, 8):
                return Moved(f"h{number}.{hat}")
        rest = self._rest.axes if self._rest is not None else ()
        changes = [(abs(now - before), axis) for axis, (now, before) in enumerate(zip(raw.axes, rest, strict=False))]
        far, axis = max(changes, default=(0.0, 0))
        return Moved(f"a{axis}", raw.axes[axis] - rest[axis], rest[axis]) if far > least else None

    def _answer(self, moved: Moved) -> None:
        control = CONTROLS[self._at][0]
        source = _sdl_source(control, moved)
        taken = {_whole(each): name for name, each in self.controls.items() if _overlap(each, source)}
        self._resting, self._seen = False, None
        if control in STICKS and not moved.source.startswith("a"):
            self.note = f"{moved.source} is not a stick's axis; Enter skips"
        elif taken:
            self.note = f"{moved.source} is {next(iter(taken.values()))} already; Enter skips"
        else:
            self.controls[control] = source
            self._next()

    def _next(self) -> None:
        self._at += 1
        self.note = ""
        self._resting, self._seen = False, None


def _sdl_source(control: str, moved: Moved) -> str:
    """Return SDL's name of what moved: whole axes for sticks, half ones for a button or a trigger that rests midway."""
    if not moved.source.startswith("a"):
        return moved.source
    if control in STICKS or (control in TRIGGERS and abs(moved.rest) > AT_REST):
        return moved.source if moved.change > 0 else f"{moved.source}~"
    return f"+{moved.source}" if moved.change > 0 else f"-{moved.source}"


def _whole(source: str) -> str:
    return source.strip("+-~")


def _overlap(one: str, other: str) -> bool:
    """Return whether two sources are the same, or one is half of the other."""
    halves = one[0] in "+-" and other[0] in "+-"
    return one == other if halves else _whole(one) == _whole(other)
