"""Names the first difference between what nodes did and what they do now."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from fullswarm.journal.feed import Event, Output
from fullswarm.journal.journal import Kind

LONGEST = 200


@dataclass(frozen=True, slots=True)
class Difference:
    """Where nodes first did something else.

    Attributes
    ----------
    event, time_s : number of the event in its journal, and the process's monotonic time
    during : what happened then
    what : what is different
    then, now : the value in the journal and the new one
    """

    event: int
    time_s: float
    during: str
    what: str
    then: str
    now: str


def difference(event: Event, outputs: list[Output], gone: str, robots: tuple[str, ...]) -> Difference | None:
    """Return the first difference between an event's outputs and the new ones; None: they are equal.

    Parameters
    ----------
    gone : what the event was for and is not there any more, see `Feed.run`
    robots : names of the rows of commands
    """
    if gone:
        return _found(event, f"{gone} is not there any more", "", "")
    for then, now in zip(event.outputs, outputs, strict=False):
        if then != now and repr(then) != repr(now):  # NaN is not equal to itself
            return _found(event, *_between(then, now, robots))
    if len(event.outputs) == len(outputs):
        return None
    shorter = min(len(event.outputs), len(outputs))
    if len(event.outputs) > shorter:
        return _found(event, f"{_title(event.outputs[shorter])} is missing", _text(event.outputs[shorter]), "nothing")
    return _found(event, f"{_title(outputs[shorter])} is new", "nothing", _text(outputs[shorter]))


def cause_of(event: Event) -> str:
    """Return what an event was."""
    kind, name = event.cause[0], str(event.cause[1])
    if kind == Kind.MESSAGE:
        return f"message {name}"
    return f"timer {name}" if kind == Kind.TIMER else f"call {name}"


def _found(event: Event, what: str, then: str, now: str) -> Difference:
    return Difference(event.number, event.time_s, cause_of(event), what, then, now)


def _between(then: Output, now: Output, robots: tuple[str, ...]) -> tuple[str, str, str]:
    if then[0] != now[0] or (then[0] != Kind.COMMAND and then[1] != now[1]):
        return f"{_title(then)} instead of which {_title(now)}", _text(then), _text(now)
    if then[0] == Kind.COMMAND:
        return _command(then, now, robots)
    if then[0] == Kind.PUBLISH:
        path, one, other = _first(_tree(then[2]), _tree(now[2]), "")
        if path:
            return f"{then[1]}: {path}", one, other
    return _title(then), _text(then), _text(now)


def _command(then: Output, now: Output, robots: tuple[str, ...]) -> tuple[str, str, str]:
    one, other = (np.frombuffer(each[1]).reshape(-1, 2) for each in (then, now))
    was, is_now = (np.frombuffer(each[2], np.bool_) for each in (then, now))
    for row, robot in enumerate(robots[: len(one)]):
        if row < len(other) and (was[row] != is_now[row] or one[row].tobytes() != other[row].tobytes()):
            return f"command of {robot}", _twist(one[row], was[row]), _twist(other[row], is_now[row])
    return "command", f"{len(one)} robots", f"{len(other)} robots"


def _twist(twist: Any, active: Any) -> str:
    return f"{float(twist[0])!r} m/s, {float(twist[1])!r} rad/s" + ("" if active else ", not driving")


def _title(output: Output) -> str:
    if output[0] == Kind.PUBLISH:
        return f"message {output[1]}"
    if output[0] == Kind.COMMAND:
        return "command"
    return f"error {output[1]}" if output[0] == Kind.RAISED else f"call {output[1]}"


def _text(output: Output) -> str:
    if output[0] == Kind.PUBLISH:
        return _short(_tree(output[2]))
    if output[0] == Kind.COMMAND:
        return _short(np.frombuffer(output[1]).reshape(-1, 2).tolist())
    return _short(output[2])


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= LONGEST else text[:LONGEST] + "…"


def _tree(data: bytes) -> Any:
    try:
        return msgspec.msgpack.decode(data)
    except msgspec.DecodeError:
        return data


def _first(then: Any, now: Any, path: str) -> tuple[str, str, str]:
    """Return path and values of the first part that differs; no path: none does."""
    if isinstance(then, dict) and isinstance(now, dict):
        for key in [*then, *(each for each in now if each not in then)]:
            found = _first(then.get(key), now.get(key), f"{path}.{key}" if path else str(key))
            if found[0]:
                return found
        return "", "", ""
    if isinstance(then, list) and isinstance(now, list) and len(then) == len(now):
        for number, (one, other) in enumerate(zip(then, now, strict=True)):
            found = _first(one, other, f"{path}[{number}]")
            if found[0]:
                return found
        return "", "", ""
    return ("", "", "") if repr(then) == repr(now) else (path or "value", _short(then), _short(now))
