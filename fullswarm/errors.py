"""The error tree. Every message states what happened, where, and what to do.

::

    FullswarmError
    ├── ConfigError          a file or an option is wrong                        exit 2
    │   └── RequestRefused   the core refused a request, with its reason         exit 2
    ├── Unreachable          no answer from the hub, the core or a robot         exit 3
    ├── TimedOut             something has not happened in time, also a TimeoutError    exit 1
    ├── MessageError         bytes that are not one of our messages
    ├── DriverError          a robot's link or firmware                          exit 3
    │   ├── LinkLost         the other end went silent or the port vanished
    │   └── DriverFault      the robot itself reports a fault
    ├── BehaviourFailed      a control law raised an error or returned no velocities
    ├── MissingExtra         an optional package is not installed                exit 2
    └── SafetyStop           motion was ended to stay safe                       exit 4
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping


class FullswarmError(Exception):
    """Root of everything this package raises on purpose.

    Parameters
    ----------
    what
        What happened, in one sentence.
    where
        File and key, port, robot or address; empty when there is none.
    hint
        What the reader can do about it.
    code, parameters
        A :class:`~fullswarm.reasons.Code` and what it is about, where a program decides by them.
    """

    exit_code = 1

    def __init__(
        self, what: str, *, where: str = "", hint: str = "", code: str = "", parameters: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(what)
        self.what, self.where, self.hint = what, where, hint
        self.code, self.parameters = code, dict(parameters or {})

    def __str__(self) -> str:
        """One line: ``where: what (hint)``."""
        text = f"{self.where}: {self.what}" if self.where else self.what
        return f"{text} ({self.hint})" if self.hint else text


class ConfigError(FullswarmError):
    """A file, a key or an option is wrong."""

    exit_code = 2


class RequestRefused(ConfigError):
    """The core refused a request; ``what`` is its reason."""


class Unreachable(FullswarmError):
    """No answer: from hub, core or robot."""

    exit_code = 3


class TimedOut(FullswarmError, TimeoutError):
    """What was waited for has not happened in time. It may happen later."""


class MessageError(FullswarmError):
    """Bytes on the bus that are not a message of this version."""


class DriverError(FullswarmError):
    """A robot's link or firmware failed."""

    exit_code = 3


class LinkLost(DriverError):
    """The other end went silent or the port vanished."""


class DriverFault(DriverError):
    """The robot itself reports a fault."""


class BehaviourFailed(FullswarmError):
    """A control law raised an error, or returned something else than velocities; its robots are stopped."""


class MissingExtra(FullswarmError):
    """An optional package is not installed."""

    exit_code = 2


class SafetyStop(FullswarmError):
    """Motion was ended to stay safe."""

    exit_code = 4


MOST_LISTED = 16
"""Names that a message lists in full."""


def nearest(word: str, known: Iterable[str]) -> str:
    """Return which of `known` may be meant; empty when nothing is near."""
    return next(iter(difflib.get_close_matches(word, sorted(known), n=1, cutoff=0.6)), "")


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """``did you mean 'x'?`` for the nearest of `known`; when nothing is near the whole choice, of many the nearest."""
    choices = sorted(known)
    near = nearest(word, choices)
    if near:
        return f"did you mean '{near}'?"
    if len(choices) > MOST_LISTED:
        return f"the nearest of {len(choices)}: {', '.join(difflib.get_close_matches(word, choices, n=5, cutoff=0.0))}"
    return f"known: {', '.join(choices)}" if choices else "none is known yet"


_NESTED = re.compile(r"[?&][A-Za-z_]*=[A-Za-z+.]*://")


def without_login(url: str) -> str:
    """Return a URL for messages: user and password before an ``@`` are hidden, also in a URL among its options.

    Everything up to the last ``@`` is hidden, whatever characters a password has: nothing is parsed that may be wrong.
    """
    scheme, end = url.find("://"), url.rfind("@")
    if not 0 <= scheme < end:
        return url
    nested = _NESTED.search(url, scheme, end)
    return f"{url[: nested.end() if nested else scheme + 3]}***{url[end:]}"
