"""Maps pads that SDL does not know: the wizard that asks for each control, and the lines that SDL reads.

A line is ``guid,name,a:b0,leftx:a0,…,platform:Linux,``; the user's file of such lines is read at each start.
"""

from __future__ import annotations

import re
from collections.abc import Mapping as Table
from dataclasses import dataclass
from pathlib import Path

from fullswarm.errors import ConfigError
from fullswarm.files import replace_file
from fullswarm.operator.joystick.state import AXES, BUTTONS, RawState

FILE = "gamecontrollerdb.txt"
_GUID = re.compile(r"[0-9a-fA-F]{32}\Z|xinput\Z")
_TARGETS = frozenset((*AXES, *BUTTONS))
_SOURCE = re.compile(r"[+-]?a\d{1,3}~?\Z|b\d{1,3}\Z|h\d{1,2}\.[1248]\Z")
_LONGEST = 4096

CONTROLS = (
    ("leftx", "push the left stick to the right"),
    ("lefty", "pull the left stick towards you"),
    ("rightx", "push the right stick to the right"),
    ("righty", "pull the right stick towards you"),
    ("leftshoulder", "press the upper left shoulder button (LB): the default dead-man"),
    ("rightshoulder", "press the upper right shoulder button (RB)"),
    ("lefttrigger", "pull the left trigger all the way"),
    ("righttrigger", "pull the right trigger all the way"),
    ("a", "press the lowest of the four buttons on the right (A)"),
    ("b", "press the right one of them (B): the default e-stop"),
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
class Mapping:
    """One line: the axis, button or hat of each control of a model of pads."""

    text: str
    guid: str
    name: str
    controls: Table[str, str]  # "leftx" → "a0", "dpup" → "h0.1"
    platform: str = ""  # empty: any


def user_file() -> Path:
    """Return the path of the user's own mappings."""
    import platformdirs

    return Path(platformdirs.user_config_dir("fullswarm")) / FILE


def build(guid: str, name: str, controls: Table[str, str], platform: str) -> Mapping:
    """Return the mapping for a pad; commas in its name become spaces, since they separate the fields."""
    plain = " ".join(re.sub(r"[,\x00-\x1f]", " ", name).split()) or "pad"
    fields = [guid, plain, *(f"{target}:{source}" for target, source in controls.items()), f"platform:{platform}"]
    return Mapping(",".join(fields) + ",", guid, plain, dict(controls), platform)


def parse(line: str) -> Mapping:
    """Read one line.

    Raises
    ------
    ValueError
        It is malformed; says how.
    """
    if len(line) > _LONGEST:
        raise ValueError(f"is longer than {_LONGEST} characters")
    fields = [field.strip() for field in line.split(",")]
    if len(fields) < 3 or not _GUID.match(fields[0]):
        raise ValueError("does not begin with 32 hexadecimal digits, a comma and a name")
    controls, platform = dict[str, str](), ""
    for field in filter(None, fields[2:]):
        target, colon, source = field.partition(":")
        if not colon or not source:
            raise ValueError(f"'{field}' is not control:source")
        if target == "platform":
            platform = source
        elif target.lstrip("+-") in _TARGETS:
            if not _SOURCE.match(source):
                raise ValueError(f"'{source}' is not an axis, button or hat; expected a0, b3 or h0.1")
            controls[target] = source
    return Mapping(line.strip(), fields[0], fields[1], controls, platform)


def read_file(path: Path) -> list[Mapping]:
    """Return the mappings of a file; none when there is no such file.

    Raises
    ------
    ConfigError
        All lines that are wrong, each with its number.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError:
        return []
    except UnicodeDecodeError as error:
        raise ConfigError(f"is not UTF-8 text (byte {error.start})", where=str(path)) from None
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", where=str(path)) from None
    found, wrong = [], []
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            found.append(parse(line))
        except ValueError as error:
            wrong.append(f"{path}:{number}: {error}")
    if wrong:
        raise ConfigError("\n".join(wrong))
    return found


def write_file(path: Path, made: Mapping) -> None:
    """Write a mapping to a file, in place of an older one for the same pad and platform.

    Raises
    ------
    ConfigError
        The file cannot be written.
    """
    try:
        before = path.read_text(encoding="utf-8-sig").splitlines() if path.exists() else []
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = [*(line for line in before if not _same_pad(line, made)), made.text]
        replace_file(path, "".join(f"{line}\n" for line in lines), mode=0o600)
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", where=str(path)) from None


def _same_pad(line: str, made: Mapping) -> bool:
    try:
        other = parse(line)
    except ValueError:
        return False
    return (other.guid.lower(), other.platform) == (made.guid.lower(), made.platform)


# ---------------------------------------------------------------- the wizard
@dataclass(frozen=True, slots=True)
class Moved:
    """The input that was moved: ``a3`` and its direction, ``b7``, ``h0.4``."""

    source: str
    change: float = 0.0
    rest: float = 0.0


class Wizard:
    """Asks for each control in turn and notes which axis, button or hat moves. Call `update` repeatedly until `done`.

    Attributes
    ----------
    controls
        Control → SDL's name of the input that was moved, such as ``leftx`` → ``a0``.
    note
        The error of the last answer.
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
        """Whether all controls have been asked for."""
        return self._at >= len(CONTROLS)

    @property
    def asking(self) -> bool:
        """Whether it waits for a control, not for the pad to be released."""
        return self._resting and not self.done

    @property
    def prompt(self) -> str:
        """The instruction to the user."""
        if self.done:
            return "done"
        return CONTROLS[self._at][1] if self.asking else "release all controls"

    @property
    def missing(self) -> tuple[str, ...]:
        """Controls that the default bindings need and that were skipped."""
        return tuple(each for each in NEEDED if each not in self.controls)

    def skip(self) -> None:
        """Skip this control: the pad has none."""
        if not self.done:
            self._next()

    def update(self, now_s: float, raw: RawState) -> None:
        """Process the pad's inputs at `now_s`."""
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
        elif self._seen is not None:  # no rest position is known yet: any constant one
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
